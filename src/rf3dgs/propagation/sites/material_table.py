"""The table of a mesh folder: where things stand in [site], and what objects are made of in [objects]."""

import json
import math
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

from rf3dgs.core.errors import DataError

TABLES = ("materials.toml", "materials.json")
LARGEST_TABLE = 2**20  # bytes
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "foot": 0.3048}

SITE = {
    "frequency_ghz": float, "tx": 3, "look_at": 3, "rx_low": 3, "rx_high": 3, "camera_low": 3, "camera_high": 3,
    "unit": str, "up": str, "exposure": float, "sky": float,
}  # fmt: skip
OBJECT = {
    "material": str, "permittivity": float, "conductivity": float, "thickness": float, "scattering": float,
    "alpha_r": int, "colour": 3, "glow": float, "transparency": float, "solid": bool,
}  # fmt: skip
NEEDED = ("frequency_ghz", "tx", "rx_low", "rx_high")


class MaterialTable(NamedTuple):
    """`site` and `objects` of the file `path`: keys are known, values of the right type, needed ones there."""

    path: Path
    site: dict[str, Any]
    objects: dict[str, dict[str, Any]]


def has_table(folder: Path) -> bool:
    """True for a folder that says what its meshes are made of."""
    return any((folder / name).is_file() for name in TABLES)


def read_table(folder: Path) -> MaterialTable:
    """The table in a folder; DataError, naming the file, when it is missing, damaged, incomplete or misspelt."""
    path = _table_in(folder)
    return MaterialTable(path, *_checked(path, _parsed(path)))


def _table_in(folder: Path) -> Path:
    for name in TABLES:
        if (folder / name).is_file():
            return folder / name
    raise DataError(
        f"{folder}: expected {TABLES[0]} or {TABLES[1]} that says what the meshes are made of; there is none"
    )


def _parsed(path: Path) -> dict[str, Any]:
    """A TOML or JSON table of at most 1 MiB."""
    if path.stat().st_size > LARGEST_TABLE:
        raise DataError(f"{path}: is larger than {LARGEST_TABLE >> 20} MiB, too large for a table of materials")
    try:
        text = path.read_bytes().decode("utf-8")
        return tomllib.loads(text) if path.suffix == ".toml" else json.loads(text)
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: cannot be read ({error})") from error


def _checked(path: Path, table: Any) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """The tables `site` and `objects`, all of whose keys are known and of the right type."""
    parts = [table.get(name) if isinstance(table, dict) else None for name in ("site", "objects")]
    for name, part in zip(("site", "objects"), parts, strict=True):
        if not isinstance(part, dict) or not part:
            raise DataError(f"{path}: expected a table [{name}]; there is none, or it is empty")
    site, entries = parts
    assert isinstance(site, dict)
    assert isinstance(entries, dict)
    if set(table) - {"site", "objects"}:
        raise DataError(
            f"{path}: expected the tables site and objects; got also {min(set(table) - {'site', 'objects'})!r}"
        )
    _check_keys(path, "site", site, SITE)
    for key, entry in entries.items():
        if not isinstance(entry, dict):
            raise DataError(f'{path}: objects.{key!r} must be a table such as {{ material = "wood" }}; got {entry!r}')
        _check_keys(path, f"objects.{key!r}", entry, OBJECT)
        if ("material" in entry) == ("permittivity" in entry):
            raise DataError(f"{path}: objects.{key!r} needs either a material or a permittivity (with a conductivity)")
    missing = [key for key in NEEDED if key not in site]
    if missing:
        raise DataError(f"{path}: [site] lacks {', '.join(missing)}; it needs {', '.join(NEEDED)}")
    if site.get("unit", "m") not in UNITS or site.get("up", "z") not in ("y", "z"):
        raise DataError(f'{path}: [site] unit must be one of {", ".join(UNITS)} and up "z" or "y"')
    if not 0.1 <= site["frequency_ghz"] <= 1000:
        raise DataError(f"{path}: frequency_ghz must be from 0.1 to 1000 gigahertz; got {site['frequency_ghz']:g}")
    return site, entries


def _check_keys(path: Path, where: str, part: dict[str, Any], known: dict[str, Any]) -> None:
    for key, value in part.items():
        if key not in known:
            raise DataError(f"{path}: {where} has the unknown key {key!r}; known are {', '.join(known)}")
        kind = known[key]
        if kind in (str, bool):
            good, what = isinstance(value, kind), "text" if kind is str else "true or false"
        elif kind is int:
            good, what = type(value) is int, "a whole number"
        elif kind is float:
            good, what = _is_number(value), "a finite number"
        else:
            good, what = isinstance(value, list) and len(value) == kind and all(map(_is_number, value)), "three numbers"
        if not good:
            raise DataError(f"{path}: {where}.{key} must be {what}; got {str(value)[:60]!r}")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
