"""Does a shared MLP earn its cost as the mirror model's residual of level? Four fields that differ in nothing else.

    python -m benchmarks.quality.mlp --paths FOLDER [--geometry photos|mesh|FILE.ply] [--out out/radiance] [--judged 20]

The lobby, preset diffuse, 40 training positions of seed 0, judged at the first validation positions of each hold-out.
--paths: a folder of `rf3dgs trace lobby --preset paper`; data and geometry are those of `benchmarks.quality.radiance`,
in the same --out. Rows:

    laws           point sources, lit and ambient laws; no residual of level
    harmonics      with the model's residual: harmonics of segments and cells, a level for each Gaussian
    mlp            one network for all Gaussians in place of that residual
    both           the network on what the harmonics leave over

All have the residual of delay and departure. The network, 128-128-64, sees where a Gaussian is (4 octaves), harmonics
of the direction to the receiver, the normal, log distance to the transmitter, cosine of incidence, the cosine about the
mirror direction and visibility. It is fitted by Adam to the errors in dB that the rasterizer throws back onto the
Gaussians, pairs drawn by their weight, in two passes as the model's own residual in six. Columns: main peak within 1
degree [%], eigenbeam loss, RMSE, MAE and path gain [dB], delay [ns]; CPU seconds of fitting the network; and of a
picture.
"""

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from benchmarks.quality.methods import known
from benchmarks.quality.methods.method import Task
from benchmarks.quality.protocol.data import Data, data_of, geometry_of
from benchmarks.quality.protocol.scenes import Setting
from benchmarks.quality.protocol.split import HOLDOUTS, SplitConfig
from rf3dgs.channel.arrays import planar_array
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.evaluation.beams import panel_covariance
from rf3dgs.evaluation.protocol import Predictor, score
from rf3dgs.field.lit import LitSurface, incidence
from rf3dgs.field.radio_field import RadioField
from rf3dgs.field.sources import PointSources
from rf3dgs.spectra.spectrum import Spectrum, stack_spectra
from rf3dgs.splats.harmonics import basis, view_directions
from rf3dgs.training.line_of_sight import fit_line_of_sight
from rf3dgs.training.lit_views import LitView, lit_views, shortfall

POSITIONS, SEED = 40, 0
OCTAVES = 4
WIDTHS = (128, 128, 64)
STEPS = (300, 150)  # of Adam, in each pass
BATCH, RATE = 4096, 3e-3
SOFT_DB = 3.0
ARRAY = planar_array(8, 8, pattern="patch")
COLUMNS = {"beam_loss_eigen_db": 2, "rmse_db": 2, "mae_db": 2, "path_gain_db": 2, "delay_ns": 2}


class Network(nn.Module):
    """One residual [dB] for all Gaussians of a surface."""

    def __init__(self, surface: LitSurface) -> None:
        super().__init__()
        distance, cosine, self.mirrored = incidence(surface.means, surface.normals, surface.tx)
        low, high = surface.means.amin(0), surface.means.amax(0)
        place = (2 * (surface.means - low) / (high - low) - 1)[:, None] * (math.pi * 2.0 ** torch.arange(OCTAVES))[
            :, None
        ]
        numbers = torch.stack((distance.log(), cosine, surface.visibility), -1)
        self.fixed = torch.cat((place.sin().flatten(1), place.cos().flatten(1), surface.normals, numbers), -1)
        widths = (self.fixed.shape[1] + 17, *WIDTHS)
        layers = [part for pair in pairwise(widths) for part in (nn.Linear(*pair), nn.ReLU())]
        self.layers = nn.Sequential(*layers, nn.Linear(WIDTHS[-1], 1))

    def forward(self, gaussian: Tensor, along: Tensor) -> Tensor:
        """The residual `[n]` of Gaussians `[n]` seen from receivers along `[n, 3]`, receiver to Gaussian."""
        lobe = (self.mirrored[gaussian] * along).sum(-1, keepdim=True)
        return self.layers(torch.cat((self.fixed[gaussian], basis(along, 3), lobe), -1))[:, 0]


@dataclass(frozen=True, eq=False)
class WithNetwork:
    """A field whose surface has a network's residual besides its own."""

    field: RadioField
    network: Network

    def at(self, receiver: Tensor) -> LitSurface:
        """The surface as a receiver at `[3]` sees it."""
        surface = self.field.surface
        assert isinstance(surface, LitSurface)
        with torch.no_grad():
            found = self.network(torch.arange(len(surface)), view_directions(surface.means, receiver))
        return replace(surface, level=surface.level + found)

    def render(self, pose: Pose, grid: DirectionGrid) -> Spectrum:
        """The spectrum `[row, col]` at one pose."""
        return replace(self.field, surface=self.at(pose.position)).render(pose, grid)


