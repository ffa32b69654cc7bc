"""A file of spectra has the bytes that its spectra give it, whatever else holds on to what the writer uses."""

import h5py
import pytest
import torch

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, list_grid
from rf3dgs.data.formats.spectra_codes import Precision
from rf3dgs.data.formats.spectra_h5 import common_scales, join_parts, write_part, write_spectra
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.spectrum import stack_spectra


@pytest.fixture(params=["sphere", "list"])
def spectra(request, random_paths):
    grid = equirect_grid(48, 24)
    if request.param == "list":
        grid = list_grid(torch.randn(100, 3, generator=torch.Generator().manual_seed(0)))
    poses = Pose.scatter(((3, 3, 1), (5, 5, 2)), 6, seed=0)
    return stack_spectra([spectrum_of(random_paths(40, seed=i, rx=poses[i]), None, grid) for i in range(6)])


def _files(folder, spectra):
    """The bytes of a dataset's file, of two parts of a run, and of the file that joins them."""
    folder.mkdir()
    write_spectra(folder / "whole.h5", spectra, spectra[:2], torch.tensor([0, 1]))
    scales = common_scales(Precision(), float(spectra.delay.max()))
    parts = [folder / "first.h5", folder / "second.h5"]
    for path, start in zip(parts, (0, 3), strict=True):
        write_part(path, (spectra[i : i + 1] for i in range(start, start + 3)), 3, scales, {})
    join_parts(parts, folder / "joined.h5", 6)
    return [file.read_bytes() for file in sorted(folder.iterdir())]


def test_bytes_do_not_depend_on_who_holds_the_writers_objects(spectra, tmp_path, held_by_others):
    alone = _files(tmp_path / "alone", spectra)
    with h5py.File(tmp_path / "other.h5", "w") as other, held_by_others() as held:
        other.create_dataset("x", data=range(1000), chunks=(10,))
        watched = _files(tmp_path / "watched", spectra)
    assert len(held) > 20
    assert watched == alone
