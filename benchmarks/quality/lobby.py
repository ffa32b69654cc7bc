"""What the report of `rf3dgs demo` does not show: the line of sight out of the field, and every held-out photograph.

    python -m benchmarks.quality.lobby out/demo

Reads the demo's geometry and field and the shipped lobby. The line of sight is compared with geometry at the validation
positions, with the transmitter given and estimated from the training spectra; the sealed test is not read.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import torch

from rf3dgs.cli.chain import photo_pairs
from rf3dgs.cli.facts import open_dataset
from rf3dgs.core.angles import angle_between
from rf3dgs.core.units import SPEED_OF_LIGHT
from rf3dgs.field.radio_field import RadioField
from rf3dgs.splats.image_loss import psnr
from rf3dgs.splats.ply import read_ply
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.radio import fit_radio


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("demo", type=Path, help="the folder that rf3dgs demo wrote")
    folder = parser.parse_args().demo
    dataset, geometry = open_dataset("lobby"), read_ply(folder / "geometry.ply")
    train, validation, tx = dataset.train.spectra, dataset.validation.spectra, dataset.tx
    assert train is not None
    assert validation is not None
    assert tx is not None
    given = RadioField.load(folder / "site.field")
    estimated = fit_radio(geometry, replace(train, tx=None), RadioConfig())
    print(f"transmitter estimated {1e3 * float((estimated.tx.position - tx.position).norm()):.2f} mm off")
    receiver = validation.pose.position.double()
    offset = tx.position.double() - receiver
    for name, field in (("given", given), ("estimated", estimated)):
        paths = field.paths(validation.pose, strongest=1)
        assert paths.order is not None
        seen = paths.order[:, 0] == 0
        delay = (paths.delay[:, 0].double() - offset.norm(dim=-1) / SPEED_OF_LIGHT)[seen].abs()
        arrival = torch.rad2deg(angle_between(paths.aoa[:, 0].double(), offset))[seen]
        worst = f"delay {1e12 * float(delay.max()):.3f} ps, arrival {float(arrival.max()):.5f} deg"
        print(f"transmitter {name}: line of sight at {int(seen.sum())} of {len(seen)} positions, at worst {worst}")
    held_out = [photo for photo, role in zip(dataset.photos, dataset.photo_roles, strict=True) if role == "test"]
    scores = []
    for pair in photo_pairs(geometry, held_out):
        scores.append(float(psnr(torch.as_tensor(pair.rendering), torch.as_tensor(pair.photo))))
        print(f"photograph {pair.name}: PSNR {scores[-1]:.2f} dB")
    print(f"mean of {len(scores)} held-out photographs: {sum(scores) / len(scores):.2f} dB, worst {min(scores):.2f} dB")


if __name__ == "__main__":
    main()
