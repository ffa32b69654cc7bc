"""What is judged: lookups, the radio stage's models, and variants of them with some settings changed."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from typing import Any

from rf3dgs.core.errors import InputError
from rf3dgs.evaluation.baselines.lookup import InverseDistance, NearestNeighbour
from rf3dgs.evaluation.protocol import Predictor
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.radio import fit_radio

LOOKUPS = {"nearest": 1, "idw4": 4, "idw8": 8}
FIELDS = ("paper", "mirror")
KNOWN = (*LOOKUPS, *FIELDS)


@dataclass(frozen=True)
class Model:
    """A name of the table: a lookup, or a model of the radio stage with `changes` to its settings."""

    name: str
    base: str
    changes: tuple[tuple[str, Any], ...] = ()

    @property
    def is_lookup(self) -> bool:
        return self.base in LOOKUPS

    def settings(self, seed: int, floor_db: float) -> dict[str, Any]:
        """All that decides its answer, as JSON can hold it."""
        if self.is_lookup:
            return {"neighbours": LOOKUPS[self.base]}
        return json.loads(json.dumps(asdict(self.config(seed, floor_db))))

    def config(self, seed: int, floor_db: float) -> RadioConfig:
        """The settings of the radio stage, whose window begins at `floor_db`; InputError for one it does not have."""
        changes: dict[str, Any] = {"floor_db": floor_db} | dict(self.changes)
        preset = changes.pop("preset", None)
        config = RadioConfig(seed=seed) if preset is None else RadioConfig.preset(preset, seed=seed)
        if "model" in {item.name for item in fields(RadioConfig)}:
            changes = {"model": self.base} | changes
        elif self.base != "paper":
            raise InputError(f"the radio stage of this version has no model {self.base!r}; judge another one")
        return changed(config, changes)

    def made(self, train: Spectrum, geometry: Gaussians | None, seed: int, floor_db: float) -> Predictor:
        """The lookup over, or the field trained on, `train` `[position, row, col]`."""
        if self.is_lookup:
            count = LOOKUPS[self.base]
            return NearestNeighbour(train) if count == 1 else InverseDistance(train, neighbours=count)
        if geometry is None:
            raise InputError(f"the model {self.name!r} needs geometry; name photos, mesh or a .ply file")
        return fit_radio(geometry, train, self.config(seed, floor_db))


def model_of(text: str) -> Model:
    """The model that "paper", or "NAME=BASE,setting=value,part.setting=value", describes; values are JSON or text.

    `preset=best` starts from a preset of the radio stage in place of its defaults.
    """
    name, _, rest = text.partition("=")
    base, *settings = rest.split(",") if rest else [name]
    if base not in KNOWN or not name or not set(name) <= set(_PLAIN):
        raise InputError(
            f"a model is one of {', '.join(KNOWN)}, or NAME=BASE,setting=value with one of them as BASE and a NAME of "
            f"letters, digits and hyphens; got {text!r}"
        )
    if (rest and name in KNOWN) or (settings and base in LOOKUPS):
        raise InputError(f"a variant needs a name of its own and a base that has settings; got {text!r}")
    changes = []
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not equals:
            raise InputError(f"a changed setting is written setting=value; got {setting!r} in {text!r}")
        changes.append((key, _value(value)))
    return Model(name, base, tuple(changes))


def changed(config: Any, changes: Mapping[str, Any]) -> Any:
    """A configuration with some settings replaced; "part.setting" reaches into a configuration inside it.

    A setting that is several names takes "one+other".
    """
    known = {item.name for item in fields(config)}
    for key, value in changes.items():
        head, _, tail = key.partition(".")
        if head not in known or (tail and not is_dataclass(getattr(config, head))):
            raise InputError(f"{type(config).__name__} has no setting {key!r}; it has {', '.join(sorted(known))}")
        old = getattr(config, head)
        if isinstance(old, tuple) and isinstance(value, str):
            value = tuple(value.split("+"))
        new = changed(old, {tail: value}) if tail else value
        config = replace(config, **{head: new})
    return config


_PLAIN = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789-."


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text
