"""Paths traced by NVIDIA's Sionna RT on the CPU: line of sight, mirrors and diffuse reflections.

One receiver is traced at a time, which keeps memory flat. Rays pass through walls and bend round edges on request only.
A path's gain is the mean over two transmit polarisations (vertical, horizontal) of the power summed over both receive
polarisations; its phase is that of vertical to vertical.
"""

import math
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from rf3dgs.channel.binning import DIFFUSE, bin_diffuse, stack_paths
from rf3dgs.channel.paths import Paths
from rf3dgs.core.errors import InputError, MissingDependencyError, RfError
from rf3dgs.core.frames import Pose
from rf3dgs.core.progress import Progress, Silent
from rf3dgs.propagation.config import TraceConfig
from rf3dgs.propagation.llvm import mitsuba_variant, prepare
from rf3dgs.propagation.sites.scene import Scene
from rf3dgs.propagation.sites.scene_files import write_radio_scene

VARIANT = "llvm_ad_mono_polarized"


def trace(
    scene: Scene | str | Path,
    *,
    rx: Pose,
    tx: Pose | None = None,
    config: TraceConfig | None = None,
    frequency: float | None = None,
    progress: Progress | None = None,
) -> Paths:
    """The paths `[rx, path]` to each of the poses `rx`, diffuse ones merged by arrival cell and delay (bin_diffuse).

    scene: a `Scene`, the name of a built-in one ("lobby", "box", "simple_street_canyon", ...) or a Sionna/Mitsuba XML
    file. tx: the scene's own transmitter when absent. frequency [Hz] overrides the configuration's and the scene's.
    Raises as `trace_each` does.
    """
    config = TraceConfig() if config is None else config
    cell = math.radians(config.cell_deg)
    rows = trace_each(scene, tx, rx, config, progress, frequency=frequency)
    return stack_paths([bin_diffuse(row, cell=cell, delay_step=config.delay_step)[0] for row in rows])


def trace_each(
    scene: Scene | str | Path,
    tx: Pose | None,
    rx: Pose,
    config: TraceConfig | None = None,
    progress: Progress | None = None,
    *,
    frequency: float | None = None,
    indices: Sequence[int] | None = None,
    tracer: "Tracer | None" = None,
) -> Iterator[Paths]:
    """Yield all paths `[1, path]` to one receiver after the other, sorted by delay, then by angles.

    Receiver i uses the seed `config.seed + i`, or `config.seed + indices[i]` when `rx` is part of a longer list, so
    that a run may be cut in pieces. The same arguments give the same bits. What nothing reaches has zero paths.
    tracer: one that has loaded this scene at this frequency, which saves half a second per call.
    Raises InputError for a receiver outside the scene, inside an object or at the transmitter, and for materials that
    are not defined at the frequency; MissingDependencyError without sionna-rt or LLVM.
    """
    from rf3dgs.propagation.sites.scenes import scene_of

    config = TraceConfig() if config is None else config
    progress = Silent() if progress is None else progress
    scene = scene if isinstance(scene, Scene) else scene_of(scene)
    tx = scene.tx if tx is None else tx
    frequency = frequency or config.frequency or scene.frequency
    if tx.batch_shape or len(rx.batch_shape) != 1:
        raise InputError(f"tx must be one pose and rx a list [rx]; got {tx.batch_shape} and {rx.batch_shape}")
    numbers = list(range(len(rx)) if indices is None else indices)
    _check(scene, tx, rx, config, frequency, numbers)
    return _trace_each(scene, tx, rx, config, progress, frequency, numbers, tracer)


def _trace_each(
    scene: Scene,
    tx: Pose,
    rx: Pose,
    config: TraceConfig,
    progress: Progress,
    frequency: float,
    numbers: list[int],
    tracer: "Tracer | None",
) -> Iterator[Paths]:
    tracer = Tracer(scene, frequency, diffraction=config.diffraction) if tracer is None else tracer
    progress.start("tracing", len(rx))
    for done, number in enumerate(numbers):
        yield tracer.paths(tx, rx[done : done + 1], config, config.seed + number)
        progress.update(done + 1)
    progress.finish()


