"""Laws of the residual's fit: which cells make a cube, and what one view may say about a cell."""

from dataclasses import replace

import torch

from rf3dgs.field.lit import LitSurface
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.training.lit_views import Shortfall
from rf3dgs.training.mirror import cells_of
from rf3dgs.training.residual import Groups, _corrected

WIDTH = 0.4


def floor(segments: int = 1) -> LitSurface:
    """A floor of 2 m with a Gaussian every 5 cm, in cells of 40 cm, cut into strips that are segments."""
    x = torch.arange(40) * 0.05 + 0.025
    means = torch.cartesian_prod(x, x, torch.zeros(1))
    segment = (means[:, 0] * segments / 2).long()
    cell = cells_of(means, segment, WIDTH)
    count, cells = len(means), int(cell.max()) + 1
    return LitSurface(
        means=means,
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4),
        log_scales=torch.full((count, 3), -3.0),
        logit_opacities=torch.full((count,), 3.0),
        normals=torch.tensor([0.0, 0.0, 1.0]).expand(count, 3),
        visibility=torch.ones(count),
        segment_of=segment,
        cell_of=cell,
        laws=torch.zeros(segments, 5),
        segment_sh=torch.zeros(segments, 16),
        cell_sh=torch.zeros(cells, 16),
        level=torch.zeros(count),
        ambient=torch.zeros(count, 4),
        segment_csi=torch.zeros(segments, 9, 4),
        cell_csi=torch.zeros(cells, 9, 4),
        own_csi=torch.zeros(count, 4),
        tx=torch.tensor([1.0, 1.0, 2.0]),
        window=DbWindow(-140.0, -60.0),
    )


def test_cubes_hold_a_few_cells_of_one_segment():
    surface = floor(2)
    groups = Groups.of(surface)
    assert torch.equal(groups.segment[surface.cell_of], surface.segment_of)
    members = torch.bincount(groups.cube)
    assert int(members.max()) <= 9  # a flat floor: three by three where the cubes' width is not a cell's multiple
    assert len(members) < len(groups.cube) / 2
    owner = torch.zeros(len(members), dtype=torch.long).index_put((groups.cube,), groups.segment)
    assert torch.equal(owner[groups.cube], groups.segment)


def test_a_view_with_many_pixels_does_not_outvote_the_others():
    """Of two views from one place one says +4 dB by a thousand pixels a Gaussian, the other -4 dB by five."""
    surface, receivers = floor(), torch.tensor([[1.0, 1.0, 1.5], [1.0, 1.0, 1.5]])
    every = torch.arange(len(surface))
    lacking = Shortfall(
        gaussian=torch.cat((every, every)),
        view=torch.cat((torch.zeros_like(every), torch.ones_like(every))),
        weight=torch.cat((torch.full((len(every),), 1000.0), torch.full((len(every),), 5.0))),
        error_db=torch.cat((torch.full((len(every),), 4.0), torch.full((len(every),), -4.0))),
    )
    told = _corrected(surface, receivers, Groups.of(surface), lacking)
    assert float(told.segment_sh.abs().max() + told.cell_sh.abs().max()) < 0.5


def test_what_all_views_lack_is_made_up():
    surface, receivers = floor(), torch.tensor([[0.4, 0.5, 1.5], [1.6, 0.4, 1.2], [1.0, 1.7, 2.0]])
    every = torch.arange(len(surface)).repeat(3)
    view = torch.arange(3).repeat_interleave(len(surface))
    lacking = Shortfall(every, view, torch.full((len(every),), 3.0), torch.full((len(every),), 2.0))
    for _ in range(6):  # ridges draw to zero: what is left shrinks from pass to pass
        told = _corrected(surface, receivers, Groups.of(surface), lacking)
        shown = _residual(told, receivers)
        lacking = replace(lacking, error_db=2.0 - shown[view, every])
        surface = told
    assert float((shown - 2.0).abs().mean()) < 0.2


def _residual(surface: LitSurface, receivers: torch.Tensor) -> torch.Tensor:
    """The residual [dB] `[view, Gaussian]`."""
    plain = surface.without_residual()
    return torch.stack(
        [10 * torch.log10(surface.values(q, csi=False) / plain.values(q, csi=False))[:, 0] for q in receivers]
    )
