from dataclasses import replace

import pytest
import torch

from rf3dgs.channel.paths import Paths
from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.units import SPEED_OF_LIGHT, db_from_power, friis_gain
from rf3dgs.propagation.config import TraceConfig
from rf3dgs.propagation.llvm import mitsuba_variant
from rf3dgs.propagation.sites.scene import Scene
from rf3dgs.propagation.sites.scene_files import check_foreign_xml
from rf3dgs.propagation.sites.scenes import scene_of

QUICK = TraceConfig(rays=20_000, depth=2, seed=7)


@pytest.fixture(scope="module")
def rx(site):
    return site.receivers(3, seed=1)


@pytest.fixture(scope="module")
def rows(tracer, site, rx) -> list[Paths]:
    return list(tracer.trace_each(site, None, rx, QUICK))


def test_line_of_sight_is_friis_and_geometry(rows, site):
    seen = 0
    for row in rows:
        direct = row.order[0] == 0
        if not bool(direct.any()):
            continue
        seen += 1
        assert int(direct.sum()) == 1
        offset = site.tx.position - row.rx.position[0]
        distance = offset.norm()
        gain_db = db_from_power(row.path_gain[0][direct])
        assert float(gain_db - db_from_power(friis_gain(distance, 60e9))) == pytest.approx(0.0, abs=0.05)
        assert float(row.delay[0][direct]) == pytest.approx(float(distance) / SPEED_OF_LIGHT, rel=1e-5)
        assert float(angle_between(row.aoa[0][direct][0], offset)) < 1e-3
        assert float(angle_between(row.aod[0][direct][0], -offset)) < 1e-3
    assert seen >= 2


def test_mirror_path_of_the_floor_has_the_image_length_and_angles(tracer):
    box = scene_of("box", scattering=0.0)
    tx, rx = Pose((-2.0, 0.0, 3.0)), Pose([[2.0, 1.0, 1.5]])
    (row,) = tracer.trace_each(box, tx, rx, replace(QUICK, depth=1))
    image = torch.tensor([-2.0, 0.0, -3.0])
    towards = image - rx.position[0]
    index = int(angle_between(row.aoa[0], towards.expand_as(row.aoa[0])).argmin())
    assert float(angle_between(row.aoa[0, index], towards)) < 1e-3
    assert float(row.delay[0, index]) * SPEED_OF_LIGHT == pytest.approx(float(towards.norm()), rel=1e-5)
    departs = rx.position[0] * torch.tensor([1.0, 1.0, -1.0]) - tx.position
    assert float(angle_between(row.aod[0, index], departs)) < 1e-3
    assert row.order[0].sort().values.tolist() == [0, 1, 1, 1, 1, 1, 1]
    assert row.kind[0].sort().values.tolist() == [0, 1, 1, 1, 1, 1, 1]
    # Metal reflects both polarisations fully, so the power mean is Friis over the path's length.
    expected = friis_gain(row.delay[0] * SPEED_OF_LIGHT, box.frequency)
    assert torch.allclose(db_from_power(row.path_gain[0]), db_from_power(expected), atol=0.05)


def test_gain_is_the_mean_over_transmit_of_the_sum_over_receive_polarisations(tracer, site):
    rt = tracer.import_sionna()
    box = scene_of("box", scattering=0.0)
    rx = Pose([[2.0, 1.0, 1.5]])
    (row,) = tracer.trace_each(box, None, rx, replace(QUICK, depth=2))
    total = 0.0
    with mitsuba_variant(tracer.VARIANT):
        scene = rt.load_scene(rt.scene.box, merge_shapes=False)
        scene.frequency = box.frequency
        scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="VH")
        scene.add(rt.Receiver("rx", rx.position[0].tolist()))
        scene.add(rt.Transmitter("tx", box.tx.position.tolist()))
        for polarization in ("V", "H"):
            scene.tx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization=polarization)
            found = rt.PathSolver()(scene, max_depth=2, samples_per_src=20_000, refraction=False)
            real, imaginary = found.a
            total += 0.5 * float((torch.from_numpy(real.numpy()) ** 2 + torch.from_numpy(imaginary.numpy()) ** 2).sum())
    assert float(row.total_gain[0]) == pytest.approx(total, rel=1e-3)


