"""Surfaces of a mesh that is known: planes, segments and normals come from its faces, not from a search."""

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.geometry.cloud import Cloud
from rf3dgs.geometry.config import SurfaceConfig
from rf3dgs.geometry.normals import mass
from rf3dgs.geometry.patches import Patches, plane_axes, widths
from rf3dgs.geometry.planes import Planes
from rf3dgs.geometry.surfaces import Surfaces
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.surface import sample_faces

COPLANAR = 1e-3  # faces count as one plane where normals, and offsets in metres, agree within this
SMOOTH = 0.82  # cosine of 35 degrees; facets that meet at less belong to something round
BETWEEN = 0.5  # share of a footprint that closes the gaps to its neighbours without reaching over the edge
ROUND = 0.4  # share of a plane's outline along which it is continued smoothly and so is no plane


def known_surfaces(
    vertices: Tensor,
    faces: Tensor,
    *,
    labels: Tensor | None = None,
    count: int | None = None,
    spacing: float | None = None,
    seed: int = 0,
    colours: Tensor | None = None,
    config: SurfaceConfig | None = None,
) -> tuple[Gaussians, Surfaces]:
    """Flat Gaussians on a mesh (see `sample_mesh`) and its surfaces; normals are those of the faces.

    A plane is all that faces of one plane and one side cover, where that has the area and width of `config` and is no
    facet of something round. `labels` `[face]`, such as objects, part segments: one for each label on a plane, and one
    for what a label has off the planes. Raises InputError as `sample_mesh` does, and for labels of another length.
    """
    config = SurfaceConfig() if config is None else config
    gaussians, face = sample_faces(vertices, faces, count=count, spacing=spacing, seed=seed, colours=colours)
    labels = torch.zeros(len(faces), dtype=torch.long) if labels is None else torch.as_tensor(labels)
    if labels.shape != (len(faces),):
        raise InputError(f"labels must be [face] for {len(faces)} faces; got {list(labels.shape)}")
    corners = torch.as_tensor(vertices, dtype=torch.float64)[torch.as_tensor(faces)]
    cross = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], dim=-1)
    normals = torch.nn.functional.normalize(cross, dim=-1)
    offsets = (normals * corners.mean(1)).sum(-1)
    planes_of_faces = torch.cat((normals, offsets[:, None]), -1).div(COPLANAR).round()
    group = torch.unique(planes_of_faces, dim=0, return_inverse=True)[1]
    area = torch.zeros(int(group.max()) + 1, dtype=cross.dtype).index_add_(0, group, 0.5 * cross.norm(dim=-1))
    smooth = _smooth_share(corners, normals, group)
    real = []
    for number in ((area >= config.min_area) & (smooth < ROUND)).nonzero().squeeze(-1).tolist():
        mine = group == number
        if widths(gaussians.means[mine[face]], plane_axes(normals[mine][:1].float())[0])[1] > config.min_width:
            real.append(number)
    real.sort(key=lambda number: -float(area[number]))
    place = torch.full((len(area),), -1)
    place[real] = torch.arange(len(real))
    first = [int((group == number).nonzero()[0]) for number in real]
    planes = Planes(normals[first].float().reshape(-1, 3), offsets[first].float())
    plane_of = place[group[face]]
    cloud = Cloud.of(gaussians, normals[face].float(), mass(gaussians), config)
    spots = gaussians.means[:, None] + BETWEEN * (cloud.spots - gaussians.means[:, None])
    patches = Patches.of(planes, [spots[plane_of == index].flatten(0, 1) for index in range(len(planes))], cloud.cell)
    segment = torch.unique(labels[face] * (len(planes) + 1) + plane_of + 1, return_inverse=True)[1]
    return gaussians, Surfaces(planes, patches, plane_of, segment, normals[face].float())


def _smooth_share(corners: Tensor, normals: Tensor, group: Tensor) -> Tensor:
    """Share `[group]` of each group's outline along which another group continues it smoothly."""
    _, vertex = torch.unique(corners.reshape(-1, 3).mul(1e4).round(), dim=0, return_inverse=True)
    vertex = vertex.reshape(-1, 3)
    pairs = torch.stack((vertex, vertex.roll(-1, 1)), -1).sort(-1).values.reshape(-1, 2)
    edge = torch.unique(pairs, dim=0, return_inverse=True)[1]
    owner = torch.arange(len(corners)).repeat_interleave(3)
    length = (corners - corners.roll(-1, 1)).norm(dim=-1).flatten()
    order = edge.argsort(stable=True)
    one, other = order[:-1], order[1:]
    same = (edge[one] == edge[other]) & (group[owner[one]] != group[owner[other]])
    one, other = one[same], other[same]
    smooth = (normals[owner[one]] * normals[owner[other]]).sum(-1) > SMOOTH
    within = (edge[order[:-1]] == edge[order[1:]]) & (group[owner[order[:-1]]] == group[owner[order[1:]]])
    inner = edge[order[:-1]][within]
    outline = ~torch.isin(edge, inner)
    size = int(group.max()) + 1
    whole = torch.zeros(size, dtype=length.dtype).index_add_(0, group[owner[outline]], length[outline])
    part = torch.zeros_like(whole)
    for side in (one[smooth], other[smooth]):
        part.index_add_(0, group[owner[side]], length[side])
    return part / whole.clamp_min(1e-9)
