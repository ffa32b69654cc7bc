"""`check-geometry`: how far Gaussians can be trusted as the surfaces of a site."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from rf3dgs.cli.show import out
from rf3dgs.core.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from rf3dgs.splats.gaussians import Gaussians


@dataclass(frozen=True)
class CheckGeometry:
    """Say how far geometry can be trusted: planes, holes, roughness, haze, segment by segment."""

    geometry: tyro.conf.Positional[Path]
    """A 3DGS .ply."""
    seen_from: str | None = None
    """A dataset whose cameras and receivers are the viewpoints, or "lobby"; points inside the geometry unless given."""
    format: Literal["text", "json"] = "text"
    """A table, or JSON."""

    def run(self) -> int:
        """Find the surfaces and print the report."""
        from rf3dgs.geometry.check import check_geometry
        from rf3dgs.splats.ply import read_ply

        gaussians = read_ply(self.geometry)
        views = inner_points(gaussians) if self.seen_from is None else viewpoints_of(self.seen_from)
        report = check_geometry(gaussians, views)
        out(json.dumps(report.as_dict(), indent=1) if self.format == "json" else report.table())
        return 0


def viewpoints_of(name: str) -> "Tensor":
    """Positions `[view, 3]` [m] of a dataset's training cameras and receivers."""
    import torch

    from rf3dgs.cli.facts import open_dataset

    part = open_dataset(name).train
    places = [photo.camera.position[None] for photo in part.photos]
    places += [part.spectra.pose.position.reshape(-1, 3)] if part.spectra is not None else []
    if not places:
        raise InputError(f"{name} has neither photographs nor spectra to see the geometry from; leave out --seen-from")
    return torch.cat(places)


def inner_points(gaussians: "Gaussians") -> "Tensor":
    """Nine points `[9, 3]` [m] at half height of what 98 % of the Gaussians fill, for want of known viewpoints."""
    import torch

    low, high = torch.quantile(gaussians.means, torch.tensor([0.01, 0.99]), dim=0)
    shares = torch.cartesian_prod(*(torch.tensor([0.25, 0.5, 0.75]),) * 2)
    return low + (high - low) * torch.cat((shares, torch.full((9, 1), 0.5)), 1)
