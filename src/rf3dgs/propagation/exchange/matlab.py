"""Paths for MATLAB: a function that makes `comm.Ray` objects, a .mat file, and a reader for our HDF5 files.

`comm.Ray` (Communications Toolbox) takes angles as [azimuth; elevation] in degrees, elevation from the horizon, and
loss in dB. Its `PhaseShift` is a lag: a ray contributes 10^(-PathLoss/20) exp(-1i PhaseShift), the carrier's turns over
the path included.
"""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rf3dgs.channel.paths import Paths
from rf3dgs.core.errors import InputError
from rf3dgs.core.files import atomic_file, write_whole
from rf3dgs.core.units import db_from_power

STRONGEST = 25
READER = Path(__file__).parent / "read_paths.m"
COLUMNS = ("delay [s]", "path loss [dB]", "phase shift [rad]", "AoD azimuth, elevation [deg]", "AoA the same [deg]")

_FUNCTION = """\
function [rays, txPosition, rxPosition] = {name}()
%{upper}  comm.Ray objects of the strongest paths to each of {count} receivers.
%   rays{{i}} is a row of comm.Ray objects, strongest first, empty where nothing arrives; txPosition (3x1) and
%   rxPosition (3xN) are in metres, x y z, z up. Use it with comm.RayTracingChannel, for example
%       channel = comm.RayTracingChannel(PropagationRays=rays{{1}}, SampleRate=100e6);
%   Needs the Communications Toolbox.
frequency = {frequency};
txPosition = [{tx}]';
rxPosition = [
{rx}
]';
% One row per path: {columns}.
paths = cell(1, {count});
{paths}
ray = comm.Ray('PathSpecification', 'Delay and angles', 'Frequency', frequency, 'PathLossSource', 'Custom');
rays = cell(1, {count});
for i = 1:{count}
    found = repmat(ray, 1, size(paths{{i}}, 1));
    for k = 1:numel(found)
        row = paths{{i}}(k, :);
        found(k).PropagationDelay = row(1);
        found(k).PathLoss = row(2);
        found(k).PhaseShift = row(3);
        found(k).AngleOfDeparture = row(4:5)';
        found(k).AngleOfArrival = row(6:7)';
    end
    rays{{i}} = found;
end
end
"""


def write_matlab(path: str | Path, paths: Paths, *, strongest: int = STRONGEST) -> None:
    """Write a MATLAB function file that returns the `strongest` paths of each receiver as `comm.Ray` objects.

    The function has the file's name, which must be a MATLAB name ending in .m. Numbers are written so that they parse
    back to the same doubles. Not run in MATLAB by our tests, which parse the file.
    """
    path = Path(path)
    if path.suffix != ".m" or not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,62}", path.stem):
        raise InputError(f"a MATLAB function file is named like my_rays.m: letters, digits and _; got {path.name!r}")
    if strongest < 1:
        raise InputError(f"strongest must be at least 1; got {strongest}")
    paths = paths.flat().strongest(strongest)
    keep = paths.valid & (paths.path_gain > 0)
    rows = ray_rows(paths).numpy()
    blocks = []
    for index in range(len(rows)):
        lines = [" ".join(map(repr, row)) for row in rows[index][keep[index].numpy()].tolist()]
        content = "[\n" + "\n".join(lines) + "\n]" if lines else "zeros(0, 7)"
        blocks.append(f"paths{{{index + 1}}} = {content};")
    text = _FUNCTION.format(
        name=path.stem,
        upper=path.stem.upper(),
        count=len(rows),
        frequency=repr(float(paths.frequency)),
        tx=" ".join(map(repr, paths.tx.position.double().tolist())),
        rx="\n".join(" ".join(map(repr, position)) for position in paths.rx.position.double().tolist()),
        columns=", ".join(COLUMNS),
        paths="\n".join(blocks),
    )
    write_whole(path, text.encode())


def ray_rows(paths: Paths) -> torch.Tensor:
    """What a `comm.Ray` takes of each path `[*batch, path, 7]`, float64.

    Delay [s], path loss [dB], phase shift [rad] in [0, 2 pi), azimuth and elevation [deg] of departure and of arrival.
    """
    lag = paths.frequency * paths.delay.double() - paths.coeff.to(torch.complex128).angle() / (2 * math.pi)
    loss = -db_from_power(paths.coeff.to(torch.complex128).abs() ** 2)
    angles = [
        torch.rad2deg(paths.aod_azimuth.double()),
        90 - torch.rad2deg(paths.aod_zenith.double()),
        torch.rad2deg(paths.aoa_azimuth.double()),
        90 - torch.rad2deg(paths.aoa_zenith.double()),
    ]
    return torch.stack((paths.delay.double(), loss, 2 * math.pi * torch.remainder(lag, 1.0), *angles), -1)


def write_mat(path: str | Path, paths: Paths) -> None:
    """Write paths as a MATLAB 5 file, which MATLAB, Octave and scipy read.

    `coeff` (complex), `delay` [s], `aoa_zenith` and the other angles [rad], `order` and `kind` are matrices with a row
    for each receiver and NaN (0 in `order` and `kind`) after its last path; `count` is the number of paths of each.
    `rx_position`, `tx_position` [m], `rx_orientation`, `tx_orientation` (quaternion wxyz), `frequency` [Hz].
    """
    from scipy.io import savemat

    paths = _packed(paths.flat())
    valid = paths.valid.numpy()

    def padded(value: torch.Tensor) -> NDArray:
        return np.where(valid, value.numpy(), np.nan)

    names = ("delay", "aoa_zenith", "aoa_azimuth", "aod_zenith", "aod_azimuth")
    content: dict[str, Any] = {"coeff": np.where(valid, paths.coeff.numpy(), complex(math.nan, math.nan))}
    content |= {name: padded(getattr(paths, name)) for name in names}
    for name in ("order", "kind"):
        value = getattr(paths, name)
        if value is not None:
            content[name] = np.where(valid, value.numpy(), 0).astype(np.int8)
    content |= {
        "count": paths.count.numpy().astype(np.float64)[:, None],
        "frequency": float(paths.frequency),
        "rx_position": paths.rx.position.numpy(),
        "rx_orientation": paths.rx.orientation.numpy(),
        "tx_position": paths.tx.position.numpy()[None],
        "tx_orientation": paths.tx.orientation.numpy()[None],
    }
    if max(value.nbytes for value in content.values() if isinstance(value, np.ndarray)) >= 2**31:
        raise InputError(
            f"{path}: a .mat file holds at most 2 GB in a matrix; export fewer paths, or HDF5, which MATLAB reads too"
        )
    with atomic_file(path) as temporary, temporary.open("wb") as stream:
        savemat(stream, content, do_compression=True)


def _packed(paths: Paths) -> Paths:
    """The valid paths of each receiver first, in their order, and no more columns than the longest needs."""
    rank = (~paths.valid).to(torch.uint8).argsort(dim=-1, stable=True)
    longest = max(int(paths.count.max()), 1)
    return paths._map(lambda value: torch.nn.functional.pad(value, (0, 1)).gather(-1, rank[..., :longest]))
