import pytest
import torch
from safetensors.torch import save_file

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.evaluation.lpips import ENVIRONMENT, LEAST_SIDE, Lpips

# The feature networks as published, read off the papers' tables: a number is a convolution with that many outputs and
# side 3, a tuple (outputs, side, stride, padding) another one; each is followed by a ReLU. "pool" halves the picture,
# and features are compared behind the layers that are marked.
ALEX = ((64, 11, 4, 2), "compare", "pool", (192, 5, 1, 2), "compare", "pool", 384, "compare", 256, "compare", 256)
VGG = (64, 64, "compare", "pool", 128, 128, "compare", "pool", 256, 256, 256, "compare", "pool")
NETWORKS = {  # with the side of the pooling window, which moves by two pixels in both
    "alex": ((*ALEX, "compare"), 3),
    "vgg": ((*VGG, 512, 512, 512, "compare", "pool", 512, 512, 512, "compare"), 2),
}


def formula(weights, network: str, first: torch.Tensor, second: torch.Tensor) -> float:
    """Zhang et al. 2018, eq. 1, of pictures `[row, col, 3]`, in double precision, channel by channel."""
    layers, pool = NETWORKS[network]
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    names = sorted({int(name.split(".")[1]) for name in weights if name.startswith("features")})
    state = [(((2 * x - 1) - shift) / scale).permute(2, 0, 1)[None].double() for x in (first, second)]
    total, convolution, head = 0.0, iter(names), 0
    for layer in layers:
        if layer == "pool":
            state = [torch.nn.MaxPool2d(pool, 2)(x) for x in state]
        elif layer == "compare":
            a, b = (x[0] / ((x[0] ** 2).sum(0) ** 0.5 + 1e-10) for x in state)
            weight = weights[f"lin{head}.model.1.weight"].flatten().double()
            total += sum(float(weight[c] * ((a[c] - b[c]) ** 2).mean()) for c in range(len(weight)))
            head += 1
        else:
            outputs, side, stride, padding = (layer, 3, 1, 1) if isinstance(layer, int) else layer
            index = next(convolution)
            module = torch.nn.Conv2d(state[0].shape[1], outputs, side, stride, padding).double()
            module.load_state_dict({part: weights[f"features.{index}.{part}"] for part in ("weight", "bias")})
            with torch.no_grad():
                state = [torch.relu(module(x)) for x in state]
    assert head == 5
    assert next(convolution, None) is None
    return total


@pytest.mark.parametrize("network", ["alex", "vgg"])
@pytest.mark.parametrize("shape", [(64, 80), (50, 75)])
def test_lpips_is_the_published_formula(random_weights, network, shape):
    weights = random_weights(network)
    first, second = torch.rand(2, 1, *shape, 3, generator=torch.Generator().manual_seed(1))
    distance = float(Lpips(weights)(first, second)[0])
    assert distance > 0.1
    assert distance == pytest.approx(formula(weights, network, first[0], second[0]), abs=1e-5)
    assert float(Lpips(weights)(first, first)) == 0.0


def test_a_grey_picture_is_the_same_as_three_equal_channels(random_weights):
    lpips = Lpips(random_weights("alex"))
    first, second = torch.rand(2, 2, 64, 64, generator=torch.Generator().manual_seed(2))
    colour = [picture[..., None].expand(2, 64, 64, 3) for picture in (first, second)]
    torch.testing.assert_close(lpips(first, second), lpips(*colour))


def test_weights_come_from_two_files_or_from_the_environment(random_weights, tmp_path, monkeypatch):
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


def test_missing_and_foreign_weights_are_named(random_weights, tmp_path):
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


def test_pictures_of_other_sizes_and_too_small_ones_are_refused(random_weights):
    lpips = Lpips(random_weights("alex"))
    with pytest.raises(InputError, match="one size"):
        lpips(torch.zeros(1, 64, 64), torch.zeros(1, 64, 65))
    with pytest.raises(InputError, match="at least 32x32 pixels; got 80x31"):
        lpips(torch.zeros(1, 31, 80), torch.zeros(1, 31, 80))


@pytest.mark.parametrize("network", ["alex", "vgg"])
def test_the_smallest_picture_still_reaches_the_last_layer(random_weights, network):
    lpips = Lpips(random_weights(network))
    last = lpips.features(torch.zeros(1, 3, LEAST_SIDE, LEAST_SIDE))[-1]
    assert min(last.shape[-2:]) >= 1
