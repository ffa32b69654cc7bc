"""How much of a scene the camera's walks see: the level round and the one that also looks down, up and out.

    python -m benchmarks.quality.coverage [SCENE] [--counts 60 120 240] [--distance 8]

Printed: the share of the area that three or more photographs see at less than 60 degrees from its normal, nothing in
between, from closer than the distance; for the whole scene and for the named objects of the lobby.
"""

import argparse

from rf3dgs.cli.facts import open_scene
from rf3dgs.propagation.config import PhotoConfig
from rf3dgs.propagation.sites.coverage import coverage
from rf3dgs.propagation.sites.walks import camera_tour

PARTS = {
    "floor": ("floor",),
    "ceiling": ("ceiling",),
    "walls": ("wall-west", "wall-south", "wall-east", "wall-north"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default="lobby")
    parser.add_argument("--counts", nargs="+", type=int, default=[60, 120, 240], help="photographs of the walks")
    parser.add_argument("--distance", type=float, default=8.0, help="farther photographs do not count [m]")
    parser.add_argument("--samples", type=int, default=20_000, help="points on the surfaces")
    options = parser.parse_args()
    scene = open_scene(options.scene)
    parts = {name: objects for name, objects in PARTS.items() if {item.name for item in scene.objects} >= set(objects)}
    print(f"{'walk':10} {'photographs':>11} {'whole scene':>11} " + " ".join(f"{name:>8}" for name in parts))
    for count in options.counts:
        for walk in ("level", "coverage"):
            cameras = camera_tour(scene, count, 0, PhotoConfig(walk=walk))
            found = coverage(scene, cameras, distance=options.distance, samples=options.samples)
            shares = " ".join(f"{found.share_of(*objects):8.1%}" for objects in parts.values())
            print(f"{walk:10} {count:11} {found.share:11.1%} {shares}", flush=True)


if __name__ == "__main__":
    main()
