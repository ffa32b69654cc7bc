"""`validate`: every fault of a dataset folder with its file and the remedy."""

import hashlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from rf3dgs.core.errors import DataError, RfError
from rf3dgs.data.formats import blender, colmap, nerfstudio, rf3dgs_v0
from rf3dgs.data.formats.detect import layout_of
from rf3dgs.data.formats.native import MANIFEST, PHOTOS, SPECTRA, check_sha256, load_native, read_manifest
from rf3dgs.data.photo import Photo
from rf3dgs.data.safe import read_json, read_picture
from rf3dgs.data.validate_spectra import spectra_faults


@dataclass(frozen=True)
class Fault:
    """What is wrong with `file` and how to mend it, each one sentence."""

    file: Path
    what: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.file}: {self.what}. {self.remedy}."


def validate(path: str | Path) -> list[Fault]:
    """Every fault found in a dataset folder, native or foreign; an empty list when it is sound.

    Nothing is changed. All pictures are decoded, all checksums compared, all point clouds parsed.
    """
    path = Path(path)
    layout = layout_of(path) if path.is_dir() else None
    if layout is None:
        what = "expected a dataset, COLMAP, nerfstudio, Blender or rf3dgs_v0 folder; found none of these"
        return [Fault(path, what, "Name the folder that holds dataset.json, transforms.json or sparse/0")]
    faults: list[Fault] = []
    if layout == "native":
        faults += _native(path)
    elif layout == "nerfstudio":
        folder = path if (path / nerfstudio.FILE_NAME).is_file() else path / PHOTOS
        faults += _transforms([folder / nerfstudio.FILE_NAME], folder)
    elif layout == "blender":
        faults += _transforms(list(blender.files_of(path).values()), None)
    else:
        faults += _colmap(path)
        if layout == "rf3dgs_v0":
            faults += _caught(path, partial(rf3dgs_v0.read_rf3dgs_v0_pictures, path), "Mend the index files")
    for file in sorted(path.rglob("*.ply")):
        faults += _caught(file, partial(_read_ply, file), "Export the point cloud again")
    return list(dict.fromkeys(faults))


def _native(path: Path) -> list[Fault]:
    file = path / MANIFEST
    found = list(_caught(file, partial(read_manifest, path), "Save the dataset again with this version of rf3dgs"))
    if found:
        return found
    manifest = read_manifest(path)
    for section, name in (("spectra", SPECTRA), ("photos", f"{PHOTOS}/{nerfstudio.FILE_NAME}")):
        entry = manifest.get(section)
        if isinstance(entry, dict):
            digest = str(entry.get("sha256"))
            found += _caught(path / name, partial(check_sha256, path / name, digest), "Save the dataset again")
    if isinstance(manifest.get("spectra"), dict):
        found += (Fault(path / SPECTRA, what, remedy) for what, remedy in spectra_faults(path / SPECTRA))
    photos = manifest.get("photos")
    if isinstance(photos, dict) and isinstance(photos.get("files"), dict):
        for name, digest in photos["files"].items():
            target = path / PHOTOS / Path(name).name
            found += _caught(target, partial(check_sha256, target, str(digest)), "Copy the picture again")
        found += _transforms([path / PHOTOS / nerfstudio.FILE_NAME], path / PHOTOS)
    return found or list(_caught(file, partial(load_native, path), "Save the dataset again"))


def _transforms(files: Sequence[Path], folder: Path | None) -> Iterator[Fault]:
    """Faults of nerfstudio and Blender files frame by frame; `folder` is searched for pictures that no frame names."""
    photos: list[Photo] = []
    broken = 0
    for file in files:
        found = list(_caught(file, lambda file=file: nerfstudio.frames_of(read_json(file), file), "Export it again"))
        yield from found
        if found:
            broken += 1
            continue
        content = read_json(file)
        for index, frame in enumerate(nerfstudio.frames_of(content, file)):
            try:
                photos.append(nerfstudio.photo_of_frame(content, frame, index, file))
            except (RfError, TypeError, ValueError) as error:
                broken += 1
                yield _fault(file, error, "Mend that frame or remove it and its picture")
    yield from _pictures(photos)
    if folder is not None and not broken:
        yield from _unnamed(files[0], folder, photos)


