"""`Part`: one side of a split, how it is taken out of a dataset, and the line that reading a sealed one leaves."""

import logging
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import torch
from torch import Tensor

from rf3dgs.data.photo import Photo
from rf3dgs.spectra.spectrum import Spectrum

LOG_NAME = "test_reads.log"
_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Part:
    """One side of a split: its photos, its spectra `[position]`, and what a second solve saw at some of them.

    Spectra of a loaded dataset stay in their file until they are looked at (`StoredSpectra`). Every access to
    `dataset.train` makes a part anew: keep it in a variable, and what it has read is kept with it.
    `index` holds the places of these spectra among the dataset's; `repeat[i]` repeats `spectra[repeat_index[i]]`, and
    both are None where nothing was solved twice.
    """

    role: str
    photos: tuple[Photo, ...]
    spectra: Spectrum | None
    index: Tensor
    repeat: Spectrum | None = None
    repeat_index: Tensor | None = None


def part_of(
    role: str,
    photos: tuple[Photo, ...],
    spectra: Spectrum | None,
    index: Tensor,
    repeat: Spectrum | None = None,
    repeat_index: Tensor | None = None,
) -> Part:
    """The part of `photos`, of the `spectra` that `index` `[n]` names, and of what `repeat` solves again of those.

    `repeat_index` `[m]` counts in `spectra`; that of the part counts in its own.
    """
    if spectra is None:
        return Part(role, photos, None, index)
    part = Part(role, photos, spectra[index], index)
    if repeat is None or repeat_index is None:
        return part
    rank = {int(place): order for order, place in enumerate(index)}
    chosen = [order for order, place in enumerate(repeat_index.tolist()) if place in rank]
    if not chosen:
        return part
    local = torch.tensor([rank[int(repeat_index[order])] for order in chosen], dtype=torch.int64)
    return replace(part, repeat=repeat[torch.tensor(chosen, dtype=torch.int64)], repeat_index=local)


def log_read(folder: Path | None, role: str, reason: str) -> None:
    """Say that a sealed part was read and why: in the log, and in `test_reads.log` of the dataset's folder."""
    line = f"{datetime.now(UTC).isoformat(timespec='seconds')} {role} {' '.join(reason.split())}"
    _log.info("sealed test read: %s", line)
    if folder is None or not folder.is_dir():
        return
    try:
        with (folder / LOG_NAME).open("a", encoding="utf-8") as file:
            file.write(line + "\n")
    except OSError as error:
        _log.warning("%s cannot be written (%s); this read is in the log only", folder / LOG_NAME, error)
