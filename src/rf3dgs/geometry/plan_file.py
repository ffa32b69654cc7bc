"""Floor plans in TOML or JSON files; docs/how-to/geometry.md shows one."""

import json
import math
import tomllib
from pathlib import Path
from typing import Any

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.geometry.plan import Opening, Room, check_room

LARGEST_FILE = 1 << 20  # bytes
MOST_ROOMS, MOST_CORNERS = 1000, 1000
PLAN_KEYS = ("height", "floor", "ceiling", "walls", "rooms")
ROOM_KEYS = ("name", "corners", "height", "base", "floor", "ceiling", "walls", "openings")
OPENING_KEYS = ("wall", "from", "to", "foot", "head", "material")


def read_plan(path: str | Path) -> tuple[Room, ...]:
    """The rooms of a floor plan in TOML or JSON.

    Raises DataError, naming the file and the place, for a file that is missing, too large or cannot be parsed, for keys
    that are unknown or missing, for values of the wrong type, and for rooms that no one could build: fewer than three
    corners, walls that cross, openings outside their wall or over one another.
    """
    path = Path(path)
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise DataError(f"{path}: is larger than {LARGEST_FILE >> 20} MiB, too large for a floor plan")
        text = path.read_bytes().decode("utf-8")
        table = json.loads(text) if path.suffix.lower() == ".json" else tomllib.loads(text)
    except FileNotFoundError as error:
        raise DataError(f"{path}: there is no such file; name a floor plan in TOML or JSON") from error
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: cannot be read as a floor plan ({error})") from error
    try:
        return _rooms(table)
    except InputError as error:
        raise DataError(f"{path}: {error}") from error


def _rooms(table: Any) -> tuple[Room, ...]:
    """The rooms of a parsed file."""
    _known(table, PLAN_KEYS, "the plan")
    entries = table.get("rooms")
    if not isinstance(entries, list) or not 1 <= len(entries) <= MOST_ROOMS:
        raise InputError(f"a floor plan needs a list of 1 to {MOST_ROOMS} rooms ([[rooms]]); got {str(entries)[:40]}")
    usual = {key: table[key] for key in PLAN_KEYS if key != "rooms" and key in table}
    rooms = []
    for number, entry in enumerate(entries):
        where = f"room {number}"
        _known(entry, ROOM_KEYS, where)
        entry = usual | entry
        corners = entry.get("corners")
        if not isinstance(corners, list) or not 3 <= len(corners) <= MOST_CORNERS:
            raise InputError(f"{where}: corners must be a list of three or more [x, y]; got {str(corners)[:40]}")
        openings = entry.get("openings", [])
        if not isinstance(openings, list):
            raise InputError(f"{where}: openings must be a list of tables; got {str(openings)[:40]}")
        room = Room(
            name=_text(entry.get("name", f"room-{number}"), f"{where}.name"),
            corners=tuple(_point(corner, f"{where}.corners") for corner in corners),
            height=_number(entry.get("height"), f"{where}.height"),
            base=_number(entry.get("base", 0.0), f"{where}.base"),
            floor=_text(entry.get("floor", "concrete"), f"{where}.floor"),
            ceiling=_text(entry.get("ceiling", "ceiling_board"), f"{where}.ceiling"),
            walls=_text(entry.get("walls", "plasterboard"), f"{where}.walls"),
            openings=tuple(_opening(value, where) for value in openings),
        )
        check_room(room)
        rooms.append(room)
    return tuple(rooms)


def _opening(entry: Any, where: str) -> Opening:
    where = f"{where}.openings"
    _known(entry, OPENING_KEYS, where)
    wall = entry.get("wall")
    if type(wall) is not int:
        raise InputError(f"{where}.wall must be a whole number, the wall's place from 0; got {wall!r}")
    numbers = {key: _number(entry.get(key), f"{where}.{key}") for key in ("from", "to", "head")}
    foot = _number(entry.get("foot", 0.0), f"{where}.foot")
    material = None if "material" not in entry else _text(entry["material"], f"{where}.material")
    return Opening(wall, numbers["from"], numbers["to"], foot, numbers["head"], material)


def _known(entry: Any, keys: tuple[str, ...], where: str) -> None:
    if not isinstance(entry, dict):
        raise InputError(f"{where} must be a table; got {str(entry)[:40]!r}")
    for key in entry:
        if key not in keys:
            raise InputError(f"{where} has the unknown key {key!r}; known are {', '.join(keys)}")


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{where} must be a number in metres; got {value!r}")
    return float(value)


def _text(value: Any, where: str) -> str:
    if not isinstance(value, str):
        raise InputError(f"{where} must be text; got {value!r}")
    return value


def _point(value: Any, where: str) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise InputError(f"{where} must be pairs [x, y] in metres; got {str(value)[:40]!r}")
    return _number(value[0], where), _number(value[1], where)
