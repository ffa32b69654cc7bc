"""What a person may choose about NeRF2: a frozen dataclass without torch."""

import math
from dataclasses import dataclass, replace
from typing import Literal

from rf3dgs.core.errors import InputError

Target = Literal["linear", "db"]


@dataclass(frozen=True)
class Nerf2Config:
    """NeRF2 as published for spatial spectra (Zhao et al., MobiCom 2023, and the settings its authors released)."""

    target: Target = "linear"
    """What the network answers: "linear", power relative to the strongest direction of the same picture, as published
    for an array's Bartlett pictures; "db", the level's place in one dB window."""
    depth: int = 8
    """Hidden layers of the attenuation network; the one after the middle sees the encoded position again."""
    width: int = 256
    """Neurons of a hidden layer."""
    position_octaves: int = 10
    """Octaves of the positional encoding of points and of the transmitter."""
    direction_octaves: int = 10
    """Octaves of the positional encoding of directions."""
    samples: int = 64
    """Points on a ray, each in the middle of its share."""
    far: float | None = None
    """Length of a ray [m], which starts at the receiver; None takes the diagonal of the smallest box around the
    training positions and the transmitter."""
    steps: int = 30_000
    """Iterations."""
    rays: int = 8192
    """Rays of an iteration, drawn from all pictures."""
    lr: float = 8e-4
    """Adam's learning rate at the start; it falls as half a cosine."""
    lr_final: float = 1e-6
    """Adam's learning rate at the end."""
    weight_decay: float = 5e-5
    """Adam's weight decay."""
    chunk: int = 4096
    """Rays of a picture that are traced at once."""
    report_every: int = 100
    """Iterations between entries of the history."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where the network lives; "auto" is CUDA where there is one."""
    seed: int = 0
    """Decides the first weights and the order of the rays; on a CPU the same seed gives the same network."""

    def __post_init__(self) -> None:
        counts = ("depth", "width", "position_octaves", "direction_octaves", "samples", "steps", "rays", "chunk")
        for name in (*counts, "report_every"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} must be at least 1; got {getattr(self, name)}")
        if self.width < 2:
            raise InputError(f"width must be at least 2, as the last hidden layer has half of it; got {self.width}")
        if not 0 < self.lr_final <= self.lr < math.inf:
            raise InputError(f"learning rates must fall and be positive; got lr {self.lr} and lr_final {self.lr_final}")
        if not 0 <= self.weight_decay < math.inf:
            raise InputError(f"weight_decay must not be negative; got {self.weight_decay}")
        if self.far is not None and not 0 < self.far < math.inf:
            raise InputError(f"far must be a positive length in metres, or None; got {self.far}")

    @property
    def samples_seen(self) -> int:
        """Points on rays that training evaluates in all."""
        return self.steps * self.rays * self.samples

    @classmethod
    def for_scale(cls, scale: str, target: Target = "linear", seed: int = 0) -> "Nerf2Config":
        """The settings of `scale`: "paper" as published, "laptop" minutes on a CPU, "smoke" seconds."""
        if scale not in SCALES:
            raise InputError(f"the scales of NeRF2 are {', '.join(SCALES)}; got {scale!r}")
        return replace(SCALES[scale], target=target, seed=seed)


_LAPTOP = Nerf2Config(
    depth=4,
    width=64,
    position_octaves=4,
    direction_octaves=4,
    samples=12,
    steps=6000,
    rays=256,
    lr=3e-3,
    lr_final=3e-5,
    weight_decay=0.0,
)
SCALES: dict[str, Nerf2Config] = {
    "paper": Nerf2Config(),
    "laptop": _LAPTOP,
    "smoke": replace(_LAPTOP, width=32, steps=150, report_every=10),
}
