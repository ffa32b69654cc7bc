"""Binning: diffuse paths merged by arrival and delay, while the line of sight and mirrors stay exact."""

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from rf3dgs.channel.paths import Paths
from rf3dgs.core.angles import angles_of
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose

DIFFUSE = 2  # bit of `Paths.kind`


def bin_diffuse(paths: Paths, *, cell: float = math.radians(1.0), delay_step: float = 1e-9) -> Paths:
    """Merge diffuse paths that arrive from the same cell of the sphere within the same delay step.

    cell: side of the cells of arrival direction [rad], equal in zenith and nearly so in area. delay_step [s].
    A merged path has the sum of the powers and the power-weighted means of delay, arrival and departure. Its
    coefficient has phase zero, so that the carrier's phase at its mean delay stands for the unknown phase of the sum:
    coherent sums over merged paths are one random draw. Its kind is 2 (diffuse) and its order the power-weighted mean,
    rounded. Paths without a diffuse bounce are kept as they are and come first. Receivers are padded to the longest.
    """
    if not (cell > 0 and delay_step > 0):
        raise InputError(f"cell [rad] and delay_step [s] must be positive; got {cell} and {delay_step}")
    if paths.kind is None:
        raise InputError("bin_diffuse needs paths.kind to tell diffuse paths from mirrors; give the interactions")
    if paths.coeff.dim() == 1:
        return _bin_one(paths, cell, delay_step)
    flat = paths.flat()
    merged = stack_paths([_bin_one(flat[index], cell, delay_step) for index in range(len(flat.rx))])
    shape = (*paths.coeff.shape[:-1], merged.coeff.shape[-1])
    return merged._map(lambda value: value.reshape(shape), rx=paths.rx)


def stack_paths(rows: list[Paths]) -> Paths:
    """One `Paths` `[rx, path]` of the paths of single receivers, padded with invalid entries to the longest.

    InputError when they do not share one frequency and one transmitter.
    """
    if not rows:
        raise InputError("stack_paths needs the paths of at least one receiver; got none")
    first = rows[0]
    for row in rows:
        if row.frequency != first.frequency or not torch.equal(row.tx.position, first.tx.position):
            raise InputError(
                "paths of different frequencies or transmitters cannot be stacked; "
                f"got {first.frequency:g} Hz from {first.tx.position.tolist()} and {row.frequency:g} Hz from "
                f"{row.tx.position.tolist()}. Keep them apart"
            )
    longest = max(row.coeff.shape[-1] for row in rows)
    names = ["coeff", "delay", "aoa_zenith", "aoa_azimuth", "aod_zenith", "aod_azimuth", "valid"]
    names += [name for name in ("order", "kind") if all(getattr(row, name) is not None for row in rows)]
    columns = {name: torch.stack([_padded(getattr(row, name), longest) for row in rows]) for name in names}
    rx = Pose(torch.stack([row.rx.position for row in rows]), torch.stack([row.rx.orientation for row in rows]))
    return Paths(**columns, frequency=first.frequency, tx=first.tx, rx=rx)


def _padded(value: Tensor, length: int) -> Tensor:
    return torch.nn.functional.pad(value, (0, length - value.shape[-1]))


def _bin_one(paths: Paths, cell: float, delay_step: float) -> Paths:
    assert paths.kind is not None
    diffuse = paths.valid & ((paths.kind & DIFFUSE) != 0) & (paths.path_gain > 0)
    certain = paths.valid & ((paths.kind & DIFFUSE) == 0)
    kept = paths._map(lambda value: value[certain])
    if not bool(diffuse.any()):
        return kept
    chosen = paths._map(lambda value: value[diffuse])
    bin_of_path, bins = _bin_index(chosen, cell, delay_step)
    weight = chosen.path_gain.double().numpy()

    def total(value: Tensor) -> np.ndarray:
        return np.bincount(bin_of_path, weights=weight * value.double().numpy(), minlength=bins)

    def mean_angles(direction: Tensor) -> tuple[Tensor, Tensor]:
        mean = torch.from_numpy(np.stack([total(direction[:, axis]) for axis in range(3)], -1))
        zenith, azimuth = angles_of(mean)
        return zenith.to(paths.delay.dtype), azimuth.to(paths.delay.dtype)

    power = np.bincount(bin_of_path, weights=weight, minlength=bins)
    aoa_zenith, aoa_azimuth = mean_angles(chosen.aoa)
    aod_zenith, aod_azimuth = mean_angles(chosen.aod)
    order = None if chosen.order is None else torch.from_numpy(np.rint(total(chosen.order) / power))
    merged = replace(
        chosen,
        coeff=torch.from_numpy(np.sqrt(power)).to(paths.coeff.dtype),
        delay=torch.from_numpy(total(chosen.delay) / power).to(paths.delay.dtype),
        aoa_zenith=aoa_zenith,
        aoa_azimuth=aoa_azimuth,
        aod_zenith=aod_zenith,
        aod_azimuth=aod_azimuth,
        valid=torch.ones(bins, dtype=torch.bool),
        order=None if order is None or paths.order is None else order.to(paths.order.dtype),
        kind=torch.full((bins,), DIFFUSE, dtype=paths.kind.dtype),
    )
    return _joined(kept, merged)


def _bin_index(paths: Paths, cell: float, delay_step: float) -> tuple[np.ndarray, int]:
    """Which bin `[path]` each path falls into, and how many bins there are."""
    rows = max(1, round(math.pi / cell))
    zenith = (np.arange(rows) + 0.5) * (math.pi / rows)
    columns = np.maximum(1, np.rint(2 * math.pi * np.sin(zenith) / cell)).astype(np.int64)
    first = np.concatenate(([0], np.cumsum(columns)))
    row = np.clip((paths.aoa_zenith.numpy() * (rows / math.pi)).astype(np.int64), 0, rows - 1)
    turn = np.mod(paths.aoa_azimuth.numpy().astype(np.float64) / (2 * math.pi), 1.0)
    column = np.minimum((turn * columns[row]).astype(np.int64), columns[row] - 1)
    step = (paths.delay.numpy().astype(np.float64) / delay_step).astype(np.int64)
    step -= step.min()
    key = (first[row] + column) * (step.max() + 1) + step
    span = int(first[-1]) * int(step.max() + 1)
    if span > 2**25:  # a table of all bins would be larger than sorting the paths
        found, index = np.unique(key, return_inverse=True)
        return index.reshape(-1), len(found)
    used = np.zeros(span, dtype=bool)
    used[key] = True
    number = np.cumsum(used, dtype=np.int32) - 1
    return number[key], int(number[-1]) + 1


def _joined(first: Paths, second: Paths) -> Paths:
    names = ("coeff", "delay", "aoa_zenith", "aoa_azimuth", "aod_zenith", "aod_azimuth", "valid", "order", "kind")
    columns = {
        name: None if getattr(first, name) is None else torch.cat((getattr(first, name), getattr(second, name)))
        for name in names
    }
    return replace(first, **columns)
