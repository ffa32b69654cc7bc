"""`trace` and `photos`: from a scene to its paths and its photographs."""

import re
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from rf3dgs.cli.show import console, out
from rf3dgs.core.errors import InputError
from rf3dgs.propagation.config import PhotoConfig, TraceConfig


@dataclass(frozen=True)
class Trace:
    """Trace the paths from the transmitter to many receivers with Sionna RT."""

    scene: tyro.conf.Positional[str]
    """"lobby", a scene that ships with Sionna RT ("box", "simple_street_canyon"), or a Sionna/Mitsuba XML file."""
    rx_count: int = 72
    """Receivers, drawn in the free space of the scene."""
    rx_seed: int = 0
    """Decides where the receivers stand."""
    out: Path = Path("lobby.paths")
    """The HDF5 file to write; a killed run leaves none."""
    trace: TraceConfig = field(default_factory=TraceConfig)
    """How paths are traced."""

    def run(self) -> int:
        """Trace one receiver after the other; memory stays flat."""
        import math

        from rf3dgs.channel.binning import bin_diffuse
        from rf3dgs.channel.io import PathsWriter
        from rf3dgs.cli.facts import open_scene
        from rf3dgs.propagation.sionna import trace_each

        if self.rx_count < 1:
            raise InputError(f"--rx-count must be at least 1; got {self.rx_count}")
        scene = open_scene(self.scene)
        rx = scene.receivers(self.rx_count, self.rx_seed)
        frequency = self.trace.frequency or scene.frequency
        meta = {"scene": scene.name, "rays": self.trace.rays, "seed": self.trace.seed, "rx_seed": self.rx_seed}
        cell = math.radians(self.trace.cell_deg)
        with PathsWriter(self.out, frequency, scene.tx, meta) as writer:
            for paths in trace_each(scene, scene.tx, rx, self.trace, console()):
                writer.append(bin_diffuse(paths, cell=cell, delay_step=self.trace.delay_step))
        out(f"{self.out}: {self.rx_count} receivers, {self.out.stat().st_size / 1e6:.1f} MB")
        return 0


@dataclass(frozen=True)
class MakePhotos:
    """Render posed photographs of a scene with Mitsuba, in nerfstudio's layout."""

    scene: tyro.conf.Positional[str]
    """"lobby", a scene that ships with Sionna RT, or a Sionna/Mitsuba XML file."""
    count: int = 60
    """Photographs."""
    tour_seed: int = 0
    """Decides where the cameras stand."""
    out: Path = Path("lobby/photos")
    """The folder to write: pictures and transforms.json; a tour already there is replaced."""
    photo: PhotoConfig = field(default_factory=PhotoConfig)
    """How photographs are rendered."""

    def run(self) -> int:
        """Render and write all of them, or nothing."""
        from rf3dgs.cli.chain import photograph
        from rf3dgs.cli.facts import open_scene
        from rf3dgs.core.files import atomic_folder
        from rf3dgs.data.formats.nerfstudio import write_nerfstudio

        if self.count < 1:
            raise InputError(f"--count must be at least 1; got {self.count}")
        _refuse_other_folder(self.out)
        scene = open_scene(self.scene)
        with atomic_folder(self.out) as folder:
            photos = photograph(scene, self.count, self.tour_seed, self.photo, folder, console())
            write_nerfstudio(folder, photos)
        out(f"{self.out}: {self.count} photographs of {self.photo.width}x{self.photo.height}")
        return 0


def _refuse_other_folder(folder: Path) -> None:
    """Refuse to replace a folder that holds anything but an earlier tour."""
    from rf3dgs.data.formats.nerfstudio import FILE_NAME

    items = folder.iterdir() if folder.is_dir() else ()
    others = sorted(item.name for item in items if not re.fullmatch(rf"\d{{5}}\.jpg|{re.escape(FILE_NAME)}", item.name))
    if others:
        raise InputError(
            f"{folder} would be replaced, but it holds something else than a tour, such as {others[0]}; choose another "
            "name with --out"
        )
