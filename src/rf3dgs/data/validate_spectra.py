"""What can be wrong with `spectra.h5`: damage, poses, empty or constant spectra, and units by plausibility."""

from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
from scipy.spatial import KDTree

from rf3dgs.core.errors import DataError
from rf3dgs.core.hdf5 import open_audited, read_array, read_attribute
from rf3dgs.core.units import LONGEST_DELAY, shortest_delay
from rf3dgs.data.formats.spectra_h5 import LIMITS, read_spectra
from rf3dgs.data.survey import Survey, survey_of

Found = Iterator[tuple[str, str]]

MAX_GAIN_DB = 30.0
SAMPLE = 256  # spectra whose units are looked at before every use; `spectra_faults` looks at all
MAX_EXTENT = 1000.0  # [m] beyond it, positions without a delay that explains them are taken for millimetres


def spectra_faults(path: Path) -> Found:
    """Pairs (what, remedy) for one file of spectra; the values are looked at raw, so that one fault hides no other."""
    again = "Write the spectra again"
    try:
        with open_audited(path, **LIMITS) as file:
            if not isinstance(file.get("spectra"), h5py.Group):
                yield "the group 'spectra' is missing", again
            for name, group in _groups(file):
                yield from _group_faults(group, name)
    except DataError as error:
        yield _sentence(path, error), again
        return
    except (OSError, ValueError, TypeError, IndexError, KeyError) as error:
        yield f"the arrays do not fit together ({error})", again
        return
    try:
        read_spectra(path)
    except DataError as error:
        yield _sentence(path, error), again


def check_units(path: Path) -> None:
    """Refuse a sound file of spectra whose values cannot be in the units it states: DataError with the remedy.

    Of many spectra 256 are looked at, from the first to the last.
    """
    with open_audited(path, **LIMITS) as file:
        for name, group in _groups(file):
            for what, remedy in _unit_faults(group, name, survey_of(group, SAMPLE)):
                raise DataError(f"{path}: {what}. {remedy}")


def _groups(file: h5py.File) -> list[tuple[str, h5py.Group]]:
    found = ((name, file.get(name)) for name in ("spectra", "repeat"))
    return [(name, group) for name, group in found if isinstance(group, h5py.Group)]


def _group_faults(group: h5py.Group, name: str) -> Found:
    positions, orientations = (read_array(group, key).astype(np.float64) for key in ("position", "orientation"))
    gain = group.get("gain")
    if not isinstance(gain, h5py.Dataset):
        raise DataError(f"{group.file.filename}: expected the dataset '{group.name}/gain'; it is missing")
    counts = {"position": len(positions), "orientation": len(orientations), "gain": len(gain)}
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"{count} of {key}" for key, count in counts.items())
        yield f"{name}: counts differ: {listed}", "Write one pose per spectrum"
        return
    yield from _pose_faults(positions, orientations, name)
    survey = survey_of(group)
    yield from _gain_faults(survey, name)
    yield from _unit_faults(group, name, survey)


def _unit_faults(group: h5py.Group, name: str, survey: Survey) -> Found:
    """Values that no spectrum has in the units of the file."""
    if not np.isnan(survey.gain).all() and read_attribute(group, "method") != "music":
        peak, least = float(np.nanmax(survey.gain)), float(np.nanmin(survey.gain))
        if peak > MAX_GAIN_DB:
            what = f"{name}: the gain reaches {peak:.1f} dB, which no path gain does"
            yield what, "It is a level in dBm or another unit; subtract the transmit power and store dB"
        elif least >= 0.0 and peak <= 1.0 and peak > least:
            what = f"{name}: all gains lie between {least:.3g} and {peak:.3g} dB, as linear power does"
            yield what, "It is linear power; store 10 log10 of it"
    lobe = read_attribute(group, "lobe")
    if isinstance(lobe, int | float) and lobe > 2 * np.pi:
        yield (
            f"{name}: the lobe is {lobe:.3g}, more than a full turn in radians",
            "It is in degrees; convert to radians",
        )
    positions = read_array(group, "position").astype(np.float64)
    if np.isfinite(positions).all():
        yield from _scale_faults(group, positions, survey, name)


