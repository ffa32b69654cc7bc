"""Laws of the lit surface: what a facet, a wall and a file must do."""

import json
import math
from dataclasses import replace

import pytest
import torch

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.frames import Pose, quaternion_from_matrix
from rf3dgs.core.grids import equirect_grid, list_grid, view_of
from rf3dgs.core.units import SPEED_OF_LIGHT
from rf3dgs.field.io import _digest, load_field
from rf3dgs.field.lit import OF_EACH, LitSurface
from rf3dgs.field.radiance import Surface
from rf3dgs.field.radio_field import RadioField
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Instrument
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.surface import normals, sample_mesh

TX = torch.tensor([1.0, 0.5, 2.0])
LAWS = torch.tensor([[-60.0, 0.7, 4.0, -90.0, -1.5]])
LOBE = Instrument.gaussian(math.radians(3))


def facet(laws=LAWS, **changes) -> LitSurface:
    """One flat Gaussian at the origin that faces up, seen by the transmitter."""
    parts = {
        "means": torch.zeros(1, 3),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "log_scales": torch.tensor([[0.1, 0.1, 0.002]]).log(),
        "logit_opacities": torch.tensor([6.0]),
        "normals": torch.tensor([[0.0, 0.0, 1.0]]),
        "visibility": torch.tensor([0.8]),
        "segment_of": torch.zeros(1, dtype=torch.long),
        "cell_of": torch.zeros(1, dtype=torch.long),
        "laws": laws,
        "segment_sh": torch.zeros(1, 16),
        "cell_sh": torch.zeros(1, 16),
        "level": torch.zeros(1),
        "ambient": torch.tensor([[20.0, 0.0, 1.0, 0.0]]),
        "segment_csi": torch.zeros(1, 9, 4),
        "cell_csi": torch.zeros(1, 9, 4),
        "own_csi": torch.zeros(1, 4),
        "tx": TX,
        "window": DbWindow(-140.0, -60.0),
    }
    return LitSurface(**{**parts, **changes})


def field_of(surface: LitSurface) -> RadioField:
    count = len(surface)
    return RadioField(
        surface=surface,
        sources=None,
        solidity=torch.ones(count),
        frequency=60e9,
        instrument=LOBE,
        tx=Pose(surface.tx),
        bounds=torch.tensor([[-1.0, -1.0, 0.0], [1.0, 1.0, 2.0]]),
        colour=torch.full((count, 3), 100, dtype=torch.uint8),
    )


def floor(spacing: float = 0.04, **changes) -> LitSurface:
    """A floor of 6 m x 6 m at z = 0, of one law."""
    corner = torch.tensor([[-3.0, -3.0, 0.0], [3.0, -3.0, 0.0], [3.0, 3.0, 0.0], [-3.0, 3.0, 0.0]])
    geometry = sample_mesh(corner, torch.tensor([[0, 1, 2], [0, 2, 3]]), spacing=spacing, thickness=0.005)
    count = len(geometry)
    return facet(
        means=geometry.means,
        quats=geometry.quats,
        log_scales=geometry.log_scales,
        logit_opacities=geometry.logit_opacities,
        normals=normals(geometry) * normals(geometry)[:, 2:].sign(),
        visibility=torch.ones(count),
        segment_of=torch.zeros(count, dtype=torch.long),
        cell_of=torch.zeros(count, dtype=torch.long),
        level=torch.zeros(count),
        ambient=torch.tensor([20.0, 0.0, 1.0, 0.0]).expand(count, 4).contiguous(),
        own_csi=torch.zeros(count, 4),
        **changes,
    )


def closed_form(receiver: torch.Tensor) -> tuple[float, float]:
    """Lit and ambient power of the facet by the formulas of docs/theory/radiance.md."""
    d = float(TX.norm())
    w, v = TX / d, receiver / receiver.norm()
    cosine = float(w[2])
    r = torch.tensor([-w[0], -w[1], w[2]])
    level, slope, alpha, ambient, falloff = LAWS[0].tolist()
    lobe = ((1 + float(r @ v)) / 2) ** alpha
    lit = 0.8 * 10 ** (level / 10) / d**2 * math.exp(slope * cosine) * lobe
    return lit, 10 ** ((ambient + falloff * 10 * math.log10(d / 5)) / 10)