def test_paths_are_sorted_and_carry_order_and_kind(rows):
    for row in rows:
        assert row.coeff.shape[0] == 1
        assert bool(row.valid.all())
        assert bool((row.delay[0].diff() >= 0).all())
        assert bool(((row.order == 0) == (row.kind == 0)).all())
        assert int(row.order.max()) <= QUICK.depth
        assert {0, 1, 2} >= set(row.kind[row.order <= 1].tolist())
        assert set(row.kind.unique().tolist()) <= {0, 1, 2, 3}


def test_the_same_seed_gives_the_same_bits_wherever_the_run_is_cut(tracer, site, rx, rows):
    (again,) = tracer.trace_each(site, None, rx[2:3], QUICK, indices=[2])
    other = next(iter(tracer.trace_each(site, None, rx[2:3], replace(QUICK, seed=99), indices=[2])))
    for name in ("coeff", "delay", "aoa_zenith", "aoa_azimuth", "aod_zenith", "aod_azimuth", "order", "kind"):
        assert torch.equal(getattr(again, name), getattr(rows[2], name)), name
    assert again.coeff.shape != other.coeff.shape or not torch.equal(again.coeff, other.coeff)


def test_more_passes_keep_the_power_and_the_mirrors(tracer, site, rx, rows):
    (more,) = tracer.trace_each(site, None, rx[:1], replace(QUICK, passes=3))
    once = rows[0]
    assert more.coeff.shape[1] > 2 * once.coeff.shape[1]
    for kinds in ((0,), (1,)):
        mine = torch.isin(more.kind, torch.tensor(kinds))
        theirs = torch.isin(once.kind, torch.tensor(kinds))
        assert torch.equal(more.coeff[mine], once.coeff[theirs])
    diffuse_db = [float(db_from_power(p.path_gain[p.kind >= 2].sum())) for p in (once, more)]
    assert diffuse_db[0] == pytest.approx(diffuse_db[1], abs=0.7)


def test_trace_bins_diffuse_paths_and_keeps_the_power(tracer, site, rx, rows):
    paths = tracer.trace(site, rx=rx, config=QUICK)
    assert paths.coeff.shape[0] == 3
    for index, row in enumerate(rows):
        assert float(paths.total_gain[index]) == pytest.approx(float(row.total_gain[0]), rel=1e-3)
        assert int(paths.count[index]) < row.coeff.shape[1]


def test_rays_that_reach_nothing_give_zero_paths(tracer, site, rx):
    nothing = replace(QUICK, depth=1, line_of_sight=False, specular=False, diffuse=False)
    (row,) = tracer.trace_each(site, None, rx[:1], nothing)
    assert row.coeff.shape == (1, 0)
    assert float(row.total_gain[0]) == 0.0


def test_line_of_sight_alone_needs_no_bounce(tracer):
    box = scene_of("box")
    (row,) = tracer.trace_each(box, None, Pose([[2.0, 2.0, 1.5]]), replace(QUICK, depth=0))
    assert row.order.tolist() == [[0]]


def test_the_street_canyon_has_a_street_to_stand_in(tracer):
    street = scene_of("simple_street_canyon")
    assert isinstance(street, Scene)
    assert street.sky > 0
    assert {item.name for item in street.objects if item.solid} == {f"building_{i}" for i in range(1, 7)}
    rx = street.receivers(2, seed=0)
    assert torch.allclose(rx.position[:, 2], torch.tensor(1.5))
    (row,) = tracer.trace_each(street, None, rx[:1], QUICK)
    assert {0, 1, 2} <= set(row.kind.unique().tolist())
    vertices, faces, colour = street.mesh()
    assert (len(vertices), len(faces), len(colour)) == (52, 74, 74)


@pytest.mark.parametrize(
    ("position", "message"),
    [
        ((4.5, 4.6, 1.5), r"receiver 0 at \(4.5, 4.6, 1.5\) is inside the object 'column-1'; move it"),
        ((4000.0, 3000.0, 1500.0), r"receiver 0 at .* is outside the scene 'lobby'.* are the positions in metres\?"),
        ((0.6, 0.8, 2.6), "receiver 0 at .* is at the transmitter"),
    ],
)
def test_receivers_that_cannot_be_are_refused(site, position, message):
    from rf3dgs.propagation import sionna

    with pytest.raises(InputError, match=message):
        sionna.trace_each(site, None, Pose([position]), QUICK)


