"""What a person may choose about training: frozen dataclasses without torch, which the command line shows as they are."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class RadioConfig:
    """The radio stage: opacity and CSI-encoded harmonics on frozen geometry."""

    steps: int = 2000
    """Iterations; each takes one training position and one of its pictures (a cube face, or its pinhole picture)."""
    csi_every: int = 2
    """Delay and departure are trained in every n-th iteration; 0 leaves them at their geometric prior."""
    seed: int = 0
    """Decides the order of the views; the same seed gives the same field, bit by bit, on one machine."""

    encoding: Literal["vector", "paper"] = "vector"
    """"vector": delay as range / c plus a residual and departure as a unit vector; "paper": the paper's own channels,
    departure angles scaled by the normalised gain and delay normalised from the first arrival."""
    line_of_sight: Literal["source", "surface"] = "source"
    """"source": the transmitter is a point source of its own, its pixels are masked in the surface's training;
    "surface": the Gaussians must show it too, as in the paper."""
    degree: int = 3
    """Degree of the gain's harmonics."""
    face_size: int | None = None
    """Pixels along a cube face on which spheres are trained; None takes the sphere's own pixel size."""
    floor_db: float | None = None
    """Lower end of the field's dB window; None takes it from the training spectra."""
    ceil_db: float | None = None
    """Upper end of the field's dB window; None puts it above the largest training peak."""

    start: Literal["ridge", "mean", "grey"] = "ridge"
    """Initial harmonics: "ridge" solves them per Gaussian by regularised least squares on the back-projected spectra,
    "mean" takes the mean back-projected level, "grey" is the paper's 0.5 everywhere."""
    ridge: float = 1.0
    """Strength that draws a Gaussian's first harmonics to those of its neighbourhood; used by start="ridge"."""
    lr_level: float = 5e-3
    """Adam's learning rate of the constant harmonic [window units]."""
    lr_harmonics: float = 1e-3
    """Adam's learning rate of the other gain harmonics [window units]."""
    lr_opacity: float = 2e-2
    """Adam's learning rate of the opacity logits."""
    lr_csi: float = 1e-2
    """Adam's learning rate of the delay and departure harmonics [delay unit, unit vector]."""
    lr_final: float = 0.1
    """All learning rates fall exponentially to this share of their start."""
    ssim_weight: float = 0.2
    """Share of D-SSIM in the loss; the rest is L1."""
    shrink: float = 0.0
    """Weight of the mean square of the gain harmonics above the constant; draws unseen directions to the level."""
    train_opacity: bool = True
    """Whether opacity follows the gain loss (the paper's choice) or stays as the geometry has it."""

    backend: Literal["auto", "native", "reference", "gsplat"] = "auto"
    """Which rasterizer works."""
    checkpoint_every: int = 500
    """Iterations between checkpoints when a checkpoint folder is given."""