def fit_network(field: RadioField, views: Sequence[LitView], floor_db: float) -> WithNetwork:
    """A network fitted to what the surface of `field` lacks in `views`."""
    assert isinstance(field.surface, LitSurface)
    torch.manual_seed(SEED)
    made = WithNetwork(field, Network(field.surface))
    nn.init.zeros_(made.network.layers[-1].weight)
    hits = [field.surface.hit_in(one.view) for one in views]
    for steps in STEPS:
        rows = []
        for one, hit in zip(views, hits, strict=True):
            receiver = one.view.position
            lacking = shortfall(made.at(receiver), [one], [hit], floor_db)
            along = view_directions(field.surface.means[lacking.gaussian], receiver)
            with torch.no_grad():
                target = lacking.error_db + made.network(lacking.gaussian, along)
            rows.append((lacking.gaussian, along, target, lacking.weight / (1 + 0.25 * lacking.weight)))
        gaussian, along, target, weight = (torch.cat(part) for part in zip(*rows, strict=True))
        ends = weight.double().cumsum(0)
        adam = torch.optim.Adam(made.network.parameters(), lr=RATE)
        for step in range(steps):
            adam.param_groups[0]["lr"] = RATE * (1 - step / steps)
            drawn = torch.searchsorted(ends, torch.rand(BATCH, dtype=torch.float64) * ends[-1])
            with torch.enable_grad():
                error = made.network(gaussian[drawn], along[drawn]) - target[drawn]
                adam.zero_grad()
                ((1 + (error / SOFT_DB).square()).sqrt() - 1).mean().backward()
            adam.step()
    return made


def without_level(surface: LitSurface) -> LitSurface:
    """The surface without its residual of level."""
    return replace(
        surface,
        segment_sh=torch.zeros_like(surface.segment_sh),
        cell_sh=torch.zeros_like(surface.cell_sh),
        level=torch.zeros_like(surface.level),
    )


def row_of(name: str, predictor: Predictor, data: Data, judged: int, cpu: float) -> str:
    """Scores of a predictor in both hold-outs."""
    cells, began = [], 0.0
    pictures = 0
    for holdout in HOLDOUTS:
        truth = data.judged("validation", holdout, "")
        truth = truth[torch.arange(min(judged, len(truth)))]
        began -= time.process_time()
        drawn = stack_spectra([predictor.render(truth.pose[index], truth.grid) for index in range(len(truth))])
        began += time.process_time()
        pictures += len(truth)
        found = score(truth, drawn, panel_covariance(truth, ARRAY), data.window(), ARRAY)
        means = [f"{np.nanmean(found[column]):.{digits}f}" for column, digits in COLUMNS.items()]
        cells.append(" / ".join([f"{100 * np.mean(found['peak_deg'] <= 1):.0f}", *means]))
    return f"| {name} | {' | '.join(cells)} | {cpu:.1f} | {began / pictures:.3f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--paths", type=Path)
    parser.add_argument("--geometry", default="photos")
    parser.add_argument("--out", type=Path, default=Path("out/radiance"))
    parser.add_argument("--judged", type=int, default=20, help="validation positions of each hold-out")
    own = parser.parse_args()
    setting = Setting("lobby", "diffuse")
    data = data_of(setting, own.out / "data" / "lobby-diffuse", SplitConfig(), receivers=480, paths=own.paths)
    geometry = geometry_of(own.geometry, setting, own.out / "geometry" / "lobby", count=100_000)
    train = data.training(POSITIONS, SEED)
    field = known()["mirror"].made(Task(train, data.window(), SEED, "paper", geometry))
    assert isinstance(field, RadioField)
    assert isinstance(field.surface, LitSurface)
    assert field.sources is not None
    laws = replace(field, surface=without_level(field.surface))
    direct = PointSources.line_of_sight(field.sources.tx, field.frequency)
    seen = fit_line_of_sight(direct, train)[1]
    views = lit_views(train, field.sources.rays_each(train.pose.position, field.obstacles, in_sight=seen))
    floor_db = data.window().floor_db
    print("| level's residual | random | region | CPU s | CPU s a picture |\n|---|---|---|---|---|")
    for name, base, fitted in (
        ("laws", laws, False),
        ("harmonics", field, False),
        ("mlp", laws, True),
        ("both", field, True),
    ):
        began = time.process_time()
        predictor = fit_network(base, views, floor_db) if fitted else base
        spent = time.process_time() - began
        print(row_of(name, predictor, data, own.judged, spent), flush=True)


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main()
