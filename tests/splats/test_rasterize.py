"""The native rasterizer against the specification, finite differences, and itself."""

import math
import os
import subprocess
import sys

import pytest
import torch
from torch import Tensor

from rf3dgs.core.cube import face_cameras
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, Panorama, equirect_grid, pinhole_grid
from rf3dgs.core.native import native_core
from rf3dgs.core.threads import thread_count
from rf3dgs.splats import constants
from rf3dgs.splats.compositing import Compositing
from rf3dgs.splats.rasterize import pick_backend, rasterize
from rf3dgs.splats.reference import rasterize_reference

NAMES = ("means", "quats", "scales", "opacities", "values")
POSE = Pose.look_at(position=(-3.0, 0.5, 0.3), target=(0.0, 0.0, 0.0))


def camera(width: int = 64, height: int = 48, fov_deg: float = 90.0) -> Camera:
    return Camera.of(POSE, pinhole_grid(width, height, fov_deg))


def cloud(count: int, channels: int = 3, *, size: float = 0.15, seed: int = 1) -> list[Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return [
        (torch.rand(count, 3, generator=generator) - 0.5) * torch.tensor([8.0, 6.0, 3.0]),
        torch.randn(count, 4, generator=generator),
        size * torch.exp(0.7 * torch.randn(count, 3, generator=generator)),
        torch.rand(count, generator=generator),
        torch.rand(count, channels, generator=generator),
    ]


def gradients(draw, tensors: list[Tensor], offset: Tensor, background: Tensor, view: Camera) -> list[Tensor]:
    leaves = [tensor.clone().requires_grad_() for tensor in (*tensors, offset, background)]
    raster = draw(*leaves[:5], view, screen_offset=leaves[5], background=leaves[6])
    generator = torch.Generator().manual_seed(5)
    of_values = torch.randn(raster.values.shape, generator=generator).to(raster.values.dtype)
    of_weight = torch.randn(raster.weight.shape, generator=generator).to(raster.values.dtype)
    ((raster.values * of_values).sum() + (raster.weight * of_weight).sum()).backward()
    found = [leaf.grad for leaf in leaves]
    return [gradient for gradient in found if gradient is not None]


def native(*arguments, **options):
    return rasterize(*arguments, **options, backend="native")


def relative(found: Tensor, expected: Tensor) -> float:
    return float((found.double() - expected).norm() / expected.norm())


def test_constants_are_the_same_in_python_and_in_the_core():
    core = native_core()
    assert core is not None
    for name, value in core.constants().items():
        assert getattr(constants, name) == pytest.approx(value, rel=1e-6), name


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5, 6, 7, 8, 11])
def test_pictures_and_gradients_agree_with_the_specification(channels: int):
    tensors = cloud(500, channels)
    background, offset = torch.rand(channels), torch.zeros(500, 2)
    precise = [tensor.double() for tensor in tensors]
    with torch.no_grad():
        found = native(*tensors, camera(), background=background)
        expected = rasterize_reference(*precise, camera(), background=background.double())
    difference = (found.values - expected.values).abs()
    assert difference.max() < 2e-3
    assert difference.mean() < 1e-6
    assert (found.weight - expected.weight).abs().mean() < 1e-6
    torch.testing.assert_close(found.radii.double(), expected.radii, rtol=1e-4, atol=1e-3)
    mine = gradients(native, tensors, offset, background, camera())
    theirs = gradients(rasterize_reference, precise, offset.double(), background.double(), camera())
    for name, first, second in zip((*NAMES, "screen_offset", "background"), mine, theirs, strict=True):
        assert relative(first, second) < 3e-4, name


