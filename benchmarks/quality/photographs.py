"""What a photograph of the lobby costs and how noisy it is: with Russian roulette and without, in turn.

    python -m benchmarks.quality.photographs [SCENE] [--photos 3] [--width 640] [--height 480] [--samples 32]
        [--truth 1024] [--truth-width 160]

Printed for each: RMSE in sRGB levels (of 255) of small photographs against clean ones of `--truth` samples without
roulette, and how much brighter they are in the mean; CPU seconds of all threads and seconds per photograph, with the
kernels compiled.
"""

import argparse
import math
import tempfile
import time
from pathlib import Path

import numpy as np

from rf3dgs.cli.facts import open_scene
from rf3dgs.propagation.config import PhotoConfig
from rf3dgs.propagation.llvm import mitsuba_variant, prepare
from rf3dgs.propagation.photographer import linear_light
from rf3dgs.propagation.sites.scene_files import srgb_from_linear, write_visual_scene
from rf3dgs.propagation.sites.walks import camera_tour


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default="lobby")
    parser.add_argument("--photos", type=int, default=3, help="cameras, spread over the walk")
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=480)
    parser.add_argument("--samples", type=int, default=32)
    parser.add_argument("--truth", type=int, default=1024, help="samples of the clean photographs")
    parser.add_argument(
        "--truth-width", type=int, default=160, help="their width; a pixel's noise is that of a large one"
    )
    options = parser.parse_args()
    prepare()
    import mitsuba

    scene = open_scene(options.scene)
    large = PhotoConfig(width=options.width, height=options.height, samples=options.samples)
    small = PhotoConfig(options.truth_width, round(options.truth_width * options.height / options.width))
    with tempfile.TemporaryDirectory() as folder, mitsuba_variant("llvm_ad_rgb"):
        loaded = mitsuba.load_file(str(write_visual_scene(scene, Path(folder))), optimize=False)

        def roulette(camera, samples, seed):
            return linear_light(mitsuba, loaded, camera, PhotoConfig(samples=samples), seed)

        def whole(camera, samples, seed):
            return linear_light(mitsuba, loaded, camera, PhotoConfig(samples=samples), seed, roulette_from=100)

        ways = {"whole paths": whole, "roulette": roulette}
        cameras = camera_tour(scene, options.photos, 0, small)
        clean = [whole(camera, options.truth, 10_000 + place) for place, camera in enumerate(cameras)]
        for name, way in ways.items():
            squares, bright = [], []
            for place, (camera, truth) in enumerate(zip(cameras, clean, strict=True)):
                seen = way(camera, options.samples, place)
                squares.append(np.mean((levels(seen, scene) - levels(truth, scene)) ** 2))
                bright.append(seen.mean() / truth.mean() - 1)
            print(
                f"{name:16} RMSE {math.sqrt(np.mean(squares)):6.2f} of 255, brighter by {np.mean(bright):+.2%}",
                flush=True,
            )
        cpu, wall = dict.fromkeys(ways, 0.0), dict.fromkeys(ways, 0.0)
        for place, camera in enumerate(camera_tour(scene, options.photos, 0, large)):
            for name, way in ways.items():
                began = time.process_time(), time.perf_counter()
                way(camera, options.samples, place)
                cpu[name] += time.process_time() - began[0]
                wall[name] += time.perf_counter() - began[1]
        for name in ways:
            print(
                f"{name:16} {cpu[name] / options.photos:6.2f} CPU s, {wall[name] / options.photos:6.2f} s a photograph"
            )


def levels(light: np.ndarray, scene) -> np.ndarray:
    """sRGB levels, not rounded, of linear light."""
    return 255.0 * srgb_from_linear(scene.exposure * light)


if __name__ == "__main__":
    main()
