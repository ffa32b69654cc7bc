"""`spectra`: from traced paths to a dataset folder, one receiver after the other."""

import math
import shutil
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from rf3dgs.cli.show import console, out
from rf3dgs.core.errors import InputError
from rf3dgs.spectra.config import ArrayProcessing, Method

if TYPE_CHECKING:
    from rf3dgs.channel.arrays import PlanarArray
    from rf3dgs.core.grids import DirectionGrid
    from rf3dgs.data.dataset import Dataset

PRESETS: dict[str, dict[str, Any]] = {
    "paper": {"grid": "pinhole", "size": (300, 200), "yaws_deg": (0.0, 90.0, 180.0, 270.0), "split": "random"},
    "sphere": {"grid": "sphere", "size": (360, 180), "split": "random"},
}


@dataclass(frozen=True)
class MakeSpectra:
    """Make spectra of traced paths and put them, with the photographs beside, into a dataset folder."""

    paths: tyro.conf.Positional[Path]
    """What rf3dgs trace wrote."""
    out: Path = Path("lobby")
    """The dataset folder; photographs already in its photos/ folder are kept."""
    preset: Literal["paper", "sphere"] | None = None
    """The paper's protocol: four 300x200 pinholes of 90 degrees around each position, or its native sphere of 360x180;
    a fifth of the positions held out at random. In place of --grid, --size, --fov-deg, --yaws-deg."""
    method: Method = "ideal"
    """Ideal narrow lobe, or an array's Bartlett (CBF), Hann-tapered (TCBF), Capon (MVDR) or MUSIC spectrum."""
    lobe_deg: float | None = None
    """Half-power width of the ideal lobe [deg]; 2, or 1.5 pixels where those are wider, unless given."""
    array: str = "8x8"
    """Rows x columns of the receiving array, at half a wavelength; ideal spectra need none."""
    pattern: Literal["isotropic", "dipole", "patch", "tr38901"] = "patch"
    """The array's element."""
    grid: Literal["sphere", "pinhole"] = "sphere"
    """The whole sphere, or a pinhole picture that looks along the receiver's forward axis."""
    size: tuple[int, int] | None = None
    """Width and height [pixel]: 180 90 for a sphere, 300 200 for a pinhole unless given."""
    fov_deg: float = 90.0
    """Horizontal field of view of a pinhole [deg]."""
    yaws_deg: tuple[float, ...] = (0.0,)
    """Turns of the receiver about its vertical axis [deg], a picture for each, all of one set of paths."""
    processing: Annotated[ArrayProcessing, tyro.conf.arg(name="")] = field(default_factory=ArrayProcessing)
    """How an array's covariance is measured, averaged and read; array methods only."""
    split: Literal["mixed", "random", "region"] | None = None
    """What is held out: 15 % at random, a region of 15 % and 10 % for validation ("mixed", unless a preset says
    otherwise), or the paper's fifth, at random or in one region."""
    seed: int = 0
    """Of the noise and of the split."""

    def run(self) -> int:
        """Read, synthesise and write receiver by receiver; a killed run goes on after the last finished part."""
        from rf3dgs.channel.io import PathsReader
        from rf3dgs.channel.paths import Paths
        from rf3dgs.data.dataset import Dataset
        from rf3dgs.data.formats.detect import read_photos
        from rf3dgs.data.stream import stream_spectra
        from rf3dgs.spectra.scan import spectrum_of
        from rf3dgs.spectra.spectrum import Spectrum
        from rf3dgs.spectra.yaws import at_yaws

        wish = self.chosen()
        array, grid, yaws = wish.receiver(), wish.directions(), [math.radians(yaw) for yaw in wish.yaws_deg]
        lobe = None if wish.lobe_deg is None else math.radians(wish.lobe_deg)

        def spectra_at(number: int, paths: Paths) -> Spectrum:
            return spectrum_of(
                at_yaws(paths, yaws),
                array,
                grid,
                method=wish.method,
                lobe=lobe,
                processing=None if wish.processing == ArrayProcessing() else wish.processing,
                seed=wish.seed + number * len(yaws),
            )

        settings = {
            name: value for name, value in asdict(wish).items() if name not in ("paths", "out", "split", "preset")
        }
        meta = {"generator": f"rf3dgs spectra, method {wish.method}", "seed": wish.seed}
        folder = self.out.parent / f".{self.out.name}.spectra"
        with PathsReader(self.paths) as reader:
            spectra = stream_spectra(reader, spectra_at, folder, settings=settings, meta=meta, progress=console())
        photos = read_photos(self.out / "photos").photos if (self.out / "photos").is_dir() else ()
        wish.divided(Dataset(photos, spectra, meta=meta)).save(self.out)
        shutil.rmtree(folder, ignore_errors=True)
        places = f" at {len(spectra) // len(yaws)} positions" if len(yaws) > 1 else ""
        out(f"{self.out}: {len(spectra)} spectra of {grid.width}x{grid.height}{places}, {len(photos)} photographs")
        return 0

    def chosen(self) -> "MakeSpectra":
        """These settings with the preset's in place; InputError where both say something."""
        if self.preset is None:
            return self if self.split else replace(self, split="mixed")
        defaults = MakeSpectra(self.paths)
        for name in ("grid", "size", "fov_deg", "yaws_deg"):
            if getattr(self, name) != getattr(defaults, name):
                option = f"--{name.replace('_', '-')}"
                raise InputError(f"--preset {self.preset} sets {option} as well; give one of the two")
        return replace(self, **(PRESETS[self.preset] | ({"split": self.split} if self.split else {})))

    def receiver(self) -> "PlanarArray | None":
        """The array, None for ideal spectra."""
        from rf3dgs.channel.arrays import planar_array

        rows, cols = _size_of(self.array)
        return None if self.method == "ideal" else planar_array(rows, cols, pattern=self.pattern)

    def directions(self) -> "DirectionGrid":
        """The grid of every picture."""
        from rf3dgs.core.grids import equirect_grid, pinhole_grid

        if self.grid == "sphere":
            return equirect_grid(*(self.size or (180, 90)))
        return pinhole_grid(*(self.size or (300, 200)), fov_deg=self.fov_deg)

    def divided(self, dataset: "Dataset") -> "Dataset":
        """The dataset with its split."""
        if self.split == "random" or self.split == "region":
            return dataset.protocol(hold_out=self.split, seed=self.seed)
        return dataset.split(seed=self.seed)


def _size_of(array: str) -> tuple[int, int]:
    rows, _, cols = array.partition("x")
    if not (rows.isdigit() and cols.isdigit() and int(rows) and int(cols)):
        raise InputError(f'--array must be rows x columns such as "8x8"; got {array!r}')
    return int(rows), int(cols)
