"""Datasets: photographs of a site and radio spectra in it, read, checked, split and stored."""

from typing import TYPE_CHECKING

from rf3dgs.core.lazy import lazy_names

if TYPE_CHECKING:
    from rf3dgs.data.dataset import Dataset as Dataset
    from rf3dgs.data.dataset import Part as Part
    from rf3dgs.data.formats.detect import read_photos as read_photos
    from rf3dgs.data.formats.spectra_h5 import Precision as Precision
    from rf3dgs.data.photo import Photo as Photo
    from rf3dgs.data.photo import PhotoSet as PhotoSet
    from rf3dgs.data.split import split_positions as split_positions

_MODULES = {
    "Dataset": ".dataset",
    "Part": ".dataset",
    "Photo": ".photo",
    "PhotoSet": ".photo",
    "Precision": ".formats.spectra_h5",
    "read_photos": ".formats.detect",
    "split_positions": ".split",
}
__all__ = ["Dataset", "Part", "Photo", "PhotoSet", "Precision", "read_photos", "split_positions"]
__getattr__, __dir__ = lazy_names(__name__, _MODULES)