def test_bad_arguments_are_refused(site):
    from rf3dgs.propagation import sionna

    rx = Pose([[3.0, 3.0, 1.5]])
    with pytest.raises(InputError, match="frequency must be in hertz"):
        sionna.trace_each(site, None, rx, QUICK, frequency=60.0)
    with pytest.raises(InputError, match=r"'floorboard', which ITU-R P.2040 does not define at 28 GHz"):
        sionna.trace_each(site, None, rx, QUICK, frequency=28e9)
    with pytest.raises(InputError, match="rays and passes must be positive"):
        sionna.trace_each(site, None, rx, replace(QUICK, rays=0))
    with pytest.raises(InputError, match=r"rx a list \[rx\]"):
        sionna.trace_each(site, None, rx[0], QUICK)


def test_unknown_scenes_are_refused(tracer):
    with pytest.raises(
        InputError,
        match=r"no scene is named 'atlantis'; use lobby, .*, an .xml file, or one of Sionna's: box",
    ):
        scene_of("atlantis")


def test_an_xml_file_is_read_with_its_meshes(tracer, site, tmp_path):
    from rf3dgs.propagation.sites.scene_files import write_radio_scene

    few = replace(site, objects=tuple(site[name] for name in ("wall-west", "wall-north", "column-3")))
    path = write_radio_scene(few, tmp_path)
    again = scene_of(path)
    assert [item.name for item in again.objects] == [item.name for item in few.objects]
    for mine, theirs in zip(few.objects, again.objects, strict=True):
        assert torch.allclose(mine.vertices[mine.faces], theirs.vertices[theirs.faces], atol=1e-6)
        assert theirs.scattering == pytest.approx(mine.scattering, abs=1e-6)
    paths = tracer.trace(path, tx=Pose((2.0, 2.0, 2.0)), rx=Pose([[3.0, 9.0, 1.5]]), config=QUICK, frequency=60e9)
    assert int(paths.count[0]) > 1


def test_a_file_named_like_a_built_in_scene_is_its_own_site(tracer, site, tmp_path):
    from rf3dgs.propagation.sites.scene_files import write_radio_scene

    few = replace(site, objects=(site["wall-west"], site["wall-north"]))
    again = scene_of(write_radio_scene(few, tmp_path).rename(tmp_path / "box.xml"))
    low, high = (torch.tensor(corner) for corner in again.bounds)
    assert again.name == "box"
    assert bool(((again.tx.position > low) & (again.tx.position < high)).all())


def plain(inner: str) -> str:
    return f'<scene version="2.1.0">{inner}</scene>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (plain('<include filename="/etc/passwd"/>'), "has a <include> element"),
        (
            plain('<shape type="ply"><string name="filename" value="/etc/passwd"/></shape>'),
            "only files in the scene's own",
        ),
        (
            plain('<shape type="ply"><string name="filename" value="../a.ply"/></shape>'),
            "only files in the scene's own",
        ),
        (
            plain('<shape type="ply"><string name="filename" value="C:\\a.ply"/></shape>'),
            "only files in the scene's own",
        ),
        (
            plain('<shape type="ply"><string name="filename" value="link/a.ply"/></shape>'),
            "only files in the scene's own",
        ),
        (plain('<shape type="ply"><string name="filename" value="no.ply"/></shape>'), "does not exist beside it"),
        (plain('<path value="/etc"/>'), "has a <path> element"),
        ('<!DOCTYPE scene [<!ENTITY a "b">]><scene version="2.1.0"/>', "declares a document type"),
        ("<html/>", "outermost element is <html>"),
        ("<scene", "cannot read the scene"),
    ],
)
def test_unsafe_scene_files_are_refused(tmp_path, text, message):
    (tmp_path / "link").symlink_to("/")
    path = tmp_path / "scene.xml"
    path.write_text(text)
    with pytest.raises(DataError, match=message) as caught:
        check_foreign_xml(path)
    assert "scene.xml" in str(caught.value)


@pytest.mark.parametrize("name", ["/etc/passwd", "../a.ply"])
def test_a_scene_that_reads_other_folders_is_never_loaded(tmp_path, name):
    (tmp_path / "site.xml").write_text(plain(f'<shape type="ply"><string name="filename" value="{name}"/></shape>'))
    with pytest.raises(
        DataError, match=r"site\.xml names the file .* only files in the scene's own folder may be read"
    ):
        scene_of(tmp_path / "site.xml")
    (tmp_path / "site.xml").write_text(plain(f'<include filename="{name}"/>'))
    with pytest.raises(DataError, match=r"site\.xml has a <include> element, which is refused"):
        scene_of(tmp_path / "site.xml")


def test_missing_scene_files_are_data_errors(tmp_path):
    with pytest.raises(DataError, match=r"cannot read the scene .*nowhere.xml"):
        scene_of(tmp_path / "nowhere.xml")
