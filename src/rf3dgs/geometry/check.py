"""How far Gaussians can be trusted as a site's surfaces: holes, roughness, opacity, haze, segment by segment."""

import math
import textwrap
from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from rf3dgs.geometry.config import SurfaceConfig
from rf3dgs.geometry.normals import depth_all_round, mass, spread_views
from rf3dgs.geometry.patches import Patches
from rf3dgs.geometry.surfaces import Surfaces, find_surfaces
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.surface import normals as shortest_axes

LISTED = 20
LARGEST = 0.98  # the few Gaussians above this quantile of the mass count no more than the others
HOLLOW = 0.5  # below this weight a direction meets nothing
VIEWS = 8
NEAR_SURFACE = 0.10  # [m]


@dataclass(frozen=True)
class SegmentReport:
    """A segment: its Gaussians and their share of all mass; the plane it lies on or -1 and its area [m^2].

    coverage: share of the plane's patch, holes filled, that its cells cover. roughness_cm: root mean square distance
    of what lies on its plane from it, or from the plane of best fit. opacity: mean, weighted by area. spread_deg:
    median angle between Gaussians' shortest axes and the segment's normals.
    """

    segment: int
    gaussians: int
    share: float
    plane: int
    area_m2: float
    coverage: float
    roughness_cm: float
    opacity: float
    spread_deg: float


@dataclass(frozen=True)
class GeometryReport:
    """What `check_geometry` says.

    on_planes and floating are shares of the mass (area times opacity): on planes, and farther than 10 cm from every
    plane and from every segment of 50 Gaussians or more. open_share: share of the directions, all round from the
    viewpoints, that meet nothing. remarks: what to mind, a sentence each.
    """

    gaussians: int
    planes: int
    walls_m2: float
    on_planes: float
    floating: float
    open_share: float
    segments: tuple[SegmentReport, ...]
    remarks: tuple[str, ...]

    def as_dict(self) -> dict:
        """The report as plain values, for JSON."""
        return asdict(self)

    def table(self) -> str:
        """The report as text of at most 80 columns."""
        head = "segment  gaussians  share  plane    area  covered  rough  opacity  normals"
        unit = "                      [%]          [m^2]      [%]   [cm]             [deg]"
        lines = [
            f"{self.gaussians:,} Gaussians, {self.planes} planes of {self.walls_m2:.0f} m^2",
            f"on planes {self.on_planes:.0%}, floating {self.floating:.0%} of the mass; "
            f"{self.open_share:.1%} of the directions meet nothing",
            "",
            head,
            unit,
        ]
        for item in self.segments:
            plane = str(item.plane) if item.plane >= 0 else "-"
            lines.append(
                f"{item.segment:7d}  {item.gaussians:9,}  {100 * item.share:5.1f}  {plane:>5}  {item.area_m2:6.1f}  "
                f"{100 * item.coverage:7.0f}  {item.roughness_cm:5.1f}  {item.opacity:7.2f}  {item.spread_deg:7.1f}"
            )
        remarks = [textwrap.fill(f"- {text}", 80, subsequent_indent="  ") for text in self.remarks]
        return "\n".join(lines + [""] * bool(remarks) + remarks)


def check_geometry(
    gaussians: Gaussians, viewpoints: Tensor, surfaces: Surfaces | None = None, config: SurfaceConfig | None = None
) -> GeometryReport:
    """How far geometry can be trusted, seen from `viewpoints` `[view, 3]` [m]; its largest segments one by one.

    `surfaces` are those of the Gaussians; they are found when not given. Raises InputError as `find_surfaces` does.
    """
    surfaces = find_surfaces(gaussians, viewpoints, config) if surfaces is None else surfaces
    weight = mass(gaussians).double()
    weight = weight.clamp_max(float(weight.quantile(LARGEST)) if len(weight) else 0.0)
    weight = weight / weight.sum().clamp_min(1e-12)
    count = torch.bincount(surfaces.segment_of, minlength=surfaces.segments)
    share = torch.zeros(surfaces.segments, dtype=weight.dtype).index_add_(0, surfaces.segment_of, weight)
    order = share.argsort(descending=True)[:LISTED].tolist()
    segments = tuple(_segment(gaussians, surfaces, weight, index) for index in order)
    views = spread_views(torch.atleast_2d(torch.as_tensor(viewpoints, dtype=torch.float32)), VIEWS)
    on_planes = float(weight[surfaces.plane_of >= 0].sum())
    floating = float(weight[_floating(gaussians, surfaces, count)].sum())
    hollow = sum(_hollow(gaussians, view) for view in views) / len(views)
    area = float(surfaces.patches.areas.sum()) if len(surfaces.planes) else 0.0
    remarks = _remarks(segments, on_planes, floating, hollow)
    return GeometryReport(len(gaussians), len(surfaces.planes), area, on_planes, floating, hollow, segments, remarks)


