"""Make the lobby that ships inside the package: its dataset and a field trained on it.

    python tools/build_assets.py              # trace, photograph, train: about half an hour on two cores
    python tools/build_assets.py --keep-data  # train again on the dataset that is there

Needs the extra `trace`. Everything is seeded; the sealed test positions are not read.
"""

import argparse
from pathlib import Path

from rf3dgs.cli.chain import make_dataset
from rf3dgs.cli.demo import Demo
from rf3dgs.cli.facts import ASSETS
from rf3dgs.cli.show import console, out
from rf3dgs.core.grids import equirect_grid
from rf3dgs.data.dataset import Dataset
from rf3dgs.propagation.config import PhotoConfig, TraceConfig
from rf3dgs.propagation.lobby import lobby
from rf3dgs.training.radio import fit_radio
from rf3dgs.training.visual import fit_geometry


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keep-data", action="store_true", help="train only")
    parser.add_argument("--only-data", action="store_true", help="trace and photograph only")
    parser.add_argument("--to", type=Path, default=ASSETS, help="the folder to write")
    options = parser.parse_args()
    progress, demo = console(), Demo()
    folder = options.to / "lobby"
    if options.keep_data:
        dataset = Dataset.load(folder)
    else:
        dataset = make_dataset(
            lobby(),
            folder,
            equirect_grid(*demo.grid),
            receivers=demo.receivers,
            photos=demo.photos,
            trace=TraceConfig(passes=5),
            photo=PhotoConfig(samples=128),
            seed=demo.seed,
            progress=progress,
        )
    out(f"{dataset}")
    if options.only_data:
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
