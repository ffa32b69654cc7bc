"""Sources fitted to spectra of a room of mirrors, whose truth is the shoebox tracer's."""

import math
from dataclasses import replace

import pytest
import torch

from rf3dgs.channel.paths import Paths
from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid
from rf3dgs.core.units import SPEED_OF_LIGHT
from rf3dgs.field.images import sequences
from rf3dgs.field.rays import RAY_FIELDS, Rays
from rf3dgs.field.sources import RIPPLE, PointSources
from rf3dgs.geometry import Patches, Planes, Surfaces
from rf3dgs.geometry.patches import surface_points
from rf3dgs.propagation.room import shoebox
from rf3dgs.propagation.sites.shapes import box
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.spectrum import Instrument, Spectrum
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.harmonics import C0
from rf3dgs.splats.obstacles import Obstacles
from rf3dgs.splats.surface import sample_mesh
from rf3dgs.training.config import SourceConfig
from rf3dgs.training.marks import Paint, fit_deviations
from rf3dgs.training.radio_views import ruled
from rf3dgs.training.reflection import (
    Glints,
    expected_db,
    fit_reflection,
    glints,
    on_time,
    outshone,
    ray_powers,
    silent_planes,
)
from rf3dgs.training.source_fit import USUAL, USUAL_OF_MESHES, _gated, fit_sources
from rf3dgs.training.timed_mirrors import timed_mirrors, with_timed
from rf3dgs.training.virtual import Mirror, peaks_of

SIZE = torch.tensor([9.0, 7.0, 3.2])
TX = torch.tensor([2.1, 1.7, 2.6])
FREQUENCY = 60e9
GAMMA_DB = (-6.0, -9.0, -12.0, -7.0, -10.0, -8.0)
FREE = Obstacles(torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3), torch.zeros(0))


def receivers(count: int, seed: int) -> Pose:
    generator = torch.Generator().manual_seed(seed)
    return Pose(0.7 + (SIZE - 1.4) * torch.rand(count, 3, generator=generator) * torch.tensor([1.0, 1.0, 0.7]))


def traced(pose: Pose) -> Paths:
    return shoebox(SIZE.tolist(), Pose(TX), pose, FREQUENCY, 2, [-(10 ** (level / 20)) for level in GAMMA_DB])


def measured(pose: Pose) -> Spectrum:
    """Paths of at most two reflections through a lobe of 4 degrees, over a haze of power from everywhere."""
    spectrum = spectrum_of(traced(pose), None, equirect_grid(180, 90), lobe=math.radians(4.0))
    generator = torch.Generator().manual_seed(1)
    haze = 3e-5 * spectrum.power.amax((-2, -1), keepdim=True)
    return replace(
        spectrum, power=spectrum.power + haze * (0.5 + torch.rand(spectrum.power.shape, generator=generator))
    )


def walls(*, without: int | None = None, turned_deg: float = 0.0, moved: float = 0.0) -> Surfaces:
    """The six walls, or five; each turned about its middle and moved by as much as said."""
    normals, offsets, points = [], [], []
    generator = torch.Generator().manual_seed(2)
    for axis in range(3):
        for high in (0, 1):
            if 2 * axis + high == without:
                continue
            spots = torch.rand(20_000, 3, generator=generator) * SIZE
            spots[:, axis] = SIZE[axis] * high
            normal = torch.eye(3)[axis] * (1.0 - 2.0 * high)
            lean = torch.eye(3)[(axis + 1) % 3]
            turn = math.radians(turned_deg)
            turned = math.cos(turn) * normal + math.sin(turn) * lean
            middle = spots.mean(0)
            normals.append(turned)
            offsets.append(turned @ middle + moved)
            points.append(spots)
    planes = Planes(torch.stack(normals), torch.stack(offsets))
    none = torch.zeros(0, dtype=torch.long)
    return Surfaces(planes, Patches.of(planes, points), none, none, torch.zeros(0, 3))


@pytest.fixture(scope="module")
def spectra() -> Spectrum:
    return measured(receivers(16, 0))


@pytest.fixture(scope="module")
def fitted(spectra):
    return fit_sources(spectra, walls(), FREE, Pose(TX), SourceConfig(complete=False))


