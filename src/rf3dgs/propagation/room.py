"""A small exact tracer: a rectangular room with smooth walls, solved by images, in float64 and without a ray tracer.

The room reaches from the origin to `size`. A mirror image of the transmitter in cell n = (nx, ny, nz) of the tiling by
copies of the room has the coordinate n L + x for even n and (n + 1) L - x for odd n on each axis (Allen and Berkley,
1979) and stands for one path of |nx| + |ny| + |nz| reflections. The straight line from an image to the receiver,
folded back into the room, is that path; every image of a rectangular room is seen from every point of it. The field is
carried along as a vector, so that walls may reflect the two polarisations differently.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rf3dgs.channel.paths import Paths
from rf3dgs.core.angles import angles_of, direction_of
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.units import SPEED_OF_LIGHT, wavelength
from rf3dgs.propagation.fresnel import slab_coefficients
from rf3dgs.propagation.sites.materials import permittivity

WALLS = ("x low", "x high", "y low", "y high", "z low", "z high")
HIGHEST_ORDER = 60  # 295,241 images
THICKNESS = 0.1  # [m], of walls given by the name of their material, as of objects of a scene
_AT_ONCE = 2**21  # crossings of walls worked on at once


@dataclass(frozen=True)
class Slab:
    """A smooth wall: relative permittivity, conductivity [S/m], thickness [m]; behind it is air."""

    permittivity: float
    conductivity: float = 0.0
    thickness: float = math.inf

    def __post_init__(self) -> None:
        if not (self.permittivity >= 1 and self.conductivity >= 0 and self.thickness > 0):
            raise InputError(
                "a wall needs a relative permittivity of at least 1, a conductivity [S/m] that is not negative and a "
                f"positive thickness [m]; got {self.permittivity}, {self.conductivity} and {self.thickness}"
            )


Reflection = complex | str | Slab


def shoebox(
    size: Sequence[float],
    tx: Pose,
    rx: Pose,
    frequency: float,
    order: int = 3,
    reflection: Reflection | Sequence[Reflection] = -1.0,
    *,
    dtype: torch.dtype = torch.float32,
) -> Paths:
    """All paths `[*batch, path]` with at most `order` reflections in the room (0, 0, 0) to `size` [m], earliest first.

    reflection: one for all walls, or six in the order of `WALLS`. A number is the reflection coefficient of an ideal
        mirror (-1 a perfect conductor); a text is a material of ITU-R P.2040, 10 cm thick; a `Slab` is a wall of its
        own. There are (2 order + 1)(2 order^2 + 2 order + 3) / 3 images; paths of no power are not valid.
    rx: `[*batch]` poses. dtype: float32, or float64 for coefficients, delays and angles of full precision.
    The coefficient is that of a dual-polarised trace (see `Paths`): power = mean over transmit polarisations of the
    sum over receive polarisations, phase of vertical to vertical. InputError for positions outside the room or at the
    transmitter, orders above 60, coefficients above 1, and materials unknown at the frequency [Hz].
    """
    room = _room(size)
    walls = _walls(reflection, frequency)
    _check(room, tx, rx, frequency, order)
    images = _images(order)
    source = tx.position.double()
    receivers = rx.position.double().reshape(-1, 3)
    step = max(1, _AT_ONCE // (len(images) * 3 * max(order, 1)))
    parts = [_solve(room, source, part, images, walls, frequency) for part in receivers.split(step)]
    amplitude, delay, arrival, departure = (torch.cat(column) for column in zip(*parts, strict=True))
    hits = images.abs().sum(-1).expand(delay.shape)
    rank = delay.argsort(dim=-1, stable=True)
    shape = (*rx.batch_shape, len(images))

    def column(value: Tensor) -> Tensor:
        return value.gather(-1, rank).reshape(shape)

    aoa, aod = ([column(angle).to(dtype) for angle in angles_of(vector)] for vector in (arrival, departure))
    coeff = column(amplitude)
    return Paths(
        coeff=coeff.to(torch.complex128 if dtype == torch.float64 else torch.complex64),
        delay=column(delay).to(dtype),
        aoa_zenith=aoa[0],
        aoa_azimuth=aoa[1],
        aod_zenith=aod[0],
        aod_azimuth=aod[1],
        valid=coeff.abs() > 0,
        frequency=frequency,
        tx=tx,
        rx=rx,
        order=column(hits).to(torch.int8),
        kind=(column(hits) > 0).to(torch.int8),
    )


def slab_reflection(slab: Slab, cosine: Tensor, frequency: float) -> tuple[Tensor, Tensor]:
    """Reflection coefficients (TE, TM), complex128 `[*batch]`, at `cosine` of the angle of incidence `[*batch]`.

    See `slab_coefficients`.
    """
    numbers = torch.tensor([slab.permittivity, slab.conductivity, slab.thickness], dtype=torch.float64)
    return slab_coefficients(numbers, cosine, frequency)


def _images(order: int) -> Tensor:
    """Cells `[image, 3]` with at most `order` reflections."""
    axis = torch.arange(-order, order + 1)
    cells = torch.cartesian_prod(axis, axis, axis)
    return cells[cells.abs().sum(-1) <= order]


def _solve(
    room: Tensor, source: Tensor, receivers: Tensor, images: Tensor, walls: Sequence[complex | Slab], frequency: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Amplitudes and delays `[rx, image]`, arrivals and departures `[rx, image, 3]` (unit vectors, float64)."""
    odd = images % 2 == 1
    mirrored = torch.where(odd, (images + 1) * room - source, images * room + source)
    line = receivers[:, None] - mirrored
    distance = torch.linalg.vector_norm(line, dim=-1)
    final = line / distance[..., None]
    first = torch.where(odd, -final, final)
    hits = images.abs().sum(-1)
    wall = _walls_met(room, mirrored, line, images)
    coefficients = _coefficients(walls, final.abs(), frequency)
    field = torch.stack(_basis(first), -2).to(torch.complex128)
    direction = first
    for number in range(wall.shape[-1]):
        reflected, turned = _reflect(field, direction, wall[..., number], coefficients)
        field = torch.where((hits > number)[:, None, None], reflected, field)
        direction = torch.where((hits > number)[:, None], turned, direction)
    power = 0.5 * field.abs().square().sum((-1, -2))
    vertical = (field[..., 0, :] * _basis(-final)[0]).sum(-1)
    spread = wavelength(frequency) / (4 * math.pi * distance)
    return torch.polar(spread * power.sqrt(), vertical.angle()), distance / SPEED_OF_LIGHT, -final, first


