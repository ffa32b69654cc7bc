"""The viewer: a field in a viser scene, a receiver to drag, its spectrum beside it, its strongest paths as rays.

It listens on 127.0.0.1 only, because whoever reaches it can read the site's geometry. The picture follows the receiver
from a thread of its own, which always draws the newest position and drops those in between.
"""

import logging
import socket
import threading
import time

import numpy as np
import torch

from rf3dgs.channel.paths import Paths
from rf3dgs.core.angles import angles_of
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid
from rf3dgs.core.units import SPEED_OF_LIGHT, db_from_power
from rf3dgs.evaluation.pictures import colour_range, coloured, spectrum_picture
from rf3dgs.field.radio_field import RadioField

HOST = "127.0.0.1"
GRID = equirect_grid(180, 90)
_log = logging.getLogger(__name__)


def view(field: RadioField, *, port: int = 8080, wait: bool = True) -> "Viewer":
    """Serve `field` on http://127.0.0.1:`port`, with `wait` until interrupted; InputError if the port is taken."""
    viewer = Viewer(field, port=port)
    if wait:
        viewer.wait()
    return viewer


class Viewer:
    """A running viewer; `position` `[3]` [m] is where the receiver stands, `stop` ends it."""

    def __init__(self, field: RadioField, *, port: int = 8080) -> None:
        import viser

        _check_port(port)
        self.field = field
        self._server = viser.ViserServer(host=HOST, port=port, label="rf3dgs", verbose=False)
        self.url = f"http://{HOST}:{self._server.get_port()}"
        self.position = self._start()
        self._colours = colour_range([field.render(Pose(self.position.tolist()), GRID, csi=False)])
        self.drawn = 0
        self._wanted = threading.Event()
        self._stopped = threading.Event()
        self._build()
        self._thread = threading.Thread(target=self._follow, name="rf3dgs-viewer", daemon=True)
        self._thread.start()
        self._wanted.set()

    def move(self, position: np.ndarray | tuple[float, float, float]) -> None:
        """Put the receiver somewhere; the picture follows."""
        low, high = self.field.bounds.numpy() + np.array([[-5.0], [5.0]])
        self.position = np.clip(np.asarray(position, dtype=float), low, high)
        self._wanted.set()

    def wait(self, seconds: float | None = None) -> None:
        """Serve for some seconds, or until interrupted; then stop."""
        try:
            self._stopped.wait(seconds)
        except KeyboardInterrupt:
            pass
        finally:
            self.stop()

    def stop(self) -> None:
        """End the server."""
        self._stopped.set()
        self._wanted.set()
        self._thread.join(timeout=10)
        self._server.stop()

    def _start(self) -> np.ndarray:
        return self.field.bounds.double().mean(0).numpy()

    def _build(self) -> None:
        field, scene, gui = self.field, self._server.scene, self._server.gui
        scene.set_up_direction("+z")
        tx = tuple(field.tx.position.tolist())
        scene.add_icosphere("/transmitter", radius=0.12, color=(230, 60, 40), position=tx)
        scene.add_label("/transmitter/label", "transmitter")
        self._handle = scene.add_transform_controls(
            "/receiver", scale=0.6, disable_rotations=True, position=tuple(self.position.tolist())
        )
        scene.add_icosphere("/receiver/ball", radius=0.1, color=(40, 110, 230))
        self._handle.on_update(lambda _event: self.move(self._handle.position))
        low, high = field.bounds.tolist()
        top = float(field.surface.means[:, 2].max())
        self._cut = gui.add_slider(
            "show below [m]",
            min=round(low[2], 1),
            max=round(max(top, high[2]) + 0.5, 1),
            step=0.1,
            initial_value=round(high[2] + 0.3, 1),
        )
        self._cut.on_update(lambda _event: self._show_site())
        self._show_site()
        centre = self._start()
        away = centre - np.array(tx)  # the first view is from above, towards the transmitter
        self._server.initial_camera.position = tuple(
            centre + 0.9 * np.array([away[0], away[1], 0.0]) + np.array([0.0, 0.0, 0.55 * (high[0] - low[0])])
        )
        self._server.initial_camera.look_at = tuple(centre)
        gui.configure_theme(control_width="large", show_logo=False)
        gui.add_markdown(
            "**Drag the blue receiver.** The picture is the whole sphere around it: the left edge is azimuth 180°, "
            f"the middle 0°, the top is up. Dark is {self._colours.floor_db:.0f} dB or less, "
            f"yellow {self._colours.ceil_db:.0f} dB or more."
        )
        blank = np.zeros((GRID.height, GRID.width, 3), dtype=np.uint8)
        self._picture = gui.add_image(blank, label="spectrum", format="png")
        self._strongest = gui.add_slider("paths", min=1, max=20, step=1, initial_value=8)
        self._strongest.on_update(lambda _event: self._wanted.set())
        self._text = gui.add_markdown("")

    def _show_site(self) -> None:
        """Draw the Gaussians below the cut, so that one looks into a room instead of at its ceiling."""
        field, surface = self.field, self.field.surface
        shown = torch.isfinite(surface.means).all(-1) & torch.isfinite(surface.log_scales).all(-1)
        shown &= surface.means[:, 2] < float(self._cut.value)
        rotation = Pose(torch.zeros(3), surface.quats[shown]).world_from_device
        stretched = rotation * surface.scales[shown][:, None, :]
        self._server.scene.add_gaussian_splats(
            "/site",
            centers=surface.means[shown].numpy(),
            covariances=(stretched @ stretched.mT).numpy(),
            rgbs=field.colour[shown].float().numpy() / 255.0,
            opacities=field.solidity[shown].reshape(-1, 1).numpy(),
        )

    def _follow(self) -> None:
        while True:
            self._wanted.wait()
            self._wanted.clear()
            if self._stopped.is_set():
                return
            try:
                self._draw(Pose(self.position.tolist()))
            except Exception as error:  # whatever is wrong here, the next position may be drawn again
                if not self._stopped.is_set():
                    _log.exception("the receiver at %s cannot be drawn", self.position)
                    self._text.content = f"**This position cannot be drawn:** {error}"

    def _draw(self, pose: Pose) -> None:
        began = time.perf_counter()
        spectrum = self.field.render(pose, GRID, csi=False)
        paths = self.field.paths(pose, strongest=int(self._strongest.value))
        spent = time.perf_counter() - began
        picture = spectrum_picture(spectrum, self._colours)
        self._picture.image = np.repeat(np.repeat(picture, 2, 0), 2, 1)
        points, levels = rays(paths, pose)
        if len(points):
            colours = np.repeat(coloured(levels)[:, None, :], 2, 1)
            self._server.scene.add_line_segments("/rays", points, colours, thickness=2.0, thickness_units="screen")
        else:
            self._server.scene.remove_by_name("/rays")
        outside = "" if bool(self.field.covers(pose)) else " **Outside the trained volume.**"
        self._text.content = f"{table(paths)}\n\n{1e3 * spent:.0f} ms.{outside}"
        self.drawn += 1


