"""`render`, `csi` and `view`: ask a trained field."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from rf3dgs.cli.show import note, out
from rf3dgs.core.errors import InputError

if TYPE_CHECKING:
    from rf3dgs.channel.paths import Paths
    from rf3dgs.core.frames import Pose
    from rf3dgs.field.radio_field import RadioField

Format = Literal["text", "json", "csv", "mat"]


@dataclass(frozen=True)
class Render:
    """Draw the spectrum that a receiver sees, as a picture or as numbers."""

    field: tyro.conf.Positional[str]
    """A .field folder, or "lobby" for the one that ships with the package."""
    at: tuple[float, float, float]
    """The receiver's position, x y z [m]."""
    tx: tuple[float, float, float] | None = None
    """Where the transmitter stands now [m], if elsewhere than in training; for fields of the mirror model."""
    out: Path = Path("spectrum.png")
    """What to write: .png is a picture with a scale, .npz holds gain_db, delay and aod in physical units."""
    towards: tuple[float, float, float] | None = None
    """The point the receiver looks at [m]; the transmitter unless given. Spheres stay level with the world."""
    grid: Literal["pinhole", "sphere"] = "pinhole"
    """A pinhole picture, or the whole sphere."""
    size: tuple[int, int] | None = None
    """Width and height [pixel]: 300 200 for a pinhole, 360 180 for a sphere unless given."""
    fov_deg: float = 90.0
    """Horizontal field of view of a pinhole [deg]."""
    part: Literal["all", "sources", "lit", "ambient"] = "all"
    """One part of a field of the mirror model alone: point sources, surfaces lit straight from the transmitter, or what
    comes by other ways."""

    def run(self) -> int:
        """Render, write the file and say what is in it."""
        from rf3dgs.cli.facts import open_field
        from rf3dgs.core.files import atomic_file
        from rf3dgs.core.frames import Pose
        from rf3dgs.core.grids import equirect_grid, pinhole_grid

        if self.out.suffix not in (".png", ".npz"):
            raise InputError(f"--out must end in .png or .npz; got {self.out}")
        field = moved_field(open_field(self.field), self.tx)
        field = field if self.part == "all" else field.only(self.part)
        if self.grid == "sphere":
            grid = equirect_grid(*(self.size or (360, 180)))
            pose = Pose(self.at) if self.towards is None else Pose.look_at(self.at, self.towards)
        else:
            grid = pinhole_grid(*(self.size or (300, 200)), fov_deg=self.fov_deg)
            pose = Pose.look_at(self.at, field.tx.position if self.towards is None else self.towards)
        spectrum = field.render(pose, grid)
        if self.out.suffix == ".npz":
            import numpy as np

            assert spectrum.delay is not None
            assert spectrum.aod is not None
            with atomic_file(self.out) as temporary:
                np.savez_compressed(
                    temporary,
                    gain_db=spectrum.gain_db.numpy(),
                    delay=spectrum.delay.numpy(),
                    aod=spectrum.aod.numpy(),
                    directions=spectrum.directions.numpy(),
                    position=pose.position.numpy(),
                    orientation=pose.orientation.numpy(),
                )
        else:
            from rf3dgs.evaluation.pictures import colour_range, save_spectrum_figure

            save_spectrum_figure(spectrum, self.out, window=colour_range([spectrum]))
        peak = float(spectrum.gain_db.max())
        gain_db = 10 * math.log10(max(float(spectrum.path_gain), 1e-30))
        what = "path gain" if self.grid == "sphere" else "path gain in view"
        out(f"{self.out}: {grid.width}x{grid.height}, peak {peak:.1f} dB, {what} {gain_db:.1f} dB")
        warn_if_outside(field, pose)
        return 0


