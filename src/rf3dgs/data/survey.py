"""`survey_of`: the extremes of stored spectra, one picture in memory at a time."""

from dataclasses import dataclass

import h5py
import numpy as np

from rf3dgs.core.errors import DataError
from rf3dgs.core.hdf5 import read_attribute


@dataclass(frozen=True, eq=False)
class Survey:
    """Extremes of the spectra `index` `[n]`, read one at a time.

    gain `[n, 2]` [dB]: least and largest, NaN where there is no power; full `[n]`: power in every direction; delay
    `[n, 2]` [s]: first and last where power arrives, None in files without delays.
    """

    index: np.ndarray
    gain: np.ndarray
    full: np.ndarray
    delay: np.ndarray | None


def survey_of(group: h5py.Group, most: int | None = None) -> Survey:
    """Look at all spectra of a group, or at `most` of them spread evenly; DataError where one is damaged."""
    gain, missing_gain, scale_gain = _column(group, "gain")
    delay, missing_delay, scale_delay = _column(group, "delay") if "delay" in group else (None, None, None)
    count = len(gain)
    index = np.arange(count)
    if most is not None and count > most:
        index = np.unique(np.linspace(0, count - 1, most).round().astype(np.int64))
    gains, delays = np.full((len(index), 2), np.nan), np.full((len(index), 2), np.nan)
    full = np.zeros(len(index), dtype=bool)
    for place, number in enumerate(index.tolist()):
        codes = _picture(gain, number)
        some = codes != missing_gain
        full[place] = some.all()
        if some.any():
            gains[place] = _extremes(codes[some], *scale_gain)
        if delay is not None and scale_delay is not None:
            late = _picture(delay, number)
            some = some & (late != missing_delay)
            if some.any():
                delays[place] = _extremes(late[some], *scale_delay)
        if most is None and isinstance(group.get("aod"), h5py.Dataset):
            _picture(group["aod"], number)  # type: ignore[arg-type]
    return Survey(index, gains, full, None if delay is None else delays)


def _column(group: h5py.Group, name: str) -> tuple[h5py.Dataset, float, tuple[float, float]]:
    """A stored array, the code that means missing, and scale and offset."""
    item = group.get(name)
    if not isinstance(item, h5py.Dataset):
        raise DataError(f"{group.file.filename}: expected the dataset '{group.name}/{name}'; it is missing")
    scale, offset, missing = (float(np.asarray(read_attribute(item, key))) for key in ("scale", "offset", "missing"))
    return item, missing, (scale, offset)


def _picture(item: h5py.Dataset, number: int) -> np.ndarray:
    try:
        return np.asarray(item[number])
    except (OSError, RuntimeError, ValueError) as error:
        where = f"{item.file.filename}: {item.name!r} of spectrum {number}"
        raise DataError(f"{where} is damaged (checksum or storage); write the file again") from error


def _extremes(codes: np.ndarray, scale: float, offset: float) -> tuple[float, float]:
    ends = (float(codes.min()) * scale + offset, float(codes.max()) * scale + offset)
    return min(ends), max(ends)
