"""What a person may choose about surfaces: a frozen dataclass without torch."""

from dataclasses import dataclass


@dataclass(frozen=True)
class SurfaceConfig:
    """How `find_surfaces` looks for planes and segments."""

    seed: int = 0
    """Decides which candidate planes are tried; the same seed gives the same surfaces, bit by bit, on one machine."""
    tolerance: float = 0.03
    """Gaussians within this distance of a plane lie on it [m]."""
    max_tolerance: float = 0.13
    """Rough planes may be this much thicker on either side, as far as that makes them larger [m]."""
    angle_deg: float = 30.0
    """Their normals may differ from the plane's by this angle [deg]."""
    min_area: float = 0.3
    """A plane needs this much surface [m^2]."""
    min_width: float = 0.3
    """And this much in its narrower direction [m]; facets of columns are narrower."""
    min_count: int = 15
    """And this many Gaussians."""
    min_cover: float = 0.15
    """Its Gaussians' one-sigma areas times their opacities must add up to this share of its area."""
    min_sharpness: float = 0.4
    """And to this share of all with the same normal within four tolerances of it."""
    layer: float = 0.25
    """Half the thickness of layers that are taken for walls although their normals say nothing [m]; 0: none are."""
    min_layer_area: float = 4.0
    """And the surface that such a layer needs [m^2]."""
    max_planes: int = 96
    """The search ends at this many planes."""
    min_opacity: float = 0.3
    """Fainter Gaussians do not make surfaces; they still get a segment and, where they lie on a plane, the plane."""
    link: float = 0.25
    """Gaussians off the planes join a segment of such neighbours within this distance [m], at cells of 10 cm."""
    link_angle_deg: float = 25.0
    """And this angle between their normals [deg]."""
