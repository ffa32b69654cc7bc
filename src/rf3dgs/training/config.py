"""What a person may choose about training: frozen dataclasses without torch, which the command line shows as is."""

from dataclasses import dataclass, replace
from typing import Literal

from rf3dgs.core.errors import InputError


@dataclass(frozen=True)
class RadioConfig:
    """The radio stage: spectra on frozen geometry.

    The settings in `PAPER_ONLY` belong to the paper's model; the mirror model, which is fitted in closed form, refuses
    them.
    """

    model: Literal["mirror", "paper"] = "mirror"
    """"mirror": the transmitter's mirror images as point sources, and surfaces that scatter by laws of their own;
    "paper": harmonics in a dB window on every Gaussian, the line of sight as a point source."""
    geometry: Literal["corrected", "given"] = "corrected"
    """The mirror model alone: "corrected" moves walls to where waves that bounced once say they are, leaves out what
    waves crossed and adds what only they know, if the spectra have delay and departure; "given" takes the Gaussians
    as they are, such as those of a mesh that is known."""
    mirror_order: int | None = None
    """Most reflections of the mirror images that are point sources beside the transmitter, 3 at most; None is 3 with
    the mirror model and 0, the line of sight alone, with the paper's."""
    array_pictures: Literal["inverted", "face-value"] = "inverted"
    """Spectra taken by an array: "inverted" fits the waves behind the pictures, so that the field shows the ideal lobe;
    "face-value" takes the pictures for what is there, side lobes and all, as the paper does."""
    array_grid: tuple[int, int] = (120, 60)
    """Columns and rows of the spheres that pictures of an array are turned into; the field's lobe is 1.5 pixels."""
    array_rounds: int = 1
    """The mirror model alone: how often pictures of an array are explained anew by what the field predicts there."""
    without: tuple[Literal["lit", "ambient", "residual", "visibility"], ...] = ()
    """The mirror model alone: parts that are left out, to see what each brings; without visibility nothing casts a
    shadow and every way is open."""
    joint: int | None = None
    """The mirror model alone: steps of joint refinement of the surface after the closed form, each on two training
    positions; None is 120, 0 leaves the closed form as it is."""
    uncertainty: bool = False
    """The mirror model alone: learn how far its levels may be off, by leaving training positions out in turn. It takes
    about three times as long as the rest."""
    steps: int = 1000
    """Iterations; each takes the picture of one training position, a whole sphere or a pinhole's."""
    csi_every: int = 2
    """Delay and departure are trained in every n-th iteration; 0 leaves them at their geometric prior."""
    seed: int = 0
    """Decides the search for planes or the order of the views; the same seed gives the same field, bit by bit, on one
    machine."""

    encoding: Literal["vector", "paper"] = "vector"
    """"vector": delay as range / c plus a residual and departure as a unit vector; "paper": the paper's own channels,
    departure angles scaled by the normalised gain and delay normalised from the first arrival."""
    line_of_sight: Literal["source", "surface"] = "source"
    """"source": the transmitter is a point source of its own, its pixels are masked in the surface's training;
    "surface": the Gaussians must show it too, as in the paper."""
    degree: int = 3
    """Degree of the gain's harmonics."""
    floor_db: float | None = None
    """Lower end of the field's dB window; None takes it from the training spectra."""
    ceil_db: float | None = None
    """Upper end of the field's dB window; None puts it above the largest training peak."""

    detail: Literal["auto", "merge", "keep"] = "auto"
    """Level of detail: "merge" merges the Gaussians that the spectra's pixels cannot tell apart before training, "auto"
    does so when there are more than 150,000, "keep" never."""

    start: Literal["ridge", "mean", "grey"] = "ridge"
    """Initial harmonics: "ridge" solves them per Gaussian by regularised least squares on the back-projected spectra,
    "mean" takes the mean back-projected level, "grey" is the paper's 0.5 everywhere."""
    ridge: float = 1.0
    """Strength that draws a Gaussian's first harmonics to those of its neighbourhood; used by start="ridge"."""
    lr_level: float = 1e-3
    """Adam's learning rate of the constant harmonic [window units]."""
    lr_harmonics: float = 2e-4
    """Adam's learning rate of the other gain harmonics [window units]."""
    lr_opacity: float = 5e-3
    """Adam's learning rate of the opacity logits."""
    lr_csi: float = 2e-3
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

    @property
    def of_the_paper(self) -> tuple[str, ...]:
        """The names of settings that are not at their defaults and that only the paper's model has."""
        plain = RadioConfig()
        return tuple(name for name in PAPER_ONLY if getattr(self, name) != getattr(plain, name))

    @classmethod
    def preset(cls, name: str, *, steps: int | None = None, seed: int = 0) -> "RadioConfig":
        """The settings of that name in `PRESETS`, all of the paper's model, with their own steps or those given."""
        if name not in PRESETS:
            raise InputError(f"the presets of the radio stage are {', '.join(PRESETS)}; got {name!r}")
        chosen = replace(PRESETS[name], seed=seed)
        return chosen if steps is None else replace(chosen, steps=steps)

    @classmethod
    def fast(cls, seed: int = 0) -> "RadioConfig":
        """The closed form, which is nearly at the plateau of held-out positions, and a short polish."""
        return cls.preset("fast", seed=seed)

    @classmethod
    def best(cls, seed: int = 0) -> "RadioConfig":
        """Small rates and plain L1 from a stiffer closed form: the least error at held-out positions of the lobby."""
        return cls.preset("best", seed=seed)

    @classmethod
    def paper(cls, steps: int = 10_000, seed: int = 0) -> "RadioConfig":
        """The published recipe: its encoding, harmonics from grey, the line of sight on the surface, larger rates."""
        return cls.preset("paper", steps=steps, seed=seed)


