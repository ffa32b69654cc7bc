import math
from dataclasses import replace

import pytest
import torch

from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.units import SPEED_OF_LIGHT, db_from_power, friis_gain
from rf3dgs.propagation.config import TraceConfig
from rf3dgs.propagation.sites import shapes
from rf3dgs.propagation.sites.lobby import lobby
from rf3dgs.propagation.sites.materials import (
    REFERENCE_ANGLE,
    SURFACES,
    mirror_loss,
    permittivity,
    scattering_amplitude,
    smooth_height,
)
from rf3dgs.propagation.sites.presets import PRESETS, preset_of
from rf3dgs.propagation.sites.scene import Scene, SceneObject
from rf3dgs.propagation.sites.scene_files import lobe_of_name, write_radio_scene
from rf3dgs.propagation.sites.scenes import scene_of

QUICK = TraceConfig(rays=20_000, depth=1, seed=3)


def plate(name, mesh, **more):
    vertices, faces, _ = mesh
    return SceneObject(name, vertices, faces, **{"material": "metal", "scattering": 0.0, **more})


def stage(*objects, frequency=10e9):
    bounds = ((-20.0, -20.0, -20.0), (20.0, 20.0, 20.0))
    return Scene("stage", objects, Pose((-2.0, 0.0, 1.0)), bounds, bounds, bounds, frequency)


@pytest.mark.parametrize("name", list(PRESETS))
def test_every_preset_gives_the_lobby_materials_at_its_frequency(name):
    preset = preset_of(name)
    scene, config = preset.applied(lobby("full", people=1), TraceConfig(seed=123))
    scene.check_radio(preset.frequency)
    assert scene.frequency == config.frequency == preset.frequency
    assert config.seed == 123
    assert (config.refraction, config.diffraction) == (preset.refraction, preset.diffraction)


def test_other_settings_stay_unless_the_preset_is_a_whole_set(site):
    wish = TraceConfig(rays=123, passes=2)
    config = preset_of("diffuse").applied(site, wish)[1]
    assert (config.rays, config.passes) == (123, 2)
    with pytest.raises(InputError, match="the preset 'paper' is a whole set and says how paths are traced"):
        preset_of("paper").applied(site, wish)


def test_the_diffuse_preset_scatters_nearly_everything_by_lamberts_law(site):
    scene, _ = preset_of("diffuse").applied(site)
    assert all(item.scattering >= 0.9 and item.alpha_r is None for item in scene.objects)


def test_realistic_mirrors_are_glass_metal_and_the_stone_floor(site):
    scene, _ = preset_of("realistic").applied(site)
    assert scene["floor"].material == "marble"
    for name in ("floor", "window-1", "lift-1"):
        assert scene[name].scattering < 0.1
    assert scene["ceiling"].scattering > 0.9
    assert scene["wall-east"].alpha_r == SURFACES["concrete"].alpha_r
    assert scene["plant-1"] is not site["wall-east"]
    assert scene["plant-1"].scattering == site["plant-1"].scattering


def test_surfaces_get_smoother_with_the_wavelength():
    for surface in SURFACES.values():
        values = [scattering_amplitude(surface, frequency) for frequency in (2.4e9, 10e9, 28e9, 60e9)]
        assert values == sorted(values)
        assert surface.inherent - 1e-12 <= values[0] <= values[-1] < 1


def test_scattered_and_mirrored_power_add_up_to_one():
    surface = SURFACES["concrete"]._replace(inherent=0.0)
    for frequency in (2.4e9, 60e9):
        mirrored = mirror_loss(surface.roughness, frequency, REFERENCE_ANGLE) ** 2
        assert scattering_amplitude(surface, frequency) ** 2 + mirrored == pytest.approx(1.0, abs=1e-12)


def test_rayleighs_height_shifts_the_phase_by_half_pi():
    for angle in (0.0, 0.7, 1.3):
        height = smooth_height(60e9, angle)
        assert 4 * math.pi * height * math.cos(angle) * 60e9 / SPEED_OF_LIGHT == pytest.approx(math.pi / 2)
        assert smooth_height(60e9, angle, parts=32) == pytest.approx(height / 4)
    assert smooth_height(60e9, math.pi / 2) == math.inf