def missed(sources: PointSources, count: int = 8, seed: int = 9) -> tuple[float, float, float]:
    """Share of the tracer's paths within 25 dB that no ray is within 1 degree and 1 ns of; their errors otherwise."""
    pose = receivers(count, seed)
    paths, lost, total, angles, levels = traced(pose), 0, 0, [], []
    for number, rays in enumerate(sources.rays_each(pose.position, FREE)):
        gain = paths.path_gain[number]
        for path in torch.nonzero(gain > 3e-3 * gain.max()).squeeze(-1).tolist():
            angle = torch.rad2deg(angle_between(rays.arrival, paths.aoa[number, path].expand(len(rays), 3)))
            good = (angle < 1.0) & ((rays.delay - paths.delay[number, path]).abs() < 1e-9)
            total += 1
            if not bool(good.any()):
                lost += 1
                continue
            best = int(torch.where(good, angle, torch.inf).argmin())
            angles.append(float(angle[best]))
            levels.append(abs(float(10 * torch.log10(rays.power[best] / gain[path]))))
    return lost / total, float(torch.tensor(angles).median()), float(torch.tensor(levels).median())


def test_all_images_of_known_walls_are_found_with_their_level(fitted):
    lost, angle, level_db = missed(fitted.sources)
    assert lost == 0.0
    assert angle < 0.2
    assert level_db < 0.5
    for plane, truth in enumerate(GAMMA_DB):
        a, b, c = fitted.sources.reflection[plane].tolist()
        own = (fitted.found.order == 1) & (fitted.found.plane[:, 0] == plane) & fitted.found.alone
        cosine = fitted.found.cosine[own, 0].median()
        assert abs(float(a + b * cosine + c * cosine**2) - truth) < 1.0
    assert bool(fitted.seen.all())
    assert abs(fitted.sources.level_db) < 0.3


def test_the_walls_are_refined_by_the_peaks(spectra):
    """Walls that are 2 degrees and 4 cm off lose paths; the bearings of their images bring them back."""
    wrong = walls(turned_deg=1.5, moved=0.03)
    loose = SourceConfig(complete=False, plane_error=0.05, plane_error_deg=2.0)
    kept = fit_sources(spectra, wrong, FREE, Pose(TX), replace(loose, refine=False)).sources
    moved = fit_sources(spectra, wrong, FREE, Pose(TX), loose).sources
    before, after = missed(kept), missed(moved)
    assert before[0] > 0.2
    assert after[0] < 0.1
    cosine = (moved.planes.normals * walls().planes.normals).sum(-1).clamp(-1, 1)
    assert math.degrees(float(cosine.arccos().median())) < 0.4


def test_a_wall_that_geometry_lacks_is_found_from_the_peaks(spectra):
    """Without the east wall its image is met by bearings; the plane is the bisector, and its surface where it shone."""
    spectra = replace(spectra, delay=None, aod=None)
    for without in (1, 5):
        fit = fit_sources(spectra, walls(without=without), FREE, Pose(TX), SourceConfig())
        truth = walls().planes
        alike = (fit.sources.planes.normals @ truth.normals[without]).abs() > math.cos(math.radians(1.0))
        near = (fit.sources.planes.offsets.abs() - truth.offsets[without].abs()).abs() < 0.1
        assert bool((alike & near).any())
        known = missed(
            fit_sources(spectra, walls(without=without), FREE, Pose(TX), SourceConfig(complete=False)).sources
        )
        assert missed(fit.sources)[0] < 0.75 * known[0]


def mirrors_of(shown, along):
    """The mirrors that peaks of spectra tell, beside walls with normals `along`."""
    return timed_mirrors(peaks_of(shown), shown, TX, along)


def test_delay_and_departure_of_single_peaks_tell_the_walls(spectra):
    """Six images of one reflection, each in its place; what two or three reflections made is not taken for a wall."""
    truth, found = walls().planes, mirrors_of(spectra, walls().planes.normals)
    assert len(found) == 6
    for mirror in found:
        plane = int((truth.normals @ mirror.normal).argmax())
        # Half a pixel of bearing is a degree; the median of a few images 5 m away is within 3 cm.
        assert float(truth.normals[plane] @ mirror.normal) > math.cos(math.radians(0.5))
        assert abs(float(truth.offsets[plane] - mirror.offset)) < 0.03
        assert float((mirror.points @ truth.normals[plane] - truth.offsets[plane]).abs().max()) < 0.05
    assert mirrors_of(replace(spectra, delay=None, aod=None), walls().planes.normals) == []


def showing(pose: Pose, images: list[torch.Tensor], *, often: list[int] | None = None) -> Spectrum:
    """What `pose` measures of the room if it shows the transmitter and these `images` [m] alone, each at the first so
    many positions as `often` says."""
    paths = traced(pose)
    place = pose.position[:, None] + SPEED_OF_LIGHT * paths.delay[..., None] * paths.aoa
    near = torch.cdist(place, torch.stack((TX, *images))) < 0.01
    limit = torch.tensor([len(pose), *(often or [len(pose)] * len(images))])
    kept = (near & (torch.arange(len(pose))[:, None, None] < limit)).any(-1)
    seen = replace(paths, coeff=torch.where(kept, paths.coeff, 0.0))
    return spectrum_of(seen, None, equirect_grid(180, 90), lobe=math.radians(4.0))


