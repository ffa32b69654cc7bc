"""The pictures that the published recipe is tried on: four pinholes at each of some positions, made once and kept."""

import json
import math
import shutil
from pathlib import Path

import numpy as np

from benchmarks.quality.protocol.split import SplitConfig, split_of
from rf3dgs.channel.io import PathsReader
from rf3dgs.channel.paths import Paths
from rf3dgs.core.errors import InputError
from rf3dgs.core.grids import pinhole_grid
from rf3dgs.core.progress import Progress
from rf3dgs.data.dataset import Dataset
from rf3dgs.data.stream import stream_spectra
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.spectra.yaws import at_yaws

YAWS = tuple(math.radians(yaw) for yaw in (0.0, 90.0, 180.0, 270.0))
FOV_DEG = 90.0


class Chosen:
    """Some receivers of many, by their numbers."""

    def __init__(self, paths: PathsReader, numbers: list[int]) -> None:
        self.paths, self.numbers = paths, numbers

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, index: int, /) -> Paths:
        return self.paths[self.numbers[index]]


def pictures_of(
    paths: Path,
    folder: Path,
    *,
    positions: int,
    held: int,
    size: tuple[int, int],
    progress: Progress,
    parts: SplitConfig | None = None,
) -> tuple[Spectrum, Spectrum]:
    """Training and judging pictures `[4 positions, row, col]` of receivers in the folder `paths`, kept in `folder`.

    Which receivers: the first `positions` and `held` of a random order of the pool and of the validation part of
    `split_of`; sealed positions are not read. Raises InputError where `folder` holds other pictures.
    """
    with PathsReader(paths) as reader:
        split = split_of(reader.rx.position, parts)
        judged = split.part("validation", "random")
        if held > len(judged):
            raise InputError(f"{held} positions are to be judged and the validation part has {len(judged)}; ask fewer")
        judged = np.sort(np.random.default_rng((split.config.seed, 2)).permutation(judged)[:held])
        trained = split.training(positions, 0)
        numbers = [*trained.tolist(), *judged.tolist()]
        plan = {"receivers": numbers, "size": list(size), "fov_deg": FOV_DEG, "of": len(reader)}
        plan["where"] = reader.rx.position[numbers].tolist()
        if (folder / "dataset").is_dir():
            dataset = Dataset.load(folder / "dataset")
            if dataset.meta.get("plan") != json.loads(json.dumps(plan)):
                raise InputError(f"{folder} holds pictures made with other settings; remove it, or give another --out")
        else:
            dataset = _made(Chosen(reader, numbers), folder, plan, size, positions, progress)
    train, validation = dataset.train.spectra, dataset.validation.spectra
    assert train is not None
    assert validation is not None
    return train, validation


def _made(
    chosen: Chosen, folder: Path, plan: dict, size: tuple[int, int], positions: int, progress: Progress
) -> Dataset:
    grid = pinhole_grid(*size, fov_deg=FOV_DEG)

    def spectrum(_number: int, one: Paths) -> Spectrum:
        return spectrum_of(at_yaws(one, YAWS), None, grid)

    meta = {"generator": "benchmarks.quality.recipe", "seed": 0}
    spectra = stream_spectra(chosen, spectrum, folder / "parts", settings=plan, meta=meta, progress=progress)
    roles = ["train"] * 4 * positions + ["validation"] * (len(spectra) - 4 * positions)
    made = Dataset((), spectra, roles=roles, meta={"plan": plan}).save(folder / "dataset")
    shutil.rmtree(folder / "parts", ignore_errors=True)
    return made