def _segment(gaussians: Gaussians, surfaces: Surfaces, weight: Tensor, index: int) -> SegmentReport:
    mine = surfaces.segment_of == index
    plane = int(surfaces.plane_of[mine].max())
    points, part = gaussians.means[mine].double(), weight[mine][:, None]
    if plane >= 0:
        on = surfaces.plane_of[mine] == plane
        points, part = points[on], part[on]
        away = points @ surfaces.planes.normals[plane].double() - surfaces.planes.offsets[plane]
        area, coverage = _coverage(surfaces.patches, plane)
    else:
        centred = points - (part * points).sum(0) / part.sum()
        away = centred @ torch.linalg.eigh(centred.mT @ (part * centred)).eigenvectors[:, 0]
        area, coverage = 0.0, 1.0
    rough = float(((part[:, 0] * away.square()).sum() / part.sum()).sqrt())
    cosine = (shortest_axes(gaussians)[mine] * surfaces.normals[mine]).sum(-1).abs().clamp_max(1.0)
    return SegmentReport(
        segment=index,
        gaussians=int(mine.sum()),
        share=float(weight[mine].sum()),
        plane=plane,
        area_m2=area,
        coverage=coverage,
        roughness_cm=100 * rough,
        opacity=float((weight[mine] * gaussians.opacities[mine]).sum() / weight[mine].sum().clamp_min(1e-12)),
        spread_deg=math.degrees(float(cosine.acos().median())),
    )


def _coverage(patches: Patches, plane: int) -> tuple[float, float]:
    """Occupied area [m^2] of a plane, and its share of the area with holes filled and gaps of a metre closed."""
    from scipy.ndimage import binary_closing, binary_fill_holes

    grid = patches.grid(plane).numpy()
    pad = 6
    wide = torch.nn.functional.pad(torch.from_numpy(grid), (pad, pad, pad, pad)).numpy()
    whole = binary_fill_holes(binary_closing(wide, iterations=pad - 1))
    return float(grid.sum()) * patches.cell**2, float(grid.sum() / max(1, (whole | wide).sum()))  # type: ignore[union-attr]


def _floating(gaussians: Gaussians, surfaces: Surfaces, count: Tensor) -> Tensor:
    """True `[gaussian]` for what is in no large segment and beside no plane."""
    free = (surfaces.plane_of < 0) & (count[surfaces.segment_of] < 50)
    for plane in range(len(surfaces.planes)):
        away = gaussians.means @ surfaces.planes.normals[plane] - surfaces.planes.offsets[plane]
        held = surfaces.patches.holds(gaussians.means, torch.full((len(gaussians),), plane))
        free &= ~(held & (away.abs() < NEAR_SURFACE))
    return free


def _hollow(gaussians: Gaussians, viewpoint: Tensor) -> float:
    """Share of the sphere round `viewpoint` `[3]` in which the drawn weight stays below `HOLLOW`."""
    _, weight = depth_all_round(gaussians, viewpoint)
    solid = torch.sin((torch.arange(len(weight)) + 0.5) * (math.pi / len(weight)))[:, None].expand_as(weight)
    return float(solid[weight < HOLLOW].sum() / solid.sum())


def _remarks(segments: tuple[SegmentReport, ...], on_planes: float, floating: float, hollow: float) -> tuple[str, ...]:
    remarks = []
    rough = [item for item in segments if item.plane >= 0 and item.roughness_cm > 5]
    if rough:
        share = sum(item.share for item in rough)
        remarks.append(
            f"{len(rough)} large segments ({share:.0%} of the mass) stray more than 5 cm from their plane: photograph "
            "them from nearer, or give a floor plan or a mesh"
        )
    if floating > 0.1:
        remarks.append(f"{floating:.0%} of the mass floats away from surfaces; it blocks paths that are free")
    if hollow > 0.02:
        remarks.append(f"{hollow:.0%} of the directions meet nothing: photograph there too, unless it is open sky")
    if on_planes < 0.5:
        remarks.append(f"only {on_planes:.0%} of the mass lies on planes; mirror images will be few or wrong")
    return tuple(remarks)