def _colmap(path: Path) -> Iterator[Fault]:
    folder = colmap.model_folder(path) or path
    faults = list(_caught(folder, partial(colmap.read_model, path), "Export the reconstruction again"))
    yield from faults
    if faults:
        return
    model = colmap.read_model(path)
    pictures = colmap.images_folder(path, model.folder)
    photos = []
    for record in model.images:
        try:
            photos.append(colmap.photo_of_record(model, record, pictures))
        except RfError as error:
            yield _fault(model.folder, error, "Mend that image's record or remove it")
    if not model.images:
        yield Fault(model.folder, "no image is registered", "Reconstruct again with pictures that overlap more")
    yield from _pictures(photos)
    if len(photos) == len(model.images):
        yield from _unnamed(model.folder, pictures, photos)


def _pictures(photos: Sequence[Photo]) -> Iterator[Fault]:
    """Faults of the pictures themselves: damage, a single colour, duplicates, mixed sizes."""
    seen: dict[bytes, Path] = {}
    for photo in photos:
        if photo.path is None:
            continue
        try:
            picture = read_picture(photo.path)
        except DataError as error:
            yield _fault(photo.path, error, "Copy the picture again or remove it and its camera")
            continue
        if picture.min() == picture.max():
            yield Fault(photo.path, "the picture shows a single colour", "Take or render it again, or remove it")
        digest = hashlib.sha256(picture.tobytes()).digest()
        if digest in seen:
            yield Fault(photo.path, f"the picture is a duplicate of {seen[digest].name}", "Remove one of the two")
        seen.setdefault(digest, photo.path)
    names = Counter(str(photo.path) for photo in photos)
    for name, count in names.items():
        if count > 1:
            yield Fault(Path(name), f"the picture has {count} cameras", "Keep one camera per picture")
    sizes = Counter((photo.camera.width, photo.camera.height) for photo in photos)
    if len(sizes) > 1:
        (usual, _), *rest = sizes.most_common()
        odd = next(photo for photo in photos if (photo.camera.width, photo.camera.height) != usual)
        what = f"mixed resolutions: {usual[0]}x{usual[1]} mostly, {sum(count for _, count in rest)} others"
        yield Fault(odd.path or Path(odd.name), what, "Bring all pictures to one size")
    yield from _one_place(photos)


def _one_place(photos: Sequence[Photo]) -> Iterator[Fault]:
    if len(photos) > 2:
        places = torch.stack([photo.camera.position for photo in photos])
        if bool((places - places[0]).abs().max() < 1e-9):
            what, remedy = "all cameras stand at one point", "Export the poses again; geometry needs several viewpoints"
            yield Fault(photos[0].path or Path(photos[0].name), what, remedy)


def _unnamed(file: Path, folder: Path, photos: Sequence[Photo]) -> Iterator[Fault]:
    known = {photo.path.resolve() for photo in photos if photo.path is not None}
    extra = [item for item in colmap.pictures_in(folder) if item.resolve() not in known]
    if extra:
        what = f"{len(known)} cameras but {len(known) + len(extra)} pictures; without a camera: {extra[0].name}"
        what += f" and {len(extra) - 1} more" if len(extra) > 1 else ""
        yield Fault(file, what, "Add their cameras or remove those pictures")


def _read_ply(file: Path) -> None:
    from rf3dgs.splats.ply import read_ply, read_point_cloud

    try:
        read_ply(file)
    except DataError:
        read_point_cloud(file)


def _caught(file: Path, work: Callable[[], object], remedy: str) -> Iterator[Fault]:
    """The fault of `work` when it raises one of the package's errors."""
    try:
        work()
    except RfError as error:
        yield _fault(file, error, remedy)


def _fault(file: Path, error: Exception, remedy: str) -> Fault:
    """A fault out of an error's message; a file that the message begins with is taken as the one at fault."""
    message = str(error).rstrip(".").removesuffix(remedy).rstrip(" .;")
    head, colon, rest = message.partition(": ")
    if colon and len(head) < 4096 and Path(head).exists():
        return Fault(Path(head), rest, remedy)
    return Fault(file, message, remedy)