@pytest.mark.parametrize(
    ("ghz", "eta", "sigma"),
    [(2.4, 38.1, 1.44), (10, 31.3, 8.01), (28, 16.6, 25.8), (60, 7.98, 36.4), (100, 5.60, 39.4)],
)
def test_skin_is_as_published(ghz, eta, sigma):
    """Tables computed from the model, to the three digits they are quoted with."""
    assert [f"{value:.3g}" for value in permittivity("skin", ghz * 1e9)] == [f"{eta:.3g}", f"{sigma:.3g}"]


def test_skin_reflects_what_other_models_of_it_do_at_60_ghz():
    """34 to 42 % of the power that meets it straight on, over models of skin (Wu, Rappaport and Collins, 2015)."""
    eta, sigma = permittivity("skin", 60e9)
    index = (eta - 1j * sigma / (2 * math.pi * 60e9 * 8.854e-12)) ** 0.5
    assert 0.34 < abs((1 - index) / (1 + index)) ** 2 < 0.42


def test_cloth_loses_a_fiftieth_per_radian_at_every_frequency():
    for frequency in (1e9, 28e9, 60e9, 100e9):
        eta, sigma = permittivity("cloth", frequency)
        assert eta == 1.7
        assert sigma / (2 * math.pi * frequency * 8.854e-12 * eta) == pytest.approx(0.02, rel=2e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"alpha_r": 0}, "alpha_r must be a whole number from 1 to 100; got 0"),
        ({"alpha_r": 2.5}, "alpha_r must be a whole number"),
        ({"electric": (0.5, 0.0)}, "electric must be a relative permittivity of at least 1"),
        ({"electric": (2.0, float("nan"))}, "electric must be"),
        ({"transparency": 1.0}, "transparency must be from 0 to below 1"),
        ({"thickness": 0.0}, "thickness .* positive"),
    ],
)
def test_impossible_materials_are_refused(site, change, message):
    with pytest.raises(InputError, match=message):
        replace(site["floor"], **change)


def test_unknown_presets_and_contradicting_frequencies_are_refused(site):
    with pytest.raises(InputError, match="no preset is named '60ghz'; use one of paper, diffuse, realistic, 28ghz"):
        preset_of("60ghz")
    with pytest.raises(InputError, match="made for 28 GHz; got the frequency 60 GHz"):
        preset_of("28ghz").applied(site, TraceConfig(frequency=60e9))
    with pytest.raises(InputError, match="puts things into the lobby; got the scene 'stage'"):
        preset_of("transparent").applied(stage())


def test_radio_xml_names_the_lobe_and_it_is_read_again(tracer, site, tmp_path):
    few = replace(site, objects=(replace(site["wall-west"], alpha_r=12), site["wall-north"]))
    again = scene_of(write_radio_scene(few, tmp_path))
    assert [item.alpha_r for item in again.objects] == [12, None]
    assert lobe_of_name("radio-wood-s0.8-d0.03-a12") == 12
    assert lobe_of_name("somebody-a12") is None


def test_a_narrow_lobe_gathers_the_diffuse_power_round_the_mirror_direction(tracer):
    ground = shapes.quad((-20, 20, 0), (40, 0, 0), (0, -40, 0))
    rx = Pose([[2.0, 0.0, 1.0]])
    mirror = torch.tensor([-2.0, 0.0, -1.0]) - rx.position[0]
    spread = {}
    for alpha in (None, 4, 30):
        scene = stage(plate("ground", ground, scattering=0.7, alpha_r=alpha), frequency=60e9)
        (row,) = tracer.trace_each(scene, None, rx, replace(QUICK, rays=100_000))
        diffuse = row.kind[0] == 2
        gain = row.path_gain[0][diffuse]
        angle = angle_between(row.aoa[0][diffuse], mirror.expand(int(diffuse.sum()), 3))
        spread[alpha] = float((gain * angle).sum() / gain.sum())
    assert spread[30] < 0.7 * spread[4] < 0.7 * spread[None]


