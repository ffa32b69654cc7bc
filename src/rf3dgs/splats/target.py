"""What a drawn picture is compared with."""

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.threads import thread_count
from rf3dgs.splats.backends import native


@dataclass(frozen=True, eq=False)
class Target:
    """A `picture` `[row, col, channel]` and the `weight` `[row, col]` of its pixels in the loss (None: all alike).

    Weights are not negative; pixels of weight 0 count as equal to what is drawn, see `image_loss.l1_ssim`. What the
    similarity needs of the target alone is computed once and kept: 8 bytes a pixel and channel beside the picture's 4.
    """

    picture: Tensor
    weight: Tensor | None = None

    def __post_init__(self) -> None:
        if self.picture.dim() != 3 or self.picture.numel() == 0:
            raise InputError(f"a target must be [row, col, channel]; got {list(self.picture.shape)}")
        object.__setattr__(self, "picture", self.picture.detach().contiguous())
        if self.weight is None:
            return
        object.__setattr__(self, "weight", self.weight.detach().contiguous())
        if self.weight.shape != self.picture.shape[:2]:
            raise InputError(
                f"weight must be [row, col] = {list(self.picture.shape[:2])}; got {list(self.weight.shape)}"
            )
        if not float(self.weight.sum()) > 0:
            raise InputError("weight must not be negative and must have a positive sum; all pixels are masked")

    @cached_property
    def statistics(self) -> Tensor:
        """Blurred values and squares `[2, row, stride]` as the native core keeps them."""
        height, width, channels = self.picture.shape
        core = native.core()
        result = torch.empty(2, height, core.loss_stride(width, channels))
        core.target_statistics(self.picture, result, thread_count())
        return result