def import_sionna():
    """The package `sionna.rt`, with LLVM found first; raises MissingDependencyError when either is missing."""
    prepare()
    try:
        import mitsuba

        if mitsuba.variant() is None:
            mitsuba.set_variant(VARIANT)
        with mitsuba_variant(VARIANT):
            import sionna.rt
    except ImportError as error:
        raise MissingDependencyError(f"tracing needs sionna-rt ({error}): pip install 'rf3dgs[trace]'") from error
    return sionna.rt


class Tracer:
    """A scene loaded into Sionna RT, ready for one receiver after the other."""

    def __init__(self, scene: Scene, frequency: float, *, diffraction: bool = False) -> None:
        """Load `scene` at `frequency` [Hz]; with `diffraction` the meshes' edges are made known to Sionna."""
        self._rt = rt = import_sionna()
        self._frequency, self._has_edges = frequency, diffraction
        corners = "shared" if diffraction else "split"
        with mitsuba_variant(VARIANT), ExitStack() as stack:
            if scene.source is not None:
                self._scene = rt.load_scene(str(scene.source), merge_shapes=False)
                for item in scene.objects:
                    self._scene.objects[item.name].radio_material.scattering_coefficient = item.scattering
                self._tune(scene, frequency)
            else:
                folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="rf3dgs-"))
                path = write_radio_scene(scene, folder, frequency=frequency, corners=corners)
                self._scene = rt.load_scene(str(path), merge_shapes=False)
                self._scene.frequency = frequency
            for item in scene.objects:
                if item.alpha_r is not None:
                    lobe = rt.DirectivePattern(alpha_r=item.alpha_r)
                    self._scene.objects[item.name].radio_material.scattering_pattern = lobe
            array = rt.PlanarArray(
                num_rows=1, num_cols=1, vertical_spacing=0.5, horizontal_spacing=0.5, pattern="iso", polarization="VH"
            )
            self._scene.tx_array = self._scene.rx_array = array
            self._solver = rt.PathSolver(deterministic=True)

    def _tune(self, scene: Scene, frequency: float) -> None:
        """Set the frequency of a scene from a file, whose materials only Sionna knows."""
        try:
            self._scene.frequency = frequency
        except ValueError as error:
            raise InputError(
                f"scene {scene.name!r} has a material that is not defined at {frequency / 1e9:g} GHz ({error}); choose "
                "another frequency, or give the material its own permittivity in the XML"
            ) from error

    def paths(self, tx: Pose, rx: Pose, config: TraceConfig, seed: int) -> Paths:
        """All paths `[1, path]` to the one receiver `rx` `[1]`, sorted by delay, then by angles.

        Line of sight and mirrors are those of the first pass; the diffuse paths of all passes share their power.
        """
        if config.diffraction and not self._has_edges:
            raise InputError("this tracer was made without diffraction; make it with Tracer(..., diffraction=True)")
        scene, rt = self._scene, self._rt
        with mitsuba_variant(VARIANT):
            for name in [*scene.transmitters, *scene.receivers]:
                scene.remove(name)
            scene.add(rt.Transmitter("tx", position=tx.position.tolist()))
            scene.add(rt.Receiver("rx", position=rx.position[0].tolist()))
            passes = [self._solve(config, number, seed) for number in range(config.passes)]
        columns = [np.concatenate(parts) for parts in zip(*passes, strict=True)]
        return _paths(columns, self._frequency, tx, rx)

    def _solve(self, config: TraceConfig, number: int, seed: int) -> tuple[NDArray, ...]:
        """Amplitude, delay, four angles, order and kind `[path]` of the valid paths of pass `number`."""
        rays = config.rays + 1009 * number  # another count is another Fibonacci lattice
        # A ray leaves at most one candidate per bounce, and the line of sight is one more: this room is never filled.
        room = rays * max(config.depth, 1) + 10_000
        found = self._solver(
            self._scene,
            max_depth=config.depth,
            samples_per_src=rays,
            max_num_paths_per_src=room,
            synthetic_array=True,
            los=config.line_of_sight and number == 0,
            specular_reflection=config.specular,
            diffuse_reflection=config.diffuse,
            refraction=config.refraction,
            diffraction=config.diffraction,
            seed=seed + 1_000_003 * number,
        )
        valid = np.array(found.valid)[0, 0]
        if len(valid) >= room:
            raise RfError(f"the tracer's room for {room} paths is full, so paths may be missing; use fewer rays")
        kinds = np.array(found.interactions)
        kinds = kinds.reshape(kinds.shape[0], len(valid))
        order = (kinds > 0).sum(0)
        kind = np.bitwise_or.reduce(kinds, axis=0) if len(kinds) else np.zeros_like(order)
        scattered = (kind & DIFFUSE) > 0
        valid = valid & (scattered | (number == 0))
        real, imaginary = (np.array(part)[0, :, 0] for part in found.a)
        power = 0.5 * (real**2 + imaginary**2).sum((0, 1)) / np.where(scattered, config.passes, 1)
        amplitude = np.sqrt(power) * np.exp(1j * np.arctan2(imaginary[0, 0], real[0, 0]))
        angles = (np.array(part)[0, 0] for part in (found.theta_r, found.phi_r, found.theta_t, found.phi_t))
        return tuple(column[valid] for column in (amplitude, np.array(found.tau)[0, 0], *angles, order, kind))


