"""Gaussian splatting for photographs and spectra alike: the Gaussians, how they are drawn, grown, pruned and stored.

`rasterize.rasterize` bears the name of its module and is imported from there.
"""

from typing import TYPE_CHECKING

from rf3dgs.core.lazy import lazy_names

if TYPE_CHECKING:
    from rf3dgs.splats.density import DensityState as DensityState
    from rf3dgs.splats.detail import Detail as Detail
    from rf3dgs.splats.detail import level_of_detail as level_of_detail
    from rf3dgs.splats.detail import prune_unseen as prune_unseen
    from rf3dgs.splats.gaussians import Gaussians as Gaussians
    from rf3dgs.splats.image_loss import l1_ssim as l1_ssim
    from rf3dgs.splats.image_loss import psnr as psnr
    from rf3dgs.splats.image_loss import ssim as ssim
    from rf3dgs.splats.obstacles import Obstacles as Obstacles
    from rf3dgs.splats.obstacles import visibility_of as visibility_of
    from rf3dgs.splats.ply import read_ply as read_ply
    from rf3dgs.splats.ply import read_point_cloud as read_point_cloud
    from rf3dgs.splats.ply import write_ply as write_ply
    from rf3dgs.splats.raster import Raster as Raster
    from rf3dgs.splats.rasterize import pick_backend as pick_backend
    from rf3dgs.splats.rates import Rates as Rates
    from rf3dgs.splats.reference import rasterize_reference as rasterize_reference
    from rf3dgs.splats.surface import sample_mesh as sample_mesh
    from rf3dgs.splats.target import Target as Target
    from rf3dgs.splats.trainer import Trainer as Trainer
    from rf3dgs.splats.transmittance import segment_transmittance as segment_transmittance

__all__ = [  # noqa: RUF022
    "Gaussians",
    "Raster",
    "pick_backend",
    "rasterize_reference",
    "l1_ssim",
    "ssim",
    "psnr",
    "Trainer",
    "Target",
    "Rates",
    "DensityState",
    "Detail",
    "level_of_detail",
    "prune_unseen",
    "sample_mesh",
    "Obstacles",
    "visibility_of",
    "segment_transmittance",
    "read_ply",
    "write_ply",
    "read_point_cloud",
]
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "Gaussians": ".gaussians",
        "Raster": ".raster",
        "pick_backend": ".rasterize",
        "rasterize_reference": ".reference",
        "l1_ssim": ".image_loss",
        "ssim": ".image_loss",
        "psnr": ".image_loss",
        "Trainer": ".trainer",
        "Target": ".target",
        "Rates": ".rates",
        "DensityState": ".density",
        "Detail": ".detail",
        "level_of_detail": ".detail",
        "prune_unseen": ".detail",
        "sample_mesh": ".surface",
        "Obstacles": ".obstacles",
        "visibility_of": ".obstacles",
        "segment_transmittance": ".transmittance",
        "read_ply": ".ply",
        "write_ply": ".ply",
        "read_point_cloud": ".ply",
    },
)
