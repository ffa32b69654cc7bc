"""What the figures have in common: their options, the study at a scale, and how they say what made them."""

import argparse
import json
import shlex
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from benchmarks.quality.methods.method import SCALES, Scale
from benchmarks.quality.protocol.cells import Extra, commit, machine
from benchmarks.quality.protocol.pictures import Pictures, pinholes
from benchmarks.quality.protocol.split import SplitConfig
from benchmarks.quality.protocol.study import Study, StudyConfig, say
from rf3dgs.core.errors import InputError, RfError
from rf3dgs.core.files import write_whole
from rf3dgs.spectra.config import Method as SpectrumMethod

SCENE, PRESET = "lobby", "diffuse"


@dataclass(frozen=True)
class Size:
    """How large a figure's study is."""

    picture: tuple[int, int]
    """Columns and rows of the four pinhole pictures of a position."""
    receivers: int
    """Positions of the protocol with regions."""
    split: SplitConfig
    judged: int | None
    """Of each hold-out the first so many positions; None: all."""
    of_paper: int
    """Positions of the paper's protocol."""
    rays: int | None = None
    """None: as `rf3dgs trace`."""
    mesh_count: int = 100_000
    geometry: str = "photos"
    """Unless another is given."""


SIZES: Mapping[Scale, Size] = {
    "smoke": Size((24, 16), 40, SplitConfig(6, 6, 4, 4), None, 40, rays=20_000, mesh_count=2_000, geometry="mesh"),
    "laptop": Size((75, 50), 480, SplitConfig(100, 100, 40, 40), 40, 800),
    "paper": Size((300, 200), 480, SplitConfig(100, 100, 40, 40), None, 800),
}


def parser_of(doc: str | None, name: str, *, without: str = "traced") -> argparse.ArgumentParser:
    """The options that every figure has; figures that share a folder share data and cells.

    without: what comes in place of --paths.
    """
    how, prog = argparse.RawDescriptionHelpFormatter, f"python -m benchmarks.quality.{name}"
    parser = argparse.ArgumentParser(prog, description=doc, formatter_class=how)
    paths = f"what rf3dgs trace lobby --preset paper wrote; {without} when missing"
    parser.add_argument("--scale", choices=SCALES, default="laptop", help="minutes, hours on two cores, or a GPU")
    parser.add_argument("--out", type=Path, default=Path("out/figures"), help="data, cells and results; kept")
    parser.add_argument("--paths", type=Path, help=paths)
    parser.add_argument("--geometry", help="photos, mesh, or a .ply file; photos unless at smoke")
    parser.add_argument("--read-test", action="store_true", help="judge by the sealed positions; logged")
    parser.add_argument("--page", type=Path, help="put the tables into this page, between its marks")
    parser.add_argument("--pictures", type=Path, help="write pictures here instead of --out")
    return parser


def study_of(
    wish: argparse.Namespace,
    name: str,
    *,
    split: Literal["own", "paper"] = "own",
    method: SpectrumMethod = "ideal",
    pictures: Pictures | None = None,
    holdouts: Sequence[str] = ("random", "region"),
    extra: Extra | None = None,
    keep: int = 0,
) -> Study:
    """The study of the lobby at the asked scale, seen by four pinholes a position unless `pictures` says otherwise.

    split "paper" is judged by its test alone, which needs `--read-test`. Each split and method has a folder of its own,
    which figures share where they share `--out`. extra and keep: as in `StudyConfig`.
    """
    size = SIZES[wish.scale]
    if split == "paper" and not wish.read_test:
        raise InputError("the paper's protocol keeps nothing for validation, so that only --read-test can judge it")
    seen = pictures or pinholes(*size.picture, method)
    return Study(
        StudyConfig(
            SCENE,
            PRESET,
            wish.out / f"{wish.scale}-{split}-{seen.method}",
            judge="test" if wish.read_test else "validation",
            holdouts=("random",) if split == "paper" else tuple(holdouts),
            judged=size.judged,
            split="paper" if split == "paper" else size.split,
            receivers=size.of_paper if split == "paper" else size.receivers,
            rays=size.rays,
            pictures=seen,
            geometry=wish.geometry or size.geometry,
            geometry_folder=wish.out / "geometry",
            mesh_count=size.mesh_count,
            scale=wish.scale,
            paths={} if wish.paths is None else {PRESET: wish.paths},
            reason=lambda: f"benchmarks.quality.{name} at {commit()}, scale {wish.scale}",
            extra=extra,
            keep=keep,
        )
    )


def command_of(name: str, words: Sequence[str] | None = None) -> str:
    """The command line as a page may show it: of a file its name alone, and without where results go."""
    given = list(sys.argv[1:] if words is None else words)
    for option in ("--out", "--page", "--pictures"):
        if option in given:
            place = given.index(option)
            del given[place : place + 2]
    given = [Path(word).name if "/" in word else word for word in given]
    return shlex.join(["python", "-m", f"benchmarks.quality.{name}", *given])


def made_by(name: str, seeds: Sequence[int], words: Sequence[str] | None = None, **more: Any) -> str:
    """The sentence under a table: command, seeds, machine, commit."""
    rest = "".join(f", {key} {value}" for key, value in more.items())
    drawn = ", ".join(map(str, seeds))
    return f"Made by `{command_of(name, words)}`, seeds {drawn}, on {machine()}{rest}; commit {commit()}."


def cpu_hours(facts: Iterable[Mapping[str, Any]]) -> str:
    """What fits and renderings took together on one core, of the facts of cells; a fit that two cells share once."""
    fits, drawn = {}, 0.0
    for fact in facts:
        fits[tuple(value for name, value in fact["key"].items() if name != "holdout")] = fact["fit"]["cpu_seconds"]
        drawn += fact["rendering"]["cpu_seconds"]
    return f"{(sum(fits.values()) + drawn) / 3600:.2f}"


def write_json(path: Path, numbers: Mapping[str, Any]) -> None:
    write_whole(path, (json.dumps(numbers, indent=1, default=float) + "\n").encode())


def put_into(page: Path, name: str, text: str) -> None:
    """Replace what stands between `<!-- name -->` and `<!-- end of name -->` in a page."""
    found = page.read_text(encoding="utf-8")
    head, mark, rest = found.partition(f"<!-- {name} -->\n")
    _, end, tail = rest.partition(f"<!-- end of {name} -->")
    if not (mark and end):
        raise InputError(
            f"{page} has no marks <!-- {name} --> and <!-- end of {name} -->; add them where tables belong"
        )
    write_whole(page, f"{head}{mark}\n{text}\n\n{end}{tail}".encode())


def told(name: str, run: Callable[[], int]) -> int:
    """The exit status of a run; what it refuses, or cannot read or write, is told in one sentence."""
    try:
        return run()
    except (OSError, RfError) as error:
        say(f"{name}: {error}")
        return 2


def page_or_sentence(page: Path | None, name: str, text: str) -> int:
    """Put a figure's text into a page where one is named; the exit status."""

    def put() -> int:
        if page is not None:
            put_into(page, name, text)
        return 0

    return told(name, put)


def rows_of(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
