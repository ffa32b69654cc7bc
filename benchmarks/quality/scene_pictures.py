"""Pictures of scenes for the documentation, rendered with Mitsuba and traced with Sionna RT.

    python -m benchmarks.quality.scene_pictures [lobby ellipsoids see_through] [--out docs/pictures]

lobby.png: the lobby at full detail with people. ellipsoids.png: the Gaussians of the shipped field as the surfaces on
which they fall to 1/e of their peak (Fig. 5a of the paper). see_through.png: a photograph all round one receiver among
the things that radio and eye see differently, over the spectrum of the same pose. A few minutes on two cores.
"""

import argparse
import io
import tempfile
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from rf3dgs.cli.facts import open_field
from rf3dgs.core.files import write_whole
from rf3dgs.core.frames import Pose, matrix_from_quaternion, mitsuba_from_viewmat
from rf3dgs.core.grids import Camera, equirect_grid, pinhole_grid
from rf3dgs.evaluation.pictures import colour_range, spectrum_picture
from rf3dgs.propagation.config import PhotoConfig, TraceConfig
from rf3dgs.propagation.llvm import mitsuba_variant, prepare
from rf3dgs.propagation.photographer import render_panorama, render_photos
from rf3dgs.propagation.sionna import trace
from rf3dgs.propagation.sites import shapes
from rf3dgs.propagation.sites.lobby import lobby
from rf3dgs.propagation.sites.presets import preset_of
from rf3dgs.spectra.scan import spectrum_of

COLOURS = 200
"""Of the palette that keeps a picture small."""


def saved(picture: np.ndarray, path: Path) -> None:
    buffer = io.BytesIO()
    Image.fromarray(picture).quantize(COLOURS, dither=Image.Dither.NONE).save(buffer, format="PNG", optimize=True)
    write_whole(path, buffer.getvalue())
    print(f"{path}: {len(buffer.getvalue()) / 1e3:.0f} kB")


def draw_lobby() -> np.ndarray:
    camera = Camera.of(Pose.look_at((13.0, 1.6, 2.2), (5.0, 9.4, 0.9)), pinhole_grid(480, 300, 86))
    (picture,) = render_photos(lobby("full", people=8), [camera], PhotoConfig(samples=144))
    return picture


def draw_ellipsoids() -> np.ndarray:
    import mitsuba

    field = open_field("lobby")
    ball, faces, _ = shapes.ball((0, 0, 0), (1, 1, 1), around=12, rows=7)
    surface = field.surface
    solid = field.solidity > 0.3
    scale = 2**0.5 * surface.log_scales[solid].exp()  # exp(-r^2 / 2) is 1/e there
    turn = matrix_from_quaternion(surface.quats[solid])
    vertices = ((turn[:, None] @ (ball * scale[:, None])[..., None])[..., 0] + surface.means[solid][:, None]).reshape(
        -1, 3
    )
    index = (faces + len(ball) * torch.arange(len(scale))[:, None, None]).reshape(-1, 3)
    colour = (field.colour[solid].float() / 255)[:, None].expand(-1, len(ball), -1).reshape(-1, 3)
    prepare()
    with tempfile.TemporaryDirectory() as folder, mitsuba_variant("llvm_ad_rgb"):
        path = Path(folder) / "ellipsoids.ply"
        _write_coloured(path, vertices.numpy(), colour.numpy() ** 2.2, index.numpy())
        camera = Camera.of(Pose.look_at((12.6, 1.9, 2.1), (5.0, 9.4, 0.9)), pinhole_grid(480, 300, 86))
        scene = mitsuba.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "path", "max_depth": 2},
                **{
                    f"lamp-{number}": {
                        "type": "point",
                        "position": [*place, 2.0],
                        "intensity": {"type": "rgb", "value": 14.0},
                    }
                    for number, place in enumerate(((11.5, 3.0), (3.0, 3.0), (11.0, 12.0), (3.0, 12.0), (7.0, 7.5)))
                },
                "things": {
                    "type": "ply",
                    "filename": str(path),
                    "bsdf": {
                        "type": "twosided",
                        "material": {
                            "type": "diffuse",
                            "reflectance": {"type": "mesh_attribute", "name": "vertex_color"},
                        },
                    },
                },
                "sensor": {
                    "type": "perspective",
                    "fov": 86,
                    "near_clip": 0.02,
                    "to_world": mitsuba.ScalarTransform4f(mitsuba_from_viewmat(camera.viewmat.double()).numpy()),
                    "film": {"type": "hdrfilm", "width": 480, "height": 300, "pixel_format": "rgb"},
                },
            }
        )
        light = np.array(mitsuba.render(scene, spp=36))[..., :3]
    return np.round(255 * np.clip(light, 0, 1) ** (1 / 2.2)).astype(np.uint8)


def _write_coloured(path: Path, vertices: np.ndarray, colour: np.ndarray, faces: np.ndarray) -> None:
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "r", "g", "b"))
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{names}"
    header += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    table = np.empty(len(faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    table["count"], table["index"] = 3, faces
    path.write_bytes(header.encode() + np.hstack((vertices, colour)).astype("<f4").tobytes() + table.tobytes())


def draw_see_through() -> np.ndarray:
    scene, config = preset_of("transparent").applied(lobby(), TraceConfig(rays=300_000))
    pose = Pose.from_yaw((6.2, 8.4, 1.5), 0.5)
    photo = render_panorama(scene, pose, 480, PhotoConfig(samples=64))
    paths = trace(scene, rx=Pose(pose.position[None], pose.orientation[None]), config=config)
    spectrum = spectrum_of(paths, grid=equirect_grid(480, 240))
    spectrum = spectrum[0] if spectrum.power.dim() > 2 else spectrum
    drawn = spectrum_picture(spectrum, colour_range([spectrum]))
    drawn = np.round(255 * drawn).astype(np.uint8) if drawn.dtype != np.uint8 else drawn
    return np.vstack((photo, drawn))


PICTURES = {"lobby": draw_lobby, "ellipsoids": draw_ellipsoids, "see_through": draw_see_through}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=list(PICTURES), help="which pictures")
    parser.add_argument("--out", type=Path, default=Path("docs/pictures"), help="the folder for the pictures")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.names:
        saved(PICTURES[name](), options.out / f"{name}.png")


if __name__ == "__main__":
    main()
