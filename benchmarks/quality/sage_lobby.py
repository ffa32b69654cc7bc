"""SAGE on traced channels of the lobby: which mirror paths it finds, which it misses, and what is in the way.

The built-in lobby is traced to random receivers that look at the transmitter, sounded over 1 GHz between 8x8 and 4x4
patches at 20 dB SNR. Mirror paths, the line of sight among them, are taken in the order in which the sounder hears
them, leaving out those within one resolution cell of a louder one. Found is a path with an estimate less than one cell
away in delay and in all direction cosines. Wanted are those that dominate: heard within 25 dB of everything that is
heard, and at least 6 dB above the diffuse power that a filter matched to the path lets through. What comes out where
one asks for more or for less is printed beside it.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from rf3dgs.channel.arrays import planar_array
from rf3dgs.channel.binning import DIFFUSE, bin_diffuse
from rf3dgs.channel.paths import Paths
from rf3dgs.channel.patterns import power_pattern
from rf3dgs.channel.sounding import Sounding, device_directions, seen
from rf3dgs.core.frames import Pose
from rf3dgs.core.units import db_from_power
from rf3dgs.propagation.config import TraceConfig
from rf3dgs.propagation.sounder import Sounder, sound
from rf3dgs.spectra.apertures import Aperture
from rf3dgs.spectra.sage import estimate_paths

LARGE = Sounder(points=256, array_rx=planar_array(8, 8, "patch"), array_tx=planar_array(4, 4, "patch"), snr_db=20.0)
WEAKEST_DB, STANDS_OUT_DB = -25.0, 6.0  # of all power heard, over the diffuse power let through
STRICTNESS = (-15.0, -20.0, -25.0, -30.0), (3.0, 6.0, 10.0)
LIMIT = 40  # paths that SAGE may report
SEED = 12  # of the receivers' positions
LATER = 4.0  # cells of delay
FAR = 99.0


def cells(paths: Paths, sounding: Sounding) -> Tensor:
    """Delay and direction cosines `[path, 5]` in resolution cells."""
    arrival, departure = device_directions(paths)
    theta = torch.cat((arrival[..., 1:], departure[..., 1:], paths.delay[..., None].double()), -1)
    return theta / Aperture.of(sounding).cell


@dataclass(frozen=True)
class Wanted:
    """A mirror path of the lobby, what is in its way, and how near the nearest estimate is."""

    position: int
    order: int
    share_db: float
    """Power heard over that of all paths, diffuse ones included [dB]."""
    over_db: float
    """Level over the diffuse power that a filter matched to the path lets through [dB]."""
    apart: float
    """Distance to the nearest louder mirror path [cells]."""
    away: float
    """Distance to the nearest estimate [cells]."""
    by_chance: float
    """The same, were all estimates `LATER` cells later than they are: how often is one near without meaning it?"""


def mirror_paths(paths: Paths, sounding: Sounding, found: Paths, position: int, most: int = 12) -> list[Wanted]:
    """The loudest resolvable mirror paths of one position `[path]`, line of sight included."""
    assert paths.kind is not None
    assert paths.order is not None
    array_rx, array_tx = sounding.array_rx, sounding.array_tx
    assert array_rx is not None
    assert array_tx is not None
    arrival, departure = device_directions(paths)
    in_view = seen(array_rx, sounding.fov_rx, arrival) & seen(array_tx, sounding.fov_tx, departure)
    element = power_pattern(array_rx.pattern, arrival) * power_pattern(array_tx.pattern, departure)
    heard, diffuse = paths.path_gain.double() * element, (paths.kind & DIFFUSE) != 0
    keep = in_view & ~diffuse
    place, estimate = cells(paths, sounding), cells(found, sounding)
    clutter = let_through(sounding, place[keep], place[diffuse], heard[diffuse])
    level, over = db_from_power(heard[keep]), db_from_power(heard[keep] / clutter)
    order, everything = paths.order[keep], db_from_power(heard[in_view].sum())
    apart, away = _distance(place[keep], place[keep]), _distance(place[keep], estimate)
    later = _distance(place[keep], estimate + torch.tensor([0.0, 0.0, 0.0, 0.0, LATER]))
    result = []
    for index in level.argsort(descending=True).tolist():
        louder = apart[index][level > level[index]]
        gap = float(louder.min()) if len(louder) else FAR
        if gap < 1.0:
            continue
        result.append(
            Wanted(
                position=position,
                order=int(order[index]),
                share_db=float(level[index] - everything),
                over_db=float(over[index]),
                apart=gap,
                away=float(away[index].min()),
                by_chance=float(later[index].min()),
            )
        )
        if len(result) == most:
            break
    return result


def wanted_of(row: list[Wanted], weakest: float = WEAKEST_DB, stands_out: float = STANDS_OUT_DB) -> list[Wanted]:
    """Those of one position that dominate: at least so much of all power heard, and so much over the diffuse [dB]."""
    return [path for path in row if path.share_db >= weakest and path.over_db >= stands_out]


def let_through(sounding: Sounding, place: Tensor, sources: Tensor, power: Tensor) -> Tensor:
    """Mean power `[path]` of incoherent `sources` at the output of filters matched to the waves at `place` [cells]."""
    aperture = Aperture.of(sounding)
    mine, total = aperture.waves(place * aperture.cell), torch.zeros(len(place), dtype=torch.float64)
    for part in torch.arange(len(sources)).split(4096):
        theirs = aperture.waves(sources[part] * aperture.cell)
        shares = [(a.conj() @ b.mT / a.shape[1]).abs().square() for a, b in zip(mine, theirs, strict=True)]
        total += (shares[0] * shares[1] * shares[2]) @ power[part]
    return total.clamp_min(1e-300)


def lobby_positions(count: int, seed: int = SEED, preset: str = "diffuse") -> Iterator[Paths]:
    """Traced paths `[path]` of random positions of the lobby under a preset, looking at the transmitter."""
    from rf3dgs.propagation.sionna import trace_each
    from rf3dgs.propagation.sites.lobby import lobby
    from rf3dgs.propagation.sites.presets import preset_of

    site, config = preset_of(preset).applied(lobby(), TraceConfig(rays=50_000))
    rx = Pose.look_at(site.receivers(count, seed=seed).position, site.tx.position)
    for row in trace_each(site, None, rx, config):
        yield bin_diffuse(row[0], cell=math.radians(3.0), delay_step=0.5 / LARGE.bandwidth)


def print_lobby(positions: int, seed: int, preset: str) -> None:
    """Sound the lobby, let SAGE read it, and print what was found and what was missed."""
    print(f"\nlobby, preset {preset}, {positions} positions of seed {seed}, up to {LIMIT} paths each\n")
    everything, spent = [], 0.0
    for position, paths in enumerate(lobby_positions(positions, seed, preset)):
        sounding = sound(paths, LARGE)
        started = time.process_time()
        estimate = estimate_paths(sounding, limit=LIMIT)
        spent += time.process_time() - started
        everything.append(mirror_paths(paths, sounding, estimate.paths, position))
        left = float(estimate.residual_power / estimate.noise_power)
        print(
            f"position {position}: {len(paths.delay)} paths, {estimate.paths.coeff.shape[-1]} found, "
            f"{int(estimate.sweeps)} sweeps, residual {left:.1f} x noise",
            flush=True,
        )
    print(f"CPU time of SAGE {spent / max(positions, 1):.1f} s a position")
    print_tables(everything)


def print_tables(everything: list[list[Wanted]]) -> None:
    """By strictness, by level and order, and the loudest missed; one list of mirror paths per position."""
    print(
        "\n| of all power heard [dB] | over diffuse [dB] | positions | all found | line of sight hidden | all found |",
        end="",
    )
    print(" paths | found | by chance |\n|---|---|---|---|---|---|---|---|---|")
    for weakest in STRICTNESS[0]:
        for stands_out in STRICTNESS[1]:
            _print_strictness(everything, weakest, stands_out)
    print("\n| of all power heard [dB] | over diffuse [dB] | order | paths | found | median error [cells] |")
    print("|---|---|---|---|---|---|")
    for shares in ((-10, 1), (-20, -10), (-25, -20), (-30, -25), (-40, -30), (-99, -40)):
        for overs in ((STANDS_OUT_DB, 999), (-999, STANDS_OUT_DB)):
            for order in range(4):
                group = [p for row in everything for p in row if shares[0] <= p.share_db < shares[1]]
                group = [p for p in group if overs[0] <= p.over_db < overs[1] and p.order == order]
                if group:
                    print(f"| {shares[0]} to {shares[1]} | {_over(overs)} | {order} | {_summary(group)} |")
    print("\nthe loudest missed\n")
    print("| position | order | of all [dB] | over diffuse [dB] | to louder mirror [cells] | to estimate [cells] |")
    print("|---|---|---|---|---|---|")
    missed = [path for row in everything for path in row if path.away >= 1.0]
    for path in sorted(missed, key=lambda path: -path.share_db)[:12]:
        print(
            f"| {path.position} | {path.order} | {path.share_db:.1f} | {path.over_db:.1f} | {path.apart:.1f} "
            f"| {path.away:.1f} |"
        )


def _print_strictness(everything: list[list[Wanted]], weakest: float, stands_out: float) -> None:
    """One line: positions with such mirror paths, how many of them have all found, with and without line of sight."""
    rows = [wanted_of(row, weakest, stands_out) for row in everything]
    rows = [row for row in rows if row]
    hidden = [row for row in rows if all(path.order > 0 for path in row)]
    whole, dark = (sum(all(path.away < 1.0 for path in row) for row in some) for some in (rows, hidden))
    paths = [path for row in rows for path in row]
    found, chance = (sum(getattr(path, name) < 1.0 for path in paths) for name in ("away", "by_chance"))
    mark = "**" if (weakest, stands_out) == (WEAKEST_DB, STANDS_OUT_DB) else ""
    share = f"{mark}{whole} ({100 * whole / max(len(rows), 1):.0f} %){mark}"
    print(
        f"| {weakest:.0f} | {stands_out:.0f} | {len(rows)} | {share} | {len(hidden)} | {dark} | {len(paths)} | {found} "
        f"| {chance} |"
    )


def _over(overs: tuple[float, float]) -> str:
    return f"at least {overs[0]:.0f}" if overs[1] > 100 else f"below {overs[1]:.0f}"


def _summary(group: list[Wanted]) -> str:
    found = torch.tensor([path.away for path in group if path.away < 1.0])
    return f"{len(group)} | {len(found)} | " + (f"{float(found.median()):.3f}" if len(found) else "-")


def _distance(first: Tensor, second: Tensor) -> Tensor:
    return (first[:, None] - second).abs().amax(-1) if len(second) else torch.full((len(first), 1), FAR)
