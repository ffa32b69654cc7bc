"""Laws of the table of measured spectra: what is trained on, and what lookups copy."""

from pathlib import Path

import pytest
import torch
from benchmarks.quality.rfid import MODELS, lookups, main, of_runs, random_folds, region_folds, scores_of
from PIL import Image

from rf3dgs.channel.arrays import planar_array
from rf3dgs.channel.response import manifold
from rf3dgs.core.frames import Pose
from rf3dgs.data.formats.gateway import GatewaySpectra, hemisphere_grid

GRID = hemisphere_grid(12, 36)
PLACES = 0.2 * torch.randn(40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


@pytest.fixture
def spectra() -> GatewaySpectra:
    amplitude = torch.rand(40, *GRID.shape, generator=torch.Generator().manual_seed(2))
    return GatewaySpectra(amplitude, GRID, PLACES, Pose((5.0, 0.0, 0.0)), planar_array(4, 4, "isotropic"), 915e6)


def test_every_place_is_judged_once_and_no_training_place_is_within_the_buffer() -> None:
    parts = region_folds(PLACES, 5, 0.05)
    assert sorted(torch.cat([test for _, test in parts]).tolist()) == list(range(40))
    for train, test in parts:
        assert len(train) > 0
        assert float(torch.cdist(PLACES[train], PLACES[test]).min()) > 0.05


def test_random_folds_train_on_all_that_they_do_not_judge() -> None:
    parts = random_folds(40, 5, 0)
    assert sorted(torch.cat([test for _, test in parts]).tolist()) == list(range(40))
    for train, test in parts:
        assert sorted(torch.cat((train, test)).tolist()) == list(range(40))
    assert [test.tolist() for _, test in random_folds(40, 5, 0)] == [test.tolist() for _, test in parts]


def test_lookups_at_a_training_place_copy_it_and_far_away_are_means(spectra: GatewaySpectra) -> None:
    at_home = lookups(spectra, PLACES[:2])
    for name in ("nearest", "idw4", "idw8"):
        assert torch.allclose(at_home[name], spectra.amplitude[:2], atol=1e-4)
    far = lookups(spectra, torch.tensor([[900.0, 0.0, 0.0]], dtype=torch.float64))
    assert torch.allclose(far["kriging"], far["mean"], atol=1e-6)
    assert set(far) | {"four sources", "field"} == set(MODELS)


def test_the_truth_scores_perfectly(spectra: GatewaySpectra) -> None:
    scores = scores_of(spectra.amplitude, spectra.amplitude, GRID)
    assert scores["psnr"].tolist() == [100.0] * 40
    assert torch.allclose(scores["ssim"], torch.ones(40), atol=1e-5)
    assert float(scores["peak"].max()) < 1e-4  # directions are float32


def test_runs_are_pictures_that_follow_each_other() -> None:
    means = of_runs(torch.arange(14.0))
    assert means.tolist() == [[3.0, 10.0]]


def test_the_command_judges_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grid, array = hemisphere_grid(), planar_array(4, 4, "isotropic", 0.49)
    (tmp_path / "spectrum").mkdir()
    info = "gateway1:\n  position: [5.0, 0.25, 0]\n  orientation: [0.5, -0.5, -0.5, 0.5]\n"
    (tmp_path / "gateway_info.yml").write_text(info)
    lines = ["name,x,y,z"]
    A = manifold(array, grid.directions.double()).conj()
    first, second = manifold(array, torch.tensor([[0.9, 0.1, 0.42], [0.8, -0.5, -0.33]], dtype=torch.float64))
    for index in range(24):
        amplitude = (A @ (first + 0.7 * second * torch.exp(torch.tensor(0.3j * index)))).abs()
        picture = (255 * amplitude / amplitude.max()).round().to(torch.uint8).numpy()
        Image.fromarray(picture).save(tmp_path / "spectrum" / f"{index}.png")
        lines.append(f"{index}.png,{0.01 * index:.2f},0,1")
    (tmp_path / "tx_pos.csv").write_text("\n".join(lines))
    out = tmp_path / "out"
    main([str(tmp_path), "--folds", "2", "--buffer", "0.015", "--splits", "region", "--out", str(out)])
    printed = capsys.readouterr().out
    assert "as read (x y z w)" in printed
    assert all(f"| {name} |" in printed for name in MODELS)
    assert (out / "region.png").read_bytes().startswith(b"\x89PNG")