@pytest.mark.parametrize("receiver", [(-1.0, -0.5, 2.0), (0.3, 0.2, 1.0), (2.0, -1.0, 0.4)])
def test_a_facet_sends_what_the_closed_formula_says(receiver):
    receiver = torch.tensor(receiver)
    lit, ambient = closed_form(receiver)
    surface = facet()
    sent = surface.values(receiver)[0] * surface.unit
    assert float(sent[0]) == pytest.approx(lit + ambient, rel=1e-4)
    shown = field_of(surface).render(Pose(receiver), list_grid(-receiver[None] / receiver.norm()))
    assert float(shown.power) == pytest.approx(lit + ambient, rel=1e-3)  # a sphere of half a lobe is interpolated
    late = (lit * float(TX.norm()) + ambient * 20e-9 * SPEED_OF_LIGHT) / (lit + ambient) + float(receiver.norm())
    assert float(shown.delay) == pytest.approx(late / SPEED_OF_LIGHT, abs=2e-12)
    departure = (lit * -TX / TX.norm() + ambient * torch.tensor([0.0, 1.0, 0.0])) / (lit + ambient)
    torch.testing.assert_close(shown.aod[0, 0], departure / departure.norm(), atol=1e-4, rtol=0)


def test_residuals_add_decibels_and_end_at_twelve():
    receiver = torch.tensor([0.3, 0.2, 1.0])
    plain = facet().values(receiver, csi=False)
    for level, expected in ((3.0, 3.0), (-7.0, -7.0), (30.0, 12.0), (-30.0, -12.0)):
        louder = facet(level=torch.tensor([level])).values(receiver, csi=False)
        assert 10 * math.log10(float(louder / plain)) == pytest.approx(expected, abs=1e-4)
    constant = torch.zeros(1, 16)
    constant[0, 0] = 2.0 / 0.28209479
    both = facet(segment_sh=constant, cell_sh=constant).values(receiver, csi=False)
    assert 10 * math.log10(float(both / plain)) == pytest.approx(4.0, abs=1e-4)


def test_the_residual_of_delay_and_departure_adds_to_both_parts_whatever_their_power():
    receiver = torch.tensor([0.3, 0.2, 1.0])
    along = -receiver / receiver.norm()
    segment, cell = torch.zeros(1, 9, 4), torch.zeros(1, 9, 4)
    segment[0, 2, 0] = 7.0  # the harmonic 0.4886 z, of delay
    cell[0, 0, 2] = 0.5 / 0.28209479  # a constant, of the departure's y
    own = torch.tensor([[2.0, 0.0, 0.0, -0.25]])
    plain = facet().values(receiver)[0]
    bent = facet(segment_csi=segment, cell_csi=cell, own_csi=own).values(receiver)[0]
    added = torch.tensor([7.0 * 0.48860251 * float(along[2]) + 2.0, 0.0, 0.5, -0.25])
    assert float(bent[0]) == float(plain[0])
    torch.testing.assert_close((bent[1:] - plain[1:]) / plain[0], added, rtol=1e-4, atol=1e-5)
    louder = facet(level=torch.tensor([5.0]), own_csi=own)
    shown = field_of(louder).render(Pose(receiver), list_grid(along[None]))
    without = field_of(replace(louder, own_csi=torch.zeros(1, 4))).render(Pose(receiver), list_grid(along[None]))
    assert float(shown.delay - without.delay) == pytest.approx(2e-9, abs=2e-12)
    assert torch.equal(louder.without_residual().own_csi, torch.zeros(1, 4))


def test_the_parts_of_a_field_add_up_to_the_whole():
    whole = field_of(floor(0.3, segment_sh=torch.full((1, 16), 2.0)))
    here, grid = Pose([-0.5, 0.4, 1.2]), equirect_grid(60, 30)
    shown = whole.render(here, grid).power
    parts = [whole.only(part).render(here, grid).power for part in ("sources", "lit", "ambient")]
    torch.testing.assert_close(torch.stack(parts).sum(0), shown, rtol=1e-5, atol=0.0)
    assert float(parts[0].max()) < 1e-20 * float(shown.max())
    assert float(parts[1].max()) > 3 * float(parts[2].max()) > 0
    with pytest.raises(InputError, match="part must be one of sources, lit, ambient; got 'dark'"):
        whole.only("dark")