PAPER_ONLY = (
    *("steps", "csi_every", "encoding", "line_of_sight", "degree", "start", "ridge", "lr_level"),
    *("lr_harmonics", "lr_opacity", "lr_csi", "lr_final", "ssim_weight", "shrink", "train_opacity"),
)
"""Settings that the mirror model does not have."""

PRESETS = {
    "fast": RadioConfig(model="paper", steps=100, ridge=3.0),
    "paper": RadioConfig(
        model="paper",
        steps=10_000,
        array_pictures="face-value",
        encoding="paper",
        line_of_sight="surface",
        start="grey",
        lr_level=5.6e-3,
        lr_harmonics=1.4e-3,
        lr_opacity=5e-2,
        lr_csi=5.6e-3,
    ),
    "best": RadioConfig(
        model="paper",
        steps=2_000,
        ridge=3.0,
        lr_level=3e-4,
        lr_harmonics=6e-5,
        lr_opacity=1.5e-3,
        ssim_weight=0.0,
    ),
}


@dataclass(frozen=True)
class VisualConfig:
    """The visual stage: photographs become Gaussians by 3D Gaussian Splatting.

    Iteration counts that are None follow from `steps`: the published values for long runs, shares of the run for short
    ones. Learning rates are for the published 30,000 steps; shorter runs multiply all but opacity's by
    sqrt(30,000 / steps), at most 4, and divide the means' by it when a sweep has put them on surfaces.
    """

    steps: int = 30_000
    """Iterations; each takes one photograph."""
    seed: int = 0
    """Decides the first Gaussians, the order of the photographs and how Gaussians split; the same seed gives the same
    Gaussians, bit by bit, on one machine."""

    start: Literal["sweep", "random"] = "sweep"
    """How to begin without points: "sweep" finds surfaces by comparing the photographs on trial planes; "random" is a
    cloud in the box."""
    start_count: int = 30_000
    """How many Gaussians to begin with when there are no points to begin from."""
    bounds: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    """Lowest and highest corner [m] of the box of the first Gaussians; None takes the cameras' box with a margin."""
    max_count: int = 1_000_000
    """Growth stops at this many Gaussians."""

    double_at: tuple[int, int] | None = None
    """Iterations at which the pictures' resolution, a quarter at first, doubles; None: 250 and 500, or 1/20 and 1/10 of
    a short run."""
    densify_from: int | None = None
    """First iteration of growth; None: 500, or 1/10 of a short run."""
    densify_until: int | None = None
    """Growth ends here; None: half of the run."""
    densify_every: int | None = None
    """Iterations between growths; None: 100, or 1/50 of a short run."""
    reset_every: int | None = None
    """Iterations between resets of opacity while the population grows; None: 3,000; short runs have none."""
    degree_every: int | None = None
    """Iterations between degrees of the harmonics; None: 1,000, or 1/10 of a short run."""
    degree: int = 3
    """Highest degree of the colour's harmonics."""

    grow_gradient: float = 2e-4
    """Gaussians whose mean screen gradient (of the picture from -1 to 1) exceeds this are cloned or split."""
    split_size: float = 0.01
    """Of those, the ones larger than this share of the scene's extent are split, the others cloned."""
    prune_opacity: float = 0.005
    """Fainter Gaussians are removed."""
    prune_size: float = 0.1
    """Gaussians larger than this share of the scene's extent are removed in the second half of growth."""
    prune_unseen: float = 1.0
    """Gaussians whose blending weights over all photographs sum to less than this many pixels are removed, three times
    during growth and at the end."""

    background: Literal["random", "black"] = "random"
    """Behind the Gaussians: another colour in every iteration, which teaches surfaces to be opaque, or black."""
    lr_means: float = 1.6e-4
    """Adam's first learning rate of the means, as a share of the scene's extent."""
    lr_means_final: float = 1.6e-6
    """Their last one; it falls exponentially in between."""
    lr_quats: float = 1e-3
    """Adam's learning rate of the quaternions."""
    lr_scales: float = 5e-3
    """Adam's learning rate of the scales' logarithms."""
    lr_opacities: float = 5e-2
    """Adam's learning rate of the opacity logits."""
    lr_sh: float = 2.5e-3
    """Adam's learning rate of the constant harmonic; the higher ones learn at a twentieth of it."""
    ssim_weight: float = 0.2
    """Share of D-SSIM in the loss; the rest is L1."""

    depth_weight: float | None = None
    """First weight of the relative error of the drawn depth against the sweep's, which falls to 0 while the population
    grows; None: 0.5 for the shortest runs, less for longer ones, down to the published method's 0 at 30,000 steps."""

    walls: Literal["flat", "free"] = "flat"
    """"flat": after three tenths and half of the run large planes are moved to where the photographs agree, those that
    bound the site are filled, and their Gaussians are flat from then on, which needs a world in metres; "free": the
    published method, which leaves haze there."""
    look_again: bool = True
    """Whether, after a fifth of the run, small things are added that photographs show and the Gaussians lack: places
    where photographs differ most from their drawings are swept at full size. The published method does not."""

    backend: Literal["auto", "native", "reference", "gsplat"] = "auto"
    """Which rasterizer works."""
    checkpoint_every: int = 1_000
    """Iterations between checkpoints when a checkpoint folder is given."""


@dataclass(frozen=True)
class SourceConfig:
    """Which mirror images of the transmitter are point sources, and how they are fitted."""

    order: int = 2
    """Most reflections of a way; 0 is the line of sight alone. Order 3 is tried over the largest planes only."""
    largest: int = 6
    """Over how many of the largest planes ways of order 3 are tried."""
    planes: int = 40
    """At most so many planes are mirrors, first those that mirror to a receiver, then by size; others only block."""
    complete: bool = True
    """Whether walls that the geometry lacks, or has in a wrong place, are found from secondary peaks of the spectra."""
    refine: bool = True
    """Whether planes are moved, within what geometry allows, to where the peaks of their images are."""
    square: bool = True
    """Whether small planes that nearly have the direction of a large one take it."""
    plane_error: float = 0.05
    """How far a plane of the geometry may lie off [m], one standard deviation."""
    plane_error_deg: float = 1.0
    """How far it may be turned [deg], one standard deviation."""
    least_db: float = 40.0
    """Sources that stay so many dB under the strongest part of the spectrum everywhere are left out."""
    most: int = 200
    """At most so many sources are kept, the strongest ones."""
    seed: int = 0
    """Decides the receivers at which sources are tried out."""
