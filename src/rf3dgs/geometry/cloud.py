"""The Gaussians as the search for planes knows them, and the tests that a plane must pass."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rf3dgs.core.frames import matrix_from_quaternion
from rf3dgs.geometry.config import SurfaceConfig
from rf3dgs.geometry.patches import Patches, cell_for, footprints, plane_axes, widths
from rf3dgs.geometry.planes import Planes
from rf3dgs.splats.gaussians import Gaussians

PART = 0.1  # smaller pieces of a plane are not part of it [m^2]
BEND = 0.5  # largest sagitta of a patch, in tolerances
BENT = 0.3  # and the share of the distances' variance that a bend must explain to count
LARGEST_SPOT = 3.0  # [cell]
EDGE_ON = 0.3  # cosine of 73 degrees


@dataclass(frozen=True, eq=False)
class Found:
    """A plane of the search: unit normal `[3]` to the free side, offset [m], how far and at which angle what lies on it
    may stray ([m], [deg]).
    """

    normal: Tensor
    offset: Tensor
    tolerance: float
    angle_deg: float


@dataclass(frozen=True, eq=False)
class Cloud:
    """What the search knows of the Gaussians: points and normals `[gaussian, 3]`, mass `[gaussian]` [m^2] (0 for faint
    ones), and points `[gaussian, spot, 3]` over their footprints. cell [m]: how wide the cells of its patches are.
    """

    points: Tensor
    normals: Tensor
    mass: Tensor
    spots: Tensor
    cell: float

    @classmethod
    def of(cls, gaussians: Gaussians, normals: Tensor, mass: Tensor, config: SurfaceConfig) -> "Cloud":
        """The cloud of Gaussians with `normals` of either sign; very large ones count no more than most."""
        axes, cell = matrix_from_quaternion(gaussians.quats), cell_for(gaussians.scales)
        order = gaussians.log_scales.argsort(-1, descending=True)[:, :2]
        longer = axes.gather(-1, order[:, None].expand(-1, 3, -1))
        scales = gaussians.scales.gather(-1, order).clamp_max(LARGEST_SPOT * cell)
        spots = footprints(gaussians.means, longer, scales)
        opaque = gaussians.opacities >= config.min_opacity
        bounded = torch.where(opaque, mass.clamp_max(float(mass.quantile(0.98))), 0.0)
        return cls(gaussians.means, normals, bounded, spots, cell)

    def __len__(self) -> int:
        return len(self.points)

    def part(self, chosen: Tensor) -> "Cloud":
        """The cloud of the Gaussians that a mask keeps; its cells stay as wide."""
        parts = {name: getattr(self, name)[chosen] for name in ("points", "normals", "mass", "spots")}
        return replace(self, **parts)

    def lies(self, plane: Found) -> Tensor:
        """True `[gaussian]` within the tolerances of a plane; an angle above 90 degrees: all but edge-on ones."""
        near = ((self.points @ plane.normal - plane.offset).abs() < plane.tolerance) & (self.mass > 0)
        cosine = self.normals @ plane.normal
        if plane.angle_deg > 90:
            return near & (cosine.abs() > EDGE_ON)
        return near & (cosine > math.cos(math.radians(plane.angle_deg)))

    def area(self, normal: Tensor, chosen: Tensor) -> float:
        """The area [m^2] that the Gaussians `chosen` cover, seen along `normal`."""
        return float(self.patch(normal, self.spots[chosen].flatten(0, 1)).areas[0]) if bool(chosen.any()) else 0.0

    def patch(self, normal: Tensor, points: Tensor) -> Patches:
        """The cells of `points` `[point, 3]`, seen along `normal`."""
        return Patches.of(Planes(normal[None], torch.zeros(1)), [points], self.cell)

    def pieces(self, normal: Tensor, lies: Tensor, width: float = 0.0) -> tuple[Tensor, Tensor, float]:
        """Of the Gaussians `lies`, those in pieces of `PART` or more, those in the largest piece, and its area [m^2].

        Smaller pieces that are narrower than `width` [m] are left out.
        """
        from scipy.ndimage import label

        chosen = lies.nonzero().squeeze(-1)
        if not len(chosen):
            return lies, lies, 0.0
        patch = self.patch(normal, self.spots[chosen].flatten(0, 1))
        number = torch.from_numpy(label(patch.grid(0).numpy())[0]).long()  # type: ignore[index]
        size = torch.bincount(number.flatten()) * self.cell**2
        size[0] = 0.0
        cell = patch.cell_of(self.points[chosen], torch.zeros(len(chosen), dtype=torch.long))
        cell = torch.minimum(cell.clamp_min(0), patch.shape[0] - 1)
        piece = number[cell[:, 0], cell[:, 1]]
        largest = int(size.argmax())
        for index in (size >= PART).nonzero().squeeze(-1).tolist() if width else ():
            if index != largest and widths(self.points[chosen[piece == index]], patch.axes[0])[1] < width:
                size[index] = 0.0
        kept, main = torch.zeros_like(lies), torch.zeros_like(lies)
        kept[chosen], main[chosen] = size[piece] >= PART, piece == largest
        return kept, main & kept, float(size[largest])


def fitted(points: Tensor, mass: Tensor, along: Tensor) -> tuple[Tensor, Tensor]:
    """The plane of least squares through `points` `[point, 3]` weighted by `mass` `[point]`, its normal as `along`."""
    points, share = points.double(), (mass / mass.sum()).double()[:, None]
    centre = (share * points).sum(0)
    normal = torch.linalg.eigh((points - centre).mT @ (share * (points - centre))).eigenvectors[:, 0]
    normal = normal if float(normal @ along.double()) > 0 else -normal
    return normal.float(), (normal @ centre).float()


def sharpness(cloud: Cloud, plane: Found, main: Cloud) -> float:
    """Mass of `main`, which lies on a plane, over that of all within 4 of its tolerances, above the same cells."""
    beside = cloud.lies(replace(plane, tolerance=4 * plane.tolerance)).nonzero().squeeze(-1)
    above = cloud.patch(plane.normal, main.points).holds(cloud.points[beside], torch.zeros_like(beside))
    return float(main.mass.sum() / cloud.mass[beside[above]].sum())


def bends(points: Tensor, mass: Tensor, plane: Found) -> bool:
    """Whether points on a plane lie on a bowl or barrel: distance = quadratic form of the two coordinates."""
    axes = plane_axes(plane.normal[None])[0]
    local = ((points - points.mean(0)) @ axes.mT).double()
    away = (points @ plane.normal - plane.offset).double()
    u, v = local.unbind(-1)
    root = mass.double().sqrt()
    columns = torch.stack((torch.ones_like(u), u, v, u * u, u * v, v * v), -1)
    solution = torch.linalg.lstsq(columns * root[:, None], (away * root)[:, None], driver="gelsd").solution
    left = (root * (away - (columns @ solution).squeeze(-1))).square().sum()
    explained = 1 - float(left / (root * away).square().sum().clamp_min(1e-12))
    a, b, c = solution[3:, 0].tolist()
    curvature, direction = torch.linalg.eigh(torch.tensor([[2 * a, b], [b, 2 * c]]))
    extent = (local.float() @ direction).quantile(torch.tensor([0.02, 0.98]), dim=0).diff(dim=0)[0]
    sagitta = float((curvature.abs() * extent.square() / 8).max())
    return explained > BENT and sagitta > BEND * plane.tolerance