@dataclass(frozen=True)
class Csi:
    """List the strongest paths at a receiver: gain, delay, arrival and departure."""

    field: tyro.conf.Positional[str]
    """A .field folder, or "lobby" for the one that ships with the package."""
    at: tuple[float, float, float]
    """The receiver's position, x y z [m]."""
    tx: tuple[float, float, float] | None = None
    """Where the transmitter stands now [m], if elsewhere than in training; for fields of the mirror model."""
    strongest: int = 8
    """How many paths."""
    format: Format = "text"
    """A table, JSON, CSV, or a MATLAB file (needs --out)."""
    out: Path | None = None
    """The file to write; standard output unless given."""

    def run(self) -> int:
        """Extract the paths and write them."""
        from rf3dgs.cli.facts import open_field
        from rf3dgs.core.files import atomic_file, write_whole
        from rf3dgs.core.frames import Pose

        if self.strongest < 1:
            raise InputError(f"--strongest must be at least 1; got {self.strongest}")
        field = moved_field(open_field(self.field), self.tx)
        pose = Pose.look_at(self.at, field.tx.position)
        columns = path_columns(field.paths(pose, strongest=self.strongest))
        if self.format == "mat":
            if self.out is None:
                raise InputError("--format mat writes a binary file; name it with --out paths.mat")
            from scipy.io import savemat

            with atomic_file(self.out) as temporary, temporary.open("wb") as stream:
                savemat(stream, columns)
            return 0
        text = WRITERS[self.format](columns)
        if self.out is None:
            out(text)
        else:
            write_whole(self.out, (text + "\n").encode())
        warn_if_outside(field, pose)
        return 0


@dataclass(frozen=True)
class View:
    """Open the site in a browser: drag a receiver, see its spectrum and its strongest paths."""

    field: tyro.conf.Positional[str]
    """A .field folder, or "lobby" for the one that ships with the package."""
    port: int = 8080
    """The port on this machine; the viewer listens on 127.0.0.1 only."""
    seconds: float | None = None
    """Stop after this many seconds; runs until interrupted unless given."""

    def run(self) -> int:
        """Serve until interrupted."""
        from rf3dgs.cli.facts import open_field
        from rf3dgs.viewer.app import view

        viewer = view(open_field(self.field), port=self.port, wait=False)
        out(f"{viewer.url}   (Ctrl+C ends)")
        viewer.wait(self.seconds)
        return 0


def moved_field(field: "RadioField", tx: tuple[float, float, float] | None) -> "RadioField":
    """The field with its transmitter at `tx` [m]; as it is for None."""
    from rf3dgs.core.frames import Pose

    return field if tx is None else field.moved_to(Pose(tx))


def path_columns(paths: "Paths") -> dict[str, list[float]]:
    """The valid paths of one receiver as columns in the units of their names."""
    from rf3dgs.core.units import db_from_power

    keep = paths.valid
    degrees = {
        f"{name}_deg": (getattr(paths, name)[keep] * (180 / math.pi)).tolist()
        for name in ("aoa_zenith", "aoa_azimuth", "aod_zenith", "aod_azimuth")
    }
    gain_db = db_from_power(paths.path_gain[keep]).tolist()
    return {"gain_db": gain_db, "delay_ns": (paths.delay[keep] * 1e9).tolist(), **degrees}


def text_of(columns: dict[str, list[float]]) -> str:
    """An aligned table with units in the header."""
    head = f"{'path':>4} {'gain':>8} {'delay':>8} {'AoA zen':>8} {'AoA azi':>8} {'AoD zen':>8} {'AoD azi':>8}"
    unit = f"{'':>4} {'[dB]':>8} {'[ns]':>8} {'[deg]':>8} {'[deg]':>8} {'[deg]':>8} {'[deg]':>8}"
    rows = zip(*columns.values(), strict=True)
    lines = [f"{number:>4} " + " ".join(f"{value:>8.2f}" for value in row) for number, row in enumerate(rows, 1)]
    return "\n".join([head, unit, *lines])


def csv_of(columns: dict[str, list[float]]) -> str:
    """Comma-separated values with a header."""
    rows = zip(*columns.values(), strict=True)
    return "\n".join([",".join(columns), *(",".join(f"{value:.9g}" for value in row) for row in rows)])


def json_of(columns: dict[str, list[float]]) -> str:
    """A list of objects, one per path."""
    rows = zip(*columns.values(), strict=True)
    return json.dumps([dict(zip(columns, row, strict=True)) for row in rows], indent=1)


WRITERS = {"text": text_of, "csv": csv_of, "json": json_of}


def warn_if_outside(field: "RadioField", pose: "Pose") -> None:
    """Say so when a receiver stands outside the volume the field was trained in."""
    if not bool(field.covers(pose)):
        note("this receiver stands outside the volume of the training positions; the answer extrapolates")