def _pose_faults(positions: np.ndarray, orientations: np.ndarray, name: str) -> Found:
    bad = np.flatnonzero(~np.isfinite(positions).all(1) | ~np.isfinite(orientations).all(1))
    if len(bad):
        yield (
            f"{name}: the pose of spectrum {_some(bad)} is NaN or infinite",
            "Remove those spectra or mend their poses",
        )
    length = np.linalg.norm(np.nan_to_num(orientations, nan=1.0), axis=1)
    zero = np.flatnonzero(length < 1e-6)
    if len(zero):
        yield f"{name}: the quaternion of spectrum {_some(zero)} is zero", "Write (1, 0, 0, 0) for no rotation"
    scaled = np.setdiff1d(np.flatnonzero(np.abs(length - 1.0) > 1e-3), np.concatenate((zero, bad)))
    if len(scaled):
        yield f"{name}: the quaternion of spectrum {_some(scaled)} is not of unit length", "Normalise it to length 1"
    finite = np.setdiff1d(np.arange(len(positions)), bad)
    pose = np.concatenate((positions, orientations), 1)[finite]
    for first, second in sorted(KDTree(pose).query_pairs(1e-3)) if len(pose) > 1 else ():
        low, high = finite[first], finite[second]
        yield f"{name}: spectra {low} and {high} have one pose", "Remove one of the two duplicates"
        return


def _gain_faults(survey: Survey, name: str) -> Found:
    dark = np.isnan(survey.gain).any(1)
    if dark.any():
        empty = survey.index[dark]
        yield f"{name}: spectrum {_some(empty)} is empty, no power arrives", "Remove it, or trace that receiver again"
    constant = survey.index[survey.full & (survey.gain[:, 1] - survey.gain[:, 0] < 1e-6)]
    if len(constant):
        what = f"{name}: spectrum {_some(constant)} is constant, the same in every direction"
        yield what, "Remove it, or measure or trace it again"


def _scale_faults(group: h5py.Group, positions: np.ndarray, survey: Survey, name: str) -> Found:
    """Positions against delays: light needs distance / c at least."""
    metres = "Positions must be in metres and delays in seconds; convert and write them again"
    delay = survey.delay
    if delay is not None and not np.isnan(delay).all():
        first, last = float(np.nanmin(delay)), float(np.nanmax(delay))
        if last > LONGEST_DELAY:
            yield f"{name}: delays reach {last:.3g} s, the way of light over 300 km", metres
            return
        if first < 0.0:
            yield f"{name}: delays are negative, down to {first:.3g} s", metres
            return
    if delay is not None and "tx_position" in group:
        tx = read_array(group, "tx_position").reshape(-1, 3)[:1]
        distance = np.linalg.norm(positions[survey.index] - tx, axis=1)
        early = np.flatnonzero(delay[:, 0] < shortest_delay(distance))
        if len(early):
            index = early[0]
            needed = f"{delay[index, 0]:.3g} s for {distance[index]:.4g} m from the transmitter"
            yield f"{name}: spectrum {_some(survey.index[early])} arrives before light could: {needed}", metres
        return
    extent = float(np.ptp(positions, axis=0).max()) if len(positions) else 0.0
    if extent > MAX_EXTENT:
        yield f"{name}: positions span {extent:.4g} m, more than {MAX_EXTENT:.0f} m; are they millimetres?", metres


def _some(indices: np.ndarray) -> str:
    """The first of many, and how many more."""
    return f"{indices[0]}" + (f" (and {len(indices) - 1} more)" if len(indices) > 1 else "")


def _sentence(path: Path, error: Exception) -> str:
    return str(error).removeprefix(f"{path}: ").rstrip(".")
