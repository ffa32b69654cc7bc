"""The data of the table: paths, spectra, splits and geometry, made once and found again."""

import hashlib
import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.quality.protocol.pictures import SPHERE, Pictures
from benchmarks.quality.protocol.scenes import BEFORE, Setting, paths_of
from benchmarks.quality.protocol.split import HOLDOUTS, PARTS, Draw, Split, SplitConfig, paper_split, split_of
from rf3dgs.channel.io import PathsReader
from rf3dgs.channel.paths import Paths
from rf3dgs.cli.chain import REPEAT_RAYS, REPEAT_SEED
from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.files import write_whole
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import view_of
from rf3dgs.core.progress import Console, Progress
from rf3dgs.data.dataset import Dataset
from rf3dgs.data.stream import stream_spectra
from rf3dgs.field.lit import BLENDING
from rf3dgs.propagation.config import TraceConfig
from rf3dgs.spectra.codec import DbWindow, window_of
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.ply import read_ply, write_ply
from rf3dgs.splats.rasterize import rasterize
from rf3dgs.splats.surface import sample_faces, sample_mesh
from rf3dgs.training.checkpoint import fingerprint
from rf3dgs.training.lit_views import LEAST_WEIGHT

RANGE_DB = 80.0  # between the window's ends
FIRST = "first.paths"
EYES = 100  # receivers that say what of a large site matters