def test_a_field_of_the_paper_has_no_parts():
    bare = facet()
    opaque = Gaussians(bare.means, bare.quats, bare.log_scales, bare.logit_opacities, torch.zeros(1, 1, 1))
    paper = replace(field_of(bare), surface=Surface.bare(opaque, tx=TX, window=bare.window))
    with pytest.raises(InputError, match="parts belong to the mirror model"):
        paper.only("lit")


def test_a_lit_floor_sends_the_analytic_integral():
    """The power of all directions that meet the floor is the integral of the law, gaps between Gaussians or not."""
    surface = floor()
    here = Pose([-0.5, 0.4, 1.2])
    grid = equirect_grid(360, 180)
    shown = field_of(surface).render(here, grid, csi=False)
    down = grid.directions[..., 2] < -0.02
    hit = here.position + grid.directions * (1.2 / -grid.directions[..., 2:].clamp_max(-0.02))
    inside = down & (hit[..., :2].abs() < 3).all(-1)
    towards = TX - hit
    d = towards.norm(dim=-1)
    w = towards / d[..., None]
    r = w * torch.tensor([-1.0, -1.0, 1.0])
    level, slope, alpha, ambient, falloff = LAWS[0].tolist()
    lobe = ((1 - (r * grid.directions).sum(-1)) / 2).clamp_min(1e-6) ** alpha
    lit = 10 ** (level / 10) / d**2 * torch.exp(slope * w[..., 2]) * lobe
    law = (lit + 10 ** (ambient / 10) * (d / 5) ** falloff) * inside
    expected = float((law * grid.solid_angle).sum()) / LOBE.beam_solid_angle
    received = float((shown.power * inside * grid.solid_angle).sum()) / LOBE.beam_solid_angle
    assert received == pytest.approx(expected, rel=0.1)
    middle = inside & (hit[..., :2].abs() < 2.5).all(-1)
    error_db = 10 * torch.log10(shown.power[middle] / law[middle])
    # Of Gaussians that overlap the nearer ones win, which shows the law a few centimetres nearer than the ray meets it;
    # it grows with their size and with the blur of a pixel at grazing angles.
    assert float(error_db.square().mean().sqrt()) < 0.5


def board(x: float, wide: float, spacing: float) -> Gaussians:
    """A board of 4 m height that stands across the x axis."""
    half = wide / 2
    corner = torch.tensor([[x, -half, 0.0], [x, half, 0.0], [x, half, 4.0], [x, -half, 4.0]])
    return sample_mesh(corner, torch.tensor([[0, 1, 2], [0, 2, 3]]), spacing=spacing, thickness=0.005)


@pytest.mark.parametrize("distance", [6.0, 10.0])
def test_a_dark_board_hides_of_a_bright_wall_what_its_outline_does(distance):
    """On a grid whose pixels are as wide as the board: the mean over ways to lay pixels over it is its own width."""
    parts = [board(distance, 0.4, 0.04), board(14.0, 12.0, 0.1)]
    of_parts = torch.repeat_interleave(torch.arange(2), torch.tensor([len(part) for part in parts]))
    count = len(of_parts)
    surface = facet(
        means=torch.cat([part.means for part in parts]),
        quats=torch.cat([part.quats for part in parts]),
        log_scales=torch.cat([part.log_scales for part in parts]),
        logit_opacities=torch.cat([part.logit_opacities for part in parts]),
        normals=torch.tensor([-1.0, 0.0, 0.0]).expand(count, 3).contiguous(),
        visibility=torch.zeros(count),
        segment_of=of_parts,
        cell_of=of_parts,
        laws=torch.tensor([[-300.0, 0.0, 0.0, -100.0, 0.0], [-300.0, 0.0, 0.0, -60.0, 0.0]]),
        segment_sh=torch.zeros(2, 16),
        cell_sh=torch.zeros(2, 16),
        level=torch.zeros(count),
        ambient=torch.zeros(count, 4),
        segment_csi=torch.zeros(2, 9, 4),
        cell_csi=torch.zeros(2, 9, 4),
        own_csi=torch.zeros(count, 4),
    )
    pixel = 2.0  # degrees
    hidden = []
    for turned in torch.arange(0.0, pixel, pixel / 10).tolist():
        facing = (math.cos(math.radians(turned)), math.sin(math.radians(turned)), 2.0)
        view = view_of(Pose.look_at((0.0, 0.0, 2.0), facing), equirect_grid(180, 90))
        shown = surface.picture(view, csi=False)[44:46, 80:100, 0] * surface.unit
        hidden.append(pixel * float((1 - (shown / 1e-6).clamp(0, 1).mean(0)).sum()))
    wide = 2 * math.degrees(math.atan(0.2 / distance))
    assert sum(hidden) / len(hidden) == pytest.approx(wide, abs=0.5 * pixel)


