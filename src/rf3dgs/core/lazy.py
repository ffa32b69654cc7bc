"""Names that are imported when they are first used, so that `import rf3dgs` and `rf3dgs --help` stay instant."""

import importlib
from collections.abc import Callable, Mapping


def lazy_names(package: str, modules: Mapping[str, str]) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """The module-level `__getattr__` and `__dir__` of `package`.

    `modules` maps each public name to the module that defines it, relative to the package (".paths"); a name mapped to
    itself with a dot (".sionna" for "sionna") is that submodule.
    """

    def get(name: str) -> object:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module = importlib.import_module(modules[name], package)
        return module if modules[name] == f".{name}" else getattr(module, name)

    def names() -> list[str]:
        return sorted(modules)

    return get, names