FLOORED, BOTH = TX * torch.tensor([1.0, 1.0, -1.0]), torch.tensor([2 * SIZE[0] - TX[0], TX[1], -TX[2]])
EASTERN = BOTH * torch.tensor([1.0, 1.0, -1.0])


def test_one_position_is_witness_of_a_mirror_along_a_wall():
    """The east wall shines at one of forty. Without walls that it could stand along nothing is made of that."""
    shown = showing(receivers(40, 0), [FLOORED, EASTERN], often=[40, 1])
    floor, board = mirrors_of(shown, walls().planes.normals)
    assert len(floor.points) > 10
    assert len(board.points) == 1
    assert float(board.normal[0]) < -math.cos(math.radians(0.5))
    assert float(-board.offset) == pytest.approx(float(SIZE[0]), abs=0.03)
    assert len(mirrors_of(shown, torch.zeros(0, 3))) == 1


def test_an_image_behind_what_bounds_the_site_is_no_mirror():
    """Two reflections in two far walls may look like one; its mirror would stand behind the wall itself."""
    opposite = torch.tensor([-2 * SIZE[0] + TX[0], TX[1], TX[2]])  # in the east wall and then in the western one
    western = TX * torch.tensor([-1.0, 1.0, 1.0])
    shown = showing(receivers(40, 0), [western, opposite], often=[40, 3])
    (known,) = mirrors_of(shown, walls().planes.normals)
    assert float(known.normal[0]) > math.cos(math.radians(0.5))


def test_a_mirror_that_one_position_saw_moves_what_stands_there():
    """Of two faces in nearly one plane that beside the reflection is moved; where nothing stands one is new."""
    planes = Planes(torch.tensor([[0.0, -1.0, 0.0], [0.2, -0.98, 0.0]]), torch.tensor([-4.05, -3.2]))
    axis = torch.arange(0.05, 0.6, 0.1)
    cells = torch.cartesian_prod(axis, torch.zeros(1), torch.arange(0.05, 3.0, 0.1))
    normal = torch.nn.functional.normalize(planes.normals[1], dim=0)
    planes = Planes(torch.stack((planes.normals[0], normal)), torch.stack((planes.offsets[0], normal[0] * 4.5 - 4.05)))
    far = cells + torch.tensor([9.0, 4.05, 0.0])
    near = cells + torch.tensor([4.2, 0.0, 0.0])
    near = near + ((planes.offsets[1] - near @ normal) / normal[1])[:, None] * torch.tensor([0.0, 1.0, 0.0])
    sources = PointSources(TX, FREQUENCY, planes, Patches.of(planes, [far, near]), sequences(2, 1), torch.zeros(2, 3))

    def put_right(x: float) -> Planes:
        spot = torch.tensor([[x, 4.1, 1.5]])
        image = TX * torch.tensor([1.0, -1.0, 1.0]) + torch.tensor([0.0, 8.2, 0.0])
        mirror = Mirror(torch.tensor([0.0, -1.0, 0.0]), torch.tensor(-4.1), spot, image, torch.zeros(1, 3))
        return with_timed(sources, [mirror])[0]

    moved = put_right(4.5)
    assert moved.normals[1].tolist() == pytest.approx([0.0, -1.0, 0.0], abs=1e-6)
    assert moved.offsets.tolist() == pytest.approx([-4.05, -4.1])
    added = put_right(7.0)
    assert torch.equal(added.normals[:2], planes.normals)
    assert added.offsets[2:].tolist() == pytest.approx([-4.1])


def test_what_a_board_and_the_floor_reflect_is_no_tilted_mirror():
    """Of the east wall only its reflections over the floor are seen: one mirror through the edge would do the same."""
    shown = showing(receivers(40, 0), [FLOORED, BOTH])
    floor = torch.tensor([0.0, 0.0, 1.0])
    (known,) = mirrors_of(shown, walls().planes.normals)
    assert float(known.normal @ floor) > math.cos(math.radians(0.5))
    first, second = timed_mirrors(
        peaks_of(shown), shown, TX, torch.zeros(0, 3)
    )  # without walls nothing tells it from a tilted one
    assert float(first.normal @ floor) > math.cos(math.radians(0.5))
    assert 0.2 < float(second.normal @ floor) < 0.5


def test_a_wall_far_from_its_place_is_moved_into_it(spectra):
    """27 cm are more than bearings can be matched over: the wall's rays lie 5 degrees beside its peaks."""
    wrong = walls(moved=0.27)
    fit = fit_sources(spectra, wrong, FREE, Pose(TX), SourceConfig())
    assert len(fit.sources.planes) == 6
    assert float((fit.sources.planes.offsets - walls().planes.offsets).abs().max()) < 0.03
    assert missed(fit.sources)[0] < 0.1
    assert missed(fit_sources(spectra, wrong, FREE, Pose(TX), SourceConfig(complete=False)).sources)[0] > 0.5