def test_a_dense_view_of_a_cube_face_agrees_with_the_specification():
    tensors = cloud(1500, 3, size=0.3)
    tensors[3] = 0.5 + 0.5 * tensors[3]
    view = face_cameras(POSE, 32)[1]
    with torch.no_grad():
        found = native(*tensors, view)
        expected = rasterize_reference(*(tensor.double() for tensor in tensors), view)
    difference = (found.values - expected.values).abs().amax(-1)
    assert difference.max() < 2e-3
    assert difference.mean() < 1e-6
    assert expected.weight.max() > 0.999


def test_gradients_agree_with_finite_differences_away_from_cut_offs():
    # Wide Gaussians of middling opacity that overfill a small picture: no alpha is near 1/255 or 0.99.
    generator = torch.Generator().manual_seed(3)
    tensors = [
        torch.rand(6, 3, generator=generator) - 0.5,
        torch.randn(6, 4, generator=generator),
        2.0 + torch.rand(6, 3, generator=generator),
        0.2 + 0.3 * torch.rand(6, generator=generator),
        torch.rand(6, 2, generator=generator),
    ]
    view = camera(8, 6, 30.0)
    factor = torch.randn(6, 8, 2, generator=generator)

    def loss(parts: list[Tensor]) -> float:
        with torch.no_grad():
            return float((native(*parts, view).values.double() * factor).sum())

    leaves = [tensor.clone().requires_grad_() for tensor in tensors]
    (native(*leaves, view).values * factor).sum().backward()
    for index, name in enumerate(NAMES):
        direction = torch.randn(tensors[index].shape, generator=generator)
        step = 1e-2
        ahead, behind = list(tensors), list(tensors)
        ahead[index] = tensors[index] + step * direction
        behind[index] = tensors[index] - step * direction
        slope = (loss(ahead) - loss(behind)) / (2 * step)
        gradient = leaves[index].grad
        assert gradient is not None
        assert float((gradient * direction).sum()) == pytest.approx(slope, rel=5e-3, abs=2e-3), name


def test_results_do_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch):
    tensors, offset, background = cloud(6000, 3, size=0.05), torch.zeros(6000, 2), torch.rand(3)
    results = []
    for threads in ("1", "2", "5"):
        monkeypatch.setenv("RF3DGS_THREADS", threads)
        monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
        assert thread_count() == int(threads)
        with torch.no_grad():
            picture = native(*tensors, camera(150, 100), background=background).values
        results.append([picture, *gradients(native, tensors, offset, background, camera(150, 100))])
    for other in results[1:]:
        assert all(torch.equal(first, second) for first, second in zip(results[0], other, strict=True))


def test_only_what_requires_a_gradient_gets_one():
    tensors = cloud(200)
    tensors[3].requires_grad_()
    tensors[4].requires_grad_()
    native(*tensors, camera()).values.sum().backward()
    assert [tensor.grad is not None for tensor in tensors] == [False, False, False, True, True]


def test_no_gaussians_give_the_background():
    empty = [tensor.requires_grad_() for tensor in cloud(0)]
    raster = native(*empty, camera(), background=torch.tensor([0.1, 0.2, 0.3]))
    assert torch.equal(raster.values, torch.tensor([0.1, 0.2, 0.3]).expand(48, 64, 3))
    assert raster.weight.max() == 0
    raster.values.sum().backward()


def test_a_picture_of_one_pixel():
    tensors = cloud(300)
    found = native(*tensors, camera(1, 1))
    expected = rasterize_reference(*(tensor.double() for tensor in tensors), camera(1, 1))
    torch.testing.assert_close(found.values.double(), expected.values, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("index", "value"),
    [
        (0, math.nan), (0, math.inf), (0, 1e30), (1, 0.0), (1, math.nan), (1, math.inf), (1, 1e-30), (2, math.nan),
        (2, math.inf), (2, -1.0), (2, 1e25), (3, math.nan), (3, math.inf), (3, 1e-40), (3, -1.0), (4, math.nan),
        (4, math.inf),
    ],
)  # fmt: skip
def test_a_gaussian_that_is_not_sound_is_not_drawn_and_gets_no_gradient(index: int, value: float):
    tensors = cloud(100)
    sound = native(*(tensor[1:] for tensor in tensors), camera())
    tensors[index][0] = value
    for tensor in tensors:
        tensor.requires_grad_()
    raster = native(*tensors, camera())
    assert raster.radii[0] == 0
    assert torch.equal(raster.values, sound.values)
    raster.values.sum().backward()
    for name, tensor in zip(NAMES, tensors, strict=True):
        assert tensor.grad is not None
        assert torch.isfinite(tensor.grad).all(), name
        assert (tensor.grad[0] == 0).all(), name


