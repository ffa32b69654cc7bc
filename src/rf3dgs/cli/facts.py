"""Opening what a command names: fields, datasets, scenes; and the facts `rf3dgs info` prints about a file."""

from pathlib import Path
from typing import TYPE_CHECKING

from rf3dgs.core import manifest
from rf3dgs.core.errors import DataError, InputError

if TYPE_CHECKING:
    from torch import Tensor

    from rf3dgs.data.dataset import Dataset
    from rf3dgs.field.radio_field import RadioField
    from rf3dgs.propagation.sites.scene import Scene

ASSETS = Path(__file__).parent.parent / "assets"


def open_field(name: str | Path) -> "RadioField":
    """The field in a folder, or the shipped one for "lobby"."""
    from rf3dgs.field.radio_field import RadioField

    path = Path(name)
    if str(name) == "lobby" and not path.exists():
        path = ASSETS / "lobby.field"
    if not path.exists():
        raise InputError(f'there is no field {path}; train one with "rf3dgs fit DATASET --out {path}", or name "lobby"')
    return RadioField.load(path)


def open_dataset(name: str | Path, *, unseal_test: bool = False) -> "Dataset":
    """The dataset in a folder, or the shipped one for "lobby"; values in impossible units are refused."""
    from rf3dgs.data.dataset import Dataset
    from rf3dgs.data.formats.native import SPECTRA
    from rf3dgs.data.validate_spectra import check_units

    path = Path(name)
    if str(name) == "lobby" and not path.exists():
        path = ASSETS / "lobby"
    if not path.is_dir():
        raise InputError(f'there is no dataset folder {path}; make one with rf3dgs spectra, or name "lobby"')
    dataset = Dataset.load(path, unseal_test=unseal_test)
    if (path / SPECTRA).exists():
        check_units(path / SPECTRA)
    return dataset


def open_scene(name: str, people: int = 0) -> "Scene":
    """The built-in lobby with so many people, a scene that ships with Sionna RT, or a Sionna/Mitsuba XML file."""
    from rf3dgs.propagation.sites.scenes import scene_of

    if people == 0:
        return scene_of(name)
    if name not in ("lobby", "lobby-full"):
        raise InputError(f"--people stand in lobby and lobby-full only; got the scene {name!r}")
    from rf3dgs.propagation.sites.lobby import lobby

    return lobby("plain" if name == "lobby" else "full", people)


def facts_of(path: Path) -> dict[str, str]:
    """Names and values about a field, a dataset, a file or folder of paths, or a .ply."""
    if str(path) == "lobby" and not path.exists():
        return _field_facts("lobby")
    if not path.exists():
        raise InputError(f"{path}: there is no such file or folder")
    if (path / "field.json").exists():
        return _field_facts(path)
    if (path / manifest.NAME).exists() and manifest.load_manifest(path).schema == "rf3dgs.paths":
        return _paths_facts(path)
    if path.is_dir():
        return _dataset_facts(path)
    if path.suffix == ".ply":
        from rf3dgs.splats.ply import read_ply

        gaussians = read_ply(path)
        return {"kind": "Gaussians", "count": f"{len(gaussians):,}", "harmonics degree": str(gaussians.degree)}
    if path.suffix in (".paths", ".h5", ".hdf5"):
        return _paths_facts(path)
    raise DataError(f"{path}: expected a .field folder, a dataset folder, a file or folder of paths, or a .ply file")


def _field_facts(path: str | Path) -> dict[str, str]:
    field = open_field(path)
    meta = {name: str(value) for name, value in field.meta.items()}
    how = f", {meta.pop('transmitter')}" if "transmitter" in meta else ""
    low, high = (", ".join(f"{value:.2f}" for value in corner) for corner in field.bounds.tolist())
    facts = {
        "kind": "radio radiance field",
        "Gaussians": f"{len(field.surface):,}",
        "point sources": "0" if field.sources is None else str(len(field.sources)),
        "frequency": f"{field.frequency / 1e9:g} GHz",
        "transmitter": "(" + ", ".join(f"{value:.2f}" for value in field.tx.position.tolist()) + f") m{how}",
        "dB window": f"{field.window.floor_db:.1f} to {field.window.ceil_db:.1f} dB",
        "instrument": field.instrument.name,
        "encoding": field.surface.encoding,
        "trained between": f"({low}) and ({high}) m",
    }
    if field.sources is not None and field.sources.slabs is not None:
        facts["planes that are slabs"] = _slabs_of(field.sources.slabs)
    return facts | {name: value for name, value in meta.items() if name not in facts}


def _slabs_of(slabs: "Tensor") -> str:
    """The planes that were found to be slabs, by relative permittivity and thickness."""
    from rf3dgs.field.polarisation import METAL

    known = slabs[slabs[:, 1] < METAL[1]]
    return ", ".join(f"{1e3 * thick:.0f} mm of permittivity {eta:.1f}" for eta, _, thick in known.tolist()) or "none"


def _dataset_facts(path: Path) -> dict[str, str]:
    dataset = open_dataset(path)
    facts = {"kind": "dataset", "photographs": str(len(dataset.photos))}
    if dataset.roles:
        grid, tx = dataset.grid, dataset.tx
        roles = ", ".join(f"{dataset.roles.count(role)} {role}" for role in dict.fromkeys(dataset.roles))
        places = len(dataset.places.unique())
        facts |= {"positions": roles} if places == len(dataset.roles) else {"positions": str(places), "pictures": roles}
        facts |= {
            "grid": f"{grid.kind} {grid.width}x{grid.height}",
            "frequency": f"{dataset.frequency / 1e9:g} GHz",
            "transmitter": "unknown" if tx is None else str([round(value, 3) for value in tx.position.tolist()]),
        }
    return facts | {name: str(value) for name, value in dataset.meta.items()}


def _paths_facts(path: Path) -> dict[str, str]:
    from rf3dgs.channel.io import PathsReader

    with PathsReader(path) as reader:
        first = reader[0]
        return {
            "kind": "propagation paths",
            "receivers": str(len(reader)),
            "frequency": f"{first.frequency / 1e9:g} GHz",
            "transmitter": str([round(value, 3) for value in first.tx.position.tolist()]),
            "paths of the first receiver": f"{int(first.count.sum()):,}",
        }