def haze(count: int, opacity: float) -> Obstacles:
    """Round Gaussians of 15 cm all over the room."""
    generator = torch.Generator().manual_seed(5)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4).contiguous()
    means = torch.rand(count, 3, generator=generator) * SIZE
    return Obstacles(means, quats, torch.full((count, 3), 0.15), torch.full((count,), opacity))


def test_a_way_lets_pass_what_its_darkest_leg_does(fitted):
    here, obstacles = torch.tensor([6.5, 5.0, 1.2]), haze(150, 0.5)
    rays, share = fitted.sources.candidates(here, obstacles)
    assert set(rays.order.tolist()) == {0, 1, 2}
    for ray in range(len(rays)):
        legs = int(rays.order[ray]) + 1
        stops = torch.cat((TX[None], rays.points[ray, : legs - 1], here[None]))
        passed = obstacles.transmittance(stops[:-1], stops[1:])
        # Both are float32, and stops and obstacles are the same.
        assert float(share[ray]) == pytest.approx(float(passed.min()), rel=1e-4, abs=1e-6)


def test_the_gate_follows_reflections_that_shine_through_haze(spectra):
    """Haze that darkens legs to a third does not close what the spectra show: nobody's sight and no reflection."""
    clear = fit_sources(spectra, walls(), FREE, Pose(TX), SourceConfig(complete=False, order=1))
    nothing = torch.full((120,), -1)
    along = torch.eye(3)[:1].expand(120, 3)
    hazy = replace(walls(), plane_of=nothing, segment_of=nothing, normals=along)
    through = fit_sources(spectra, hazy, haze(120, 0.4), Pose(TX), SourceConfig(complete=False, order=1))
    ways = [int(sum(len(one) for one in fit.rays)) for fit in (clear, through)]
    assert ways[1] > 0.9 * ways[0]


def test_the_gate_asks_more_proof_of_peaks_without_delay(fitted, spectra):
    """Haze in four of sixteen lines of sight: with delays that is enough for a lower gate, without it is not."""
    middles = 0.5 * (TX + spectra.pose.position[::4])
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(4, 4).contiguous()
    lumps = Obstacles(middles, quats, torch.full((4, 3), 0.03), torch.tensor([0.649, 0.65, 0.651, 0.652]))
    assert bool(fitted.seen.all())
    assert _gated(fitted.sources, spectra, fitted.seen, lumps).open_above == 0.3  # the highest gate that 0.35 passes
    untimed = replace(spectra, delay=None, aod=None)
    assert _gated(fitted.sources, untimed, fitted.seen, lumps).open_above == USUAL
    sampled = replace(lumps, opacities=torch.full((4,), 0.65))
    assert _gated(fitted.sources, spectra, fitted.seen, sampled).open_above == USUAL_OF_MESHES  # 0.35 passes that, too
    assert _gated(fitted.sources, untimed, fitted.seen, sampled).open_above == USUAL


@pytest.mark.parametrize("spacing", [0.06, 0.1, 0.15])
def test_the_gate_of_meshes_opens_within_three_centimetres_of_an_edge(spacing):
    """Half of a ray passes only 3 to 5 cm beside the edge of a sampled box; nothing does within it."""
    vertices, faces, _ = box((-0.3, -0.3, 0.0), (0.3, 0.3, 3.5))
    post = sample_mesh(vertices, faces, spacing=spacing, thickness=0.007)
    obstacles = Obstacles(post.means, post.quats, post.scales, post.opacities)
    height = torch.linspace(0.5, 3.0, 60)

    def passed(beside: float) -> float:
        start = torch.stack((torch.full((60,), -5.0), torch.full((60,), 0.3 + beside), height), -1)
        return float(obstacles.transmittance(start, start * torch.tensor([-1.0, 1.0, 1.0])).median())

    assert passed(-0.01) < 0.05
    assert passed(0.03) > USUAL_OF_MESHES
    assert passed(0.02) < 0.5


def test_what_hides_a_reflection_that_shines_is_cleared(spectra):
    """A lump in a way that a training position sees open, and one that no such way meets."""
    clear = fit_sources(spectra, walls(), FREE, Pose(TX), SourceConfig(complete=False, refine=False, order=1))
    found = clear.found
    one = int(torch.nonzero(found.alone & found.seen)[0])
    middle = 0.5 * (found.point[one, 0] + spectra.pose.position[found.position[one]])
    aside = torch.tensor([[0.3, 0.3, 0.3]])
    means = torch.cat((middle[None], aside))
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(2, 4).contiguous()
    lumps = Obstacles(means, quats, torch.full((2, 3), 0.05), torch.full((2,), 0.95))
    none = torch.full((2,), -1)
    known = replace(walls(), plane_of=none, segment_of=none, normals=torch.eye(3)[:1].expand(2, 3))
    fit = fit_sources(spectra, known, lumps, Pose(TX), SourceConfig(complete=False, refine=False, order=1))
    assert float(fit.obstacles.opacities[0]) == pytest.approx(0.05, abs=0.01)  # it stands in the middle of the way
    assert float(fit.obstacles.opacities[1]) > 0.9


