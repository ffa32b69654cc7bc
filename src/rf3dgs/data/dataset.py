"""`Dataset`: photographs of a site and radio spectra in it, split into train, validation and a sealed test."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError, SealedError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.data.part import Part, log_read, part_of
from rf3dgs.data.photo import Photo
from rf3dgs.data.split import (
    SEALED_ROLES,
    HoldOut,
    check_roles,
    every_kth,
    keep_fraction,
    places_of,
    protocol,
    split_positions,
)
from rf3dgs.spectra.spectrum import Spectrum

if TYPE_CHECKING:
    from rf3dgs.data.formats.spectra_codes import Precision


@dataclass(frozen=True, eq=False, init=False)
class Dataset:
    """Photographs and spectra of one site, with a role for each.

    photos: the pictures, or a folder of them in any layout that `read_photos` knows.
    spectra, repeat: see the properties; several spectra at one place (other orientations) are entries of their own.
        `repeat_index` `[n]` names the spectrum that each of `repeat` solves again with
        another seed and ray count (the ceiling of any prediction).
    roles: "train", "validation", "test", "region" (a held-out region), "buffer" (around it) or "unused" per spectrum;
        photo_roles: "train", "validation" or "test" per photo. Empty before `split`.
    meta: what made the data: "generator" (text), "seed", and anything else that JSON can hold.
    path: the folder it was loaded from or saved to.
    unseal_test: the caller says that the test may be read.
    """

    photos: tuple[Photo, ...]
    roles: tuple[str, ...]
    photo_roles: tuple[str, ...]
    meta: dict[str, Any]
    path: Path | None
    unseal_test: bool
    repeat_index: Tensor | None
    _spectra: Spectrum | None
    _repeat: Spectrum | None

    def __init__(
        self,
        photos: str | Path | Sequence[Photo] = (),
        spectra: Spectrum | None = None,
        *,
        repeat: Spectrum | None = None,
        repeat_index: Tensor | Sequence[int] | None = None,
        roles: Sequence[str] = (),
        photo_roles: Sequence[str] = (),
        meta: Mapping[str, Any] | None = None,
        path: str | Path | None = None,
        unseal_test: bool = False,
    ) -> None:
        if isinstance(photos, str | Path):
            from rf3dgs.data.formats.detect import read_photos

            photos = read_photos(photos).photos
        index = None if repeat_index is None else torch.as_tensor(repeat_index, dtype=torch.int64)
        fields = {
            "photos": tuple(photos),
            "roles": tuple(roles),
            "photo_roles": tuple(photo_roles),
            "meta": dict(meta or {}),
            "path": None if path is None else Path(path),
            "unseal_test": unseal_test,
            "repeat_index": index,
            "_spectra": spectra,
            "_repeat": repeat,
        }
        for name, value in fields.items():
            object.__setattr__(self, name, value)
        self._check()

    def _check(self) -> None:
        spectra, repeat, index = self._spectra, self._repeat, self.repeat_index
        if spectra is not None and len(spectra.pose.batch_shape) != 1:
            raise InputError(f"spectra must be [position, row, col]; got power {list(spectra.power.shape)}")
        if self.roles:
            if spectra is None:
                raise InputError("roles were given without spectra; give both or neither")
            check_roles(spectra.pose.position, self.roles)
        if self.photo_roles and len(self.photo_roles) != len(self.photos):
            raise InputError(f"expected one role per photo, {len(self.photos)}; got {len(self.photo_roles)}")
        unknown = sorted(set(self.photo_roles) - {"train", "validation", "test"})
        if unknown:
            raise InputError(f"photo roles must be train, validation or test; got {', '.join(unknown)}")
        if (repeat is None) != (index is None):
            raise InputError("repeat and repeat_index belong together; give both or neither")
        if repeat is None or index is None:
            return
        if spectra is None or len(index) != len(repeat):
            raise InputError(f"expected one repeat_index per repeated spectrum, {len(repeat)}; got {len(index)}")
        if len(index) and not (int(index.min()) >= 0 and int(index.max()) < len(spectra)):
            raise InputError(f"repeat_index must name spectra 0 to {len(spectra) - 1}; got up to {int(index.max())}")
        if not torch.allclose(repeat.pose.position, spectra.pose.position[index], atol=1e-3):
            raise InputError("repeat was not taken at the positions that repeat_index names; check the index")

    @classmethod
    def load(cls, path: str | Path, *, unseal_test: bool = False) -> "Dataset":
        """Open a dataset folder; DataError names what is damaged, unsafe, or in other units or another version.

        Values of spectra stay in the file until they are asked for, so that a dataset may be larger than memory.
        """
        from rf3dgs.data.formats.native import load_native

        return load_native(Path(path), unseal_test=unseal_test)

    def save(self, path: str | Path, *, precision: "Precision | None" = None) -> "Dataset":
        """Write the dataset folder `path` at once or not at all, pictures copied beside the spectra; returns it loaded.

        `precision`: a `Precision`, how finely spectra are stored (0.005 dB, 10 ps, 0.06 degrees when None).
        """
        from rf3dgs.data.formats.native import save_native

        save_native(self, Path(path), precision)
        return Dataset.load(path, unseal_test=self.unseal_test)

    def split(
        self,
        *,
        test: float = 0.15,
        validation: float = 0.1,
        region: float = 0.15,
        buffer: float = 0.3,
        seed: int = 0,
        photo_test_every: int = 8,
        unseal_test: bool | None = None,
    ) -> "Dataset":
        """The same data with roles from `split_positions` and every `photo_test_every`-th photo for testing.

        `unseal_test=True` opens `.test` and `.region`; otherwise they are read with `open_test("why")`.
        """
        roles: tuple[str, ...] = ()
        if self._spectra is not None:
            roles = split_positions(
                self._spectra.pose.position, test=test, validation=validation, region=region, buffer=buffer, seed=seed
            )
        how = {"test": test, "validation": validation, "region": region, "buffer": buffer, "seed": seed}
        return self._with(
            roles=roles,
            photo_roles=every_kth(len(self.photos), photo_test_every),
            meta=self.meta | {"split": how | {"photo_test_every": photo_test_every}},
            unseal_test=self.unseal_test if unseal_test is None else unseal_test,
        )

    def protocol(
        self,
        *,
        hold_out: HoldOut = "random",
        fraction: float = 1.0,
        buffer: float = 0.3,
        seed: int = 0,
        photo_test_every: int = 8,
    ) -> "Dataset":
        """The same data with the roles of the paper's protocol, a fifth of the places held out (`split.protocol`)."""
        how = {"hold_out": hold_out, "fraction": fraction, "buffer": buffer, "seed": seed}
        return self._with(
            roles=protocol(self.pose.position, hold_out=hold_out, fraction=fraction, buffer=buffer, seed=seed),
            photo_roles=every_kth(len(self.photos), photo_test_every),
            meta=self.meta | {"split": how | {"photo_test_every": photo_test_every}},
        )

    def with_fraction(self, fraction: float, *, seed: int | None = None) -> "Dataset":
        """The same split with the share `fraction` of its training places; smaller ones are part of larger ones.

        `seed` None takes that of the split.
        """
        if not self.roles:
            raise InputError("the dataset has not been split; call split(test=0.15, seed=0) first")
        if seed is None:
            how = self.meta.get("split")
            own = how.get("seed") if isinstance(how, dict) else None
            seed = own if isinstance(own, int) else 0
        return self._with(
            roles=keep_fraction(self.pose.position, self.roles, fraction, seed=seed),
            meta=self.meta | {"fraction": {"kept": fraction, "seed": seed}},
        )

    @property
    def train(self) -> Part:
        """What may be learned from."""
        return self._part("train")

    @property
    def validation(self) -> Part:
        """What choices are made on."""
        return self._part("validation")

    @property
    def test(self) -> Part:
        """Held-out positions drawn at random; SealedError unless made or loaded with `unseal_test=True`; logged."""
        return self._unsealed("test")

    @property
    def region(self) -> Part:
        """The held-out region; sealed as `test` is."""
        return self._unsealed("region")

    def open_test(self, reason: str, role: str = "test") -> Part:
        """The sealed "test" or "region", after a line with the reason in the log and in `test_reads.log`."""
        if role not in SEALED_ROLES:
            raise InputError(f"role must be one of {', '.join(SEALED_ROLES)}; got {role!r}")
        if not reason.strip():
            raise InputError("open_test needs the reason why the test is read, such as 'final evaluation'")
        part = self._part(role)
        log_read(self.path, role, reason)
        return part

    @property
    def spectra(self) -> Spectrum | None:
        """All spectra `[position, row, col]`; SealedError when some of them are a sealed test."""
        if not self.unseal_test and set(self.roles) & set(SEALED_ROLES):
            raise SealedError(
                "dataset.spectra includes the sealed test. Use dataset.train.spectra or dataset.validation.spectra, "
                "dataset.pose for all positions, or open_test('why')"
            )
        return self._spectra

    @property
    def repeat(self) -> Spectrum | None:
        """The second solve `[repeat, row, col]` of the spectra named by `repeat_index`; sealed as they are."""
        if self._repeat is not None and not self.unseal_test and set(self.roles) & set(SEALED_ROLES):
            raise SealedError("dataset.repeat includes the sealed test. Use the repeat of open_test('why')")
        return self._repeat

    @property
    def pose(self) -> Pose:
        """The receivers' poses `[position]`, of all roles."""
        return self._any().pose

    @property
    def grid(self) -> DirectionGrid:
        """The directions of every spectrum."""
        return self._any().grid

    @property
    def frequency(self) -> float:
        """The carrier of every spectrum [Hz]."""
        return self._any().frequency

    @property
    def tx(self) -> Pose | None:
        """The transmitter's pose, when known."""
        return self._any().tx

    @property
    def places(self) -> Tensor:
        """The number of the place `[position]` of each spectrum: spectra at one place (within 1 mm) have one number."""
        return torch.from_numpy(places_of(self.pose.position)[0].astype("int64"))

    def where(self, role: str) -> Tensor:
        """The places `[n]` of a role among the positions."""
        return torch.tensor([index for index, each in enumerate(self.roles) if each == role], dtype=torch.int64)

    def __repr__(self) -> str:
        count = 0 if self._spectra is None else len(self._spectra)
        roles = {role: self.roles.count(role) for role in dict.fromkeys(self.roles)}
        return f"Dataset({len(self.photos)} photos, {count} spectra, roles {roles})"

    def _any(self) -> Spectrum:
        if self._spectra is None:
            raise InputError("this dataset has photos only; give it spectra")
        return self._spectra

    def _with(self, **changes: Any) -> "Dataset":
        names = ("photos", "roles", "photo_roles", "meta", "path", "unseal_test", "repeat_index")
        values: dict[str, Any] = {name: getattr(self, name) for name in names}
        values |= {"spectra": self._spectra, "repeat": self._repeat}
        return Dataset(**(values | changes))

    def _unsealed(self, role: str) -> Part:
        if not self.unseal_test:
            raise SealedError(
                f"the {role} is sealed. Read it once, at the end: open_test('why', {role!r}), "
                "or load or split the dataset with unseal_test=True"
            )
        return self.open_test("unseal_test=True", role)

    def _part(self, role: str) -> Part:
        if not self.roles and (self._spectra is not None or not self.photo_roles):
            raise InputError("the dataset has not been split; call split(test=0.15, seed=0) first")
        photo_roles = self.photo_roles or ("train",) * len(self.photos)
        photos = tuple(photo for photo, each in zip(self.photos, photo_roles, strict=True) if each == role)
        return part_of(role, photos, self._spectra, self.where(role), self._repeat, self.repeat_index)
