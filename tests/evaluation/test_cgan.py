import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from torch.nn.functional import l1_loss

from rf3dgs.core.errors import InputError, TrainingError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, list_grid, pinhole_grid
from rf3dgs.evaluation import metrics
from rf3dgs.evaluation.baselines import CganConfig, fit_cgan
from rf3dgs.evaluation.baselines.cgan import picture_order
from rf3dgs.evaluation.baselines.cgan_nets import Generator, PoseCode
from rf3dgs.propagation.room import shoebox
from rf3dgs.spectra.codec import DbWindow, window_of
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.spectrum import Spectrum

PINHOLE = pinhole_grid(36, 24, fov_deg=90)
SMOKE = replace(CganConfig.for_scale("smoke"), device="cpu")


def shoebox_pictures(count: int, seed: int) -> Spectrum:
    """Ideal pictures of a room with plaster walls at `count` receivers that look along x."""
    rx = Pose.scatter(((2.0, 1.0, 1.0), (7.0, 5.0, 1.6)), count, seed)
    paths = shoebox((8.0, 6.0, 3.0), Pose((1.0, 1.5, 2.6)), rx, 28e9, order=4, reflection="plasterboard")
    return spectrum_of(paths, None, PINHOLE, lobe=math.radians(12))


def psnr(predictor, truth: Spectrum, window: DbWindow) -> float:
    drawn = predictor.render(truth.pose, truth.grid).power
    weight = metrics.pixel_weight(truth.grid)
    return float(metrics.psnr(window.encode(truth.power), window.encode(drawn), weight).mean())


@pytest.fixture(scope="module")
def pictures() -> Spectrum:
    return shoebox_pictures(60, seed=1)


@pytest.fixture(scope="module")
def few(pictures: Spectrum) -> tuple[Spectrum, DbWindow]:
    return pictures[:6], DbWindow(window_of(pictures).ceil_db - 60.0, window_of(pictures).ceil_db)


def test_it_overfits_one_view_above_30_db(few):
    train, window = few
    cgan = fit_cgan(train[:1], SMOKE, window)
    assert psnr(cgan, train[:1], window) > 30.0


@pytest.mark.slow
def test_it_overfits_one_view_of_the_laptop_size_above_30_db(few):
    _, window = few
    rx = Pose((5.0, 3.0, 1.2))
    paths = shoebox((8.0, 6.0, 3.0), Pose((1.0, 1.5, 2.6)), rx, 28e9, order=4, reflection="plasterboard")
    view = spectrum_of(paths, None, pinhole_grid(75, 50, fov_deg=90), lobe=math.radians(3))
    view = replace(view, power=view.power[None], pose=view.pose.flat(), delay=None, aod=None)
    config = replace(CganConfig.for_scale("laptop"), steps=300, device="cpu")
    assert psnr(fit_cgan(view, config, window), view, window) > 30.0


def test_it_beats_the_constant_on_held_out_positions(pictures, few):
    _, window = few
    train, held = pictures[:50], pictures[50:]
    cgan = fit_cgan(train, SMOKE, window)
    weight = metrics.pixel_weight(PINHOLE)
    constant = window.encode(train.power).mean(0).expand(len(held), -1, -1)
    floor = float(metrics.psnr(window.encode(held.power), constant, weight).mean())
    assert psnr(cgan, held, window) > floor + 3.0


def test_the_curve_tells_steps_time_and_both_losses(few):
    train, window = few
    history = fit_cgan(train, replace(SMOKE, steps=40), window).history
    assert [record.step for record in history] == list(range(1, 41))
    assert all(later.seconds >= earlier.seconds for earlier, later in pairwise(history))
    assert history[-1].l1 < 0.8 * history[0].l1
    verdicts = [record.discriminator for record in history]
    assert verdicts[0] == pytest.approx(math.log(2), abs=0.1), "at first it guesses"
    assert max(verdicts) - min(verdicts) > 0.01, "it learns, and so does the generator"


