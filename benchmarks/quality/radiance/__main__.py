"""One table of radiance models against lookup, by one command that goes on where it was stopped.

    python -m benchmarks.quality.radiance --preset realistic --paths realistic=lobby.paths --models nearest idw4 paper

docs/how-to/radiance-table.md says what it makes, reads, checks and writes.
"""

import argparse
import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from benchmarks.quality.radiance.cells import SECOND, Key, Truth, commit, make_cells, make_second, read_cell
from benchmarks.quality.radiance.data import Data, data_of, geometry_digest, geometry_of, second_solve, spectra_at
from benchmarks.quality.radiance.models import KNOWN, LOOKUPS, Model, model_of
from benchmarks.quality.radiance.results import Results
from benchmarks.quality.radiance.scenes import SITES, Setting
from benchmarks.quality.radiance.split import HOLDOUTS, JUDGES, SplitConfig
from benchmarks.quality.radiance.tables import numbers_of, page_of, text_of
from rf3dgs.core.errors import InputError, RfError
from rf3dgs.core.files import write_whole
from rf3dgs.splats.gaussians import Gaussians


class Run:
    """One call: what is asked, the data of each preset, and the cells that are there."""

    def __init__(self, wish: argparse.Namespace) -> None:
        self.wish, self.out = wish, wish.out
        self.models = [model_of(text) for text in (*wish.models, *wish.variants)]
        names = [model.name for model in self.models]
        if len(set(names)) < len(names):
            raise InputError(f"every model needs a name of its own; got {', '.join(names)}")
        for model in self.models:
            model.settings(0, -150.0)
        self.geometries: dict[str, Gaussians] = {}
        unknown = [name for name in wish.against or () if name not in names]
        if unknown:
            raise InputError(f"{', '.join(unknown)} is to be judged against, but is no model of this table")
        against = wish.against or [*LOOKUPS, "paper"]
        self.results = Results(names, wish.judge, Path(wish.geometry).stem, wish.seeds, against)

    def preset(self, preset: str) -> None:
        """Make the missing cells of one preset, model by model, and gather all."""
        wish = self.wish
        setting = Setting(wish.scene, preset)
        data = self.data(setting)
        before = data if wish.trained is None else self.data(Setting(wish.trained, preset))
        if before.split != data.split or not torch.equal(before.dataset.pose.position, data.dataset.pose.position):
            raise InputError(f"{wish.trained!r} and {wish.scene!r} have other receivers; nothing can be compared")
        window = before.window()
        truths: dict[str, Truth] = {}
        base = {"data": [before.digest, data.digest], "window_db": [window.floor_db, window.ceil_db]}

        def truth(holdout: str) -> Truth:
            if holdout not in truths:
                truths[holdout] = Truth.of(data.judged(wish.judge, holdout, self.reason), window)
            return truths[holdout]

        for holdout in wish.holdout:
            self.second(data, holdout, base, truth)
        for count in wish.positions:
            for seed in wish.seeds:
                for model in self.models:
                    self.cells(setting, before, model, count, seed, base, truth)

    def data(self, setting: Setting) -> Data:
        wish, site = self.wish, setting.site
        parts = wish.held or site.held
        split = SplitConfig(*parts, buffer=site.buffer if wish.buffer is None else wish.buffer)
        given = dict(text.split("=", 1) for text in wish.paths)
        own = given.get(setting.preset) if setting.name == wish.scene else None
        return data_of(
            setting,
            self.folder(setting),
            split,
            receivers=wish.receivers or site.receivers,
            paths=None if own is None else Path(own),
        )

    @property
    def reason(self) -> str:
        """Why the sealed positions are read, for the log."""
        wish = self.wish
        asked = f"models {', '.join(self.results.models)}; seeds {wish.seeds}; positions {wish.positions}"
        return f"benchmarks.quality.radiance at {commit()}: {asked}"

    def second(self, data: Data, holdout: str, base: dict[str, Any], truth: Any) -> None:
        """The cell of the second solve of one hold-out."""
        wish, setting = self.wish, data.setting
        if not wish.again:
            return
        key = Key(setting.name, setting.preset, "none", wish.judge, holdout, 0, 0, SECOND, setting.name)
        identity = base | {"receivers": wish.again}
        if read_cell(key.path(self.out), identity) is None and not wish.only_read:
            solved = second_solve(data, self.folder(setting), wish.judge, wish.again)
            repeat = spectra_at(solved, wish.judge, holdout, self.reason, data.places(wish.judge, holdout))
            if repeat is not None:
                make_second(key, truth(holdout), repeat, identity, self.out)
        found = read_cell(key.path(self.out), identity)
        if found is not None:
            self.results.add_second(key, found)

    def folder(self, setting: Setting) -> Path:
        return self.out / "data" / f"{setting.name}-{setting.preset}"

    def cells(
        self, setting: Setting, before: Data, model: Model, count: int, seed: int, base: dict[str, Any], truth: Any
    ) -> None:
        """The cells of one fit, which differ in the hold-out; a model that fails leaves them out and is reported."""
        wish, kind = self.wish, "none" if model.is_lookup else Path(self.wish.geometry).stem
        keys = [
            Key(setting.name, setting.preset, kind, wish.judge, holdout, count, seed, model.name, before.setting.name)
            for holdout in wish.holdout
        ]
        identity = base | {
            "model": model.base,
            "settings": model.settings(seed, base["window_db"][0]),
            "geometry": None,
        }
        geometry = None if model.is_lookup else self.geometry(setting)
        if geometry is not None:
            identity["geometry"] = geometry_digest(geometry)
        missing = [
            key for key in keys if model.name in wish.again_models or not read_cell(key.path(self.out), identity)
        ]
        if missing and not wish.only_read:
            say(f"{setting.preset} {wish.judge} {count} positions, seed {seed}: {model.name}")
            train = before.training(count, seed)
            try:
                truths = {key.holdout: truth(key.holdout) for key in missing}
                make_cells(missing, model, train, truths, geometry, identity, self.out)
            except RfError as error:
                say(f"{model.name} failed, its cells stay empty: {error}")
        for key in keys:
            found = read_cell(key.path(self.out), identity)
            if found is not None:
                self.results.add(key, found)

    def geometry(self, setting: Setting) -> Gaussians:
        site = "lobby" if setting.photographs else setting.name
        if site not in self.geometries:
            kind, count = self.wish.geometry, self.wish.mesh_count
            self.geometries[site] = geometry_of(kind, setting, self.out / "geometry" / site, count=count)
        return self.geometries[site]


