"""What may be chosen about the conditional GAN: a frozen dataclass, and its sizes at the scales of the benchmarks."""

from dataclasses import dataclass, replace
from typing import Literal

from rf3dgs.core.errors import InputError

PUBLISHED_PASSES = 200
BATCH = 8
LEAST_BATCH = 4


@dataclass(frozen=True)
class CganConfig:
    """Networks and training of the conditional GAN. Unless given, as published for pix2pix (Isola et al., CVPR 2017).

    What differs is in docs/how-to/baselines-cgan.md. The published training is 200 passes over all pictures.
    """

    width: int = 64
    """Channels of the generator's first layer; the layers below have 2, 4, 8, 8, ... times as many."""
    depth: int = 8
    """Halvings of the generator; fewer, so that two pixels or more are left each way."""
    critic_width: int = 64
    """Channels of the discriminator's first layer."""
    critic_depth: int = 3
    """Halvings of the discriminator; with 3 it judges patches of 70x70 pixels, with 2 of 34x34."""
    octaves: int = 1
    """Frequencies at which the networks are also told the receiver's position, each twice the one before; 0 is the
    position alone."""
    dropout: float = 0.5
    """Share of values dropped in the three innermost layers of the way up, in training alone."""
    adversarial: float = 1.0
    """Weight of the discriminator's verdict in the generator's loss; 0 is plain regression, without discriminator."""
    l1: float = 100.0
    """Weight of the mean absolute error; pictures lie between -1 and 1."""
    lr: float = 2e-4
    """Adam's learning rate, for both networks; it stays for the first half and falls to zero in the second."""
    betas: tuple[float, float] = (0.5, 0.999)
    """Adam's decay rates."""
    pixels: int = 480_000
    """Pixels in one step: eight pictures of 300x200, but never fewer than four pictures where there are as many;
    with one alone, batch normalisation takes its level away."""
    steps: int = 64_000
    """Steps of training: one of the discriminator and one of the generator each."""
    seed: int = 0
    """Of the first weights, the order of the pictures and the dropout."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """"auto" takes CUDA where there is one. On the CPU one seed gives one predictor, bit by bit, on one machine."""

    def __post_init__(self) -> None:
        counts = {name: getattr(self, name) for name in ("width", "depth", "critic_width", "critic_depth", "pixels")}
        for name, value in (counts | {"steps": self.steps}).items():
            if value < 1:
                raise InputError(f"{name} must be at least 1; got {value}")
        weights = (self.adversarial, self.l1)
        if min(weights) < 0 or max(weights) == 0:
            raise InputError(
                f"adversarial and l1 must not be negative nor both zero; got {weights[0]} and {weights[1]}"
            )
        if not (0 <= self.dropout < 1 and self.lr > 0 and self.octaves >= 0):
            raise InputError(
                "dropout must be from 0 to below 1, lr above 0 and octaves not negative; "
                f"got {self.dropout}, {self.lr} and {self.octaves}"
            )

    @classmethod
    def for_scale(cls, scale: str, *, pictures: int = 2560, seed: int = 0) -> "CganConfig":
        """The sizes of a scale: "smoke" (seconds), "laptop" (minutes on a CPU) or "paper" (as published, on a GPU).

        pictures: how many there are to learn from; they decide the published number of steps.
        """
        if scale not in ("smoke", "laptop", "paper"):
            raise InputError(f'scale must be "smoke", "laptop" or "paper"; got {scale!r}')
        if scale == "paper":
            return cls(steps=max(1, PUBLISHED_PASSES * pictures // BATCH), seed=seed)
        laptop = cls(
            width=16,
            depth=5,
            critic_width=8,
            critic_depth=2,
            octaves=0,
            dropout=0.0,
            lr=1e-3,
            pixels=30_000,
            steps=1000,
            seed=seed,
        )
        return laptop if scale == "laptop" else replace(laptop, width=8, depth=3, pixels=4000, steps=150)
