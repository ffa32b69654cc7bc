"""What a folder of shards holds: its `manifest.json`, written before the first shard and never changed.

A long job is cut into shards of `shard_size` items each. The manifest says how many items there are, what they are made
from (the arguments) and by (versions and processor): the same two give the same bytes, so that a killed job goes on
where it stopped, and another job is kept out of the folder.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.files import write_whole

NAME = "manifest.json"
VERSION = 1
MAX_BYTES = 4 * 2**20


@dataclass(frozen=True)
class Manifest:
    """`count` items in shards of `shard_size`; `made_from` and `made_by` are nested mappings that JSON holds exactly.

    schema names what the shards are, such as "rf3dgs.paths".
    """

    schema: str
    count: int
    shard_size: int
    made_from: Mapping[str, object]
    made_by: Mapping[str, object]

    def __post_init__(self) -> None:
        whole = type(self.count) is int and type(self.shard_size) is int
        if not whole or self.count < 1 or self.shard_size < 1:
            raise InputError(
                f"count and shard size must be whole numbers from 1; got {self.count} and {self.shard_size}"
            )

    @property
    def shards(self) -> int:
        """How many shards there are; the last may be short."""
        return -(-self.count // self.shard_size)

    def part(self, shard: int) -> range:
        """The items of one shard."""
        return range(shard * self.shard_size, min((shard + 1) * self.shard_size, self.count))

    def shard_of(self, item: int) -> int:
        """The shard that holds one item."""
        return item // self.shard_size

    @property
    def digest(self) -> str:
        """The sha256 of everything but `made_by`: a shard that carries it belongs to this set."""
        content = {name: value for name, value in asdict(self).items() if name != "made_by"}
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def save(self, folder: str | Path) -> None:
        """Write `manifest.json` into `folder`, at once or not at all."""
        text = json.dumps({"version": VERSION, **asdict(self)}, indent=1, allow_nan=False)
        write_whole(Path(folder) / NAME, (text + "\n").encode())


def load_manifest(folder: str | Path) -> Manifest:
    """The manifest of a folder of shards; DataError names a missing, damaged or newer one."""
    path = Path(folder) / NAME
    try:
        if path.stat().st_size > MAX_BYTES:
            raise DataError(f"{path}: expected at most {MAX_BYTES} bytes; it is something else")
        content = json.loads(path.read_bytes())
        version = content.pop("version")
        if version != VERSION:
            raise DataError(f"{path}: manifest version {version} is not {VERSION}; update rf3dgs to read it")
        manifest = Manifest(**content)
        texts = isinstance(manifest.schema, str) and isinstance(manifest.made_from, dict)
        if not (texts and isinstance(manifest.made_by, dict)):
            raise TypeError("schema, made_from or made_by is of another type")
        return manifest
    except FileNotFoundError as error:
        raise DataError(f"{path}: there is no such file, so {folder} is not a folder of shards") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DataError(
            f"{path} is not a readable manifest ({error}); delete the folder and make the set again"
        ) from error


def difference(before: object, now: object, name: str = "") -> str:
    """The first place where two nested mappings differ, in words; empty when they are equal."""
    if isinstance(before, dict) and isinstance(now, dict):
        for key in sorted(before.keys() | now.keys()):
            found = difference(before.get(key), now.get(key), f"{name}.{key}" if name else str(key))
            if found:
                return found
        return ""
    return "" if before == now else f"{name} (it had {_short(before)}, this run has {_short(now)})"


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 24 else text[:20] + "..."
