"""The methods that the benchmarks compare, one subject a file; each file lists its `METHODS`.

A method of your own is a file like these, named by its path: docs/how-to/adding-a-method.md.
"""

import importlib
import importlib.util
import json
import pkgutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from benchmarks.quality.methods.method import Method
from rf3dgs.core.errors import InputError

_PLAIN = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789-."


def known() -> dict[str, Method]:
    """The methods of this folder, by name."""
    found: dict[str, Method] = {}
    for item in pkgutil.iter_modules(__path__, f"{__name__}."):
        for method in getattr(importlib.import_module(item.name), "METHODS", ()):
            if method.name in found:
                raise InputError(f"two methods are named {method.name!r}; rename the one in {item.name}")
            found[method.name] = method
    return found


def methods_in(path: str | Path) -> tuple[Method, ...]:
    """The methods that a Python file lists as `METHODS`; the file is run."""
    file = Path(path)
    if not file.is_file():
        raise InputError(f"{file}: no such file; name a Python file with METHODS, or one of {', '.join(known())}")
    spec = importlib.util.spec_from_file_location(f"method_{file.stem}", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return _listed(module, file)


def methods_of(texts: Sequence[str]) -> list[Method]:
    """The methods that words of a command line name; InputError where two have one name.

    A word is a name of this folder, the path of a file that lists methods, or "NAME=BASE,setting=value", a variant of a
    model of the radio stage; `part.setting=value` reaches into a part, values are JSON or text, and `preset=best`
    starts from a preset in place of the defaults.
    """
    methods = [method for text in texts for method in _named(text)]
    names = [method.name for method in methods]
    if len(set(names)) < len(names):
        raise InputError(f"every model needs a name of its own; got {', '.join(names)}")
    return methods


def _named(text: str) -> Iterator[Method]:
    if text.endswith(".py"):
        yield from methods_in(text)
        return
    methods = known()
    name, equals, rest = text.partition("=")
    base, *settings = rest.split(",") if equals else [name]
    if base not in methods or not name or not set(name) <= set(_PLAIN):
        raise InputError(
            f"a model is one of {', '.join(methods)}, a Python file, or NAME=BASE,setting=value with one of them as "
            f"BASE and a NAME of letters, digits and hyphens; got {text!r}"
        )
    vary = methods[base].vary
    if equals and (name in methods or vary is None):
        raise InputError(f"a variant needs a name of its own and a base that has settings; got {text!r}")
    if not equals or vary is None:
        yield methods[base]
        return
    changes = {}
    for setting in settings:
        key, is_set, value = setting.partition("=")
        if not is_set:
            raise InputError(f"a changed setting is written setting=value; got {setting!r} in {text!r}")
        changes[key] = _value(value)
    yield vary(name, changes=changes)


def _listed(module: ModuleType, file: Path) -> tuple[Method, ...]:
    found: Any = getattr(module, "METHODS", None)
    if not isinstance(found, tuple | list) or not found or not all(isinstance(each, Method) for each in found):
        raise InputError(f"{file} must list its methods as METHODS = (Method(...),); got {found!r}")
    return tuple(found)


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text
