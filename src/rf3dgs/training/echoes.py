"""Echoes: places off which the transmitter's wave reached a receiver in one bounce, out of spectra alone.

A pixel knows its direction of arrival u at the receiver q, the departure a at the transmitter p and the delay tau. If
its power came in one bounce, the ray from q along u and that from p along a meet at the bounce x, and

    c tau = |x - p| + |x - q|

After two bounces in one plane the rays may meet as well, but the way by their meeting is longer than the one that was
taken, or shorter where they meet before they bounce. Power of more bounces that is mixed in makes the mean delay
longer, leaves u as it is and hardly turns a: the place is that where the rays meet, and the delay, which may be a
little long, is the witness.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.units import SPEED_OF_LIGHT
from rf3dgs.spectra.spectrum import Spectrum

MISS = 0.01  # how far the two rays may pass each other, over their lengths' sum [rad]
EXCESS = (-0.1, 0.2)  # what the delay's way may lack or have over the way by the meeting [m]
CROSSING = 0.3  # least sine of the angle at which the rays meet
NEAREST = 0.2  # of a meeting to either end [m]
DETOUR = 0.3  # a way that is less longer than the straight one is the straight one [m]
FAINTEST = 1e-8  # of a spectrum's largest power
BEARING = 0.01  # [rad], one standard deviation


@dataclass(frozen=True, eq=False)
class Echoes:
    """Places `points` `[echo, 3]` [m] off which receivers `view` `[echo]`, rows of `receivers` `[view, 3]` [m], got an
    echo of the transmitter at `tx` `[3]`; `error` `[echo]` [m] is how far bearings of 0.6 degrees let them stray.
    """

    points: Tensor
    view: Tensor
    error: Tensor
    receivers: Tensor
    tx: Tensor

    def __len__(self) -> int:
        return len(self.points)

    def only(self, chosen: Tensor) -> "Echoes":
        """Some of them, by a mask or list."""
        return Echoes(self.points[chosen], self.view[chosen], self.error[chosen], self.receivers, self.tx)


@dataclass(frozen=True, eq=False)
class Spots:
    """Echoes merged by cubes: `points` `[spot, 3]` [m], unit `normals` `[spot, 3]` to the receivers, and how many
    `views` `[spot]` have an echo within two cubes' sides.
    """

    points: Tensor
    normals: Tensor
    views: Tensor

    def __len__(self) -> int:
        return len(self.points)


def echoes_of(spectra: Spectrum, tx: Tensor) -> Echoes:
    """The echoes in spectra `[position, row, col]` of the transmitter at `tx` `[3]` [m], as float32.

    Raises InputError for spectra without delay or departure, or without a list of positions.
    """
    if spectra.delay is None or spectra.aod is None:
        raise InputError(
            "echoes need spectra with delay and departure; these have none. Use ideal spectra, or paths with delays"
        )
    if len(spectra.pose.batch_shape) != 1:
        raise InputError(f"echoes need spectra at a list of positions; got batch {list(spectra.pose.batch_shape)}")
    tx = tx.double()
    parts = [_of_one(spectra[number], tx) for number in range(len(spectra))]
    view = torch.repeat_interleave(torch.arange(len(parts)), torch.tensor([len(part[0]) for part in parts]))
    points, error = (torch.cat(column).float() for column in zip(*parts, strict=True))
    return Echoes(points, view, error, spectra.pose.position, tx.float())


def _of_one(one: Spectrum, tx: Tensor) -> tuple[Tensor, Tensor]:
    """Places `[echo, 3]` and errors `[echo]` of one spectrum `[row, col]`, in float64."""
    assert one.delay is not None
    assert one.aod is not None
    power, way = one.power.double(), one.delay.double() * SPEED_OF_LIGHT
    arrival, departure = one.directions.double(), one.aod.double()
    usable = (
        (power > FAINTEST * power.max()) & torch.isfinite(way) & (torch.linalg.vector_norm(departure, dim=-1) > 0.5)
    )
    arrival, departure, way = arrival[usable], torch.nn.functional.normalize(departure[usable], dim=-1), way[usable]
    receiver = one.pose.position.double()
    straight = tx - receiver
    cosine = (arrival * departure).sum(-1)
    sine2 = (1 - cosine * cosine).clamp_min(1e-9)
    along_arrival, along_departure = arrival @ straight, departure @ straight
    near = (along_arrival - cosine * along_departure) / sine2
    far = (cosine * along_arrival - along_departure) / sine2
    last, first = receiver + near[:, None] * arrival, tx + far[:, None] * departure
    share = (far / (near + far))[:, None]  # the end that is nearer knows better
    point = share * last + (1 - share) * first
    miss = torch.linalg.vector_norm(last - first, dim=-1) / (near + far)
    excess = way - torch.linalg.vector_norm(point - tx, dim=-1) - torch.linalg.vector_norm(point - receiver, dim=-1)
    single = (near > NEAREST) & (far > NEAREST) & (sine2 > CROSSING**2) & (miss < MISS)
    single &= (excess > EXCESS[0]) & (excess < EXCESS[1]) & (way - torch.linalg.vector_norm(straight) > DETOUR)
    error = BEARING * torch.hypot(near, far) / sine2.sqrt()
    return point[single], error[single]


def merged(echoes: Echoes, size: float, neighbours: int = 24) -> Spots:
    """The echoes of each cube of `size` [m] as one, at the mean weighted by 1 / error^2.

    Normals are those of the plane through the nearest `neighbours`, towards the receiver that is nearest.
    """
    from scipy.sparse import coo_array
    from scipy.spatial import KDTree

    cube, place = torch.unique(torch.floor(echoes.points / size).long(), dim=0, return_inverse=True)
    weight = 1 / echoes.error.double().clamp_min(0.01) ** 2
    total = torch.zeros(len(cube), dtype=torch.float64).index_add_(0, place, weight)
    sums = torch.zeros(len(cube), 3, dtype=torch.float64).index_add_(0, place, weight[:, None] * echoes.points.double())
    points = (sums / total[:, None].clamp_min(1e-12)).float()
    tree = KDTree(points.numpy())
    near = torch.from_numpy(np.asarray(tree.query(points.numpy(), k=min(neighbours, len(points)))[1])).long()
    near = near.reshape(len(points), -1)
    spread = points[near] - points[near].mean(1, keepdim=True)
    normals = torch.linalg.eigh(spread.mT @ spread).eigenvectors[..., 0]
    towards = echoes.receivers[torch.cdist(points, echoes.receivers).argmin(-1)] - points
    behind = (normals * towards).sum(-1) < 0
    saw = coo_array((np.ones(len(place)), (place.numpy(), echoes.view.numpy())), (len(points), len(echoes.receivers)))
    beside = tree.query_pairs(2 * size, output_type="ndarray")
    beside = np.concatenate((beside, beside[:, ::-1], np.arange(len(points)).repeat(2).reshape(-1, 2)))
    link = coo_array((np.ones(len(beside)), tuple(beside.T)), (len(points), len(points))).tocsr()
    views = torch.from_numpy(np.asarray(((link @ saw.tocsr()) > 0).sum(1))).long()
    return Spots(points, torch.where(behind[:, None], -normals, normals), views)
