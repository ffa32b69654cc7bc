"""Cells of a table: one method trained on one set of positions and judged by one hold-out, a JSON file each.

A cell holds every position's scores, what it cost, and what it was made from; one that is there and was made from the
same is never made again.
"""

import json
import math
import os
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.quality.methods.method import Method, Task
from benchmarks.quality.protocol.kept import keep_pictures, kept_beside
from benchmarks.quality.protocol.seen import seen
from benchmarks.quality.protocol.split import Draw
from rf3dgs.channel.arrays import planar_array
from rf3dgs.core.files import write_whole
from rf3dgs.evaluation import beams
from rf3dgs.evaluation.lpips import Lpips
from rf3dgs.evaluation.protocol import Predictor, refuse_leak, score
from rf3dgs.evaluation.provenance import processor, versions
from rf3dgs.field.radio_field import RadioField
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Spectrum, stack_spectra
from rf3dgs.training.checkpoint import fingerprint

SECOND = "second solve"
ARRAY = planar_array(8, 8, pattern="patch")
Values = dict[str, np.ndarray]


@dataclass(frozen=True)
class Key:
    """Which cell: `count` training positions drawn by `seed`; `geometry` is "none" for methods without; `trained` names
    the scene that the training spectra are of, which is `scene` unless things have moved."""

    scene: str
    preset: str
    geometry: str
    judge: str
    holdout: str
    count: int
    seed: int
    model: str
    trained: str
    draw: Draw = "uniform"

    def path(self, folder: Path) -> Path:
        """Where the cell is kept."""
        trained = "" if self.trained == self.scene else f"-after-{self.trained}"
        drawn, model = "" if self.draw == "uniform" else f"-{self.draw}", self.model.replace(" ", "-")
        name = f"{self.holdout}-{self.count:03d}-{self.seed}-{self.geometry}-{model}{trained}{drawn}.json"
        return folder / "cells" / self.judge / f"{self.scene}-{self.preset}" / name


@dataclass(frozen=True)
class Extra:
    """Scores of a figure's own, beside those of every figure."""

    name: str
    """Cells that have them are kept under this name."""
    of: Callable[[Spectrum, Spectrum, DbWindow], Mapping[str, Tensor]]
    """Columns `[n]` from a truth `[n, row, col]`, what was drawn and the window."""


@dataclass(frozen=True, eq=False)
class Truth:
    """What a hold-out is judged by: `spectra` `[n, row, col]`, their covariances, the window.

    views: pictures of a position, which follow each other. extra: more scores. keep: of the first so many pictures,
    what a predictor draws is kept beside the cell.
    """

    spectra: Spectrum
    covariance: Tensor
    window: DbWindow
    views: int = 1
    extra: Extra | None = None
    keep: int = 0

    @classmethod
    def of(
        cls, spectra: Spectrum, window: DbWindow, views: int = 1, *, extra: Extra | None = None, keep: int = 0
    ) -> "Truth":
        return cls(spectra, beams.panel_covariance(spectra, ARRAY), window, views, extra, keep)

    @property
    def digest(self) -> str:
        """What identifies the levels and the window."""
        window = torch.tensor([self.window.floor_db, self.window.ceil_db])
        return fingerprint((self.spectra.power, self.spectra.pose.position, window))

    def drawn(self, predictor: Predictor) -> Spectrum:
        """What a predictor shows of every pose `[n, row, col]`, a field as the truth's instrument would see it."""
        with torch.no_grad():
            return stack_spectra([seen(predictor, self.spectra[index]) for index in range(len(self.spectra))])

    def scored(self, drawn: Spectrum) -> Values:
        """Every picture's scores."""
        return self._scores(self.spectra, self.covariance, drawn)

    def _scores(self, truth: Spectrum, covariance: Tensor, drawn: Spectrum) -> Values:
        with torch.no_grad():
            values = score(truth, drawn, covariance, self.window, ARRAY, lpips_of_user())
            more = {} if self.extra is None else self.extra.of(truth, drawn, self.window)
        return values | {name: value.double().numpy() for name, value in more.items()}

    def second(self, repeat: Spectrum) -> Values:
        """Scores of the second solve `[m, row, col]` of some of the positions, NaN at the others."""
        apart = torch.cdist(repeat.pose.position.double(), self.spectra.pose.position.double())
        place = apart.argmin(1) + torch.arange(len(repeat)) % self.views
        found = self._scores(self.spectra[place], self.covariance[place], repeat)
        values = {}
        for name, value in found.items():
            values[name] = np.full(len(self.spectra), math.nan)
            values[name][place.numpy()] = value
        return values


