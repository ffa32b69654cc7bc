"""What can be chosen about tracing and photographing; free of heavy imports, so that `--help` is instant."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class TraceConfig:
    """How paths are traced."""

    depth: int = 3
    """Largest number of interactions (reflections, diffuse or specular) of a path."""
    rays: int = 300_000
    """Rays shot from the transmitter; below 300,000 the rays' lattice shows as dots near the receiver."""
    passes: int = 1
    """Solves per receiver with different lattices of rays, whose diffuse powers are averaged: more detail."""
    seed: int = 0
    """Receiver number i is traced with the seed `seed + i`."""
    frequency: float | None = None
    """Carrier [Hz]; the scene's own when absent."""
    line_of_sight: bool = True
    """Whether the direct path is traced."""
    specular: bool = True
    """Whether mirror-like reflections are traced."""
    diffuse: bool = True
    """Whether diffuse reflections are traced."""
    refraction: bool = False
    """Whether rays pass through walls; what passes an outer wall is lost."""
    diffraction: bool = False
    """Whether rays bend round the edges of solid objects, once per path."""
    cell_deg: float = 1.0
    """`trace` merges diffuse paths that arrive within one cell of this size [deg] ..."""
    delay_step: float = 1e-9
    """... and within this delay [s]; line of sight and purely specular paths are kept exactly."""


@dataclass(frozen=True)
class ReceiverConfig:
    """Where receivers stand."""

    kind: Literal["random", "grid", "route"] = "random"
    """Drawn uniformly in the free space, on a regular grid in it, or along a walked route."""
    count: int | None = None
    """How many are drawn, 72 unless given; random only."""
    seed: int = 0
    """Decides where they are drawn; random only."""
    spacing: float = 0.5
    """Distance [m] between neighbours of a grid."""
    route: tuple[tuple[float, float], ...] = ()
    """Waypoints (x, y) [m] of a route."""
    speed: float = 1.0
    """Speed of the walk along a route [m/s] ..."""
    interval: float = 0.25
    """... and time between two of its receivers [s]."""
    height: float | None = None
    """Height above the ground [m]; the scene's own heights, or their middle on grids and routes, when absent."""
    clearance: float = 0.35
    """Least distance from every surface [m]."""


@dataclass(frozen=True)
class PhotoConfig:
    """How photographs are rendered."""

    width: int = 320
    """Pixels in a row."""
    height: int = 240
    """Rows."""
    fov_deg: float = 85.0
    """Horizontal field of view [deg]."""
    walk: Literal["level", "coverage"] = "level"
    """Once round looking across, or also out at the walls, down at the floor and up at the ceiling."""
    samples: int = 64
    """Light paths per pixel (a square number at least where something is transparent); noise falls with the root."""
    held_out_samples: int | None = None
    """The same for held-out photographs, which judge the others; None takes `samples`."""
    bounces: int = 6
    """Largest number of segments of a light path."""
    exposure: float = 1.0
    """Factor on the linear light before the sRGB curve, on top of the scene's own exposure."""
    seed: int = 0
    """Photograph number i is rendered with the seed `seed + i`."""
