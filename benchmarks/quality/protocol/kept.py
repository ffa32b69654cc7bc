"""Pictures that methods drew, kept beside their cells, so that a figure can show them without another fit."""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from rf3dgs.core.files import write_whole
from rf3dgs.core.npz import read_npz_array
from rf3dgs.spectra.spectrum import Spectrum


def kept_beside(cell: Path) -> Path:
    """Where the pictures of a cell are kept."""
    return cell.with_suffix(".npz")


def keep_pictures(path: Path, drawn: Spectrum) -> None:
    """Write power, and delay and departure where there are any, of pictures `[n, row, col]`."""
    parts = {"power": drawn.power, "delay": drawn.delay, "aod": drawn.aod}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **{name: part.numpy() for name, part in parts.items() if part is not None})
    write_whole(path, buffer.getvalue())


def kept_pictures(path: Path, truth: Spectrum) -> Spectrum:
    """The pictures `[n, row, col]` that were kept of the first poses of `truth` `[m, row, col]`."""
    power = torch.tensor(read_npz_array(path, "power"))
    with np.load(path, allow_pickle=False) as held:
        names = set(held.files)

    def part(name: str) -> torch.Tensor | None:
        return torch.tensor(read_npz_array(path, name)) if name in names else None

    return replace(truth[: len(power)], power=power, delay=part("delay"), aod=part("aod"), floor=None, noise=None)