def test_a_held_out_score_is_kept_in_the_curve_and_changes_nothing(few):
    train, window = few
    config = replace(SMOKE, steps=3)
    watched = fit_cgan(train, config, window, on_step=lambda done, cgan: psnr(cgan, train, window))
    alone = fit_cgan(train, config, window)
    assert watched.history[-1].score == pytest.approx(psnr(watched, train, window), abs=1e-4)
    assert alone.history[-1].score is None
    pose = train.pose[0]
    assert torch.equal(watched.render(pose, train.grid).power, alone.render(pose, train.grid).power)


def test_one_seed_gives_one_predictor_bit_by_bit_and_leaves_the_callers_randomness_alone(few):
    train, window = few
    config = replace(SMOKE, steps=10, dropout=0.5)
    torch.manual_seed(7)
    first = fit_cgan(train, config, window).render(train.pose, train.grid).power
    drawn = torch.rand(1)
    torch.manual_seed(7)
    assert torch.equal(torch.rand(1), drawn)
    assert torch.equal(fit_cgan(train, config, window).render(train.pose, train.grid).power, first)
    other = fit_cgan(train, replace(config, seed=1), window)
    assert not torch.equal(other.render(train.pose, train.grid).power, first)


def test_without_an_adversary_it_is_plain_regression_bit_by_bit(few):
    train, window = few
    config = replace(SMOKE, steps=8, pixels=1, adversarial=0.0)
    cgan = fit_cgan(train, config, window)
    code = PoseCode(train.pose.position.amin(0), train.pose.position.amax(0), config.octaves)
    target = (2 * window.encode(train.power) - 1)[:, None]
    with torch.random.fork_rng():
        torch.manual_seed(config.seed)
        plain = Generator(code.channels, config, train.grid)
    adam = torch.optim.Adam(plain.parameters(), config.lr, config.betas)
    for step, chosen in enumerate(picture_order(len(train), 4, config.steps, config.seed)):
        adam.param_groups[0]["lr"] = config.lr * min(1.0, 2 - 2 * step / config.steps)
        adam.zero_grad()
        (config.l1 * l1_loss(plain(code.picture(train.pose[chosen], train.grid)), target[chosen])).backward()
        adam.step()
    plain.eval()
    with torch.no_grad():
        expected = window.decode((plain(code.picture(train.pose[:1], train.grid))[0, 0] + 1) / 2)
    assert torch.equal(cgan.render(train.pose[0], train.grid).power, expected)
    assert cgan.history[-1].discriminator is None
    assert cgan.history[-1].loss == pytest.approx(2 * config.l1 * cgan.history[-1].l1)


def test_what_it_draws_is_a_spectrum_within_the_window(few):
    train, window = few
    cgan = fit_cgan(train, replace(SMOKE, steps=3), window)
    one, all_of_them = cgan.render(train.pose[2], train.grid), cgan.render(train.pose, train.grid)
    assert (one.method, one.delay, one.aod) == ("cgan", None, None)
    assert (one.frequency, one.instrument) == (train.frequency, train.instrument)
    assert one.tx is train.tx
    assert cgan.window == window
    assert torch.equal(one.power, all_of_them.power[2])
    low, high = (10 ** (level / 10) for level in (window.floor_db, window.ceil_db))
    assert 0.9999 * low <= float(all_of_them.power.min()) <= float(all_of_them.power.max()) <= 1.0001 * high


def test_another_grid_is_interpolated_in_the_picture_and_refused_beyond_it(few):
    train, window = few
    cgan = fit_cgan(train, replace(SMOKE, steps=3), window)
    whole = cgan.render(train.pose[0], train.grid)
    inner = cgan.render(train.pose[0], list_grid(train.grid.directions[5, 7:9]))
    torch.testing.assert_close(inner.power[0], whole.power[5, 7:9], rtol=1e-3, atol=0.0)  # a ten-thousandth of a pixel
    with pytest.raises(InputError, match="the asked grid looks beyond"):
        cgan.render(train.pose[0], equirect_grid(36, 18))