def test_needles_points_and_gaussians_around_the_camera_give_finite_results():
    centre = camera().position
    ahead = torch.nn.functional.normalize(-centre, dim=0)
    means = torch.stack(
        [centre, centre - ahead, centre + 0.051 * ahead, centre + ahead, centre + 2 * ahead, centre + 1e4 * ahead]
    )
    scales = torch.tensor([[1.0] * 3, [1.0] * 3, [1.0] * 3, [50.0, 1e-6, 1e-6], [0.0] * 3, [1e-42, 1e-42, 1e3]])
    tensors = [means, torch.rand(6, 4), scales, torch.full((6,), 0.9), torch.rand(6, 3)]
    for tensor in tensors:
        tensor.requires_grad_()
    raster = native(*tensors, camera())
    assert torch.isfinite(raster.values).all()
    assert (raster.radii[:2] == 0).all()
    raster.values.sum().backward()
    assert all(torch.isfinite(tensor.grad).all() for tensor in tensors if tensor.grad is not None)


def test_nearer_gaussians_hide_farther_ones_whatever_their_order():
    centre = camera().position
    ahead = torch.nn.functional.normalize(-centre, dim=0)
    means = torch.stack([centre + 3 * ahead, centre + 2 * ahead])
    tensors = [means, torch.tensor([[1.0, 0, 0, 0]] * 2), torch.full((2, 3), 0.3), torch.full((2,), 0.99), torch.eye(2)]
    picture = native(*tensors, camera()).values
    assert picture[24, 32, 1] > 0.9
    assert picture[24, 32, 0] < 0.1
    swapped = native(*(tensor.flip(0) for tensor in tensors), camera()).values
    assert torch.equal(picture, swapped)


@pytest.mark.parametrize(
    ("index", "shape", "message"),
    [
        (0, (3, 50), r"means must be \[gaussian, 3\]; got \[3, 50\]\. Transpose it\?"),
        (1, (50, 3), r"quats must be \[gaussian, 4\]; got \[50, 3\]"),
        (2, (49, 3), r"scales must have one row per Gaussian \(50, as means\); got 49"),
        (3, (50, 1), r"opacities must be \[gaussian\]; got \[50, 1\]"),
        (4, (50,), r"values must be \[gaussian, channel\]; got \[50\]"),
    ],
)
def test_wrong_shapes_are_named(index: int, shape: tuple[int, ...], message: str):
    tensors = cloud(50)
    tensors[index] = torch.rand(shape)
    with pytest.raises(InputError, match=message):
        rasterize(*tensors, camera())


def test_wrong_dtypes_and_backends_are_named():
    tensors = cloud(5)
    with pytest.raises(InputError, match="the native backend needs float32"):
        native(*(tensor.double() for tensor in tensors), camera())
    with pytest.raises(InputError, match=r"values must be torch\.float32 on cpu as means are; got torch\.float64"):
        rasterize(*tensors[:4], tensors[4].double(), camera())
    with pytest.raises(InputError, match="backend must be one of auto, native, reference, gsplat; got 'cuda'"):
        rasterize(*tensors, camera(), backend="cuda")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"background must be \[channel\] = \[3\]; got \[1\]"):
        rasterize(*tensors, camera(), background=torch.zeros(1))