@lru_cache(maxsize=1)
def lpips_of_user() -> Lpips | None:
    """LPIPS with the weights that RF3DGS_LPIPS names; None without."""
    return Lpips.from_environment()


def read_cell(path: Path, identity: Mapping[str, Any]) -> dict[str, Any] | None:
    """The cell in a file, None where there is none or it was made from something else."""
    try:
        cell = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    wanted = json.loads(json.dumps(identity))
    return cell if isinstance(cell, dict) and cell.get("identity") == wanted else None


def values_of(cell: Mapping[str, Any]) -> Values:
    """Scores by name `[position]`, NaN where one does not apply."""
    return {
        name: np.array([math.nan if value is None else value for value in row], dtype=np.float64)
        for name, row in cell["values"].items()
    }


def make_cells(
    keys: Sequence[Key],
    method: Method,
    task: Task,
    truths: Mapping[str, Truth],
    identity: Mapping[str, Any],
    folder: Path,
) -> None:
    """Train a method once and write the cells `keys`, which differ in the hold-out alone."""
    train = task.spectra
    for key in keys:
        refuse_leak(train.pose.position, truths[key.holdout].spectra.pose.position)
    load = os.getloadavg()[0]
    reset_peak()
    clock = _Clock()
    predictor = method.made(task)
    facts: dict[str, Any] = {"fit": clock.lap(), "peak_memory_bytes": peak_memory(), "load": load}
    if isinstance(predictor, RadioField):
        facts |= {"gaussians": len(predictor.solidity), "meta": dict(predictor.meta)}
    for key in keys:
        truth, clock = truths[key.holdout], _Clock()
        drawn = truth.drawn(predictor)
        rendering = clock.lap() | {"pictures": len(drawn)}
        values = truth.scored(drawn)
        if truth.keep:
            keep_pictures(kept_beside(key.path(folder)), drawn[: truth.keep])
        saw = {"trained": views_digest(train), "judged": views_digest(truth.spectra)}
        _write(key, values, identity, facts | {"rendering": rendering, "views": truth.views, "saw": saw}, folder)


def views_digest(spectra: Spectrum) -> str:
    """What identifies the poses and the grid of pictures: two methods with the same saw the same views."""
    return fingerprint((spectra.pose.position, spectra.pose.orientation, spectra.grid.directions))


def make_second(key: Key, truth: Truth, repeat: Spectrum, identity: Mapping[str, Any], folder: Path) -> None:
    """Write the cell of the second solve: the best that anything can be expected to reach."""
    facts = {"load": os.getloadavg()[0], "views": truth.views, "saw": {"judged": views_digest(truth.spectra)}}
    _write(key, truth.second(repeat), identity, facts, folder)


def _write(key: Key, values: Values, identity: Mapping[str, Any], facts: Mapping[str, Any], folder: Path) -> None:
    cell = {
        "key": asdict(key),
        "identity": identity,
        **facts,
        "made": {
            "when": datetime.now(UTC).isoformat(timespec="seconds"),
            "commit": commit(),
            "machine": machine(),
            "versions": versions(),
        },
        "values": {name: [None if math.isnan(v) else float(v) for v in row] for name, row in values.items()},
    }
    write_whole(key.path(folder), (json.dumps(cell, indent=1, allow_nan=False) + "\n").encode())


class _Clock:
    def __init__(self) -> None:
        self.wall, self.cpu = time.perf_counter(), time.process_time()

    def lap(self) -> dict[str, float]:
        return {"seconds": time.perf_counter() - self.wall, "cpu_seconds": time.process_time() - self.cpu}


def commit() -> str:
    """The commit of the source, with "+changes" where files differ from it; "unknown" outside a repository."""
    here = Path(__file__).parent

    def git(*words: str) -> str:
        found = subprocess.run(["git", *words], cwd=here, capture_output=True, text=True, check=False)
        return found.stdout.strip() if found.returncode == 0 else ""

    name = git("rev-parse", "--short=12", "HEAD")
    return (name + ("+changes" if git("status", "--porcelain", "-uno") else "")) if name else "unknown"


def machine() -> str:
    """The processor and its cores, and the GPU where there is one."""
    gpu = f", {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ""
    return f"{processor()}, {os.cpu_count()} cores{gpu}"


def reset_peak() -> None:
    """Let the system count this process's peak memory from now on, where it can (Linux)."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return


def peak_memory() -> int | None:
    """Peak resident memory [byte] since `reset_peak`; None where the system does not tell."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    peaks = [int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM")]
    return peaks[0] if peaks else None