def _paths(columns: list[NDArray], frequency: float, tx: Pose, rx: Pose) -> Paths:
    """Amplitude, delay, four angles, order and kind as sorted `Paths` `[1, path]`."""
    amplitude, delay, *angles, order, kind = columns
    rank = np.lexsort((np.abs(amplitude), kind, *angles[::-1], delay))

    def column(value: NDArray, dtype: torch.dtype) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(value[rank])).to(dtype)[None]

    zenith, azimuth, zenith_tx, azimuth_tx = (column(angle, torch.float32) for angle in angles)
    return Paths(
        coeff=column(amplitude, torch.complex64),
        delay=column(delay, torch.float32),
        aoa_zenith=zenith,
        aoa_azimuth=azimuth,
        aod_zenith=zenith_tx,
        aod_azimuth=azimuth_tx,
        valid=torch.ones(1, len(rank), dtype=torch.bool),
        frequency=frequency,
        tx=tx,
        rx=rx,
        order=column(order.astype(np.int64), torch.int64),
        kind=column(kind.astype(np.int64), torch.int64),
    )


def _check(scene: Scene, tx: Pose, rx: Pose, config: TraceConfig, frequency: float, numbers: Sequence[int]) -> None:
    """Refuse what cannot be traced, naming the receiver and what is in its way."""
    if config.rays < 1 or config.passes < 1 or config.depth < 0:
        raise InputError(
            f"rays and passes must be positive and depth not negative; "
            f"got {config.rays}, {config.passes} and {config.depth}"
        )
    if not 1e8 <= frequency <= 1e12:
        raise InputError(f"frequency must be in hertz, between 100 MHz and 1 THz; got {frequency:g}")
    if scene.source is None:
        scene.check_radio(frequency)
    for label, position in [
        ("the transmitter", tx.position),
        *((f"receiver {i}", p) for i, p in zip(numbers, rx.position, strict=True)),
    ]:
        place = "(" + ", ".join(f"{value:g}" for value in position.tolist()) + ")"
        occupant = scene.occupant(position)
        if occupant == "outside":
            raise InputError(
                f"{label} at {place} is outside the scene {scene.name!r}, which spans {scene.bounds[0]} to "
                f"{scene.bounds[1]} metres; are the positions in metres?"
            )
        if occupant is not None:
            raise InputError(f"{label} at {place} is inside the object {occupant!r}; move it into free space")
        if label != "the transmitter" and float((position - tx.position).norm()) < 1e-3:
            raise InputError(f"{label} at {place} is at the transmitter; move it away")
