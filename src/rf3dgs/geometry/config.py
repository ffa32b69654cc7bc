"""What a person may choose about surfaces: a frozen dataclass without torch."""

from dataclasses import dataclass


@dataclass(frozen=True)
class SurfaceConfig:
    """How `find_surfaces` looks for planes and segments."""

    seed: int = 0
    """Decides which candidate planes are tried; the same seed gives the same surfaces, bit by bit, on one machine."""
    tolerance: float = 0.03
    """Gaussians within this distance of a plane lie on it [m]."""
    angle_deg: float = 30.0
    """Their normals may differ from the plane's by this angle [deg]."""
    min_area: float = 0.3
    """A plane needs this much surface [m^2]."""
    min_width: float = 0.25
    """And this much in its narrower direction [m]; facets of columns are narrower."""
    max_planes: int = 64
    """The search ends at this many planes."""
    min_opacity: float = 0.3
    """Fainter Gaussians do not make surfaces; they still get a segment and, where they lie on a plane, the plane."""
    link: float = 0.25
    """Gaussians off the planes join a segment of such neighbours within this distance [m]."""
    link_angle_deg: float = 25.0
    """And this angle between their normals [deg]."""
