"""Make the lobby that ships inside the package: its dataset and a field trained on it.

    python tools/build_assets.py              # trace, photograph, train: about half an hour on two cores
    python tools/build_assets.py --keep-data  # train again on the dataset that is there
    python tools/build_assets.py --photos     # photograph again, keep the spectra, do not train

Needs the extra `trace`. Everything is seeded; the sealed test positions are not read.
"""

import argparse
import tempfile
from pathlib import Path

from rf3dgs.cli.chain import HOLD_OUT_EVERY, make_dataset, photograph
from rf3dgs.cli.demo import Demo
from rf3dgs.cli.facts import ASSETS
from rf3dgs.cli.show import console, out
from rf3dgs.core.grids import equirect_grid
from rf3dgs.core.progress import Progress
from rf3dgs.data.dataset import Dataset
from rf3dgs.propagation.config import PhotoConfig, TraceConfig
from rf3dgs.propagation.sites.lobby import lobby
from rf3dgs.training.radio import fit_radio
from rf3dgs.training.visual import fit_geometry

PHOTO = PhotoConfig(samples=144, held_out_samples=512)


def photographed(folder: Path, demo: Demo, progress: Progress) -> Dataset:
    """The dataset in `folder` with new photographs; its spectra stay as they are."""
    old = Dataset.load(folder, unseal_test=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as temporary:
        photos = photograph(lobby(), demo.photos, demo.seed, PHOTO, Path(temporary), progress)
        new = Dataset(photos, old.spectra, repeat=old.repeat, repeat_index=old.repeat_index, meta=old.meta)
        return new.split(seed=demo.seed, photo_test_every=HOLD_OUT_EVERY).save(folder)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keep-data", action="store_true", help="train only")
    parser.add_argument("--only-data", action="store_true", help="trace and photograph only")
    parser.add_argument("--photos", action="store_true", help="photograph only, beside the spectra that are there")
    parser.add_argument("--to", type=Path, default=ASSETS, help="the folder to write")
    options = parser.parse_args()
    progress, demo = console(), Demo()
    folder = options.to / "lobby"
    if options.photos:
        dataset = photographed(folder, demo, progress)
    elif options.keep_data:
        dataset = Dataset.load(folder)
    else:
        dataset = make_dataset(
            lobby(),
            folder,
            equirect_grid(*demo.grid),
            receivers=demo.receivers,
            photos=demo.photos,
            trace=TraceConfig(passes=5),
            photo=PHOTO,
            seed=demo.seed,
            progress=progress,
        )
    out(f"{dataset}")
    if options.only_data or options.photos:
        return
    train = dataset.train
    assert train.spectra is not None
    geometry = fit_geometry(train.photos, demo.visual, progress=progress)
    fit_radio(geometry, train.spectra, demo.radio, progress=progress).save(options.to / "lobby.field")
    for path in (folder, options.to / "lobby.field"):
        size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
        out(f"{path.name}: {size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