@dataclass(frozen=True, eq=False)
class Data:
    """A scene under a preset: `dataset` with the sealed test, the `split` of positions, and a `digest` of both.

    views: pictures of a position, which follow each other in the dataset.
    """

    setting: Setting
    dataset: Dataset
    split: Split
    digest: str
    views: int = 1

    @property
    def positions(self) -> Tensor:
        """All positions `[position, 3]` [m]; each has `views` pictures."""
        return self.dataset.pose.position[:: self.views]

    def training(self, count: int, seed: int, draw: Draw = "uniform") -> Spectrum:
        """The pictures `[at most count x views, row, col]` of the training positions that show anything."""
        pool = self.dataset.train
        assert pool.spectra is not None
        chosen = self.split.training(count, seed, draw, self.positions[:, :2].double().numpy())
        ours = torch.isin(pool.index // self.views, torch.from_numpy(chosen))
        return pool.spectra[ours & (pool.spectra.power.amax((-2, -1)) > 0)]

    def window(self) -> DbWindow:
        """The dB window of every score: that of the whole pool, so that it depends on neither model nor cell."""
        pool = self.dataset.train.spectra
        assert pool is not None
        return window_for(pool)

    def judged(self, judge: str, holdout: str, reason: str, most: int | None = None) -> Spectrum:
        """The truth `[n x views, row, col]` of a hold-out; a sealed one is logged with the reason.

        most: of so many positions, the first ones; None of all.
        """
        found = spectra_at(self.dataset, judge, holdout, reason, self.places(judge, holdout)[:most])
        assert found is not None
        return found

    def places(self, judge: str, holdout: str) -> Tensor:
        """The positions `[n, 3]` [m] of a hold-out."""
        return self.positions[torch.from_numpy(self.split.part(judge, holdout))]


def window_for(spectra: Spectrum) -> DbWindow:
    """The dB window of spectra, in which levels more than 80 dB below the strongest count as the floor.

    Where surfaces scatter in narrow lobes a traced spectrum has directions that no path reaches, and what lies between
    those and a weak path is not a level that an instrument could tell.
    """
    found = window_of(spectra)
    return DbWindow(max(found.floor_db, found.ceil_db - RANGE_DB), found.ceil_db)


def data_of(
    setting: Setting,
    folder: Path,
    config: SplitConfig | None,
    *,
    receivers: int,
    paths: Path | None = None,
    pictures: Pictures = SPHERE,
    rays: int | None = None,
    progress: Progress | None = None,
) -> Data:
    """The spectra of a setting in `folder`, traced and made where they are not there yet.

    config: how positions are split; None as in the paper. receivers: the first so many. paths: a folder of `rf3dgs
    trace` to take them from; otherwise `rays` are traced. pictures: what is seen at each. Raises InputError where the
    folder holds other data.
    """
    progress = Console() if progress is None else progress
    split_plan = "paper" if config is None else asdict(config)
    plan = {"setting": asdict(setting), "split": split_plan, "receivers": receivers, "pictures": asdict(pictures)}
    plan |= {"rays": rays} if paths is None else {}

    def traced() -> Path:
        how = TraceConfig() if rays is None else TraceConfig(rays=rays)
        first = folder / FIRST
        return paths or paths_of(setting, first, setting.receivers(receivers), how, progress)

    def splitting(positions: Tensor) -> Split:
        return paper_split(positions) if config is None else split_of(positions, config)

    def roles_of(positions: Tensor) -> tuple[str, ...]:
        return splitting(positions).roles

    dataset = _dataset(folder / "dataset", plan, traced, receivers, roles_of, pictures, progress)
    split = splitting(dataset.pose.position[:: pictures.views])
    if tuple(np.repeat(split.roles, pictures.views)) != dataset.roles:
        raise DataError(f"{folder}: the roles of the dataset are not those of the split; remove the folder")
    digest = hashlib.sha256((folder / "dataset" / "spectra.h5").read_bytes() + json.dumps(split.names).encode())
    return Data(setting, dataset, split, digest.hexdigest(), pictures.views)


def second_solve(
    data: Data,
    folder: Path,
    judge: str,
    count: int,
    *,
    pictures: Pictures = SPHERE,
    rays: int | None = None,
    progress: Progress | None = None,
) -> Dataset:
    """The first `count` positions of each hold-out traced again with another seed and number of rays, in `folder`."""
    progress = Console() if progress is None else progress
    index = np.sort(np.concatenate([data.split.part(judge, holdout)[:count] for holdout in HOLDOUTS])).tolist()
    views = data.views
    config = TraceConfig(seed=REPEAT_SEED, rays=round((rays or TraceConfig().rays) * REPEAT_RAYS))
    plan = {"of": data.digest, "judge": judge, "count": count, "trace": asdict(config)}

    def traced() -> Path:
        rx = data.dataset.pose[views * torch.tensor(index)]
        return paths_of(data.setting, folder / f"second-{judge}.paths", rx, config, progress)

    def roles_of(positions: Tensor) -> tuple[str, ...]:
        return tuple(data.dataset.roles[views * place] for place in index)

    return _dataset(folder / f"second-{judge}", plan, traced, len(index), roles_of, pictures, progress)


def _dataset(
    folder: Path,
    plan: Mapping[str, Any],
    paths: Callable[[], Path],
    count: int,
    roles_of: Callable[[Tensor], tuple[str, ...]],
    pictures: Pictures,
    progress: Progress,
) -> Dataset:
    """The dataset in `folder`, made of the first `count` receivers of the paths that `paths` finds or traces."""
    wanted, file = json.loads(json.dumps(plan)), folder.with_name(f"{folder.name}.plan.json")
    if folder.is_dir():
        held = json.loads(file.read_text(encoding="utf-8")) if file.exists() else None
        if held != wanted:
            raise InputError(f"{folder} holds data made with other settings; remove it, or give another --out")
        return Dataset.load(folder)
    parts = folder.with_name(f"{folder.name}.parts")
    spectra = _spectra(paths(), parts, count, pictures, progress)
    write_whole(file, (json.dumps(wanted, indent=1) + "\n").encode())
    roles = np.repeat(roles_of(spectra.pose.position[:: pictures.views]), pictures.views).tolist()
    made = Dataset((), spectra, roles=roles, meta={"plan": wanted}).save(folder)
    shutil.rmtree(parts, ignore_errors=True)
    return made


def spectra_at(dataset: Dataset, judge: str, holdout: str, reason: str, wanted: Tensor) -> Spectrum | None:
    """The spectra at the positions `wanted` `[n, 3]`, in the dataset's order; None where there are none."""
    name = PARTS[judge, holdout]
    part = dataset.open_test(reason, name) if judge == "test" else dataset.validation
    if part.spectra is None or not len(part.spectra):
        return None
    apart = torch.cdist(part.spectra.pose.position.double(), wanted.double()).amin(1)
    return part.spectra[apart < 1e-3] if bool((apart < 1e-3).any()) else None


class _First:
    """The first `count` receivers of many."""

    def __init__(self, paths: PathsReader, count: int) -> None:
        if len(paths) < count:
            raise InputError(f"{count} receivers were asked for and the paths have {len(paths)}; trace more")
        self.paths, self.count = paths, count

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int, /) -> Paths:
        return self.paths[index]


