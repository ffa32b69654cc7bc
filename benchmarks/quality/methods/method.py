"""What a method is to the benchmarks: a name, and a function from a training task to a predictor."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

from rf3dgs.core.errors import InputError
from rf3dgs.evaluation.protocol import Predictor
from rf3dgs.propagation.sites.scene import Scene
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.splats.gaussians import Gaussians

Scale = Literal["smoke", "laptop", "paper"]
Need = Literal["geometry", "scene"]
SCALES: tuple[Scale, ...] = get_args(Scale)


@dataclass(frozen=True, eq=False)
class Task:
    """What a method may learn from. No held-out position is part of it."""

    spectra: Spectrum
    """The training pictures `[picture, row, col]`; several may stand at one position."""
    window: DbWindow
    """The dB window that every method is judged in."""
    seed: int = 0
    """Decides everything random."""
    scale: Scale = "laptop"
    """How much a method may spend: "smoke" minutes for a whole figure, "laptop" hours on two cores, "paper" a GPU."""
    geometry: Gaussians | None = None
    """Gaussians of the site, of photographs or on a mesh; for methods that need "geometry"."""
    scene: Scene | None = None
    """The site as it is, with its preset's materials; for methods that need "scene"."""


@dataclass(frozen=True)
class Method:
    """A method of the benchmarks. `fit(task)` learns; what it returns has `render(pose, grid) -> Spectrum`."""

    name: str
    fit: Callable[[Task], Predictor]
    needs: tuple[Need, ...] = ()
    settings: Callable[[Task], Mapping[str, Any]] = lambda task: {}
    """All that decides its answer beside the task, as JSON: a cell made with other settings is made anew."""
    vary: "Callable[..., Method] | None" = None
    """`vary(name, changes=...)` is this method under another name with some settings changed; None: it has none."""

    def made(self, task: Task) -> Predictor:
        """The trained predictor; InputError where the task lacks what the method needs."""
        for need in self.needs:
            if getattr(task, need) is None:
                raise InputError(f"the method {self.name!r} needs a task with {need}; give it, or leave the method out")
        return self.fit(task)