def rays(paths: Paths, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
    """Line segments `[n, 2, 3]` [m] of one receiver's paths, and their levels `[n]` in [0, 1] over 40 dB.

    The line of sight is one segment. Another path is drawn as if it bounced once: along its arrival to the point from
    which the transmitter is as far as the rest of c times its delay.
    """
    tx = paths.tx.position.double()
    points, levels = [], []
    gain_db = db_from_power(paths.path_gain)
    for index in paths.valid.nonzero().flatten().tolist():
        start = pose.position.double()
        arrival, length = paths.aoa[index].double(), float(paths.delay[index]) * SPEED_OF_LIGHT
        offset = start - tx
        slack = length**2 - float(offset @ offset)
        level = float((gain_db[index] - gain_db.max()) / 40.0 + 1.0)
        if slack < 1e-3 * length**2:
            segments = [(start, tx)]
        else:
            bounce = start + arrival * slack / (2 * (length + float(arrival @ offset)))
            segments = [(start, bounce), (bounce, tx)]
        points += [torch.stack(segment) for segment in segments]
        levels += [level] * len(segments)
    if not points:
        return np.zeros((0, 2, 3)), np.zeros(0)
    return torch.stack(points).numpy(), np.array(levels)


def table(paths: Paths) -> str:
    """The paths of one receiver as a Markdown table."""
    lines = ["| gain | delay | arrives | leaves |", "|---|---|---|---|"]
    gain_db = db_from_power(paths.path_gain)
    for index in paths.valid.nonzero().flatten().tolist():
        ends = []
        for vector in (paths.aoa[index], paths.aod[index]):
            zenith, azimuth = (float(torch.rad2deg(angle)) for angle in angles_of(vector))
            ends.append(f"{azimuth:.0f}°, {zenith:.0f}°")
        lines.append(
            f"| {float(gain_db[index]):.1f} dB | {1e9 * float(paths.delay[index]):.1f} ns | {' | '.join(ends)} |"
        )
    return "\n".join([*lines, "", "Angles are azimuth, zenith."])


def _check_port(port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except (OSError, OverflowError) as error:
            raise InputError(f"port {port} on {HOST} cannot be used ({error}); choose another with --port") from error