def test_pictures_of_whole_spheres_are_learned_without_a_seam(room):
    train = room.spectra_at(room.receivers(4))
    window = window_of(train)
    cgan = fit_cgan(train, replace(SMOKE, steps=3, adversarial=0.0), window)
    narrow = cgan.render(train.pose[0], pinhole_grid(12, 8, fov_deg=60))
    assert narrow.power.shape == (8, 12)
    config = replace(SMOKE, depth=1)
    generator = Generator(3, config, room.grid).eval()
    picture = torch.rand(1, 3, *room.grid.shape)
    with torch.no_grad():
        turned = generator(picture.roll(8, -1))
        torch.testing.assert_close(turned, generator(picture).roll(8, -1), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("size", [(8, 8), (9, 11), (37, 25), (75, 50)])
def test_pictures_of_any_size_are_drawn_in_their_size(size):
    grid = pinhole_grid(*size, fov_deg=90)
    train = Spectrum(torch.rand(2, *grid.shape), grid, Pose(torch.rand(2, 3)), 28e9, shoebox_pictures(1, 0).instrument)
    cgan = fit_cgan(train, replace(SMOKE, steps=1, pixels=10_000), DbWindow(-30.0, 0.0))
    assert cgan.render(train.pose[0], grid).power.shape == grid.shape


def test_the_pose_is_told_by_directions_in_the_world_and_the_place_in_the_box():
    code = PoseCode(torch.tensor([0.0, 0, 1]), torch.tensor([4.0, 2, 1]), octaves=1)
    picture = code.picture(Pose.from_yaw((3.0, 1.0, 1.0), math.pi / 2).flat(), PINHOLE)
    assert picture.shape == (1, code.channels, 24, 36)
    turned = Pose.from_yaw((0.0, 0, 0), math.pi / 2).to_world(PINHOLE.directions)
    torch.testing.assert_close(picture[0, :3].movedim(0, -1), turned)
    expected = torch.tensor([0.5, 0, -1, 1, 0, 0, 0, 1, -1])
    torch.testing.assert_close(picture[0, 3:, 4, 9], expected, rtol=0, atol=1e-6)


def test_published_sizes_belong_to_the_paper_scale():
    paper = CganConfig.for_scale("paper", pictures=80, seed=3)
    assert paper == replace(CganConfig(), steps=2000, seed=3)
    assert CganConfig.for_scale("smoke").steps < CganConfig.for_scale("laptop").steps < CganConfig().steps


def test_what_cannot_be_learned_is_refused(few):
    train, window = few
    with pytest.raises(InputError, match="needs training spectra with a pose axis"):
        fit_cgan(train[0], SMOKE, window)
    tiny = pinhole_grid(12, 6, fov_deg=90)
    small = replace(train, power=torch.rand(6, 6, 12), grid=tiny, delay=None, aod=None)
    with pytest.raises(InputError, match="pictures of 8 pixels or more each way; got pinhole 12x6"):
        fit_cgan(small, SMOKE, window)
    with pytest.raises(TrainingError, match=r"lower lr, which is 1e\+30"):
        fit_cgan(train, replace(SMOKE, lr=1e30, steps=5), window)


def test_a_configuration_says_what_is_wrong_with_it():
    with pytest.raises(InputError, match="steps must be at least 1; got 0"):
        CganConfig(steps=0)
    with pytest.raises(InputError, match="must not be negative nor both zero; got 0 and 0"):
        CganConfig(adversarial=0, l1=0)
    with pytest.raises(InputError, match=r"got 1\.5, 0\.0002 and 1"):
        CganConfig(dropout=1.5)
    with pytest.raises(InputError, match='scale must be "smoke", "laptop" or "paper"; got \'huge\''):
        CganConfig.for_scale("huge")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_cuda_is_refused_where_there_is_none(few):
    train, window = few
    with pytest.raises(InputError, match='device is "cuda" but there is no CUDA device'):
        fit_cgan(train, replace(SMOKE, device="cuda"), window)
