"""Checkpoints that survive SIGKILL, a full disk and flipped bits; and the lock that keeps two runs out of one folder.

A checkpoint is `step-NNNNNNNN.safetensors` and a JSON file of the same name that holds the numbers, what the run was
made from (its identity) and the sha256 of both. The JSON file is written last: a checkpoint without it does not exist.
"""

import contextlib
import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load as read_tensors
from safetensors.torch import save as tensor_bytes
from torch import Tensor

from rf3dgs.core import lock
from rf3dgs.core.errors import DataError, InputError, TrainingError
from rf3dgs.core.files import atomic_file, remove_partials
from rf3dgs.core.manifest import difference

SCHEMA = 1
KEPT = 2


@dataclass(frozen=True)
class State:
    """Everything a stage needs to go on: tensors by name and numbers that JSON can hold exactly."""

    tensors: dict[str, Tensor]
    numbers: dict[str, object]


def fingerprint(tensors: Iterable[Tensor]) -> str:
    """The sha256 of shapes, types and bytes of tensors: tells whether a run continues on the same data."""
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(f"{tensor.dtype}{list(tensor.shape)}".encode())
        digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


class CheckpointFolder:
    """The checkpoints of one run in one folder; the two newest are kept.

    `identity` is what the run is made from: stage, configuration, data fingerprint, as nested JSON-able mappings.
    """

    def __init__(self, folder: str | Path, identity: Mapping[str, object]) -> None:
        self.folder = Path(folder)
        self.identity = json.loads(json.dumps(identity))
        self.folder.mkdir(parents=True, exist_ok=True)

    def save(self, iteration: int, state: State) -> None:
        """Write the checkpoint of `iteration` atomically, then remove older ones but one, and any of a later iteration.

        Later ones can only be damaged: the run would have gone on from them.
        """
        stem = f"step-{iteration:08d}"
        data = tensor_bytes({name: tensor.detach().contiguous() for name, tensor in state.tensors.items()})
        body = {
            "schema": SCHEMA,
            "iteration": iteration,
            "identity": self.identity,
            "numbers": state.numbers,
            "tensors_sha256": hashlib.sha256(data).hexdigest(),
        }
        with atomic_file(self.folder / f"{stem}.safetensors") as path:
            path.write_bytes(data)
        with atomic_file(self.folder / f"{stem}.json") as path:
            path.write_text(json.dumps({"body": body, "sha256": _digest(body)}, indent=1))
        ahead = [path for path in self._newest_first() if path.stem > stem]
        for old in ahead + self._newest_first()[len(ahead) + KEPT :]:
            old.unlink(missing_ok=True)
            old.with_suffix(".safetensors").unlink(missing_ok=True)

    def load_newest(self) -> tuple[int, State] | None:
        """The newest checkpoint that is whole, as (iteration, state); None when there is none.

        Damaged checkpoints are passed over. Raises `InputError` when the newest whole one belongs to another run.
        """
        for path in self._newest_first():
            try:
                body, state = _read(path)
            except DataError:
                continue
            found = difference(body["identity"], self.identity)
            if found:
                raise InputError(
                    f"the checkpoint {path} was made with another {found}; give the run another "
                    "checkpoint folder, go back to what the checkpoint was made with, or delete the folder"
                )
            return int(body["iteration"]), state
        return None

    def sweep(self) -> None:
        """Remove what killed writers left: temporary files and tensors that have no JSON file."""
        remove_partials(self.folder, older_than=0.0)
        for path in self.folder.glob("step-*.safetensors"):
            if not path.with_suffix(".json").exists():
                path.unlink(missing_ok=True)

    def _newest_first(self) -> list[Path]:
        return sorted(self.folder.glob("step-*.json"), reverse=True)


def _read(path: Path) -> tuple[dict, State]:
    """The checked body and state of one checkpoint; raises `DataError` for any damage."""
    try:
        record = json.loads(path.read_bytes())
        body = record["body"]
        whole = record["sha256"] == _digest(body) and body["schema"] == SCHEMA
        data = path.with_suffix(".safetensors").read_bytes()
        if not whole or hashlib.sha256(data).hexdigest() != body["tensors_sha256"]:
            raise DataError(f"{path} is damaged: its checksum or schema does not match; delete it")
        return body, State(read_tensors(data), body["numbers"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError, SafetensorError) as error:
        raise DataError(f"{path} is not a readable checkpoint ({error}); delete it") from error


def _digest(body: object) -> str:
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()


@contextlib.contextmanager
def locked(folder: str | Path) -> Iterator[None]:
    """Hold a checkpoint folder for this process; `TrainingError` when another one does (`core.lock`)."""
    with lock.locked(folder, error=TrainingError, called="checkpoint folder"):
        yield