def test_a_peak_at_the_wrong_time_is_no_reflection(fitted, spectra):
    rays, one = fitted.rays[0], spectra[0]
    first = rays.only(rays.order == 1)
    assert bool(on_time(one, first).any())
    late = replace(one, delay=one.delay + 3e-9)
    assert not bool(on_time(late, first).any())
    assert bool(on_time(replace(one, delay=None, aod=None), first).all())
    single = [rays.only(rays.order <= 1)]
    before = glints(fitted.sources, single, spectra[:1])
    after = glints(fitted.sources, single, replace(spectra[:1], delay=spectra.delay[:1] + 3e-9))
    assert bool(before.seen.any())
    assert not bool(after.seen.any())
    # What stands there instead bounds the reflection's level from above.
    assert torch.equal(after.limit_db[before.seen], before.level_db[before.seen])


def test_points_rule_the_pixels_of_their_beams(fitted, spectra):
    for number in range(3):
        share, rule = ruled(spectra[number], fitted.rays[number])
        assert bool((share >= 0).all())
        assert 0.003 < float(rule.float().mean()) < 0.3
        strong = fitted.rays[number].power > 1e-2 * fitted.rays[number].power.max()
        pixel, _ = spectra.grid.pixel_of(fitted.rays[number].arrival[strong])
        col, row = pixel.long().unbind(-1)
        assert bool(rule[row.clamp_max(89), col.clamp_max(179)].all())


def test_a_door_in_a_wall_is_marked():
    """Levels of one plane that are 12 dB higher in one part than in the other are told by the place."""
    spectra = measured(receivers(24, 3))
    fit = fit_sources(spectra, walls(), FREE, Pose(TX), SourceConfig(order=1, complete=False, refine=False))
    found = fit.found
    door = (found.plane[:, 0] == 3) & (found.point[:, 0, 0] > 4.5)
    louder = replace(found, level_db=found.level_db + 12.0 * door)
    reflection = fit_reflection(louder, 6)
    plain = replace(fit.sources, reflection=reflection, marks=None, ripple=None, slabs=None)
    marks, ripple = fit_deviations(louder, plain)
    assert marks is not None
    sources = replace(plain, marks=marks, ripple=ripple)
    wall = louder.alone & louder.seen & (louder.plane[:, 0] == 3)
    peaks = louder.only(wall)
    errors = [float((expected_db(peaks, one) - peaks.level_db).abs().median()) for one in (sources, plain)]
    assert errors[0] < 1.0
    assert errors[0] < 0.5 * errors[1]


@pytest.mark.parametrize("wood", [(1.0, 0.0, -1.0), (-1.5, -1.5, -1.5)])
def test_marks_end_where_looks_do(wood):
    """Peaks on a grey door and on its wall, far apart: a place between them goes with what it looks like, however the
    light falls."""
    generator = torch.Generator().manual_seed(6)
    spots = torch.rand(4000, 3, generator=generator) * torch.tensor([9.0, 0.0, 3.0])
    door = spots[:, 0] > 5.0
    colour = 0.5 + C0 * torch.where(door[:, None], torch.ones(3), torch.tensor(wood))
    lamp = 0.8 + 0.2 * torch.cos(spots[:, :1])
    sh = ((colour * lamp - 0.5) / C0)[:, None]
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(4000, 4)
    shape = (spots, quats, torch.full((4000, 3), -3.0), torch.full((4000,), 3.0), sh)
    paint = Paint.of(Gaussians(*shape), torch.zeros(4000, dtype=torch.long))
    planes = Planes(torch.tensor([[0.0, 1.0, 0.0]]), torch.zeros(1))
    places = torch.rand(24, 3, generator=generator) * torch.tensor([9.0, 0.0, 3.0])
    places = places[(places[:, 0] - 5.0).abs() > 1.0]
    found = peaks_at(places, torch.where(places[:, 0] > 5.0, 2.0, -10.0))
    plain = one_plane(planes, spots)
    marks, ripple = fit_deviations(found, plain, paint)
    assert marks is not None
    beside = torch.tensor([[5.5, 0.0, 1.5], [4.5, 0.0, 1.5]])  # two brushes from the edge
    asked = peaks_at(beside, torch.zeros(2))
    at_door, at_wall = (expected_db(asked, replace(plain, marks=marks, ripple=ripple)) + 10.0).tolist()
    assert at_door > 8.0
    assert abs(at_wall) < 2.0


