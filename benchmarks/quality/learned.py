"""Does a learned baseline learn? One view by heart, other positions better than a constant, and what it costs.

    python -m benchmarks.quality.learned --method nerf2-db --scale laptop --paths paper.paths

`--paths` is what `rf3dgs trace lobby --preset paper` wrote, split and pictured as in the figures; without it an exact
room with smooth walls is taken. The method is fitted twice: to one picture, and to four pictures (yaw 0, 90, 180, 270
degrees) at each of `--positions` places; the first `--held` of the held-out places judge. Writes NAME.json (all
figures) and NAME.png (both training curves, and a held-out picture beside its prediction).

Works with every method whose predictor has `history`: entries of iterations done, wall seconds, mean loss and, where it
has one, a held-out score. A method's file may have `published_cost(task)`, the cost at the published size, which is
extrapolated from what is measured here and called so.
"""

import argparse
import importlib
import io
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import torch

from benchmarks.quality.methods.method import Method, Scale, Task
from benchmarks.quality.protocol.figure import (
    SIZES,
    made_by,
    page_or_sentence,
    parser_of,
    study_of,
    write_json,
)
from benchmarks.quality.protocol.pictures import pinholes
from benchmarks.quality.protocol.study import say
from rf3dgs.channel.paths import Paths
from rf3dgs.core.errors import InputError, RfError
from rf3dgs.core.files import write_whole
from rf3dgs.core.frames import Pose
from rf3dgs.evaluation import metrics
from rf3dgs.evaluation.baselines.lookup import NearestNeighbour
from rf3dgs.evaluation.figures import STYLE
from rf3dgs.evaluation.pictures import coloured
from rf3dgs.evaluation.protocol import Predictor, refuse_leak
from rf3dgs.propagation.room import shoebox
from rf3dgs.spectra.codec import DbWindow, PerViewLinear, window_of
from rf3dgs.spectra.spectrum import Spectrum, stack_spectra

SUBJECTS = {"nerf2": "nerf2", "nerf2-db": "nerf2", "cgan": "cgan"}  # the file of each method
ROOM, TX = (6.0, 5.0, 3.0), (0.6, 0.8, 2.6)
BY_HEART_DB = 30.0


def method_of(name: str) -> tuple[Method, Any]:
    """The method and its file."""
    file = importlib.import_module(f"benchmarks.quality.methods.{SUBJECTS[name]}")
    return next(method for method in file.METHODS if method.name == name), file


def pictures(paths: Iterable[Paths], scale: Scale) -> Spectrum:
    """Ideal pinhole pictures `[4 n, row, col]` of the paths to n receivers, four at each."""
    seen = pinholes(*SIZES[scale].picture)
    return stack_spectra([seen.of(number, one) for number, one in enumerate(paths)])


def room_paths(count: int, seed: int) -> Iterator[Paths]:
    """All paths in an exact room to `count` receivers drawn by `seed`."""
    poses = Pose.scatter(((1.2, 0.3, 1.0), (5.7, 4.7, 2.0)), count, seed)
    paths = shoebox(ROOM, Pose(TX), poses, 60e9, order=3, reflection="concrete")
    return (paths[index] for index in range(count))


def data(wish: argparse.Namespace) -> tuple[Task, Spectrum]:
    """What is learned from, and the pictures that judge, at the wished numbers of places."""
    if min(wish.positions, wish.held) < 1:
        raise InputError(f"--positions and --held must be at least 1; got {wish.positions} and {wish.held}")
    if wish.paths is None:
        paths = list(room_paths(wish.positions + wish.held, wish.seed))
        train, judge = (pictures(part, wish.scale) for part in (paths[: wish.positions], paths[wish.positions :]))
        return Task(train, window_of(train), wish.seed, wish.scale), judge
    study = study_of(wish, "learned", holdouts=("random",))
    judge = study.truth("random").spectra
    there = len(judge) // study.data.views
    if wish.held > there:
        raise InputError(f"{there} places are held out and {wish.held} are asked; lower --held")
    return study.task(wish.positions, wish.seed, geometry=False), judge[: wish.held * study.data.views]


def scores(predictor: Predictor, truth: Spectrum, window: DbWindow) -> dict[str, float]:
    """Means over pictures: PSNR in the window and on the linear scale of each picture's peak [dB], RMSE [dB]."""
    answers = stack_spectra([predictor.render(pose, truth.grid) for pose in (truth.pose[i] for i in range(len(truth)))])
    weight, linear = metrics.pixel_weight(truth.grid), PerViewLinear()
    own = metrics.psnr(linear.encode(truth.power), linear.encode(answers.power), weight)
    return {
        "psnr_db": float(metrics.psnr(window.encode(truth.power), window.encode(answers.power), weight).mean()),
        "psnr_linear_db": float(own.mean()),
        "rmse_db": float(metrics.rmse_db(truth.power, answers.power, window, weight).mean()),
    }


class Constant:
    """The mean of all training pictures in the window, pixel by pixel, at every pose."""

    def __init__(self, train: Spectrum, window: DbWindow) -> None:
        self.train, self.power = train, window.decode(window.encode(train.power).mean(0))

    def render(self, pose: Pose, grid: Any) -> Spectrum:
        return Spectrum(self.power, grid, pose, self.train.frequency, self.train.instrument, "constant")


def fitted(method: Method, task: Task) -> tuple[Any, float, float]:
    """The predictor, and the wall and CPU seconds of its making."""
    wall, cpu = time.perf_counter(), time.process_time()
    predictor = method.made(task)
    return predictor, time.perf_counter() - wall, time.process_time() - cpu