def _spectra(paths: Path, folder: Path, count: int, pictures: Pictures, progress: Progress) -> Spectrum:
    with PathsReader(paths) as reader:
        first = _First(reader, count)
        meta = {"generator": "benchmarks.quality.protocol", "seed": 0}
        settings = asdict(pictures)
        return stream_spectra(first, pictures.of, folder, settings=settings, meta=meta, progress=progress)


def geometry_of(
    kind: str, setting: Setting, folder: Path, *, count: int, seed: int = 0, progress: Progress | None = None
) -> Gaussians:
    """Gaussians of the scene: "photos" by the demo's visual stage on the shipped photographs with a `seed`, "mesh" on
    its surfaces, so many and the same for every seed.

    Made once and kept in `folder`. Where things have moved the geometry shows them as they were before. Any other
    `kind` is a .ply file.
    """
    if kind not in ("photos", "mesh"):
        return read_ply(Path(kind))
    path = folder / (f"{kind}-{seed}.ply" if kind == "photos" else f"{kind}-{count}.ply")
    if not path.exists():
        made = _from_photographs(setting, seed, progress) if kind == "photos" else _from_mesh(setting, count)
        folder.mkdir(parents=True, exist_ok=True)
        write_ply(path, made)
    return read_ply(path)


def _from_photographs(setting: Setting, seed: int, progress: Progress | None) -> Gaussians:
    from rf3dgs.cli.demo import Demo
    from rf3dgs.cli.facts import open_dataset
    from rf3dgs.training.visual import fit_geometry

    if setting.photographs != "lobby":
        raise InputError(f"nobody photographed the scene {setting.name!r}; use --geometry mesh")
    return fit_geometry(open_dataset("lobby").train.photos, replace(Demo().visual, seed=seed), progress=progress)


def _from_mesh(setting: Setting, count: int) -> Gaussians:
    scene, around = Setting(BEFORE.get(setting.name, setting.name), setting.preset).scene(), setting.site.around
    vertices, faces, colours = scene.mesh(None if around is None else around / 4)
    if around is not None:
        low, high = torch.tensor(scene.rx_bounds)[:, :2]
        middle = vertices[faces].mean(1)[:, :2]
        near = ((middle > low - around) & (middle < high + around)).all(-1)
        faces, colours = faces[near], colours[near]
        eyes = torch.cat((scene.tx.position[None], setting.receivers(EYES).position))
        seen = _in_sight(vertices, faces, eyes, count)
        faces, colours = faces[seen], colours[seen]
    return sample_mesh(vertices, faces, count=count, colours=colours)


def _in_sight(vertices: Tensor, faces: Tensor, eyes: Tensor, count: int) -> Tensor:
    """True `[face]` for faces of which one of `eyes` `[eye, 3]` sees a part; those too small for a Gaussian stay."""
    gaussians, face = sample_faces(vertices, faces, count=count)
    shape = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
    most = torch.zeros(len(gaussians))
    for eye in eyes:
        values = torch.zeros(len(gaussians), 1).requires_grad_()
        drawn = rasterize(*shape, values, view_of(Pose(eye), SPHERE.grid), compositing=BLENDING)
        most = torch.maximum(most, torch.autograd.grad(drawn.values.sum(), values)[0][:, 0])
    held = torch.bincount(face, minlength=len(faces))
    return (torch.bincount(face[most > LEAST_WEIGHT], minlength=len(faces)) > 0) | (held == 0)


def geometry_digest(gaussians: Gaussians) -> str:
    """What identifies the Gaussians in a cell."""
    return fingerprint(gaussians.tensors().values())