def test_a_level_that_comes_and_goes_with_the_angle_is_a_ripple():
    """A thin layer: the level swings by 3 dB while the cosine changes by 0.15, the same all over the plane."""
    generator = torch.Generator().manual_seed(7)
    spots = torch.rand(4000, 3, generator=generator) * torch.tensor([9.0, 0.0, 3.0])
    planes = Planes(torch.tensor([[0.0, 1.0, 0.0]]), torch.zeros(1))
    cosine = 0.2 + 0.7 * torch.rand(60, generator=generator, dtype=torch.float64)

    def swing(cosine: torch.Tensor) -> torch.Tensor:
        return 3.0 * torch.sin(2 * math.pi * cosine / 0.3)

    found = replace(
        peaks_at(spots[:60], -10.0 + swing(cosine)), cosine=torch.stack((cosine, *torch.ones(2, 60).double()), -1)
    )
    marks, ripple = fit_deviations(found, one_plane(planes, spots))
    assert ripple is not None
    inside = slice(20, 69)
    wanted = swing(torch.linspace(0, 1, RIPPLE, dtype=torch.float64))
    assert float((ripple[0].double() - wanted)[inside].abs().mean()) < 0.5
    assert marks is None or float(marks.level_db.abs().mean()) < 1.0


def test_two_reflections_tell_deviations_only_where_delays_do():
    """On a floor that is 12 dB brighter where only ways over a wall come from: marks rise there if peaks are timed."""
    planes = Planes(torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]), torch.zeros(2))
    generator = torch.Generator().manual_seed(8)
    floor = torch.rand(4000, 3, generator=generator) * torch.tensor([9.0, 0.0, 3.0])
    wall = floor[:, [1, 0, 2]]
    places = torch.rand(60, 3, generator=generator) * torch.tensor([9.0, 0.0, 3.0])
    bright = places[:, 0] > 5.0
    twice = bright[:, None] & torch.tensor([False, True, False])
    found = peaks_at(places, torch.where(bright, 2.0, -10.0))
    found = replace(found, plane=torch.where(twice, 1, found.plane))
    rows, laws = torch.tensor([[-1, -1, -1], [0, -1, -1]]), torch.tensor([[-10.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    plain = PointSources(TX, FREQUENCY, planes, Patches.of(planes, [floor, wall]), rows, laws)

    def told_db(found: Glints) -> float:
        marks, ripple = fit_deviations(found, plain)
        asked = peaks_at(torch.tensor([[7.0, 0.0, 1.5]]), torch.zeros(1))
        return float(expected_db(asked, replace(plain, marks=marks, ripple=ripple))) + 10.0

    assert told_db(found) > 8.0
    assert abs(told_db(replace(found, timed=torch.zeros_like(found.timed)))) < 1.0


def peaks_at(places: torch.Tensor, level_db: torch.Tensor) -> Glints:
    """Peaks of one reflection at places `[n, 3]` of one plane."""
    count = len(places)
    none, yes = torch.full((count, 2), -1), torch.ones(count, dtype=torch.bool)
    zeros = torch.zeros(count, dtype=torch.long)
    plane = torch.cat((zeros[:, None], none), -1)
    levels = (level_db.double(), torch.full((count,), -60.0).double())
    cosine = torch.ones(count, 3, dtype=torch.float64)
    point, departure = places[:, None].expand(-1, 3, 3), torch.tensor([0.0, -1.0, 0.0]).expand(count, 3)
    return Glints(torch.arange(count), zeros, plane, point, cosine, departure, *levels, yes, yes, yes)


def one_plane(planes: Planes, spots: torch.Tensor) -> PointSources:
    """One plane with surface around `spots` `[n, 3]`, which takes 10 dB of what it reflects."""
    rows, law = torch.tensor([[-1, -1, -1], [0, -1, -1]]), torch.tensor([[-10.0, 0.0, 0.0]])
    return PointSources(TX, FREQUENCY, planes, Patches.of(planes, [spots]), rows, law)


def test_a_law_is_that_of_most_of_a_plane_not_of_where_most_look():
    """Twelve peaks on one door, seven all over its wall."""
    generator = torch.Generator().manual_seed(8)
    door = torch.tensor([6.0, 0.0, 1.2]) + 0.15 * torch.randn(12, 3, generator=generator)
    wall = torch.stack((torch.linspace(0.5, 5.0, 7), torch.zeros(7), torch.full((7,), 1.5)), -1)
    level = torch.cat((torch.full((12,), 0.0), torch.full((7,), -12.0)))
    law = fit_reflection(peaks_at(torch.cat((door, wall)), level), 1)
    assert float(law.sum()) == pytest.approx(-12.0, abs=2.0)


def test_a_reflection_is_heard_through_a_weak_one_that_arrives_with_it(spectra, fitted):
    """A transmitter beside a wall sends everything twice: over the wall it is the weaker."""
    single = fitted.rays[0].only(fitted.rays[0].order == 1)
    assert len(single) == 6
    twin = replace(single, power=0.03 * single.power, index=single.index + 1)
    both = Rays(*(torch.cat((getattr(single, name), getattr(twin, name))) for name in RAY_FIELDS))
    assert outshone(both, 0.05).tolist() == [False] * 6 + [True] * 6
    alike = replace(both, power=torch.cat((single.power, 0.3 * single.power)))
    assert not bool(outshone(alike, 0.05).any())
    alone = glints(fitted.sources, [single], spectra[:1])
    together = glints(fitted.sources, [both], spectra[:1])
    assert together.source.tolist() == alone.source.tolist()
    torch.testing.assert_close(together.level_db, alone.level_db)


def test_where_a_plane_has_surface_a_mirror_adds_none():
    """A partition of 2 x 1.9 m that reflected near its top keeps its height; where it has a hole it is closed."""
    planes = Planes(torch.tensor([[0.0, 1.0, 0.0]]), torch.zeros(1))
    cells = torch.cartesian_prod(torch.arange(0.05, 2.0, 0.1), torch.zeros(1), torch.arange(0.05, 1.9, 0.1))
    hole = (cells[:, 0] - 1.0).abs() < 0.4
    patches = Patches.of(planes, [cells[~hole]])
    sources = PointSources(
        torch.tensor([1.0, 3.0, 2.0]), FREQUENCY, planes, patches, sequences(1, 1), torch.zeros(1, 3)
    )
    image = torch.tensor([1.0, -3.0, 2.0])

    def seen_at(*spots: list[float]) -> Patches:
        found = Mirror(planes.normals[0], planes.offsets[0], torch.tensor(spots), image, torch.zeros(len(spots), 3))
        return with_timed(sources, [found])[1]

    assert float(seen_at([0.3, 0.0, 1.8], [1.8, 0.0, 1.8]).areas[0]) == pytest.approx(float(patches.areas[0]))
    filled = seen_at([0.3, 0.0, 1.8], [1.0, 0.0, 0.9])
    assert bool(filled.holds(torch.tensor([1.0, 0.0, 0.9]), torch.tensor(0)))
    assert float(filled.areas[0]) > float(patches.areas[0]) + 0.3


@pytest.mark.parametrize(("side", "wide"), [(1.6, False), (3.0, True)])
def test_surface_about_reflections_is_narrow_off_small_planes_and_wide_off_large_ones(side: float, wide: bool):
    """Two reflections 1.3 m apart, beyond a table's end: 40 cm about each; beyond a wall's they are joined."""
    planes = Planes(torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1))
    steps = torch.arange(0.05, side, 0.1)
    patches = Patches.of(planes, [torch.cartesian_prod(steps, steps, torch.zeros(1))])
    sources = PointSources(
        torch.tensor([1.0, 1.0, 3.0]), FREQUENCY, planes, patches, sequences(1, 1), torch.zeros(1, 3)
    )
    spots = torch.tensor([[side + 1.0, 0.5, 0.0], [side + 1.0, 1.8, 0.0]])
    spots = torch.cat((spots, spots + torch.tensor([0.05, 0.0, 0.0])))
    found = Mirror(planes.normals[0], planes.offsets[0], spots, torch.tensor([1.0, 1.0, -3.0]), torch.zeros(4, 3))
    after = with_timed(sources, [found])[1]
    assert bool(after.holds(torch.tensor([side + 1.0, 1.15, 0.0]), torch.tensor(0))) == wide
    assert (float(after.areas[0] - patches.areas[0]) > 1.4) == wide
    assert bool(after.holds(spots, torch.zeros(4, dtype=torch.long)).all())


def test_ways_of_two_reflections_tell_what_a_plane_reflects(fitted):
    """Without a single reflection of it, a wall's level comes from ways over it and another wall."""
    found = fitted.found
    hidden = (found.order == 1) & (found.plane[:, 0] == 3)
    assert bool(((found.order == 2) & (found.plane == 3).any(-1) & found.alone & found.seen).any())
    told = fit_reflection(found.only(~hidden), 6)[3]
    cosine = float(found.cosine[hidden, 0].median())
    assert abs(float(told @ torch.tensor([1.0, cosine, cosine**2])) - GAMMA_DB[3]) < 1.5


def test_marks_are_left_out_where_planes_are_uniform(fitted):
    assert fitted.sources.marks is None


@pytest.mark.parametrize("over_db", [10.0, 40.0, 80.0])
def test_powers_of_beams_are_right_however_far_they_stand_over_their_surroundings(over_db):
    lobe = Instrument.gaussian(math.radians(4.0))
    azimuth = torch.tensor([0.3, 0.3 + math.radians(6.0), 2.0])
    arrival = torch.stack((azimuth.cos(), azimuth.sin(), torch.zeros(3)), -1)
    grid, truth = equirect_grid(180, 90), 1e-10 * torch.tensor([1.0, 0.2, 0.01], dtype=torch.float64)
    angle = angle_between(*torch.broadcast_tensors(grid.directions[:, :, None], arrival))
    power = (lobe.kernel(angle).double() * truth).sum(-1) + 1e-10 * 10 ** (-over_db / 10)
    found, _ = ray_powers(Spectrum(power, grid, Pose(torch.zeros(3)), 60e9, lobe, "ideal"), arrival)
    torch.testing.assert_close(found, truth, rtol=0.02, atol=1e-13)  # float32 angles; the third is the haze at 10 dB


def test_a_mirror_that_is_nowhere_seen_falls_silent(spectra):
    """A plane in mid-room that reflects nothing: its image is looked for and not seen."""
    true = walls()
    middle = torch.rand(4000, 3, generator=torch.Generator().manual_seed(4)) * SIZE
    middle[:, 0] = 7.5
    normals = torch.cat((true.planes.normals, torch.tensor([[-1.0, 0.0, 0.0]])))
    planes = Planes(normals, torch.cat((true.planes.offsets, torch.tensor([-7.5]))))
    points = [*surface_points(true.planes, true.patches), middle]
    surfaces = replace(true, planes=planes, patches=Patches.of(planes, points))
    fit = fit_sources(spectra, surfaces, FREE, Pose(TX), SourceConfig(refine=False, complete=False))
    assert fit.sources.mirrors.tolist() == [True] * 6 + [False]
    assert not bool((fit.sources.sequence == 6).any())


def test_an_oblique_plane_mirrors_only_if_it_was_seen_to():
    """A wall seen ten times, a square plane and an oblique one of which nobody tells, and oblique ones that were seen
    at two of three and at one of two positions.
    """
    asked, heard = torch.tensor([10, 0, 0, 3, 2]), torch.tensor([10, 0, 0, 2, 1])
    found = peaks_at(torch.zeros(15, 3), torch.full((15,), -10.0))
    plane = found.plane.clone()
    plane[:, 0] = torch.repeat_interleave(torch.arange(5), asked)
    seen = torch.cat([torch.arange(int(a)) < h for a, h in zip(asked, heard, strict=True)])
    found = replace(found, plane=plane, seen=seen)
    oblique = torch.tensor([False, False, True, True, True])
    assert silent_planes(found, 5, oblique).tolist() == [False, False, True, False, True]


def test_peaks_that_are_not_seen_lower_a_plane_and_do_not_raise_it():
    sources = PointSources(
        TX, FREQUENCY, walls().planes, None, sequences(6, 1), torch.tensor([-8.0, 0.0, 0.0]).expand(6, 3)
    )
    pose = receivers(10, 5)
    spectra = measured(pose)
    found = glints(sources, sources.rays_each(pose.position, FREE), spectra)
    deaf = replace(found, seen=torch.zeros_like(found.seen), limit_db=torch.full_like(found.limit_db, -30.0))
    level = fit_reflection(deaf, 6).sum(-1)
    assert float(level.max()) < -25.0
    above = replace(deaf, limit_db=torch.full_like(found.limit_db, 0.0))
    torch.testing.assert_close(
        fit_reflection(above, 6),
        fit_reflection(found.__class__(*[getattr(found, name)[:0] for name in found.__dataclass_fields__]), 6),
        atol=0.5,
        rtol=0,
    )


def test_the_same_seed_gives_the_same_sources(spectra, fitted):
    again = fit_sources(spectra, walls(), FREE, Pose(TX), SourceConfig(complete=False))
    assert torch.equal(again.sources.sequence, fitted.sources.sequence)
    assert torch.equal(again.sources.reflection, fitted.sources.reflection)


def test_no_planes_leave_the_line_of_sight(spectra):
    for surfaces, config in ((None, SourceConfig()), (walls(), SourceConfig(order=0))):
        fit = fit_sources(spectra, surfaces, FREE, Pose(TX), config)
        assert len(fit.sources) == 1
        assert [rays.order.tolist() for rays in fit.rays] == [[0]] * len(spectra)


def test_an_order_that_is_not_offered_is_refused(spectra):
    with pytest.raises(InputError, match="order must be from 0 to 3; got 4"):
        fit_sources(spectra, walls(), FREE, Pose(TX), SourceConfig(order=4))
