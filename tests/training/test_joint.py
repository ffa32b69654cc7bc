"""Laws of joint refinement, in a room that the model itself drew: mirrors in its walls, and walls that scatter."""

import math
from dataclasses import fields, replace

import pytest
import torch

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid
from rf3dgs.field.images import sequences
from rf3dgs.field.lit import LitSurface
from rf3dgs.field.sources import PointSources
from rf3dgs.geometry import Planes
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Instrument, Spectrum
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.obstacles import Obstacles
from rf3dgs.splats.surface import sample_mesh
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.joint import CSI, RESIDUAL, SCALES, loss_of, picture, refine_jointly
from rf3dgs.training.joint_views import JointView, joint_views, misfit
from rf3dgs.training.mirror import JOINT
from rf3dgs.training.radio import fit_radio

HIGH = torch.tensor([6.0, 5.0, 3.0])
TX = torch.tensor([1.0, 1.2, 2.4])
LOBE = Instrument.gaussian(math.radians(15))
GRID = equirect_grid(36, 18)
FLOOR_DB = -140.0


def room(spacing: float = 0.5) -> Gaussians:
    corner = [[float(HIGH[axis]) if i >> axis & 1 else 0.0 for axis in range(3)] for i in range(8)]
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return sample_mesh(torch.tensor(corner), torch.tensor(faces), spacing=spacing, thickness=0.01)


def walls() -> LitSurface:
    """Six segments, one a wall; a cell is a quarter of a wall."""
    geometry = room()
    apart = torch.cat((geometry.means.abs(), (HIGH - geometry.means).abs()), -1)
    segment = apart.argmin(-1)
    inwards = torch.cat((torch.eye(3), -torch.eye(3)))
    beyond = (geometry.means > HIGH / 2).long()
    generator = torch.Generator().manual_seed(3)
    shares = torch.rand(6, 5, generator=generator) - 0.5
    return LitSurface(
        means=geometry.means.detach(),
        quats=geometry.quats.detach(),
        log_scales=geometry.log_scales.detach(),
        logit_opacities=geometry.logit_opacities.detach(),
        normals=inwards[segment],
        visibility=torch.ones(len(geometry)),
        segment_of=segment,
        cell_of=segment * 8 + beyond @ torch.tensor([1, 2, 4]),
        laws=torch.tensor([-88.0, 0.8, 6.0, -110.0, -1.0]) + shares * torch.tensor([6.0, 0.5, 4.0, 6.0, 0.5]),
        segment_sh=0.5 * torch.randn(6, 16, generator=generator),
        cell_sh=0.3 * torch.randn(48, 16, generator=generator),
        level=torch.randn(len(geometry), generator=generator),
        ambient=torch.tensor([12.0, 0.0, 0.0, 0.7]).expand(len(geometry), 4),
        segment_csi=0.1 * torch.randn(6, 9, 4, generator=generator),
        cell_csi=0.1 * torch.randn(48, 9, 4, generator=generator),
        own_csi=0.1 * torch.randn(len(geometry), 4, generator=generator),
        tx=TX,
        window=DbWindow(-140.0, -60.0),
    )


def mirrors() -> PointSources:
    """The transmitter and its images in the six walls, which reflect as dielectrics do."""
    planes = Planes(torch.cat((torch.eye(3), -torch.eye(3))), torch.cat((torch.zeros(3), -HIGH)))
    reflection = torch.tensor([[-8.0, -5.0, 1.0]]).expand(6, 3) - torch.arange(6.0)[:, None]
    return PointSources(TX, 60e9, planes, None, sequences(6, 1), reflection, level_db=0.5)


