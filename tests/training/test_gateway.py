"""Laws of the field of a receiver that stands still: a made-up gateway with a wall, heard exactly."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor

from rf3dgs.channel.arrays import planar_array
from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.units import wavelength
from rf3dgs.data.formats.gateway import GatewaySpectra, hemisphere_grid
from rf3dgs.field.gateway import GatewayField, Waves, element_places, kernel
from rf3dgs.training.gateway_fit import GatewayConfig, blocks_of, fit_gateway
from rf3dgs.training.gateway_sources import twins_of
from rf3dgs.training.phase_retrieval import element_responses, tree

FREQUENCY = 915e6
POSE = Pose.look_at((5.0, 0.3, 0.5), (0.0, 0.0, 1.0))
ARRAY = planar_array(4, 4, "isotropic", 0.49)
NORMAL, OFFSET = torch.tensor([0.0, 0.8, -0.6], dtype=torch.float64), 2.0  # of the wall, between it and both ends
GRID = hemisphere_grid(30, 90)


def heard(places: Tensor, *, wall: float = 0.6) -> Tensor:
    """Responses `[place, element]`: the straight wave and one by the wall, from nothing but distances."""
    mirrored = places - 2.0 * (places @ NORMAL - OFFSET)[:, None] * NORMAL
    total = torch.zeros(len(places), ARRAY.count, dtype=torch.complex128)
    for source, gain in ((places, 1.0), (mirrored, wall)):
        distance = torch.linalg.vector_norm(source[:, None] - element_places(POSE, ARRAY, FREQUENCY), dim=-1)
        total += gain / distance * torch.exp(-2j * math.pi / wavelength(FREQUENCY) * distance)
    return total


def pictured(responses: Tensor, places: Tensor) -> GatewaySpectra:
    """What a gateway would publish: 8 bits of amplitude, each picture over its own largest."""
    y, z = GRID.directions.double()[..., 1], GRID.directions.double()[..., 2]
    row, col = torch.arange(16) % 4, torch.arange(16) // 4
    phase = 2 * math.pi * 0.49 * ((col - 1.5) * y[..., None] + (1.5 - row) * z[..., None])
    amplitude = torch.einsum("rcm,pm->prc", torch.exp(-1j * phase), responses).abs()
    amplitude = (255 * amplitude / amplitude.amax((1, 2), keepdim=True)).round() / 255
    return GatewaySpectra(amplitude.float(), GRID, places, POSE, ARRAY, FREQUENCY)


def places_in(low: float, high: float, count: int, seed: int) -> Tensor:
    """Random places in a box around (0, 0, 1), `low` to `high` along x [m]."""
    random = np.random.default_rng(seed)
    side = random.uniform(-0.15, 0.15, (count, 2))
    return torch.tensor(np.column_stack((random.uniform(low, high, count), side[:, 0], 1.0 + side[:, 1])))


@pytest.fixture(scope="module")
def near() -> GatewaySpectra:
    places = places_in(-0.2, 0.2, 60, 1)
    return pictured(heard(places), places)


@pytest.fixture(scope="module")
def field(near: GatewaySpectra) -> GatewayField:
    fit = fit_gateway(near, GatewayConfig(sources=(0, 1, 2), lengths=(0.3,), noises=(0.01,), blocks=3))
    assert fit.choice[0] == 2, fit.errors
    return fit.field


def test_responses_out_of_pictures_are_the_true_ones_up_to_phase_and_twin(near: GatewaySpectra) -> None:
    found, error = element_responses(near)
    truth = heard(near.places)
    unit = [value / torch.linalg.vector_norm(value, dim=-1, keepdim=True) for value in (found, truth)]
    as_is = (unit[0].conj() * unit[1]).sum(-1).abs()
    twin = (twins_of(unit[0]).conj() * unit[1]).sum(-1).abs()
    # 8 bits are 0.0011 of noise on each of 600 pixels, for 32 numbers
    assert error.max() < 0.003
    best = torch.maximum(as_is, twin)
    assert float(best.median()) > 0.9995
    assert float(best.min()) > 0.98  # where the picture is dark in places, some part of h hardly shows


def test_the_wall_is_found_where_it_stands(near: GatewaySpectra, field: GatewayField) -> None:
    origin = near.places.mean(0)
    truth = origin - 2.0 * (origin @ NORMAL - OFFSET) * NORMAL
    found = field.waves.images[1]
    centre = POSE.position.double()
    bearing = angle_between(truth - centre, found - centre)
    normal = angle_between(NORMAL, found - origin)
    assert math.degrees(bearing) < 0.5  # a hundredth of the 4 x 4 array's beam
    assert math.degrees(normal) < 2.0  # told by how the wave's phase runs over 0.4 m of places
    share = field.waves.amplitudes[1].abs() / field.waves.amplitudes[0].abs()
    straight, bounced = (torch.linalg.vector_norm(source - centre) for source in (origin, truth))
    assert float(share) == pytest.approx(0.6 * float(straight / bounced), rel=0.05)


def test_far_from_training_the_field_beats_a_copy(near: GatewaySpectra, field: GatewayField) -> None:
    places = places_in(0.5, 0.7, 20, 2)
    truth = pictured(heard(places), places).amplitude
    drawn = field.render(places, GRID)
    drawn = drawn / drawn.amax((1, 2), keepdim=True)  # as published; a picture's gain is not known
    copied = near.amplitude[torch.cdist(places, near.places).argmin(1)]
    error, of_copy = (((picture - truth) ** 2).mean().sqrt() for picture in (drawn, copied))
    assert float(error) < 0.25 * float(of_copy)


def test_at_training_places_the_field_draws_the_pictures(near: GatewaySpectra, field: GatewayField) -> None:
    drawn = field.render(near.places, GRID)
    assert float((drawn - near.amplitude).square().mean().sqrt()) < 0.02


def test_what_is_not_known_is_the_mean_power_of_the_rest() -> None:
    places = places_in(-0.2, 0.2, 20, 3)
    fit = fit_gateway(pictured(heard(places), places), GatewayConfig(sources=(0,), lengths=(0.3,), noises=(0.01,)))
    far = torch.tensor([[30.0, 0.0, 0.0]], dtype=torch.float64)
    steering = torch.exp(-2j * math.pi * (GRID.directions.double().reshape(-1, 3) @ ARRAY.positions.mT))
    mean = torch.einsum("dm,mn,dn->d", steering, fit.field.covariance, steering.conj()).real.sqrt()
    assert torch.allclose(fit.field.doubt(far), torch.ones(1, dtype=torch.float64))
    assert torch.allclose(fit.field.gain(far), torch.ones(1, dtype=torch.float64))
    assert torch.allclose(fit.field.render(far, GRID).reshape(-1), mean.float(), rtol=1e-4, atol=1e-6)
    assert float(fit.field.doubt(places).max()) < 0.02


def test_a_source_is_the_straight_wave_and_its_image_moves_as_a_mirror_says() -> None:
    origin = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    image = origin - 2.0 * (origin @ NORMAL - OFFSET) * NORMAL
    elements = element_places(POSE, ARRAY, FREQUENCY)
    gains = 1.0 / torch.linalg.vector_norm(torch.stack((origin, image)) - POSE.position.double(), dim=-1)
    turns = torch.polar(gains * torch.tensor([1.0, 0.6]), -2 * math.pi / wavelength(FREQUENCY) / gains)
    waves = Waves(origin, torch.stack((origin, image)), turns, elements, wavelength(FREQUENCY))
    places = places_in(-0.4, 0.4, 10, 4)
    # the array's centre is a float32 position: 1e-7 of 5 m against a wavelength of 0.33 m
    assert torch.allclose(waves.responses(places), heard(places), atol=1e-5)


def test_the_same_pictures_give_the_same_field(near: GatewaySpectra) -> None:
    config = GatewayConfig(sources=(2,), lengths=(0.3,), noises=(0.01,))
    some = near[list(range(20))]
    first, second = (fit_gateway(some, config).field.render(near.places, GRID) for _ in range(2))
    assert torch.equal(first, second)


def test_every_place_follows_its_nearest_earlier_one() -> None:
    places = places_in(-0.2, 0.2, 30, 5)
    order = tree(places)
    assert sorted(index for index, _ in order) == list(range(30))
    for step, (index, parent) in enumerate(order[1:], 1):
        earlier = [one for one, _ in order[:step]]
        distance = torch.linalg.vector_norm(places[earlier] - places[index], dim=-1)
        assert parent == earlier[int(distance.argmin())]


def test_blocks_are_slabs_with_equally_many_places() -> None:
    places = places_in(-0.5, 0.5, 22, 6)
    blocks = blocks_of(places, 4)
    assert sorted(torch.cat(blocks).tolist()) == list(range(22))
    assert [len(block) for block in blocks] == [6, 6, 5, 5]
    ends = sorted((float(places[block, 0].min()), float(places[block, 0].max())) for block in blocks)
    assert all(first[1] < second[0] + 0.1 for first, second in pairwise(ends))


def test_the_kernel_is_positive_definite_and_one_at_no_distance() -> None:
    places = places_in(-0.2, 0.2, 40, 7)
    gram = kernel(places, places, 0.1)
    assert torch.allclose(gram.diagonal(), torch.ones(40, dtype=torch.float64))
    assert float(torch.linalg.eigvalsh(gram).min()) > 0.0


def test_too_few_pictures_and_wrong_places_are_refused(near: GatewaySpectra, field: GatewayField) -> None:
    with pytest.raises(InputError, match="at least 8 transmitter places; got 5"):
        fit_gateway(near[range(5)])
    with pytest.raises(InputError, match="two or more pictures"):
        element_responses(near[[0]])
    with pytest.raises(InputError, match=r"places must be \[place, 3\]"):
        field.doubt(torch.zeros(3))


def test_settings_that_mean_nothing_are_refused() -> None:
    with pytest.raises(InputError, match=r"sources must be counts to try, such as \(0, 2\); got \(\)"):
        GatewayConfig(sources=())
    with pytest.raises(InputError, match="lengths and noises must be above 0"):
        GatewayConfig(lengths=(0.0,))
    with pytest.raises(InputError, match="blocks must be 2 or more"):
        GatewayConfig(blocks=1)
