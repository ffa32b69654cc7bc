"""Finds the native core."""

import importlib
from functools import cache
from types import ModuleType


@cache
def _load() -> tuple[ModuleType | None, str]:
    try:
        return importlib.import_module("rf3dgs._native"), ""
    except ImportError as error:
        return None, str(error)


def native_core() -> ModuleType | None:
    """The compiled module, or None where it was not built or cannot be loaded."""
    return _load()[0]


def native_failure() -> str:
    """Why the compiled module cannot be loaded; empty when it can."""
    return _load()[1]


class Held:
    """What the native core holds too, as its property `held`, which copies and pickles make anew."""

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in self.__dict__.items() if name != "held"}
