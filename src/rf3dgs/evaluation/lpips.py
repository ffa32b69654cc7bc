"""LPIPS (Zhang et al. 2018): the distance of two pictures in the features of an image network.

The network (AlexNet or VGG-16 trained on ImageNet) and the published linear heads belong to others and are not part of
this package: the user supplies them as files, in an argument or in the environment variable RF3DGS_LPIPS. Without them
the answer is "not available", never a substitute.
"""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path

import torch
from torch import Tensor

from rf3dgs.core.errors import DataError, InputError

ENVIRONMENT = "RF3DGS_LPIPS"
LARGEST_FILE = 1 << 30  # [byte]
LEAST_SIDE = 32  # [pixel], below which AlexNet's last layers see nothing
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)

# Steps of each network: ("conv", index of the layer in the published state dict, stride, padding),
# ("pool", kernel, stride, 0) and ("tap", 0, 0, 0) where LPIPS reads the features, always behind a ReLU.
ALEXNET = (
    *(("conv", 0, 4, 2), ("tap", 0, 0, 0), ("pool", 3, 2, 0), ("conv", 3, 1, 2), ("tap", 0, 0, 0), ("pool", 3, 2, 0)),
    *(("conv", 6, 1, 1), ("tap", 0, 0, 0), ("conv", 8, 1, 1), ("tap", 0, 0, 0), ("conv", 10, 1, 1), ("tap", 0, 0, 0)),
)
VGG16 = (
    *(("conv", 0, 1, 1), ("conv", 2, 1, 1), ("tap", 0, 0, 0), ("pool", 2, 2, 0)),
    *(("conv", 5, 1, 1), ("conv", 7, 1, 1), ("tap", 0, 0, 0), ("pool", 2, 2, 0)),
    *(("conv", 10, 1, 1), ("conv", 12, 1, 1), ("conv", 14, 1, 1), ("tap", 0, 0, 0), ("pool", 2, 2, 0)),
    *(("conv", 17, 1, 1), ("conv", 19, 1, 1), ("conv", 21, 1, 1), ("tap", 0, 0, 0), ("pool", 2, 2, 0)),
    *(("conv", 24, 1, 1), ("conv", 26, 1, 1), ("conv", 28, 1, 1), ("tap", 0, 0, 0)),
)
NETWORKS = {"alex": (ALEXNET, (64, 3, 11, 11)), "vgg": (VGG16, (64, 3, 3, 3))}


class Lpips:
    """The distance, ready to use: `Lpips.load(paths)(first, second)`.

    weights: `features.N.weight` / `features.N.bias` of the network and `linK.model.1.weight` `[1, C, 1, 1]` of the
    heads, named as in the published files.
    """

    def __init__(self, weights: Mapping[str, Tensor]) -> None:
        first = weights.get("features.0.weight")
        shape = None if first is None else tuple(first.shape)
        names = [name for name, (_, expected) in NETWORKS.items() if expected == shape]
        if not names:
            raise InputError(
                "LPIPS needs the features of AlexNet or VGG-16 (features.0.weight of 64x3x11x11 or 64x3x3x3); "
                f"got {shape}. Name the backbone's file as well as the linear heads'"
            )
        self.network = names[0]
        self.steps = NETWORKS[self.network][0]
        layers = [step[1] for step in self.steps if step[0] == "conv"]
        heads = sum(step[0] == "tap" for step in self.steps)
        wanted = [f"features.{layer}.{part}" for layer in layers for part in ("weight", "bias")]
        wanted += [f"lin{head}.model.1.weight" for head in range(heads)]
        missing = [name for name in wanted if name not in weights]
        if missing:
            raise InputError(
                f"LPIPS lacks {missing[0]} and {len(missing) - 1} more; name both files, backbone and heads"
            )
        self.weights = {name: weights[name].detach().float() for name in wanted}

    @classmethod
    def load(cls, paths: str | Path | Iterable[str | Path]) -> "Lpips":
        """From one file or several (safetensors, or torch state dicts, loaded as weights only)."""
        files = [paths] if isinstance(paths, (str, Path)) else list(paths)
        weights: dict[str, Tensor] = {}
        for file in files:
            weights.update(_read(Path(file)))
        return cls(weights)

    @classmethod
    def from_environment(cls) -> "Lpips | None":
        """From the files named in RF3DGS_LPIPS (separated as PATH is), or None when the variable is not set."""
        value = os.environ.get(ENVIRONMENT, "")
        return cls.load([part for part in value.split(os.pathsep) if part]) if value else None

    def features(self, picture: Tensor) -> list[Tensor]:
        """The tapped features of pictures `[n, 3, row, col]` in [-1, 1]."""
        value = (picture - torch.tensor(SHIFT)[:, None, None]) / torch.tensor(SCALE)[:, None, None]
        taps = []
        for step, index, stride, padding in self.steps:
            if step == "conv":
                weight, bias = self.weights[f"features.{index}.weight"], self.weights[f"features.{index}.bias"]
                value = torch.relu(torch.nn.functional.conv2d(value, weight, bias, stride, padding))
            elif step == "pool":
                value = torch.nn.functional.max_pool2d(value, index, stride)
            else:
                taps.append(value)
        return taps

    @torch.no_grad()
    def __call__(self, first: Tensor, second: Tensor) -> Tensor:
        """Distances `[n]` of pictures `[n, row, col]` (grey) or `[n, row, col, 3]` in [0, 1]; at least 32 pixels a
        side.

        Per tap, features are normalised over their channels, their squared difference weighted by the head, summed over
        channels and averaged over the picture; the taps are added. Pixels count alike also on a sphere.
        """
        if first.shape != second.shape:
            raise InputError(f"LPIPS compares pictures of one size; got {list(first.shape)} and {list(second.shape)}")
        total = torch.zeros(len(first))
        pairs = zip(self.features(_network_input(first)), self.features(_network_input(second)), strict=True)
        for head, (a, b) in enumerate(pairs):
            difference = (_unit(a) - _unit(b)) ** 2
            weighted = torch.nn.functional.conv2d(difference, self.weights[f"lin{head}.model.1.weight"])
            total = total + weighted.mean((1, 2, 3))
        return total


def _unit(features: Tensor) -> Tensor:
    return features / (features.square().sum(1, keepdim=True).sqrt() + 1e-10)


def _network_input(picture: Tensor) -> Tensor:
    colour = picture[..., None].expand(*picture.shape, 3) if picture.dim() == 3 else picture
    if min(colour.shape[1:3]) < LEAST_SIDE:
        got = f"{colour.shape[2]}x{colour.shape[1]}"
        raise InputError(f"LPIPS needs pictures of at least {LEAST_SIDE}x{LEAST_SIDE} pixels; got {got}")
    return 2.0 * colour.permute(0, 3, 1, 2).float() - 1.0


def _read(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        raise DataError(
            f"{path}: no such file; {ENVIRONMENT} and lpips must name the backbone's and the heads' weights"
        )
    if path.stat().st_size > LARGEST_FILE:
        raise DataError(f"{path}: {path.stat().st_size} bytes are more than LPIPS weights can have (1 GiB)")
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            state: object = load_file(path)
        else:
            state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise DataError(f"{path}: not a safetensors file or torch state dict of plain tensors ({error})") from error
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise DataError(f"{path}: expected named tensors; save the network's state_dict")
    return state
