"""What an array that stands still receives from a transmitter that moves: a coherent field over its places.

The response of the elements q_m to a transmitter at p is a sum of waves and a rest,

    h_m(p) = sum_k c_k (D_k / |s_k(p) - q_m|) exp(-j kappa (|s_k(p) - q_m| - D_k)) + r_m(p),   kappa = 2 pi / lambda

s_0(p) = p is the transmitter itself, s_k(p) its mirror image in the plane half way between the mean place and the image
s_k, which is D_k from the array. r is a zero-mean complex Gaussian process, as diffuse fields are: its covariance is
`covariance` over the elements times Matern's kernel of order 3/2 over the distance between places. What it does not
know of a place adds to the power in every direction as much as the rest is known to have there. Pictures are each
divided by something; the logarithm of that is kriged too, over half the length, as it follows power.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rf3dgs.channel.arrays import PlanarArray
from rf3dgs.channel.response import manifold
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.core.units import wavelength

GAIN_LENGTH = 0.5  # of the kernel's own length
DIRECT = 1e-6  # [m] an image this near the mean place is the transmitter itself


@dataclass(frozen=True, eq=False)
class Waves:
    """The transmitter and its images as an array hears them.

    origin `[3]`: the mean place of the transmitter [m]. images `[source, 3]`: where each source is when the transmitter
    is there. amplitudes `[source]`: c, complex128. elements `[element, 3]`: q [m]. All float64, world frame.
    """

    origin: Tensor
    images: Tensor
    amplitudes: Tensor
    elements: Tensor
    wavelength: float

    def __len__(self) -> int:
        return len(self.images)

    def parts(self, places: Tensor) -> Tensor:
        """What each source would give for c = 1 `[source, place, element]` (complex128) at places `[place, 3]`."""
        link = self.images - self.origin
        length = torch.linalg.vector_norm(link, dim=-1, keepdim=True)
        normal = torch.where(length > DIRECT, link / length.clamp_min(DIRECT), torch.zeros_like(link))[:, None]
        middle = 0.5 * (self.images + self.origin)[:, None]
        moved = places - 2.0 * (normal * (places - middle)).sum(-1, keepdim=True) * normal
        distance = torch.linalg.vector_norm(moved[:, :, None] - self.elements, dim=-1)
        mean = torch.linalg.vector_norm(self.images - self.elements.mean(0), dim=-1)[:, None, None]
        return torch.polar(mean / distance, -2.0 * math.pi / self.wavelength * (distance - mean))

    def responses(self, places: Tensor) -> Tensor:
        """Their sum `[place, element]`, complex128."""
        if not len(self):
            return torch.zeros(len(places), len(self.elements), dtype=torch.complex128)
        return torch.einsum("k,kpm->pm", self.amplitudes, self.parts(places))

    def chosen(self, count: int) -> "Waves":
        """The first `count` sources."""
        return replace(self, images=self.images[:count], amplitudes=self.amplitudes[:count])


def element_places(pose: Pose, array: PlanarArray, frequency: float) -> Tensor:
    """Where the elements are `[element, 3]` [m], world frame, float64."""
    local = array.positions * wavelength(frequency)
    return pose.position.double() + local @ pose.world_from_device.double().mT


def kernel(first: Tensor, second: Tensor, length: float) -> Tensor:
    """Matern's kernel of order 3/2, `[n, m]`, of places `[n, 3]` and `[m, 3]`, `length` [m]; 1 at no distance."""
    distance = torch.cdist(first, second, compute_mode="donot_use_mm_for_euclid_dist") * (math.sqrt(3.0) / length)
    return (1.0 + distance) * torch.exp(-distance)


@dataclass(frozen=True, eq=False)
class GatewayField:
    """A fitted field: `responses` is complex, `render` gives amplitudes as measured pictures have them.

    places `[n, 3]`: where it was trained. weights `[n, element]`: K^-1 times the rest seen there. inverse `[n, n]`:
    K^-1, noise included. covariance `[element, element]` of the rest. gains `[n]`: likewise, of the logarithms of the
    pictures' gains. length [m] of the kernel.
    """

    pose: Pose
    array: PlanarArray
    waves: Waves
    places: Tensor
    weights: Tensor
    inverse: Tensor
    covariance: Tensor
    gains: Tensor
    length: float

    def responses(self, places: Tensor) -> Tensor:
        """The expected responses `[place, element]` (complex128) at transmitter places `[place, 3]` [m]."""
        places = _checked(places)
        return (
            self.waves.responses(places) + kernel(places, self.places, self.length).to(torch.complex128) @ self.weights
        )

    def of_sources(self) -> "GatewayField":
        """What the sources alone send: the same field without the rest."""
        nothing = (torch.zeros_like(self.weights), torch.zeros_like(self.covariance))
        return replace(self, weights=nothing[0], covariance=nothing[1])

    def doubt(self, places: Tensor) -> Tensor:
        """The share `[place]` of the rest's power that is not known there: about 0 at training places, 1 far away."""
        near = kernel(_checked(places), self.places, self.length)
        return (1.0 - ((near @ self.inverse) * near).sum(-1)).clamp(0.0, 1.0)

    def gain(self, places: Tensor) -> Tensor:
        """What a picture taken there would have been multiplied with `[place]`; 1 far from training places."""
        return torch.exp(kernel(_checked(places), self.places, GAIN_LENGTH * self.length) @ self.gains)

    def render(self, places: Tensor, grid: DirectionGrid) -> Tensor:
        """Amplitudes `[place, row, col]`, float32, towards the directions of `grid` (device frame).

        gain sqrt(|a^H h|^2 + doubt a^H R a): the root of the expected power, in the unit of the training pictures.
        """
        A = manifold(self.array, grid.directions.double().reshape(-1, 3)).conj()
        return self.seen(places, A).reshape(len(places), *grid.shape).float()

    def seen(self, places: Tensor, A: Tensor) -> Tensor:
        """The same `[place, direction]`, float64, for rows a(u)^H `[direction, element]`."""
        known = (self.responses(places) @ A.mT).abs().square()
        ambient = ((A @ self.covariance) * A.conj()).sum(-1).real.clamp_min(0.0)
        return self.gain(places)[:, None] * (known + self.doubt(places)[:, None] * ambient).sqrt()


def _checked(places: Tensor) -> Tensor:
    places = torch.as_tensor(places, dtype=torch.float64)
    if places.dim() != 2 or places.shape[-1] != 3:
        raise InputError(f"places must be [place, 3] in metres, the transmitter's; got {list(places.shape)}")
    return places