def test_options_that_do_not_go_together_are_named():
    tensors, panorama = cloud(5), Panorama.of(POSE, equirect_grid(8, 4))
    with pytest.raises(InputError, match="a panorama has no screen"):
        rasterize(*tensors, panorama, screen_offset=torch.zeros(5, 2))
    with pytest.raises(InputError, match="normalise divides by the weight"):
        rasterize(*tensors, camera(), background=torch.zeros(3), compositing=Compositing(normalise=True))
    with pytest.raises(InputError, match=r"added must be \[row, col, channel\] = \[48, 64, 3\]; got \[48, 64\]"):
        rasterize(*tensors, camera(), added=torch.zeros(48, 64))
    with pytest.raises(InputError, match=r"added must be torch\.float32 on cpu as values are; got torch\.float64"):
        rasterize(*tensors, camera(), added=torch.zeros(48, 64, 3, dtype=torch.float64))
    with pytest.raises(InputError, match=r"one for each channel \(3\); got 2 names"):
        rasterize(*tensors, camera(), compositing=Compositing(transfer=("identity", "identity")))
    with pytest.raises(InputError, match="view must be a Camera or a Panorama; got DirectionGrid"):
        rasterize(*tensors, pinhole_grid(8, 6, 90.0))  # type: ignore[arg-type]


def test_the_backend_is_chosen_by_what_the_tensors_are(monkeypatch: pytest.MonkeyPatch):
    assert pick_backend()[0] == "native"
    assert pick_backend("cuda")[0] == "gsplat"
    assert pick_backend("cpu", torch.float64)[0] == "reference"
    raster = rasterize(*(tensor.double() for tensor in cloud(20)), camera(8, 6))
    assert raster.values.dtype == torch.float64
    monkeypatch.setenv("RF3DGS_THREADS", "many")
    with pytest.raises(InputError, match="RF3DGS_THREADS must be a positive whole number; got 'many'"):
        rasterize(*cloud(20), camera(8, 6))


FORK = """
import os, torch
from tests_cloud import draw
before = draw()
child = os.fork()
if child == 0:
    os._exit(0 if torch.equal(draw(), before) else 1)
_, status = os.waitpid(child, 0)
raise SystemExit(os.waitstatus_to_exitcode(status))
"""

CLOUD = """
import torch
torch.set_num_threads(1)  # torch's own threads do not survive a fork; the core's pool starts anew
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, Panorama, equirect_grid, pinhole_grid
from rf3dgs.splats.rasterize import rasterize
def draw():
    g = torch.Generator().manual_seed(0)
    view = Camera.of(Pose.look_at(position=(-3.0, 0.5, 0.3), target=(0.0, 0.0, 0.0)), pinhole_grid(64, 48, 90.0))
    means = torch.rand(5000, 3, generator=g) - 0.5
    scales, opacities = torch.full((5000, 3), 0.02), torch.full((5000,), 0.5)
    return rasterize(means, torch.ones(5000, 4), scales, opacities, means, view).values
"""


def run_python(code: str, folder, **environment: str) -> subprocess.CompletedProcess[str]:
    (folder / "tests_cloud.py").write_text(CLOUD)
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=60,
    )


def test_a_forked_child_draws_the_same_picture(tmp_path):
    done = run_python(FORK, tmp_path, RF3DGS_THREADS="2")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("instruction_set", ["portable", "avx2"])
def test_every_instruction_set_draws_the_same_picture(tmp_path, instruction_set: str):
    code = "from tests_cloud import draw; import rf3dgs._native as n; print(n.info()['instruction_set']);"
    code += f"import torch; torch.save(draw(), '{instruction_set}.pt')"
    done = run_python(code, tmp_path, RF3DGS_ISA=instruction_set)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() in (instruction_set, "portable")
    space: dict = {}
    exec(CLOUD, space)
    found = torch.load(tmp_path / f"{instruction_set}.pt", weights_only=True)
    assert (found - space["draw"]()).abs().mean() < 1e-6
