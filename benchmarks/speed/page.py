"""Puts the table of a run into the documentation.

python -m benchmarks.speed.page out/bench docs/performance.md
"""

import argparse
import json
from pathlib import Path

from rf3dgs.core.files import write_whole


def page_table(run: dict) -> str:
    """The rows of a run as Markdown, with where and how they were measured."""
    floor = run["floor"]["all_threads"]
    lines = [
        f"{run['cpu']}, {run['instruction_set']}, {run['threads']} threads, commit {run['commit'][:12]}, "
        f"load average {run['load'][0]:.1f} to {run['load'][1]:.1f}; "
        f"{32 * floor['vectors'] / 1e9:.0f} GFLOP/s a thread, {floor['read'] / 1e9:.0f} GB/s read, "
        f"{floor['changed'] / 1e9:.0f} GB/s read and written.",
        "",
        "| 300x200 unless said | CPU ms | median | clock ms | floor | ratio | must / goal | |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in run["rows"]:
        timing = row["timing"]
        lines.append(
            f"| {row['label']} | {timing['cpu_min']:.2f} | {timing['cpu_median']:.2f} | {timing['wall_min']:.2f} | "
            f"{row['floor_ms']:.2f} | {row['ratio']:.1f} | {row['must']:.1f} / {row['goal']:.1f} | {row['verdict']} |"
        )
    reference = run["reference"]
    lines += [
        "",
        f"Frozen step against the reference backend, {reference['gaussians']} Gaussians, same picture of 60x40: "
        f"{reference['reference_small_ms']:.0f} ms against {reference['native_small_ms']:.1f} ms of CPU time, "
        f"{reference['measured']:.0f} times (must 80, goal 200). At 300x200, the reference extrapolated from two "
        f"smaller pictures: {reference['extrapolated']:.0f} times.",
    ]
    return "\n".join(lines)


def page_scaling(run: dict) -> str:
    """The sweeps, the busy neighbour and the memory of a run as Markdown."""
    kinds = list(run["gaussians"])
    lines = [f"| CPU ms | {' | '.join(kinds)} |", f"|---|{'---|' * len(kinds)}"]
    for name in ("gaussians", "pixels", "channels"):
        fits = [run[name][kind] for kind in kinds]
        for number, at in enumerate(point["at"] for point in fits[0]["points"]):
            costs = " | ".join(f"{fit['points'][number]['cpu_ms']:.2f}" for fit in fits)
            lines.append(f"| {at} {name} | {costs} |")
        distances = " | ".join(f"exponent {fit['exponent']:.2f}, within {100 * fit['worst']:.0f} %" for fit in fits)
        lines.append(f"| {name}: fit, distance from a line | {distances} |")
    for number, at in enumerate(point["at"] for point in run["threads"][kinds[0]]["points"]):
        clock = " | ".join(f"{run['threads'][kind]['points'][number]['wall_ms']:.2f}" for kind in kinds)
        lines.append(f"| {at} thread{'s' * (at > 1)}, ms of the clock | {clock} |")
    used = run["memory"]
    return "\n".join(
        [
            *lines,
            "",
            f"Beside a process that computes without end on one of the processors a step takes "
            f"{run['busy_neighbour']:.1f} times as long by the clock (at most 2.5 asked for). Training one channel "
            f"with frozen geometry, a Gaussian adds {used['per_gaussian']:.0f} bytes to the process, a view of 300x200 "
            f"{used['per_view'] / 1e6:.2f} MB. Load average at the end {run['load']:.1f}.",
        ]
    )


def between_marks(text: str, name: str, content: str) -> str:
    """`text` with what stands between the marks of `name` replaced."""
    begin = text.index("\n", text.index(f"<!-- {name}:")) + 1
    return text[:begin] + content + "\n" + text[text.index(f"<!-- end of {name} -->") :]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="the folder that make bench wrote")
    parser.add_argument("page", type=Path, help="the page that has the marks")
    options = parser.parse_args()
    text = options.page.read_text()
    for name, write in (("table", page_table), ("scaling", page_scaling)):
        text = between_marks(text, name, write(json.loads((options.run / f"{name}.json").read_text())))
    write_whole(options.page, text.encode())


if __name__ == "__main__":
    main()