def learned(name: str, task: Task, judge: Spectrum) -> tuple[dict, bytes]:
    """All figures of one method, and its picture as PNG bytes."""
    method, file = method_of(name)
    train, window = task.spectra, task.window
    refuse_leak(train.pose.position, judge.pose.position)
    alone = train[:1]
    one, *_ = fitted(method, replace(task, spectra=alone))
    many, wall, cpu = fitted(method, task)
    began = time.process_time()
    held_out = scores(many, judge, window)
    picture_cpu = (time.process_time() - began) / len(judge)
    cost = getattr(file, "published_cost", None)
    figures = {
        "method": name,
        "scale": task.scale,
        "places": [len(torch.unique(part.pose.position, dim=0)) for part in (train, judge)],
        "seed": task.seed,
        "settings": dict(method.settings(task)),
        "one_view": scores(one, alone, window),
        "held_out": {
            name: held_out,
            "constant": scores(Constant(train, window), judge, window),
            "nearest": scores(NearestNeighbour(train), judge, window),
        },
        "fit_wall_s": wall,
        "fit_cpu_s": cpu,
        "picture_cpu_s": picture_cpu,
        "history": {"one_view": list(one.history), "positions": list(many.history)},
        "published_cost": None if cost is None else cost(task),
    }
    shown = judge[int(window.encode(judge.power).mean((-2, -1)).argmax())]
    return figures, _drawn(figures, window, shown, many.render(shown.pose, shown.grid))


def _drawn(figures: dict, window: DbWindow, truth: Spectrum, answer: Spectrum) -> bytes:
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({**STYLE, "axes.grid": False}):
        figure = Figure(figsize=(10.5, 5.4), dpi=120, layout="constrained")
        grid = figure.add_gridspec(2, 2, width_ratios=(1.5, 1.0))
        axis = figure.add_subplot(grid[:, 0])
        for key, label, colour in (
            ("one_view", "one view", "#d9822b"),
            ("positions", f"{figures['places'][0]} places, 4 views each", "#0b6e99"),
        ):
            history = figures["history"][key]
            axis.semilogy([entry[0] for entry in history], [entry[2] for entry in history], color=colour, label=label)
        judged = [entry for entry in figures["history"]["positions"] if len(entry) > 3 and entry[3] is not None]
        if judged:
            beside = axis.twinx()
            beside.plot([entry[0] for entry in judged], [entry[3] for entry in judged], color="#8a5fb5", linestyle="--")
            beside.set_ylabel("held-out score (dashed)")
        axis.grid(visible=True, which="major", color="#e4e7eb")
        axis.set(xlabel="iterations", ylabel="training loss", title=f"{figures['method']} at scale {figures['scale']}")
        axis.legend()
        for row, (title, spectrum) in enumerate((("held-out picture", truth), ("predicted", answer))):
            panel = figure.add_subplot(grid[row, 1])
            panel.imshow(coloured(window.encode(spectrum.power).numpy()), interpolation="nearest")
            panel.set(title=title, xticks=[], yticks=[])
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png")
        return buffer.getvalue()


def lines_of(figures: dict) -> list[str]:
    """What the command prints."""
    one = max(figures["one_view"]["psnr_db"], figures["one_view"]["psnr_linear_db"])
    lines = [
        f"{figures['method']} at scale {figures['scale']}, {figures['places'][0]} + {figures['places'][1]} places",
        f"one view by heart: PSNR {figures['one_view']['psnr_db']:.2f} dB in the window, "
        f"{figures['one_view']['psnr_linear_db']:.2f} dB relative to the peak: "
        + ("learned" if one > BY_HEART_DB else f"NOT above {BY_HEART_DB:.0f} dB"),
    ]
    for name, values in figures["held_out"].items():
        lines.append(
            f"held out, {name}: PSNR {values['psnr_db']:.2f} dB in the window, {values['psnr_linear_db']:.2f} dB "
            f"relative to the peak, RMSE {values['rmse_db']:.2f} dB"
        )
    lines.append(f"fit {figures['fit_cpu_s']:.0f} CPU s, picture with scoring {figures['picture_cpu_s']:.3f} CPU s")
    cost = figures["published_cost"]
    if cost is not None:
        lines.append(
            f"published size, an extrapolation ({cost['measured_on']}; {cost['how']}): "
            f"fit {cost['fit_seconds'] / 3600:.1f} h, picture of 300x200 {cost['picture_seconds']:.1f} s"
        )
    return lines


def asked(words: Sequence[str] | None = None) -> argparse.Namespace:
    parser = parser_of(__doc__, "learned", without="an exact room")
    parser.add_argument("--method", nargs="+", choices=sorted(SUBJECTS), required=True, help="what is to learn")
    parser.add_argument("--positions", type=int, default=40, help="training places")
    parser.add_argument("--held", type=int, default=10, help="places that judge")
    parser.add_argument("--seed", type=int, default=0, help="of the places and of the method")
    return parser.parse_args(words)


def main(words: Sequence[str] | None = None) -> int:
    wish, parts = asked(words), []
    try:
        task, judge = data(wish)
        for name in wish.method:
            figures, picture = learned(name, task, judge)
            figures["data"] = "exact room" if wish.paths is None else wish.paths.name
            write_json(wish.out / f"{name}.json", figures)
            write_whole((wish.pictures or wish.out) / f"{name}.png", picture)
            parts.append("\n".join(lines_of(figures)))
    except RfError as error:
        say(f"learned: {error}")
        return 2
    text = "\n\n".join([*parts, made_by("learned", [wish.seed], words)])
    print(text)
    return page_or_sentence(wish.page, "learned", text)


if __name__ == "__main__":
    sys.exit(main())