def drawn(count: int, seed: int) -> tuple[Spectrum, list]:
    """What `walls` and `mirrors` show at some positions, and the rays that reach them."""
    surface, sources = walls(), mirrors()
    pose = Pose.scatter(((1.5, 1.5, 0.8), (5.0, 4.0, 1.8)), count, seed)
    nothing = Obstacles(surface.means, surface.quats, surface.scales, torch.zeros(len(surface)), None)
    rays = sources.rays_each(pose.position, nothing)
    empty = Spectrum(
        power=torch.ones(count, *GRID.shape),
        grid=GRID,
        pose=pose,
        frequency=60e9,
        instrument=LOBE,
        delay=torch.ones(count, *GRID.shape),
        aod=torch.ones(count, *GRID.shape, 3),
    )
    views = joint_views(surface, empty, rays, floor_db=FLOOR_DB)
    shown = torch.stack([picture(surface, numbers(surface), one) for one in views])
    return replace(
        empty,
        power=shown[..., 0] * surface.unit,
        delay=shown[..., 1] / shown[..., 0] * 1e-9,
        aod=torch.nn.functional.normalize(shown[..., 2:], dim=-1),
    ), rays


def numbers(surface: LitSurface) -> dict[str, torch.Tensor]:
    return {name: getattr(surface, name) for name in ("laws", *RESIDUAL)}


def doubles(noun):
    """A frozen dataclass with its float32 tensors in float64."""
    values = {item.name: getattr(noun, item.name) for item in fields(noun)}
    changed = {
        name: x.double() for name, x in values.items() if isinstance(x, torch.Tensor) and x.dtype == torch.float32
    }
    return replace(noun, **changed)


def wrong() -> LitSurface:
    """Walls that are some decibels off."""
    surface = walls()
    return replace(surface, laws=surface.laws + torch.tensor([2.0, 0.0, -1.0, 2.0, 0.0]))


def misfit_of(surface: LitSurface, spectra: Spectrum, rays: list) -> float:
    views = joint_views(surface, spectra, rays, floor_db=FLOOR_DB)
    return sum(float(misfit(picture(surface, numbers(surface), one), one)) for one in views)


@pytest.fixture(scope="module")
def training() -> tuple[Spectrum, list]:
    return drawn(6, 0)


def refined(training, **changes) -> LitSurface:
    spectra, rays = training
    settings = {"steps": 60, "seed": 0, "floor_db": FLOOR_DB} | changes
    return refine_jointly(wrong(), rays, spectra, **settings)


def test_a_picture_is_the_surface_and_the_point_sources(training):
    spectra, rays = training
    surface = walls()
    (one,) = joint_views(surface, spectra[:1], rays[:1], floor_db=FLOOR_DB)
    assert len(rays[0]) == 7
    shown = picture(surface, numbers(surface), one)[..., 0] * surface.unit
    apart = rays[0].picture(spectra.pose[0], GRID, LOBE) + surface.picture(one.view, csi=False)[..., 0] * surface.unit
    # Both add the same float32 numbers, powers of ten by way of float32 decibels around 100.
    torch.testing.assert_close(shown, apart, rtol=3e-5, atol=0.0)
    assert misfit_of(surface, spectra[:1], rays[:1]) < 1e-3 * misfit_of(wrong(), spectra[:1], rays[:1])


@pytest.mark.parametrize("lobe", [0.0, LOBE.lobe])
def test_the_gradient_of_the_loss_is_that_of_finite_differences(training, lobe):
    spectra, rays = training
    surface = replace(wrong(), lobe=lobe)
    (view,) = joint_views(surface, spectra[:1], rays[:1], floor_db=FLOOR_DB)
    one: JointView = doubles(view)
    surface = doubles(surface)
    start = {name: x.double() for name, x in numbers(surface).items()}
    generator = torch.Generator().manual_seed(5)
    moved = {name: 0.05 * torch.randn(x.shape, generator=generator).double() for name, x in start.items()}
    assert moved.keys() == SCALES.keys()

    def loss(trial: dict[str, torch.Tensor]) -> torch.Tensor:
        return loss_of(surface, start, trial, one, 1, backend="reference")

    free = {name: x.clone().requires_grad_() for name, x in moved.items()}
    loss(free).backward()
    step = 1e-4
    for name, x in moved.items():
        along = torch.randn(x.shape, generator=generator).double()
        up, down = (float(loss(moved | {name: x + sign * step * along})) for sign in (1, -1))
        gradient = free[name].grad
        assert gradient is not None
        # Central differences in float64: an error of step squared, 1e-8 of the loss's third derivative.
        assert float((gradient * along).sum()) == pytest.approx((up - down) / (2 * step), rel=1e-4, abs=1e-8), name


