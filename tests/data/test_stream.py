"""Spectra of many receivers, part by part."""

from dataclasses import replace

import pytest
import torch

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, pinhole_grid
from rf3dgs.core.progress import Silent
from rf3dgs.data import stream
from rf3dgs.spectra.config import ArrayProcessing
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.yaws import at_yaws


@pytest.fixture
def receivers(random_paths):
    poses = Pose.scatter(((3, 3, 1), (5, 5, 2)), 9, seed=0)
    return [random_paths(40, seed=number, rx=poses[number]) for number in range(9)]


def run(receivers, folder, made, **settings):
    def spectra_at(number, paths):
        made.append(number)
        return spectrum_of(at_yaws(paths, (0.0, 2.0)), None, equirect_grid(24, 12))

    meta = {"generator": "test", "seed": 0}
    return stream.stream_spectra(receivers, spectra_at, folder, settings=settings, meta=meta, progress=Silent())


def test_finished_parts_are_not_made_again(receivers, tmp_path, monkeypatch):
    monkeypatch.setattr(stream, "PIXELS", 2 * 2 * 24 * 12)
    made: list[int] = []
    stored = run(receivers, tmp_path / "run", made)
    assert made == list(range(9))
    parts = sorted((tmp_path / "run").glob("part-*.h5"))
    assert len(parts) == 5
    whole = replace(stored)
    parts[1].unlink()
    made.clear()
    again = run(receivers, tmp_path / "run", made)
    assert made == [0, 2, 3], "the first receiver tells the shape"
    assert torch.equal(again.power, whole.power)
    made.clear()
    run(receivers, tmp_path / "run", made, lobe=0.3)
    assert made == list(range(9)), "other settings are another run"
    made.clear()
    louder = [*receivers[:8], replace(receivers[8], coeff=2 * receivers[8].coeff)]
    run(louder, tmp_path / "run", made, lobe=0.3)
    assert made == list(range(9)), "other paths are another run"


def test_array_spectra_without_delays_are_streamed_too(receivers, tmp_path):
    from rf3dgs.channel.arrays import planar_array

    grid = pinhole_grid(12, 8, 90)

    def spectra_at(number, paths):
        return spectrum_of(
            paths, planar_array(2, 2), grid, method="bartlett", processing=ArrayProcessing(snapshots=None)
        )

    stored = stream.stream_spectra(receivers, spectra_at, tmp_path / "run", settings={}, meta={}, progress=Silent())
    assert stored.delay is None
    assert stored.method == "bartlett"
    alone = spectra_at(4, receivers[4])
    assert float((stored[4].gain_db - alone.gain_db).abs().max()) < 0.00251, "half a step"


def test_no_receivers_are_refused(tmp_path):
    with pytest.raises(InputError, match="there are no receivers to make spectra of"):
        run([], tmp_path / "run", [])
