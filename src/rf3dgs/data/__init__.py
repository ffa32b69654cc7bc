"""Datasets: photographs of a site and radio spectra in it, read, checked, split and stored.

`align.align` and `validate.validate` bear the names of their modules and are imported from there.
"""

from typing import TYPE_CHECKING

from rf3dgs.core.lazy import lazy_names

if TYPE_CHECKING:
    from rf3dgs.data.align import Similarity as Similarity
    from rf3dgs.data.dataset import Dataset as Dataset
    from rf3dgs.data.formats.blender import read_blender as read_blender
    from rf3dgs.data.formats.colmap import read_colmap as read_colmap
    from rf3dgs.data.formats.colmap import write_colmap as write_colmap
    from rf3dgs.data.formats.detect import read_photos as read_photos
    from rf3dgs.data.formats.gateway import GatewaySpectra as GatewaySpectra
    from rf3dgs.data.formats.gateway import read_gateway as read_gateway
    from rf3dgs.data.formats.nerfstudio import read_nerfstudio as read_nerfstudio
    from rf3dgs.data.formats.nerfstudio import write_nerfstudio as write_nerfstudio
    from rf3dgs.data.formats.rf3dgs_v0 import read_rf3dgs_v0 as read_rf3dgs_v0
    from rf3dgs.data.formats.spectra_codes import Precision as Precision
    from rf3dgs.data.formats.stored import StoredSpectra as StoredSpectra
    from rf3dgs.data.part import Part as Part
    from rf3dgs.data.photo import Photo as Photo
    from rf3dgs.data.photo import PhotoSet as PhotoSet
    from rf3dgs.data.sfm import poses_from_photos as poses_from_photos
    from rf3dgs.data.split import keep_fraction as keep_fraction
    from rf3dgs.data.split import protocol as protocol
    from rf3dgs.data.split import split_positions as split_positions
    from rf3dgs.data.validate import Fault as Fault
    from rf3dgs.data.video import photos_of_video as photos_of_video

_MODULES = {
    "Dataset": ".dataset",
    "Part": ".part",
    "Photo": ".photo",
    "PhotoSet": ".photo",
    "Precision": ".formats.spectra_codes",
    "StoredSpectra": ".formats.stored",
    "split_positions": ".split",
    "protocol": ".split",
    "keep_fraction": ".split",
    "read_photos": ".formats.detect",
    "read_colmap": ".formats.colmap",
    "write_colmap": ".formats.colmap",
    "read_nerfstudio": ".formats.nerfstudio",
    "write_nerfstudio": ".formats.nerfstudio",
    "read_blender": ".formats.blender",
    "read_rf3dgs_v0": ".formats.rf3dgs_v0",
    "GatewaySpectra": ".formats.gateway",
    "read_gateway": ".formats.gateway",
    "photos_of_video": ".video",
    "poses_from_photos": ".sfm",
    "Similarity": ".align",
    "Fault": ".validate",
}
__all__ = [  # noqa: RUF022
    "Dataset",
    "Part",
    "Photo",
    "PhotoSet",
    "Precision",
    "StoredSpectra",
    "split_positions",
    "protocol",
    "keep_fraction",
    "read_photos",
    "read_colmap",
    "write_colmap",
    "read_nerfstudio",
    "write_nerfstudio",
    "read_blender",
    "read_rf3dgs_v0",
    "GatewaySpectra",
    "read_gateway",
    "photos_of_video",
    "poses_from_photos",
    "Similarity",
    "Fault",
]
__getattr__, __dir__ = lazy_names(__name__, _MODULES)