def test_delay_of_a_lit_wall_is_that_of_the_single_bounce():
    laws = LAWS.clone()
    laws[0, 3] = -300.0
    here = Pose([-0.5, 0.4, 1.2])
    grid = equirect_grid(360, 180)
    shown = field_of(floor(laws=laws)).render(here, grid)
    hit = here.position + grid.directions * (1.2 / -grid.directions[..., 2:].clamp_max(-0.02))
    seen = (grid.directions[..., 2] < -0.5) & (hit[..., :2].abs() < 2.5).all(-1)
    length = (hit - TX).norm(dim=-1) + (hit - here.position).norm(dim=-1)
    assert shown.delay is not None
    assert (
        float((shown.delay - length / SPEED_OF_LIGHT)[seen].abs().mean()) < 0.15e-9
    )  # of Gaussians that overlap the nearer win: 4 cm
    assert shown.aod is not None
    straight = torch.nn.functional.normalize(hit - TX, dim=-1)
    cosine = (shown.aod * straight).sum(-1)[seen]
    assert math.degrees(math.acos(float(cosine.mean().clamp_max(1)))) < 2.0


def test_gradients_are_those_of_finite_differences():
    generator = torch.Generator().manual_seed(0)

    def random(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    means, tx = random(5, 3), TX.double()
    unit = torch.nn.functional.normalize(random(5, 3), dim=-1)
    unit = unit * ((tx - means) * unit).sum(-1, keepdim=True).sign()
    double = {
        "means": means,
        "quats": quaternion_from_matrix(torch.eye(3).expand(5, 3, 3)).double(),
        "log_scales": random(5, 3),
        "logit_opacities": random(5),
        "normals": unit,
        "visibility": torch.rand(5, generator=generator, dtype=torch.float64),
        "segment_of": torch.tensor([0, 1, 1, 0, 1]),
        "cell_of": torch.tensor([0, 1, 2, 0, 1]),
        "tx": tx,
        "window": DbWindow(-140.0, -60.0),
    }

    names = ("laws", "segment_sh", "cell_sh", "level", "ambient", "segment_csi", "cell_csi", "own_csi")

    def sent(*values):
        learned = dict(zip(names, values, strict=True))
        return LitSurface(**double, **learned).values(torch.tensor([0.1, 4.0, 3.0], dtype=torch.float64))

    laws = torch.tensor([[-60.0, 0.7, 4.0, -61.0, -1.5], [-62.0, -0.4, 1.0, -63.0, 0.5]], dtype=torch.float64)
    learned = [laws, 0.5 * random(2, 16), 0.5 * random(3, 16), random(5), random(5, 4)]
    learned += [random(2, 9, 4), random(3, 9, 4), random(5, 4)]
    assert torch.autograd.gradcheck(sent, [tensor.requires_grad_() for tensor in learned])


def test_a_lit_field_comes_back_from_disk_and_saving_it_again_changes_nothing(tmp_path):
    generator = torch.Generator().manual_seed(1)
    surface = floor(0.3)
    drawn = {name: getattr(surface, name) for name in ("level", "segment_csi", "cell_csi", "own_csi")}
    drawn = {name: torch.randn(tensor.shape, generator=generator) for name, tensor in drawn.items()}
    surface = replace(surface, lobe=0.07, **drawn)
    before = field_of(surface)
    before.save(tmp_path / "one.field")
    after = load_field(tmp_path / "one.field")
    assert isinstance(after.surface, LitSurface)
    assert after.surface.lobe == 0.07
    torch.testing.assert_close(after.surface.laws, surface.laws, rtol=0, atol=0)
    for name, tensor in drawn.items():
        torch.testing.assert_close(getattr(after.surface, name), tensor.half().float(), rtol=0, atol=0)
    here, grid = Pose([-0.5, 0.4, 1.2]), equirect_grid(60, 30)
    first, second = before.render(here, grid), after.render(here, grid)
    lit = first.power > 0
    # float16 levels and logarithmic scales: a thousandth of a few dB, and of the Gaussians' sizes
    assert float((first.gain_db - second.gain_db)[lit & (second.power > 0)].abs().mean()) < 0.02
    after.save(tmp_path / "two.field")
    names = [tmp_path / name / "tensors.safetensors" for name in ("one.field", "two.field")]
    assert names[0].read_bytes() == names[1].read_bytes()


def rewritten(path, edit) -> None:
    """The description of a saved field, edited and signed again."""
    record = json.loads((path / "field.json").read_text())
    edit(record["body"])
    record["sha256"] = _digest(record["body"])
    (path / "field.json").write_text(json.dumps(record))


def test_a_file_of_before_delay_and_departure_had_a_residual_loads_without_one(tmp_path):
    surface = floor(0.3)
    surface = replace(surface, own_csi=torch.ones(len(surface), 4))
    field_of(surface).save(tmp_path / "a.field")
    rewritten(tmp_path / "a.field", lambda body: (body.pop("csi_coefficients"), body.pop("lobe")))
    # An older file lacks the tensors as well; what a description does not name is not looked at.
    older = load_field(tmp_path / "a.field").surface
    assert isinstance(older, LitSurface)
    assert float(older.own_csi.abs().max()) == 0.0
    assert older.lobe == 0.0


def test_a_cell_of_two_segments_is_refused():
    surface = floor(0.5)
    halves = (surface.means[:, 0] > 0).long()
    two = {name: torch.cat([getattr(surface, name)] * 2) for name in ("laws", "segment_sh", "segment_csi")}
    with pytest.raises(InputError, match="a cell must lie in one segment; cell 0 has Gaussians of several"):
        replace(surface, segment_of=halves, **two)


def test_a_picture_needs_only_the_gaussians_that_it_shows():
    generator = torch.Generator().manual_seed(2)
    surface = floor(0.2)
    hidden = replace(surface, means=surface.means - torch.tensor([0.0, 0.0, 1.0]))  # under the floor
    both = {name: torch.cat((getattr(surface, name), getattr(hidden, name))) for name in OF_EACH}
    both["level"] = torch.randn(2 * len(surface), generator=generator)
    surface = replace(surface, lobe=0.05, **both)
    view = view_of(Pose([0.3, -0.2, 1.5]), equirect_grid(60, 30))
    hit = surface.hit_in(view)
    assert 0.3 < float(hit.float().mean()) < 0.7
    part = surface.subset(hit)
    assert len(part) == int(hit.sum())
    assert torch.equal(part.picture(view), surface.picture(view))
    again = surface.subset(hit.nonzero().squeeze(-1))
    assert torch.equal(again.level, part.level)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"normals": torch.zeros(2, 3)}, r"normals must be \[1, 3\] for 1 Gaussians, 1 segments and 1 cells"),
        ({"laws": torch.zeros(1, 4)}, r"laws must be \[1, 5\]"),
        ({"segment_of": torch.tensor([1])}, r"segment_of must number 0..0; got 1 to 1"),
        ({"cell_csi": torch.zeros(1, 4, 4)}, r"cell_csi must be \[1, 9, 4\] for 1 Gaussians, 1 segments and 1 cells"),
        ({"cell_of": torch.tensor([-1])}, r"cell_of must number 0..0; got -1 to -1"),
    ],
)
def test_surfaces_that_do_not_fit_together_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        facet(**changes)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda body: body.update(model="crystal"), "model must be one of mirror, paper; got 'crystal'"),
        (lambda body: body.update(segments=7), "laws must be"),
        (lambda body: body.pop("cells"), "cells"),
        (lambda body: body.update(csi_coefficients=4), "csi_coefficients must be 9, or left out .* got 4"),
    ],
)
def test_descriptions_that_do_not_fit_the_tensors_are_refused(tmp_path, edit, message):
    field_of(facet()).save(tmp_path / "a.field")
    rewritten(tmp_path / "a.field", edit)
    with pytest.raises(DataError, match=message):
        load_field(tmp_path / "a.field")