def test_an_edge_diffracts_into_the_shadow_and_less_at_higher_frequency(tracer):
    ridge = plate("ridge", shapes.rod((0, 15, 0.5), (0, -15, 0.5), 1.0, 3), solid=True)  # its edge is 1.5 m high
    rx = Pose([[3.0, 0.3, 0.5]])
    gains = []
    for frequency in (2.4e9, 28e9):
        scene = stage(ridge, frequency=frequency)
        (dark,) = tracer.trace_each(scene, None, rx, QUICK)
        assert dark.coeff.shape[1] == 0
        (bent,) = tracer.trace_each(scene, None, rx, replace(QUICK, diffraction=True))
        assert bool((bent.kind & 8).all())
        gains.append(float(db_from_power(bent.total_gain[0] / friis_gain(torch.tensor(5.03), frequency))))
    # In the deep shadow an edge diffracts an amplitude of 1 / sqrt(k): 10 log10(28 / 2.4) = 10.7 dB less.
    assert -40 < gains[1] < gains[0] < -6
    assert gains[0] - gains[1] == pytest.approx(10.7, abs=0.7)


def test_a_tracer_without_edges_refuses_to_diffract(tracer):
    scene = stage(plate("screen", shapes.box((0, -1, -1), (0.1, 1, 1)), solid=True))
    ready = tracer.Tracer(scene, scene.frequency)
    with pytest.raises(InputError, match="made without diffraction"):
        ready.paths(scene.tx, Pose([[3.0, 0.0, 1.0]]), replace(QUICK, diffraction=True), 0)


def test_radio_passes_a_poster_wall_and_not_coated_glass(tracer, site):
    scene, config = preset_of("transparent").applied(site, QUICK)
    config = replace(config, diffuse=False, specular=False)
    loss = {}
    for name, side in (
        ("glass-partition", (1.0, 0.0, 0.0)),
        ("poster-wall", (0.0, 1.0, 0.0)),
        ("curtain", (1.0, 0.0, 0.0)),
    ):
        middle = scene[name].vertices.mean(0)
        away = torch.tensor(side)
        tx, rx = Pose(middle + away), Pose((middle - away)[None])
        only = replace(scene, objects=(scene[name],))
        (row,) = tracer.trace_each(only, tx, rx, config)
        seen = row.total_gain[0] / friis_gain(torch.tensor(2.0), 60e9)
        loss[name] = -float(db_from_power(seen.clamp_min(1e-9)))
    # A film of 5 ohms per square passes (2 R / (2 R + 377 ohm))^2 = 31.8 dB less; the sheets pass most of the wave.
    assert loss["glass-partition"] == pytest.approx(31.8, abs=1.0)
    assert loss["poster-wall"] < 10
    assert loss["curtain"] < 2


def test_presets_reach_the_scenes_of_sionna(tracer):
    street, config = preset_of("28ghz").applied(scene_of("simple_street_canyon"), QUICK)
    walls = [item for item in street.objects if item.material in SURFACES]
    assert walls
    assert all(item.alpha_r == SURFACES[item.material].alpha_r for item in walls)
    (row,) = tracer.trace_each(street, None, street.receivers(1, seed=0), config)
    assert row.frequency == 28e9
    assert int((row.kind == 2).sum()) > 0


def test_a_foreign_material_that_is_undefined_at_the_frequency_is_one_error(tracer):
    box = scene_of("box")
    with pytest.raises(InputError, match=r"scene 'box' has a material that is not defined at 200 GHz"):
        next(tracer.trace_each(box, None, box.receivers(1, seed=0), QUICK, frequency=200e9))


def test_refraction_is_off_unless_asked_for(tracer, site):
    scene, config = preset_of("transparent").applied(site, QUICK)
    only = replace(scene, objects=(scene["curtain"],))
    middle = scene["curtain"].vertices.mean(0)
    away = torch.tensor([1.0, 0.0, 0.0])
    off = replace(config, refraction=False, diffuse=False, specular=False)
    (row,) = tracer.trace_each(only, Pose(middle + away), Pose((middle - away)[None]), off)
    assert row.coeff.shape[1] == 0
