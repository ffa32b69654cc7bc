"""One table of radiance models against lookup, by one command that goes on where it was stopped.

    python -m benchmarks.quality.radiance --preset realistic --paths realistic=lobby.paths --models nearest idw4 paper

docs/how-to/radiance-table.md says what it makes, reads, checks and writes.
"""

import argparse
import json
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import get_args

from benchmarks.quality.methods import methods_of
from benchmarks.quality.methods.method import SCALES
from benchmarks.quality.protocol.cells import commit
from benchmarks.quality.protocol.pictures import SPHERE
from benchmarks.quality.protocol.results import LOOKUPS, Results
from benchmarks.quality.protocol.scenes import SITES, Setting
from benchmarks.quality.protocol.split import HOLDOUTS, JUDGES, Draw, SplitConfig
from benchmarks.quality.protocol.study import Study, StudyConfig, say
from benchmarks.quality.radiance.tables import numbers_of, page_of, text_of
from rf3dgs.core.errors import InputError, RfError
from rf3dgs.core.files import write_whole


class Run:
    """One call: what is asked, a study of each preset, and the cells that are there."""

    def __init__(self, wish: argparse.Namespace) -> None:
        self.wish = wish
        self.models = methods_of((*wish.models, *wish.variants))
        names = [model.name for model in self.models]
        unknown = [name for name in wish.against or () if name not in names]
        if unknown:
            raise InputError(f"{', '.join(unknown)} is to be judged against, but is no model of this table")
        against = wish.against or [*LOOKUPS, "paper"]
        self.results = Results(names, wish.judge, Path(wish.geometry).stem, wish.seeds, against)

    def preset(self, preset: str) -> None:
        """Make the missing cells of one preset, model by model, and gather all."""
        wish, study = self.wish, self.study(preset)
        if wish.again:
            study.add_second(self.results, wish.again)
        for count in wish.positions:
            for seed in wish.seeds:
                study.add(self.results, self.models, count, seed, wish.draw, again=wish.again_models)

    def study(self, preset: str, scene: str | None = None) -> Study:
        """The study of a preset, of the asked scene or another."""
        wish = self.wish
        scene = scene or wish.scene
        site = Setting(scene, preset).site
        held, given = wish.held or site.held, dict(text.split("=", 1) for text in wish.paths)
        return Study(
            StudyConfig(
                scene=scene,
                preset=preset,
                out=wish.out,
                trained=wish.trained,
                judge=wish.judge,
                holdouts=tuple(wish.holdout),
                judged=wish.judged,
                split=SplitConfig(*held, buffer=site.buffer if wish.buffer is None else wish.buffer),
                receivers=wish.receivers,
                pictures=replace(SPHERE, size=tuple(wish.size)),
                geometry=wish.geometry,
                mesh_count=wish.mesh_count,
                scale=wish.scale,
                paths={name: Path(path) for name, path in given.items()} if scene == wish.scene else {},
                reason=self.reason,
                only_read=wish.only_read,
            )
        )

    def reason(self) -> str:
        """Why the sealed positions are read, for the log."""
        wish = self.wish
        asked = f"models {', '.join(self.results.models)}; seeds {wish.seeds}; positions {wish.positions}"
        return f"benchmarks.quality.radiance at {commit()}: {asked}"


def without_folder(word: str) -> str:
    """A word of the command line as a page may show it: of a file its name alone."""
    head, equals, path = word.rpartition("=")
    return f"{head}{equals}{Path(path).name}" if "/" in path else word


def asked(words: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", choices=SITES, default="lobby")
    parser.add_argument("--preset", nargs="+", help="diffuse, realistic, ...; the scene's own when missing")
    parser.add_argument("--holdout", nargs="+", choices=HOLDOUTS, default=list(HOLDOUTS))
    parser.add_argument("--positions", nargs="+", type=int, default=[20, 40, 80, 160], help="training positions")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument(
        "--models",
        nargs="+",
        default=["nearest", "idw4", "idw8", "paper"],
        help="names of methods, or Python files that list some",
    )
    parser.add_argument("--variants", nargs="+", default=[], metavar="NAME=BASE,SETTING=VALUE", help="ablations")
    parser.add_argument("--against", nargs="+", help="the baselines; the lookups and paper when missing")
    parser.add_argument("--geometry", default="photos", help="photos, mesh, or a .ply file")
    parser.add_argument("--mesh-count", type=int, default=100_000, help="Gaussians on a mesh")
    parser.add_argument("--judge", choices=JUDGES, default="validation", help='"test" reads the sealed positions')
    parser.add_argument("--paths", nargs="+", default=[], metavar="PRESET=FOLDER", help="what rf3dgs trace wrote")
    parser.add_argument("--receivers", type=int, help="the first so many of the paths; the scene's own when missing")
    parser.add_argument("--held", nargs=4, type=int, metavar=("TEST", "REGION", "VALIDATION", "NEAR"), help="held out")
    parser.add_argument("--buffer", type=float, help="round both regions [m]")
    parser.add_argument("--judged", type=int, help="of each hold-out the first so many positions; all when missing")
    parser.add_argument("--again", type=int, default=20, help="positions of each hold-out solved again; 0 for none")
    parser.add_argument("--size", nargs=2, type=int, default=SPHERE.size, help="columns and rows of the spheres")
    parser.add_argument("--draw", choices=get_args(Draw), default="uniform", help="how training positions lie")
    parser.add_argument("--scale", choices=SCALES, default="laptop", help="what learned baselines may spend")
    parser.add_argument("--trained", choices=SITES, help="scene of the training spectra, where things have moved since")
    parser.add_argument("--again-models", nargs="+", default=[], help="models whose cells are made anew")
    parser.add_argument("--only-read", action="store_true", help="make no cell, show those that are there")
    parser.add_argument("--out", type=Path, default=Path("out/radiance"))
    wish = parser.parse_args(words)
    wish.preset = wish.preset or [SITES[wish.scene].preset]
    return wish


def main(words: Sequence[str] | None = None) -> int:
    wish = asked(words)
    try:
        run = Run(wish)
        for preset in wish.preset:
            run.preset(preset)
    except RfError as error:
        say(f"radiance: {error}")
        return 2
    results = run.results
    given = [without_folder(word) for word in (sys.argv[1:] if words is None else words)]
    command = shlex.join(["python", "-m", "benchmarks.quality.radiance", *given])
    trained = "" if wish.trained is None else f"-after-{wish.trained}"
    name = f"{wish.scene}-{Path(wish.geometry).stem}-{wish.judge}{trained}"
    text = text_of(results)
    write_whole(wish.out / f"{name}.txt", (text + "\n").encode())
    write_whole(wish.out / f"{name}.md", page_of(results, command).encode())
    numbers = {"command": command} | numbers_of(results) | {"facts": results.facts}
    write_whole(wish.out / f"{name}.json", (json.dumps(numbers, indent=1) + "\n").encode())
    print(text)
    print(f"\n{wish.out / name}.md has all intervals, .json all numbers")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
