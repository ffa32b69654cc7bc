"""The viewer in a real browser, headless."""

import shutil
import socket
import time
from collections.abc import Iterator

import numpy as np
import pytest
import torch

from rf3dgs.channel.paths import Paths
from rf3dgs.cli.facts import open_field
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.viewer.app import Viewer, rays, table


@pytest.fixture(scope="module")
def viewer() -> Iterator[Viewer]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    running = Viewer(open_field("lobby"), port=port)
    yield running
    running.stop()


def until(condition, seconds: float = 30.0) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.05)
    return False


def test_the_picture_follows_the_receiver(viewer: Viewer) -> None:
    assert until(lambda: viewer.drawn >= 1)
    before, drawn = viewer._picture.image.copy(), viewer.drawn
    viewer.move((9.0, 10.0, 1.2))
    assert until(lambda: viewer.drawn > drawn)
    assert not np.array_equal(before, viewer._picture.image)
    assert "dB |" in viewer._text.content


def test_a_position_that_cannot_be_drawn_does_not_end_the_viewer(viewer: Viewer, monkeypatch, caplog) -> None:
    class Broken:
        bounds = viewer.field.bounds

        def render(self, *_, **__):
            raise InputError("out of field")

    with monkeypatch.context() as patch:
        patch.setattr(viewer, "field", Broken())
        viewer.move((4.0, 4.0, 1.2))
        assert until(lambda: viewer._text.content == "**This position cannot be drawn:** out of field")
    assert "cannot be drawn" in caplog.text
    drawn = viewer.drawn
    viewer.move((5.0, 5.0, 1.2))
    assert until(lambda: viewer.drawn > drawn)


def test_it_listens_on_this_machine_only_and_says_when_a_port_is_taken(viewer: Viewer) -> None:
    assert viewer.url.startswith("http://127.0.0.1:")
    port = int(viewer.url.rsplit(":", 1)[1])
    with pytest.raises(InputError, match=f"port {port} on 127.0.0.1 cannot be used .*; choose another with --port"):
        Viewer(viewer.field, port=port)


def test_a_browser_shows_the_site(viewer: Viewer, tmp_path) -> None:
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium")
    assert chromium, "the project's set-up installs chromium"
    flags = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    flags += ["--ignore-gpu-blocklist", "--disable-background-networking", "--no-first-run"]
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium, args=flags)
        page = browser.new_page(viewport={"width": 1100, "height": 700})
        page.goto(viewer.url)
        page.get_by_text("Drag the blue receiver").wait_for(timeout=60_000)
        page.wait_for_timeout(4_000)
        picture = page.screenshot(path=tmp_path / "viewer.png")
        browser.close()
    from io import BytesIO

    from PIL import Image

    pixels = np.asarray(Image.open(BytesIO(picture)).convert("RGB")).astype(int)
    scene = pixels[100:600, 100:600]
    assert scene.std() > 10, "the 3D view is not blank"


def test_a_single_bounce_is_drawn_through_its_true_point() -> None:
    tx, rx, bounce = torch.tensor([0.0, 0.0, 2.0]), torch.tensor([6.0, 0.0, 1.0]), torch.tensor([3.0, 4.0, 1.5])
    from rf3dgs.core.angles import angles_of
    from rf3dgs.core.units import SPEED_OF_LIGHT

    arrivals = torch.stack((tx - rx, bounce - rx))
    departures = torch.stack((rx - tx, bounce - tx))
    lengths = torch.stack(((tx - rx).norm(), (bounce - rx).norm() + (bounce - tx).norm()))
    aoa, aod = angles_of(arrivals), angles_of(departures)
    paths = Paths(
        torch.tensor([1e-4, 1e-5]).to(torch.complex64),
        lengths / SPEED_OF_LIGHT,
        *aoa,
        *aod,
        torch.ones(2, dtype=torch.bool),
        60e9,
        Pose(tx),
        Pose(rx),
    )
    segments, levels = rays(paths, Pose(rx))
    assert segments.shape == (3, 2, 3)
    np.testing.assert_allclose(segments[0], torch.stack((rx, tx)).numpy(), atol=1e-4)
    np.testing.assert_allclose(segments[1, 1], bounce.numpy(), atol=1e-3)
    assert levels[0] == pytest.approx(1.0)
    assert levels[1] == pytest.approx(0.5, abs=1e-4)
    assert table(paths).count(" dB |") == 2
