"""Ways of a fitted field against the mesh: which it opens that something blocks, and which it closes that are free.

    python -m benchmarks.quality.gates --paths FOLDER [--geometry mesh|FILE.ply] [--train 40] [--seeds 0 1 2]

FOLDER holds traced paths of the lobby (`rf3dgs trace lobby --preset realistic --out FOLDER`). For each seed a field
is fitted to ideal spectra of --train positions. At --places free places of the lobby the truth is cast exactly against
the triangles: for the line of sight, and, at a tenth of them, for every single reflection that the field has a way for.
Such a way is true when both legs are free, up to 12 cm before the mirror, and a surface of the mesh is met there within
6 cm and 2.5 degrees. Printed for each threshold of transmittance, "*" at the field's own: per 100 places, lines of
sight and single reflections that are open and should not be, and that are closed and should not be.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.quality.mirrors import geometry_of
from benchmarks.quality.visibility import free
from rf3dgs.channel.io import PathsReader
from rf3dgs.cli.facts import open_scene
from rf3dgs.core.grids import equirect_grid
from rf3dgs.field.radio_field import RadioField
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.spectrum import stack_spectra
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.radio import fit_radio

THRESHOLDS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)
SEED_OF_PLACES = 31
SHORT, OFF, TURNED_DEG = 0.12, 0.06, 2.5  # of a leg before a mirror [m]; a mirror from the mesh [m], [deg]


def sights(field: RadioField, places: Tensor, corners: Tensor) -> tuple[Tensor, Tensor]:
    """What passes `[place]` on lines of sight, and whether they are free."""
    assert field.sources is not None
    tx = field.sources.tx.expand_as(places)
    return field.obstacles.transmittance(tx, places), free(tx, places, corners)


def reflections(field: RadioField, places: Tensor, corners: Tensor) -> tuple[Tensor, Tensor]:
    """What passes `[way]` on single reflections to the places, and whether there is one in truth."""
    assert field.sources is not None
    single = replace(field.sources, sequence=field.sources.sequence[field.sources.order <= 1])
    passed, mirror, receiver, plane = [], [], [], []
    for place in places:
        rays, share = single.candidates(place, field.obstacles)
        once = rays.order == 1
        passed.append(share[once])
        mirror.append(rays.points[once, 0])
        receiver.append(place.expand(int(once.sum()), 3))
        plane.append(single.sequence[rays.index[once], 0])
    share, met, here, number = (torch.cat(column) for column in (passed, mirror, receiver, plane))
    true = is_surface(met, single.planes.normals[number], corners)
    for end in (single.tx.expand_as(met), here):
        inwards = torch.nn.functional.normalize(end - met, dim=-1)
        true &= free(end, met + SHORT * inwards, corners) & ~free(met + SHORT * inwards, met - SHORT * inwards, corners)
    return share, true


def is_surface(points: Tensor, normals: Tensor, corners: Tensor) -> Tensor:
    """True `[point]` where the plane of one of the triangles lies near a point and is turned like `normals`."""
    across = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], dim=-1)
    across = torch.nn.functional.normalize(across, dim=-1)
    away = (points @ across.mT - (across * corners[:, 0]).sum(-1)).abs()
    alike = (normals @ across.mT).abs() > torch.tensor(TURNED_DEG).deg2rad().cos()
    return ((away < OFF) & alike).any(-1)


def row(name: str, share: Tensor, true: Tensor, count: int, own: float) -> str:
    """A line of the table: open falsely and closed falsely at each threshold, per 100 of `count` places."""
    cells = []
    for threshold in THRESHOLDS:
        opened, closed = (share > threshold) & ~true, (share <= threshold) & true
        mark = "*" if threshold == own else ""
        cells.append(f"{100 * int(opened.sum()) / count:.1f} + {100 * int(closed.sum()) / count:.1f}{mark}")
    return f"| {name}, {100 * int(true.sum()) / count:.0f} free | {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--paths", type=Path, required=True, help="traced paths of the lobby")
    parser.add_argument("--geometry", default="mesh", help='"mesh", or a .ply such as rf3dgs demo writes')
    parser.add_argument("--train", type=int, default=40, help="positions of a fit")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="which positions are drawn")
    parser.add_argument("--places", type=int, default=3000, help="where lines of sight are asked")
    wish = parser.parse_args()
    scene = open_scene("lobby")
    vertices, faces, _ = scene.mesh()
    corners = vertices[faces].float()
    places = scene.receivers(wish.places, SEED_OF_PLACES).position
    some = places[:: max(1, len(places) // max(1, wish.places // 10))]
    print(f"| seed | per 100 places, {wish.train} positions | {' | '.join(map(str, THRESHOLDS))} |")
    print("|---" * (2 + len(THRESHOLDS)) + "|")
    geometry, grid = geometry_of(wish.geometry), equirect_grid(180, 90)
    for seed in wish.seeds:
        with PathsReader(wish.paths) as reader:
            order = torch.randperm(len(reader), generator=torch.Generator().manual_seed(seed))[: wish.train].tolist()
            spectra = stack_spectra([spectrum_of(reader[index], None, grid) for index in order])
        field = fit_radio(geometry, replace(spectra, tx=scene.tx), RadioConfig(model="mirror", joint=0))
        own = 0.0 if field.sources is None else field.sources.open_above
        print(f"| {seed} {row('lines of sight', *sights(field, places, corners), len(places), own)}", flush=True)
        print(f"| {seed} {row('reflections', *reflections(field, some, corners), len(some), own)}", flush=True)


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main()
