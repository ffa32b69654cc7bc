import pytest
import torch
from safetensors.torch import save_file

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.evaluation.lpips import ALEXNET, ENVIRONMENT, VGG16, Lpips

CHANNELS = {"alex": (64, 192, 384, 256, 256), "vgg": (64, 128, 256, 512, 512)}
LAYERS = {
    "alex": ((0, 3, 64, 11), (3, 64, 192, 5), (6, 192, 384, 3), (8, 384, 256, 3), (10, 256, 256, 3)),
    "vgg": (
        *((0, 3, 64, 3), (2, 64, 64, 3), (5, 64, 128, 3), (7, 128, 128, 3), (10, 128, 256, 3), (12, 256, 256, 3)),
        *((14, 256, 256, 3), (17, 256, 512, 3), (19, 512, 512, 3), (21, 512, 512, 3), (24, 512, 512, 3)),
        *((26, 512, 512, 3), (28, 512, 512, 3)),
    ),
}


def random_weights(network: str) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    weights = {}
    for index, inputs, outputs, size in LAYERS[network]:
        shape = (outputs, inputs, size, size)
        weights[f"features.{index}.weight"] = torch.randn(shape, generator=generator) * (2 / (inputs * size**2)) ** 0.5
        weights[f"features.{index}.bias"] = 0.1 * torch.randn(outputs, generator=generator)
    for head, channels in enumerate(CHANNELS[network]):
        weights[f"lin{head}.model.1.weight"] = torch.rand(1, channels, 1, 1, generator=generator)
    return weights


def formula(weights, network: str, first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """Zhang et al. 2018, eq. 1, written with torch.nn modules and loops."""
    from torch import nn

    layers: list[nn.Module] = []
    taps = []
    for step, index, stride, padding in {"alex": ALEXNET, "vgg": VGG16}[network]:
        if step == "conv":
            weight = weights[f"features.{index}.weight"]
            module = nn.Conv2d(weight.shape[1], weight.shape[0], weight.shape[2], stride, padding)
            module.load_state_dict({"weight": weight, "bias": weights[f"features.{index}.bias"]})
            layers += [module, nn.ReLU()]
        elif step == "pool":
            layers.append(nn.MaxPool2d(index, stride))
        else:
            taps.append(len(layers))
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])

    def features(picture):
        value = ((2 * picture - 1) - shift) / scale
        value = value.permute(2, 0, 1)[None]
        found = []
        for number, layer in enumerate(layers, start=1):
            value = layer(value)
            if number in taps:
                found.append(value[0] / (value[0].pow(2).sum(0).sqrt() + 1e-10))
        return found

    total = torch.zeros(())
    for head, (a, b) in enumerate(zip(features(first), features(second), strict=True)):
        weight = weights[f"lin{head}.model.1.weight"].reshape(-1)
        total = total + sum(weight[c] * (a[c] - b[c]).pow(2).mean() for c in range(len(weight)))
    return total


@pytest.mark.parametrize("network", ["alex", "vgg"])
def test_lpips_is_the_published_formula(network):
    weights = random_weights(network)
    generator = torch.Generator().manual_seed(1)
    first, second = torch.rand(2, 1, 64, 80, 3, generator=generator)
    distance = Lpips(weights)(first, second)
    with torch.no_grad():
        expected = formula(weights, network, first[0], second[0])
    torch.testing.assert_close(distance[0], expected, rtol=1e-4, atol=1e-6)
    assert float(Lpips(weights)(first, first)) == 0.0


def test_a_grey_picture_is_the_same_as_three_equal_channels():
    lpips = Lpips(random_weights("alex"))
    first, second = torch.rand(2, 2, 64, 64, generator=torch.Generator().manual_seed(2))
    colour = [picture[..., None].expand(2, 64, 64, 3) for picture in (first, second)]
    torch.testing.assert_close(lpips(first, second), lpips(*colour))


def test_weights_come_from_two_files_or_from_the_environment(tmp_path, monkeypatch):
    weights = random_weights("alex")
    heads = {name: value for name, value in weights.items() if name.startswith("lin")}
    backbone = {name: value for name, value in weights.items() if name.startswith("features")}
    save_file(backbone, tmp_path / "alexnet.safetensors")
    torch.save(heads, tmp_path / "heads.pth")
    monkeypatch.delenv(ENVIRONMENT, raising=False)
    assert Lpips.from_environment() is None
    monkeypatch.setenv(ENVIRONMENT, f"{tmp_path / 'alexnet.safetensors'}:{tmp_path / 'heads.pth'}")
    lpips = Lpips.from_environment()
    assert lpips is not None
    assert lpips.network == "alex"


def test_missing_and_foreign_weights_are_named(tmp_path):
    weights = random_weights("alex")
    with pytest.raises(InputError, match=r"LPIPS lacks lin0\.model\.1\.weight"):
        Lpips({name: value for name, value in weights.items() if not name.startswith("lin0")})
    with pytest.raises(InputError, match="features of AlexNet or VGG-16"):
        Lpips({"features.0.weight": torch.zeros(1)})
    with pytest.raises(DataError, match=r"nothing\.pth: no such file"):
        Lpips.load(tmp_path / "nothing.pth")
    (tmp_path / "broken.pth").write_bytes(b"not a state dict")
    with pytest.raises(DataError, match=r"broken\.pth: not a safetensors file or torch state dict"):
        Lpips.load(tmp_path / "broken.pth")


class Trap:
    def __reduce__(self):
        return (print, ("code ran",))


def test_a_file_that_would_run_code_is_refused(tmp_path, capsys):
    torch.save({"features.0.weight": Trap()}, tmp_path / "trap.pth")
    with pytest.raises(DataError, match=r"trap\.pth"):
        Lpips.load(tmp_path / "trap.pth")
    assert "code ran" not in capsys.readouterr().out


def test_pictures_of_other_sizes_are_refused():
    lpips = Lpips(random_weights("alex"))
    with pytest.raises(InputError, match="one size"):
        lpips(torch.zeros(1, 64, 64), torch.zeros(1, 64, 65))
    with pytest.raises(InputError, match="at least 64x64 pixels; got 80x32"):
        lpips(torch.zeros(1, 32, 80), torch.zeros(1, 32, 80))
