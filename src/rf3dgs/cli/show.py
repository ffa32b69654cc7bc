"""Writing to the terminal: the one place of the package that prints."""

import shutil
import sys
import textwrap
from collections.abc import Sequence

from rf3dgs.core.progress import Console


def out(text: str) -> None:
    """A line, or lines, to standard output."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def note(text: str) -> None:
    """A remark to standard error, so that standard output stays what a program may read."""
    sys.stderr.write(f"note: {text}\n")
    sys.stderr.flush()


def complain(text: str) -> None:
    """What went wrong, to standard error, in the program's name."""
    sys.stderr.write(f"rf3dgs: {text}\n")
    sys.stderr.flush()


def console() -> Console:
    """Progress on standard error: a bar on a terminal, plain lines elsewhere."""
    return Console()


def table(rows: Sequence[Sequence[str]], *, width: int | None = None) -> str:
    """Rows in aligned columns; the last column wraps within the terminal's width (80 when there is none)."""
    if not rows:
        return ""
    width = width or min(shutil.get_terminal_size((80, 24)).columns, 100)
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]) - 1)]
    indent = sum(widths) + 2 * len(widths)
    lines = []
    for row in rows:
        head = "".join(f"{cell:<{size}}  " for cell, size in zip(row, widths, strict=False))
        wrapped = textwrap.wrap(row[-1], max(width - indent, 20)) or [""]
        lines += [(head if number == 0 else " " * indent) + line for number, line in enumerate(wrapped)]
    return "\n".join(line.rstrip() for line in lines)
