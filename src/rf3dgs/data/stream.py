"""`stream_spectra`: spectra of many receivers into one file, with a few of them in memory at a time.

Parts of a few receivers are written to a folder, each at once or not at all, and joined in the end without being
decompressed. A run that was killed finds its parts and goes on after them. The parts belong to their run: a run with
other settings or other paths removes them.
"""

import hashlib
import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

from rf3dgs.channel.paths import Paths
from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.files import atomic_file, remove_partials, write_whole
from rf3dgs.core.progress import Progress
from rf3dgs.data.formats.spectra_codes import Precision
from rf3dgs.data.formats.spectra_h5 import common_scales, join_parts, read_spectra, write_part
from rf3dgs.data.formats.stored import StoredSpectra
from rf3dgs.data.safe import read_json
from rf3dgs.spectra.spectrum import Spectrum, stack_spectra

PIXELS = 2**20  # a part has at least so many: what a killed run makes again
MOST_PARTS = 1000
JOINED = "spectra.h5"
IDENTITY = "run.json"


class ManyPaths(Protocol):
    """The paths of many receivers, one at a time: a `PathsReader`."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Paths: ...


def stream_spectra(
    paths: ManyPaths,
    spectra_at: Callable[[int, Paths], Spectrum],
    folder: Path,
    *,
    settings: Mapping[str, Any],
    meta: Mapping[str, Any],
    progress: Progress,
) -> StoredSpectra:
    """The spectra that `spectra_at(number, paths)` makes of each receiver, in a file in `folder`.

    `spectra_at` returns one picture `[row, col]` or several `[n, row, col]`, as many for each receiver. `settings`: all
    that decides its answer, as JSON; `meta`: "generator" and "seed" for the file. The paths are read twice: once for
    the longest delay, which decides how delays are stored, and for a digest. The caller removes the folder.
    """
    count = len(paths)
    if count == 0:
        raise InputError("there are no receivers to make spectra of")
    first = spectra_at(0, paths[0])
    longest, digest = _survey(paths, progress)
    _claim(folder, {"settings": dict(settings), "paths": digest})
    views = len(first) if first.pose.batch_shape else 1
    scales = common_scales(Precision(), None if first.delay is None else longest, first.method)
    size = max(1, PIXELS // (views * first.grid.height * first.grid.width), -(-count // MOST_PARTS))
    parts = [
        (folder / f"part-{start:07d}.h5", range(start, min(start + size, count))) for start in range(0, count, size)
    ]
    done = sum(len(numbers) for path, numbers in parts if path.exists())
    progress.start("spectra", count, done)

    def made(numbers: range) -> Iterator[Spectrum]:
        nonlocal done
        for number in numbers:
            yield stack_spectra([first if number == 0 else spectra_at(number, paths[number])])
            done += 1
            progress.update(done)

    try:
        for path, numbers in parts:
            if not path.exists():
                with atomic_file(path) as temporary:
                    write_part(temporary, made(numbers), len(numbers) * views, scales, meta)
    except BaseException:
        if not parts[0][0].exists():
            shutil.rmtree(folder, ignore_errors=True)
        raise
    progress.finish()
    with atomic_file(folder / JOINED) as temporary:
        join_parts([path for path, _ in parts], temporary, count * views)
    return read_spectra(folder / JOINED)[0]


def _survey(paths: ManyPaths, progress: Progress) -> tuple[float, str]:
    """The longest delay [s] of any path that arrives, and a digest of all paths."""
    longest, digest = 0.0, hashlib.sha256()
    progress.start("reading paths", len(paths))
    for number in range(len(paths)):
        one = paths[number]
        columns = (one.coeff, one.delay, one.aoa_zenith, one.aoa_azimuth, one.aod_zenith, one.aod_azimuth, one.valid)
        for column in (*columns, one.rx.position, one.rx.orientation):
            digest.update(column.contiguous().numpy().tobytes())
        arriving = one.delay[one.path_gain > 0]
        longest = max(longest, float(arriving.max())) if len(arriving) else longest
        progress.update(number + 1)
    progress.finish()
    return longest, digest.hexdigest()


def _claim(folder: Path, identity: Mapping[str, Any]) -> None:
    """Make `folder` the folder of the run `identity`; parts of another run are removed, other content is refused."""
    wanted = json.loads(json.dumps(identity))
    file = folder / IDENTITY
    if folder.is_dir():
        remove_partials(folder, older_than=0.0)
        if not file.exists() and any(folder.iterdir()):
            raise DataError(f"{folder} is to hold the parts of this run, but holds something else; remove it")
    if file.exists() and read_json(file) != wanted:
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    if not file.exists():
        write_whole(file, (json.dumps(wanted, indent=1) + "\n").encode())
