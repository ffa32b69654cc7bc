"""Digital twins as predictors: the ray tracer itself, on the true scene or on one that is a little wrong."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from rf3dgs.channel.binning import bin_diffuse
from rf3dgs.channel.paths import Paths
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.core.units import VACUUM_PERMITTIVITY
from rf3dgs.propagation.config import TraceConfig
from rf3dgs.propagation.sionna import Tracer
from rf3dgs.propagation.sites.scene import Scene, SceneObject, without_looks
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.spectrum import Spectrum

KEPT = 128  # positions whose paths are kept, 1 to 3 MB each
DELAY_STEP = 1e-8  # [s], of the paths that are kept: a lobe averages delays over more than that


class Twin:
    """Spectra of paths that are traced in `scene` when a position is first asked for.

    Pictures of one position share one trace, of `config.rays` rays with the seed `config.seed`. Of the training spectra
    only frequency and lobe are used; the transmitter is the scene's. Where the scene has something solid at the asked
    position next to nothing arrives, and the spectrum says so. MissingDependencyError without the extra `trace`.
    """

    name = "twin"

    def __init__(self, scene: Scene, train: Spectrum, config: TraceConfig) -> None:
        self.scene, self.config, self.lobe = scene, config, train.instrument.lobe
        self._tracer = Tracer(without_looks(scene), train.frequency, diffraction=config.diffraction)
        self._kept: dict[tuple[float, ...], Paths] = {}

    def render(self, pose: Pose, grid: DirectionGrid) -> Spectrum:
        """The spectrum `[row, col]` at one pose, with delay and departure."""
        paths = replace(self.paths(pose.position), rx=pose)
        return replace(spectrum_of(paths, None, grid, lobe=self.lobe), method=self.name)

    def paths(self, position: Tensor) -> Paths:
        """The paths `[path]` to a receiver at `position` `[3]`, diffuse ones merged."""
        place = tuple(position.tolist())
        if place not in self._kept:
            if len(self._kept) >= KEPT:
                del self._kept[next(iter(self._kept))]
            found = self._tracer.paths(self.scene.tx, Pose(position[None]), self.config, self.config.seed)
            self._kept[place] = bin_diffuse(found[0], delay_step=DELAY_STEP)
        return self._kept[place]


def misplaced(scene: Scene, deviation: float, *, seed: int = 0) -> Scene:
    """The scene with each object shifted as a whole by its own Gaussian offset of `deviation` [m] along each axis.

    Walls, floor and ceiling are objects like any other, so rooms get gaps and steps. The transmitter stays. InputError
    for a scene that is traced from a file, not from its objects.
    """
    if not deviation >= 0:
        raise InputError(f"deviation must be a length of at least 0 m; got {deviation}")
    generator = torch.Generator().manual_seed(seed)
    offsets = deviation * torch.randn(len(_own(scene)), 3, generator=generator)
    objects = (replace(item, vertices=item.vertices + by) for item, by in zip(scene.objects, offsets, strict=True))
    return replace(scene, objects=tuple(objects))


def mistaken(scene: Scene) -> Scene:
    """The scene with each material taken for the one in it that reflects next less, the least for the one above it.

    They are ordered by the size of the complex permittivity at the scene's frequency. An object gets permittivity,
    thickness, scattering amplitude and lobe of the first object of that material. Shapes stay. InputError for a scene
    that is traced from a file, or whose objects are all of one material.
    """
    first = {item.material: item for item in reversed(_own(scene))}
    ranked = sorted(first.values(), key=lambda item: (_reflects(item, scene.frequency), item.material))
    if len(ranked) < 2:
        raise InputError(f"materials are mistaken for others in the scene; {scene.name!r} has only {', '.join(first)}")
    other = {item.material: ranked[abs(place - 1)] for place, item in enumerate(ranked)}
    objects = (
        replace(
            item,
            material=other[item.material].material,
            electric=other[item.material].electric,
            thickness=other[item.material].thickness,
            scattering=other[item.material].scattering,
            alpha_r=other[item.material].alpha_r,
        )
        for item in scene.objects
    )
    return replace(scene, objects=tuple(objects))


def _reflects(item: SceneObject, frequency: float) -> float:
    """Size of the complex relative permittivity."""
    real, conductivity = item.permittivity(frequency)
    return math.hypot(real, conductivity / (2 * math.pi * frequency * VACUUM_PERMITTIVITY))


def _own(scene: Scene) -> tuple[SceneObject, ...]:
    if scene.source is not None:
        raise InputError(
            f"the scene {scene.name!r} is traced from {scene.source.name}, whose objects cannot be changed here; use a "
            "built-in scene or a folder of meshes"
        )
    return scene.objects
