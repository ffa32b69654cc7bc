"""The package's own models, and variants of them with some settings changed."""

import json
from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass, replace
from functools import partial
from typing import Any

from benchmarks.quality.methods.method import Method, Task
from rf3dgs.core.errors import InputError
from rf3dgs.evaluation.protocol import Predictor
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.radio import fit_radio

MODELS = ("paper", "mirror")


def config_of(base: str, changes: Mapping[str, Any], task: Task) -> RadioConfig:
    """The settings of the radio stage, whose window begins where the task's does; InputError for unknown ones.

    `preset` among the changes starts from a preset of the radio stage in place of its defaults.
    """
    changes = {"floor_db": task.window.floor_db, "model": base} | dict(changes)
    preset = changes.pop("preset", None)
    config = RadioConfig(seed=task.seed) if preset is None else RadioConfig.preset(preset, seed=task.seed)
    return changed(config, changes)


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


def field(name: str, base: str, changes: Mapping[str, Any] | None = None) -> Method:
    """A model of the radio stage with `changes` to its settings, on the task's geometry; InputError for others."""
    changes = dict(changes or {})
    preset = changes.get("preset")
    start = RadioConfig() if preset is None else RadioConfig.preset(preset)
    changed(start, {key: value for key, value in changes.items() if key != "preset"})

    def fitted(task: Task) -> Predictor:
        assert task.geometry is not None
        return fit_radio(task.geometry, task.spectra, config_of(base, changes, task))

    def settings(task: Task) -> Mapping[str, Any]:
        return json.loads(json.dumps(asdict(config_of(base, changes, task))))

    return Method(name, fitted, needs=("geometry",), settings=settings, vary=partial(field, base=base))


METHODS = tuple(field(name, name) for name in MODELS)
