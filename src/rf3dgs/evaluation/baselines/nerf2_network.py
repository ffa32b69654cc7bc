"""NeRF2's two networks and its tracing: from rays to the signals that arrive along them.

Every point of space takes something from a wave that passes and sends a wave of its own. The attenuation network says
what it takes, the radiance network what it sends towards the receiver when the transmitter stands at a given place:
Zhao et al., "NeRF2: Neural Radio-Frequency Radiance Fields", MobiCom 2023, sections 3 and 4. Lengths in this file are
shares of the longest ray, so that no setting depends on the size of the site.
"""

import math

import torch
from torch import Tensor, nn

from rf3dgs.evaluation.baselines.nerf2_config import Nerf2Config


def encode(values: Tensor, octaves: int) -> Tensor:
    """Positional encoding `[*batch, 3 + 6 octaves]` of `[*batch, 3]`: x, sin(2^k pi x), cos(2^k pi x), k from 0."""
    scales = math.pi * 2.0 ** torch.arange(octaves, device=values.device)
    turns = (values[..., None, :] * scales[:, None]).flatten(-2)
    return torch.cat((values, torch.sin(turns), torch.cos(turns)), -1)


class Nerf2Network(nn.Module):
    """The attenuation network and, on top of its feature, the radiance network."""

    def __init__(self, config: Nerf2Config) -> None:
        super().__init__()
        self.octaves = config.position_octaves, config.direction_octaves
        point, direction = (3 + 6 * octaves for octaves in self.octaves)
        width, self.skip = config.width, config.depth // 2
        sizes = [point] + [width + point if layer == self.skip else width for layer in range(1, config.depth)]
        self.attenuation_layers = nn.ModuleList(nn.Linear(size, width) for size in sizes)
        self.attenuation = nn.Linear(width, 2)
        self.feature = nn.Linear(width, width)
        self.radiance_of_feature = nn.Linear(width, width)
        self.radiance_of_ray = nn.Linear(direction + point, width, bias=False)
        self.radiance_hidden = nn.Linear(width, width // 2)
        self.radiance = nn.Linear(width // 2, 2)

    def forward(self, points: Tensor, directions: Tensor, transmitter: Tensor) -> tuple[Tensor, Tensor]:
        """Attenuation and signal `[ray, sample]`, both complex, of points `[ray, sample, 3]`.

        attenuation: per length of the longest ray, decay [neper] and phase [rad] as real and imaginary part; decay is
        not negative. signal: what the point sends against `directions` `[ray, 3]`, the unit vectors from the receiver.
        transmitter `[3]`: where it stands, in the unit of the points.
        """
        code = encode(points, self.octaves[0])
        hidden = code
        for number, layer in enumerate(self.attenuation_layers):
            if number and number == self.skip:
                hidden = torch.cat((hidden, code), -1)
            hidden = torch.relu(layer(hidden))
        decay, phase = self.attenuation(hidden).unbind(-1)
        # Direction and transmitter are the same all along a ray, so their part of the layer's sum is made once a ray.
        towards = encode(directions, self.octaves[1])
        source = encode(transmitter, self.octaves[0]).expand(*towards.shape[:-1], -1)
        of_ray = self.radiance_of_ray(torch.cat((towards, source), -1))
        hidden = torch.relu(self.radiance_of_feature(self.feature(hidden)) + of_ray[:, None])
        signal = self.radiance(torch.relu(self.radiance_hidden(hidden)))
        return torch.complex(nn.functional.softplus(decay), phase), torch.view_as_complex(signal)


def received(attenuation: Tensor, signal: Tensor, step: float) -> Tensor:
    """The complex sum `[ray]` that arrives along each ray of `[ray, sample]` points, `step` apart.

    sum_n S_n exp(-sum_{m < n} delta_m step): each point's signal S_n, attenuated and turned by all points before it.
    """
    before = torch.cumsum(attenuation, -1) - attenuation
    return (signal * torch.exp(-step * before)).sum(-1)