def without_folder(word: str) -> str:
    """A word of the command line as a page may show it: of a file its name alone."""
    head, equals, path = word.rpartition("=")
    return f"{head}{equals}{Path(path).name}" if "/" in path else word


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def asked(words: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", choices=SITES, default="lobby")
    parser.add_argument("--preset", nargs="+", help="diffuse, realistic, ...; the scene's own when missing")
    parser.add_argument("--holdout", nargs="+", choices=HOLDOUTS, default=list(HOLDOUTS))
    parser.add_argument("--positions", nargs="+", type=int, default=[20, 40, 80, 160], help="training positions")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--models", nargs="+", default=["nearest", "idw4", "idw8", "paper"], help=", ".join(KNOWN))
    parser.add_argument("--variants", nargs="+", default=[], metavar="NAME=BASE,SETTING=VALUE", help="ablations")
    parser.add_argument("--against", nargs="+", help="the baselines; the lookups and paper when missing")
    parser.add_argument("--geometry", default="photos", help="photos, mesh, or a .ply file")
    parser.add_argument("--mesh-count", type=int, default=100_000, help="Gaussians on a mesh")
    parser.add_argument("--judge", choices=JUDGES, default="validation", help='"test" reads the sealed positions')
    parser.add_argument("--paths", nargs="+", default=[], metavar="PRESET=FOLDER", help="what rf3dgs trace wrote")
    parser.add_argument("--receivers", type=int, help="the first so many of the paths; the scene's own when missing")
    parser.add_argument("--held", nargs=4, type=int, metavar=("TEST", "REGION", "VALIDATION", "NEAR"), help="held out")
    parser.add_argument("--buffer", type=float, help="round both regions [m]")
    parser.add_argument("--again", type=int, default=20, help="positions of each hold-out solved again; 0 for none")
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
