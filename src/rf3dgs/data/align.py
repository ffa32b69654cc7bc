"""Bringing a photogrammetry world, whose scale and tilt are arbitrary, to the metric world with z up."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.grids import Camera
from rf3dgs.data.photo import Photo, PhotoSet


@dataclass(frozen=True, eq=False)
class Similarity:
    """`target = scale * rotation @ source + translation`; `residuals` `[anchor]` [m] are what the anchors miss."""

    scale: float
    rotation: Tensor
    translation: Tensor
    residuals: Tensor

    def report(self) -> str:
        """One sentence for people."""
        rms = float(self.residuals.square().mean().sqrt())
        worst = int(self.residuals.argmax())
        return (
            f"scale {self.scale:.6g}, {len(self.residuals)} anchors, residual {rms:.4g} m rms, "
            f"largest {float(self.residuals[worst]):.4g} m at anchor {worst}"
        )

    def points(self, points: Tensor) -> Tensor:
        """Points `[*batch, 3]` of the source world in the target world."""
        return (self.scale * points.double() @ self.rotation.mT + self.translation).to(points.dtype)

    def camera(self, camera: Camera) -> Camera:
        """The same camera in the target world."""
        position = self.points(camera.position.double())
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3] = camera.viewmat[:3, :3].double() @ self.rotation.mT
        viewmat[:3, 3] = -viewmat[:3, :3] @ position
        return replace(camera, viewmat=viewmat.float())

    def photos(self, found: PhotoSet) -> PhotoSet:
        """A reader's photos and points in the target world, with the report among the notes."""
        moved: Sequence[Photo] = [replace(photo, camera=self.camera(photo.camera)) for photo in found.photos]
        points = None if found.points is None else self.points(found.points)
        return replace(found, photos=tuple(moved), points=points, notes=(*found.notes, f"aligned: {self.report()}"))


def align(source: Tensor, target: Tensor) -> Similarity:
    """The similarity of least squares that takes anchors `source` `[n, 3]` to `target` `[n, 3]` [m].

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns" (1991), eq. 34-43.
    InputError when there are fewer than three anchors or when they (nearly) lie on one line.
    """
    source, target = torch.as_tensor(source).double(), torch.as_tensor(target).double()
    if source.dim() != 2 or source.shape[-1] != 3 or source.shape != target.shape:
        raise InputError(f"anchors must be two [n, 3] of one length; got {list(source.shape)} and {list(target.shape)}")
    if len(source) < 3:
        raise InputError(f"align needs at least 3 anchors that are not on one line; got {len(source)}")
    if not bool(torch.isfinite(source).all() and torch.isfinite(target).all()):
        raise InputError("anchors hold NaN or infinity; remove those pairs")
    mean_source, mean_target = source.mean(0), target.mean(0)
    from_source, from_target = source - mean_source, target - mean_target
    for name, spread in (("source", from_source), ("target", from_target)):
        extent = torch.linalg.svdvals(spread)
        if float(extent[0]) < 1e-9 or float(extent[1]) < 1e-3 * float(extent[0]):
            raise InputError(f"the {name} anchors lie on one line or point; choose anchors spread over an area")
    u, values, vt = torch.linalg.svd(from_target.mT @ from_source / len(source))
    sign = torch.ones(3, dtype=torch.float64)
    sign[2] = torch.sign(torch.linalg.det(u) * torch.linalg.det(vt))
    rotation = u @ torch.diag(sign) @ vt
    scale = float((values * sign).sum() / from_source.square().sum(1).mean())
    if scale < 1e-12:
        raise InputError("the anchors do not correspond: the best scale is zero. Check their order")
    translation = mean_target - scale * rotation @ mean_source
    residuals = torch.linalg.vector_norm(scale * source @ rotation.mT + translation - target, dim=-1)
    return Similarity(scale, rotation, translation, residuals)
