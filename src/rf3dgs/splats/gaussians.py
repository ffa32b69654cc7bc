"""The Gaussians of a scene, in the raw form that an optimiser changes."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.errors import InputError, TrainingError
from rf3dgs.splats.harmonics import C0, coefficient_count, degree_of

LARGEST_SCALE = 1e4  # [m]; beyond it an optimisation has exploded
LARGEST_LOGIT = 100.0


@dataclass(frozen=True, eq=False)
class Gaussians:
    """`means` `[gaussian, 3]` [m], `quats` `[gaussian, 4]` (wxyz of world_from_gaussian, normalised when used),
    `log_scales` `[gaussian, 3]` (natural logarithm of metres), `logit_opacities` `[gaussian]` and `sh`
    `[gaussian, k, channel]` with k = (degree + 1)^2. All are contiguous float32 on the CPU.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    logit_opacities: Tensor
    sh: Tensor

    def __post_init__(self) -> None:
        for field in fields(self):
            tensor = torch.as_tensor(getattr(self, field.name))
            object.__setattr__(self, field.name, tensor.to("cpu", torch.float32).contiguous())
        count = len(self.means) if self.means.dim() else 0
        expected = {"means": (count, 3), "quats": (count, 4), "log_scales": (count, 3), "logit_opacities": (count,)}
        for name, shape in expected.items():
            got = tuple(getattr(self, name).shape)
            if got != shape:
                text = ", ".join(("gaussian", *(str(size) for size in shape[1:])))
                raise InputError(
                    f"{name} must be [{text}] for {count} Gaussians; got {list(got)}. Transpose or reshape it"
                )
        if self.sh.dim() != 3 or len(self.sh) != count:
            raise InputError(f"sh must be [gaussian, k, channel] for {count} Gaussians; got {list(self.sh.shape)}")
        degree_of(self.sh.shape[1])

    @classmethod
    def random(
        cls,
        count: int,
        low: Sequence[float],
        high: Sequence[float],
        channels: int = 3,
        degree: int = 3,
        seed: int = 0,
    ) -> "Gaussians":
        """`count` Gaussians uniform in the box from `low` to `high` [m], with random rotations and degree-0 values.

        They are flattened balls about as large as their mean spacing, of opacity 0.1; seen through `offset=0.5` their
        values are uniform in 0..1 and do not depend on the direction.
        """
        generator = torch.Generator().manual_seed(seed)
        corner, size = torch.tensor(low, dtype=torch.float32), torch.tensor(high) - torch.tensor(low)
        if count < 1 or corner.shape != (3,) or not bool((size > 0).all()):
            raise InputError(f"a random cloud needs a count >= 1 and corners low < high; got {count}, {low}, {high}")
        means = corner + size * torch.rand(count, 3, generator=generator)
        quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1)
        spacing = float(size.prod() / count) ** (1 / 3)
        log_scales = math.log(0.5 * spacing) + 0.5 * (torch.rand(count, 3, generator=generator) - 0.5)
        sh = torch.zeros(count, coefficient_count(degree), channels)
        sh[:, 0] = (torch.rand(count, channels, generator=generator) - 0.5) / C0
        return cls(means, quats, log_scales, torch.full((count,), _logit(0.1)), sh)

    @classmethod
    def from_points(
        cls, points: Tensor, colours: Tensor | None = None, *, channels: int = 3, degree: int = 3, opacity: float = 0.1
    ) -> "Gaussians":
        """Round Gaussians on `points` `[point, 3]` [m], as large as the mean distance of the three nearest neighbours.

        `colours` `[point, channel]` in 0..1 become the degree-0 harmonics; without them all are mid-grey.
        """
        from scipy.spatial import KDTree

        points = torch.as_tensor(points, dtype=torch.float32)
        if points.dim() != 2 or points.shape[1] != 3 or len(points) < 2 or not bool(torch.isfinite(points).all()):
            raise InputError(f"points must be at least two finite rows [point, 3]; got {list(points.shape)}")
        neighbours = min(4, len(points))
        distance = KDTree(points.numpy()).query(points.numpy(), k=neighbours)[0][:, 1:]
        scale = np.clip(np.sqrt(np.mean(distance**2, axis=1)), 1e-4, None)
        sh = torch.zeros(len(points), coefficient_count(degree), channels)
        if colours is not None:
            colours = torch.as_tensor(colours, dtype=torch.float32)
            if colours.shape != (len(points), channels):
                raise InputError(f"colours must be [{len(points)}, {channels}] in 0..1; got {list(colours.shape)}")
            sh[:, 0] = (colours - 0.5) / C0
        quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(points), 1)
        log_scales = torch.from_numpy(np.log(scale)).float()[:, None].repeat(1, 3)
        return cls(points, quats, log_scales, torch.full((len(points),), _logit(opacity)), sh)

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> "Gaussians":
        """The Gaussians of a mapping as `tensors()` gives it."""
        names = [field.name for field in fields(cls)]
        missing = [name for name in names if name not in tensors]
        if missing:
            raise InputError(f"Gaussians need the tensors {', '.join(names)}; missing: {', '.join(missing)}")
        return cls(**{name: tensors[name] for name in names})

    @classmethod
    def join(cls, parts: Sequence["Gaussians"]) -> "Gaussians":
        """All Gaussians of `parts`, one after another; they must agree in degree and channels."""
        return cls(**{field.name: torch.cat([getattr(part, field.name) for part in parts]) for field in fields(cls)})

    def tensors(self) -> dict[str, Tensor]:
        """The five raw tensors by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def __len__(self) -> int:
        return len(self.means)

    @property
    def scales(self) -> Tensor:
        """Standard deviations `[gaussian, 3]` [m]."""
        return torch.exp(self.log_scales)

    @property
    def opacities(self) -> Tensor:
        """Opacities `[gaussian]` in 0..1."""
        return torch.sigmoid(self.logit_opacities)

    @property
    def degree(self) -> int:
        return degree_of(self.sh.shape[1])

    @property
    def channels(self) -> int:
        return self.sh.shape[2]

    def subset(self, chosen: Tensor) -> "Gaussians":
        """The rows of a boolean mask `[gaussian]` or an index `[row]`."""
        return Gaussians(**{name: tensor[chosen] for name, tensor in self.tensors().items()})

    def detach(self) -> "Gaussians":
        """The same values outside any autograd graph; memory is shared."""
        return Gaussians(**{name: tensor.detach() for name, tensor in self.tensors().items()})

    def check(self, *, source: Literal["input", "training"] = "input") -> None:
        """Raise InputError (or TrainingError) naming the tensor that is empty, not finite, zero or exploded."""
        error, remedy = (
            (InputError, "mend the file or the code that made them")
            if source == "input"
            else (TrainingError, "lower the learning rate and resume from the last checkpoint")
        )
        if len(self) == 0:
            raise error(f"there must be at least one Gaussian; got none: {remedy}")
        for name, tensor in self.tensors().items():
            wrong = int(
                (~torch.isfinite(tensor)).flatten(1 if tensor.dim() > 1 else 0).reshape(len(self), -1).any(-1).sum()
            )
            if wrong:
                raise error(f"{name} must be finite; {wrong} of {len(self)} Gaussians have NaN or infinity: {remedy}")
        rules = (
            ("quats", torch.linalg.vector_norm(self.quats, dim=-1) < 1e-8, "must not be zero"),
            ("log_scales", (self.log_scales > math.log(LARGEST_SCALE)).any(-1), f"must stay below {LARGEST_SCALE:g} m"),
            ("logit_opacities", self.logit_opacities.abs() > LARGEST_LOGIT, f"must stay within +-{LARGEST_LOGIT:g}"),
        )
        for name, wrong, rule in rules:
            if bool(wrong.any()):
                raise error(f"{name} {rule}; {int(wrong.sum())} of {len(self)} Gaussians do not: {remedy}")


def _logit(probability: float) -> float:
    return math.log(probability / (1 - probability))
