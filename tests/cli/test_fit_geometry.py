"""`rf3dgs fit-geometry --spectra`: geometry out of a dataset's spectra, and what is refused."""

import torch

from rf3dgs.cli.main import main
from rf3dgs.splats.ply import read_ply, write_ply
from rf3dgs.splats.surface import sample_mesh


def test_the_shipped_spectra_give_the_room(tmp_path):
    file = tmp_path / "radio.ply"
    assert main(["fit-geometry", "--spectra", "lobby", "--out", str(file)]) == 0
    low, high = torch.quantile(read_ply(file).means, torch.tensor([0.01, 0.99]), dim=0)
    assert torch.allclose(low, torch.tensor([0.0, 0.0, 0.0]), atol=0.25)  # the north wall comes out tilted by 3 degrees
    assert torch.allclose(high, torch.tensor([14.0, 15.0, 3.5]), atol=0.25)


def test_spectra_correct_a_ply(tmp_path):
    flat, file = tmp_path / "floor.ply", tmp_path / "corrected.ply"
    vertices = torch.tensor([[1.0, 1.0, 0.15], [9.0, 1.0, 0.15], [9.0, 9.0, 0.15], [1.0, 9.0, 0.15]])
    write_ply(flat, sample_mesh(vertices, torch.tensor([[0, 1, 2], [0, 2, 3]]), spacing=0.3))
    assert main(["fit-geometry", str(flat), "--spectra", "lobby", "--out", str(file)]) == 0
    found = read_ply(file).means
    assert len(found) > 20_000
    assert float(found[:700, 2].abs().max()) < 0.12  # the floor's own Gaussians come first


def test_geometry_has_one_source_beside_photographs(tmp_path, capsys):
    out = ("--out", str(tmp_path / "x.ply"))
    assert main(["fit-geometry", "--spectra", "lobby", "--mesh", "lobby", *out]) == 2
    assert "from --plan or from --spectra; got mesh and spectra" in " ".join(capsys.readouterr().err.split())
    assert main(["fit-geometry", *out]) == 2
    assert "got none of them" in " ".join(capsys.readouterr().err.split())
