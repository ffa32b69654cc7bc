"""Presets: a frequency, how surfaces scatter at it, and what the tracer follows, by one name.

A preset changes a scene and a `TraceConfig` together, because scattering depends on the wavelength.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

from rf3dgs.core.errors import InputError
from rf3dgs.propagation.config import TraceConfig
from rf3dgs.propagation.sites.materials import SURFACES, scattering_amplitude
from rf3dgs.propagation.sites.scene import Scene, SceneObject

DIFFUSE_SCATTERING = 0.95
"""Amplitude S of every surface in the preset "diffuse": nine tenths of the power."""
FOLIAGE_SCATTERING = 0.96
"""An object that scatters at least this amplitude by itself is foliage and stays as it is."""


@dataclass(frozen=True)
class Preset:
    """What a name stands for: `frequency` [Hz], whether rays pass through walls or bend round edges, how objects are
    changed, and where it is a whole set, how many receivers and how many paths each at least, before binning."""

    name: str
    summary: str
    frequency: float
    change: Callable[[Scene], Scene]
    refraction: bool = False
    diffraction: bool = False
    rx_count: int | None = None
    min_paths: int = 0

    def applied(self, scene: Scene, config: TraceConfig | None = None) -> tuple[Scene, TraceConfig]:
        """The scene and the configuration under this preset; what the configuration says otherwise stays.

        Raises InputError when the configuration names another frequency or changes a whole set, or when a material is
        not defined at this frequency.
        """
        config = TraceConfig() if config is None else config
        if self.min_paths and config != TraceConfig(seed=config.seed, frequency=config.frequency):
            raise InputError(
                f"the preset {self.name!r} is a whole set and says how paths are traced; leave out other settings, or "
                "take the preset 'diffuse' with them"
            )
        if config.frequency is not None and config.frequency != self.frequency:
            raise InputError(
                f"the preset {self.name!r} is made for {self.frequency / 1e9:g} GHz; got the frequency "
                f"{config.frequency / 1e9:g} GHz. Leave out one of them"
            )
        changed = self.change(replace(scene, frequency=self.frequency))
        if changed.source is None:
            changed.check_radio(self.frequency)
        return changed, replace(
            config,
            frequency=self.frequency,
            refraction=config.refraction or self.refraction,
            diffraction=config.diffraction or self.diffraction,
        )


def preset_of(name: str) -> Preset:
    """The preset of that name; InputError lists the names there are."""
    if name not in PRESETS:
        raise InputError(f"no preset is named {name!r}; use one of {', '.join(PRESETS)}")
    return PRESETS[name]


def _diffuse(scene: Scene) -> Scene:
    """Every surface scatters nearly all it reflects by Lambert's law."""
    objects = (
        replace(item, scattering=max(item.scattering, DIFFUSE_SCATTERING), alpha_r=None) for item in scene.objects
    )
    return replace(scene, objects=tuple(objects))


def _realistic(scene: Scene) -> Scene:
    """Surfaces scatter as rough as they are at the scene's frequency, in lobes round the mirror direction."""
    return replace(scene, objects=tuple(_as_rough_as_it_is(item, scene.frequency) for item in scene.objects))


def _as_rough_as_it_is(item: SceneObject, frequency: float) -> SceneObject:
    if item.material == "floorboard" and item.electric is None:
        item = replace(item, material="marble")
    surface = SURFACES.get(item.material.removeprefix("itu_"))
    if surface is None or item.scattering >= FOLIAGE_SCATTERING:
        return item
    amplitude = round(scattering_amplitude(surface, frequency), 4)
    return replace(item, scattering=amplitude, alpha_r=surface.alpha_r)


def _transparent(scene: Scene) -> Scene:
    """The realistic scene with things that radio and eye see differently."""
    from rf3dgs.propagation.sites.lobby_extras import see_through

    if scene.name != "lobby":
        raise InputError(f"the preset 'transparent' puts things into the lobby; got the scene {scene.name!r}")
    return _realistic(replace(scene, objects=(*scene.objects, *see_through())))


PRESETS = {
    preset.name: preset
    for preset in (
        Preset("paper", "diffuse, for 800 receivers", 60e9, _diffuse, rx_count=800, min_paths=300_000),
        Preset("diffuse", "60 GHz, every surface scatters by Lambert's law, as in the paper", 60e9, _diffuse),
        Preset("realistic", "60 GHz, directive lobes, mirrors of glass, metal and polished stone", 60e9, _realistic),
        Preset("28ghz", "28 GHz, as realistic", 28e9, _realistic),
        Preset("10ghz", "10 GHz, as realistic, with diffraction", 10e9, _realistic, diffraction=True),
        Preset(
            "2.4ghz", "2.4 GHz, through walls and round edges", 2.4e9, _realistic, refraction=True, diffraction=True
        ),
        Preset("transparent", "60 GHz, things that radio and eye see differently", 60e9, _transparent, refraction=True),
    )
}