def _walls_met(room: Tensor, mirrored: Tensor, line: Tensor, images: Tensor) -> Tensor:
    """Index into `WALLS` `[rx, image, order]` of each reflection, in the order from the transmitter; 0 beyond the last.

    The line from an image in cell n crosses |n| planes of its axis; plane m is the high wall for odd m.
    """
    order = int(images.abs().max())
    number = torch.arange(order)
    cell = images[..., None]
    plane = torch.where(cell > 0, cell - number, cell + 1 + number)
    share = (plane * room[:, None] - mirrored[..., None]) / line[..., None]
    share = torch.where(number < cell.abs(), share, math.inf)
    wall = 2 * torch.arange(3)[:, None] + plane % 2
    first = share.flatten(-2).argsort(dim=-1, stable=True)[..., :order]
    return wall.flatten(-2).expand(len(line), -1, -1).gather(-1, first)


def _coefficients(walls: Sequence[complex | Slab], cosine: Tensor, frequency: float) -> Tensor:
    """TE and TM `[rx, image, wall, 2]`; `cosine` `[rx, image, 3]` of the angle on the walls of each axis.

    One path meets all walls of an axis at the same angle. A number r turns the field into r times its mirror image.
    """
    pairs = []
    for index, wall in enumerate(walls):
        on_axis = cosine[..., index // 2]
        if isinstance(wall, Slab):
            pairs.append(torch.stack(slab_reflection(wall, on_axis, frequency), -1))
        else:
            pairs.append(torch.tensor([wall, -wall], dtype=torch.complex128).expand(*on_axis.shape, 2))
    return torch.stack(pairs, -2)


def _reflect(field: Tensor, direction: Tensor, wall: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """Fields `[rx, image, 2, 3]` and directions `[rx, image, 3]` after a reflection on `wall` `[rx, image]`."""
    axis = wall // 2
    normal = torch.eye(3, dtype=torch.float64)[axis]
    turned = direction - 2 * (direction * normal).sum(-1, keepdim=True) * normal
    te = torch.linalg.cross(direction, normal)
    length = torch.linalg.vector_norm(te, dim=-1, keepdim=True)
    beside = torch.eye(3, dtype=torch.float64)[(axis + 1) % 3]  # head-on, where every direction is as good
    te = torch.where(length > 1e-9, te / length.clamp_min(1e-9), beside)
    te_part = (field * te[..., None, :]).sum(-1)
    tm_part = (field * torch.linalg.cross(te, direction)[..., None, :]).sum(-1)
    pair = coefficients.gather(-2, wall[..., None, None].expand(*wall.shape, 1, 2))
    te_part, tm_part = te_part * pair[..., 0], tm_part * pair[..., 1]
    tm = torch.linalg.cross(te, turned)
    return te_part[..., None] * te[..., None, :] + tm_part[..., None] * tm[..., None, :], turned


def _basis(direction: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vectors of rising zenith (vertical polarisation) and of rising azimuth (horizontal), `[*batch, 3]`."""
    zenith, azimuth = angles_of(direction)
    level, right = torch.full_like(zenith, math.pi / 2), math.pi / 2
    return direction_of(zenith + right, azimuth), direction_of(level, azimuth + right)


def _room(size: Sequence[float]) -> Tensor:
    room = torch.as_tensor(size, dtype=torch.float64)
    if room.shape != (3,) or not bool((torch.isfinite(room) & (room > 0)).all()):
        raise InputError(f"size must be the three edges of the room, positive, in metres; got {size}")
    return room


def _walls(reflection: Reflection | Sequence[Reflection], frequency: float) -> list[complex | Slab]:
    given = [reflection] * 6 if isinstance(reflection, int | float | complex | str | Slab) else list(reflection)
    if len(given) != 6:
        raise InputError(f"reflection must be one for all walls or six ({', '.join(WALLS)}); got {len(given)}")
    walls: list[complex | Slab] = []
    for name, wall in zip(WALLS, given, strict=True):
        if isinstance(wall, str):
            walls.append(Slab(*permittivity(wall, frequency, owner=f"wall {name!r}"), THICKNESS))
        elif isinstance(wall, Slab):
            walls.append(wall)
        elif abs(wall) <= 1:
            walls.append(complex(wall))
        else:
            raise InputError(f"wall {name!r} must have a reflection coefficient of at most 1; got {wall}")
    return walls


def _check(room: Tensor, tx: Pose, rx: Pose, frequency: float, order: int) -> None:
    if not 1e8 <= frequency <= 1e12:
        raise InputError(f"frequency must be in hertz, between 100 MHz and 1 THz; got {frequency:g}")
    if not 0 <= order <= HIGHEST_ORDER:
        raise InputError(
            f"order must be between 0 and {HIGHEST_ORDER}, as the number of paths grows with its cube; got {order}"
        )
    if tx.batch_shape:
        raise InputError(f"tx must be one pose; got {list(tx.batch_shape)} of them")
    points = torch.cat((tx.position[None], rx.position.reshape(-1, 3)))
    for index, point in enumerate(points.double()):
        label = f"receiver {index - 1}" if index else "the transmitter"
        place = "(" + ", ".join(f"{value:g}" for value in point.tolist()) + ")"
        if not bool(((point > 0) & (point < room)).all()):
            raise InputError(
                f"{label} at {place} is outside the room, which reaches from the origin to {room.tolist()} metres; "
                "move it inside"
            )
        if index and float((point - points[0]).norm()) < 1e-3:
            raise InputError(f"{label} at {place} is at the transmitter; move it away")