def test_levels_of_walls_are_found_beside_mirrors(training):
    spectra, rays = training
    held_out, arriving = drawn(3, 9)
    before, after = wrong(), refined(training)
    assert misfit_of(after, spectra, rays) < 0.25 * misfit_of(before, spectra, rays)
    assert misfit_of(after, held_out, arriving) < 0.35 * misfit_of(before, held_out, arriving)


def test_no_step_changes_nothing_bit_for_bit(training):
    surface = refined(training, steps=0)
    assert all(torch.equal(getattr(surface, name), getattr(wrong(), name)) for name in ("laws", *RESIDUAL))


def test_the_same_seed_gives_the_same_bits_and_another_one_others(training):
    first, again, other = (refined(training, steps=8, seed=seed) for seed in (1, 1, 2))
    for name in ("laws", *RESIDUAL):
        assert torch.equal(getattr(first, name), getattr(again, name))
    assert not torch.equal(first.laws, other.laws)


def test_what_is_not_asked_for_or_not_known_stays(training):
    spectra, rays = training
    laws_alone = refined(training, steps=4, residual=False)
    assert all(torch.equal(getattr(laws_alone, name), getattr(wrong(), name)) for name in RESIDUAL)
    assert not torch.equal(laws_alone.laws, wrong().laws)
    levels_alone = refined((replace(spectra, delay=None, aod=None), rays), steps=4)
    assert all(torch.equal(getattr(levels_alone, name), getattr(wrong(), name)) for name in CSI)
    assert not torch.equal(levels_alone.level, wrong().level)


def test_levels_up_to_a_floor_are_all_one(training):
    spectra, rays = training
    surface = walls()
    high = replace(spectra, floor=torch.full_like(spectra.power, float(spectra.power.max())))
    (one,) = joint_views(surface, high[:1], rays[:1], floor_db=FLOOR_DB)
    shown = picture(surface, numbers(surface), one)
    assert float(misfit(0.1 * shown, one)) == 0.0
    assert float(misfit(10 * shown, one)) > 0.0


def test_the_surface_of_a_field_is_refined_unless_it_is_not_to_be(training):
    spectra, _ = training
    asked, usual, none = (
        fit_radio(room(), spectra, RadioConfig(model="mirror", geometry="given", joint=steps))
        for steps in (JOINT, None, 0)
    )
    surfaces = [field.surface for field in (asked, usual, none)]
    assert all(isinstance(surface, LitSurface) for surface in surfaces)
    assert all(torch.equal(getattr(surfaces[0], name), getattr(surfaces[1], name)) for name in ("laws", *RESIDUAL))
    assert not torch.equal(surfaces[1].laws, surfaces[2].laws)
    assert usual.sources is not None
    assert none.sources is not None
    assert torch.equal(usual.sources.reflection, none.sources.reflection)
    assert usual.sources.level_db == none.sources.level_db


@pytest.mark.parametrize(("model", "steps"), [("paper", 10), ("mirror", -1)])
def test_steps_of_joint_refinement_belong_to_the_mirror_model(training, model, steps):
    with pytest.raises(InputError, match=f"joint counts steps .*; got {steps} with the model '{model}'"):
        fit_radio(room(), training[0], RadioConfig(model=model, joint=steps))


def test_where_nothing_stands_the_surface_stays_finite(training):
    spectra, rays = training
    surface = wrong()
    under_the_sky = surface.means[:, 2] < 2.0
    per_gaussian = [item.name for item in fields(surface) if len_of(getattr(surface, item.name)) == len(surface)]
    cut = {name: getattr(surface, name)[under_the_sky] for name in per_gaussian}
    surface = replace(surface, **cut, lobe=math.radians(4))
    found = refine_jointly(surface, rays, spectra, steps=12, seed=0, floor_db=FLOOR_DB)
    for name, x in numbers(found).items():
        assert bool(torch.isfinite(x).all()), name
    assert not torch.equal(found.level, surface.level)


def len_of(value) -> int:
    return len(value) if isinstance(value, torch.Tensor) and value.dim() else 0
