"""Units, and progress that tells what is left."""

import io
import math

import pytest
import torch

from rf3dgs.core.progress import Console, Silent, duration, track
from rf3dgs.core.units import SPEED_OF_LIGHT, db_from_power, friis_gain, power_from_db, wavelength


def test_decibels_round_trip_and_zero_power_has_a_floor() -> None:
    power = torch.tensor([1e-14, 1.0, 250.0])
    torch.testing.assert_close(power_from_db(db_from_power(power)), power)
    assert float(db_from_power(torch.tensor(0.0))) == -300.0


def test_friis_gain_falls_by_six_decibels_per_doubling() -> None:
    near, far = friis_gain(torch.tensor(3.0), 60e9), friis_gain(torch.tensor(6.0), 60e9)
    assert float(near / far) == pytest.approx(4.0, rel=1e-5)
    assert float(near) == pytest.approx((SPEED_OF_LIGHT / 60e9 / (12 * math.pi)) ** 2, rel=1e-5)
    assert wavelength(SPEED_OF_LIGHT) == 1.0


def test_progress_without_a_terminal_writes_plain_lines_of_at_most_79_columns() -> None:
    stream = io.StringIO()
    console = Console(stream, plain_every=0.0)
    assert list(track(range(3), "tracing", 3, console)) == [0, 1, 2]
    lines = stream.getvalue().splitlines()
    assert lines[-1].startswith("tracing: 3/3 in")
    assert "2/3" in lines[1]
    assert all(len(line) < 80 and "\r" not in line for line in lines)


def test_silent_progress_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(track(range(2), "x", 2, Silent())) == [0, 1]
    assert capsys.readouterr().out == ""


def test_what_is_left_is_told_in_hours_where_it_takes_hours() -> None:
    assert [duration(seconds) for seconds in (0.4, 59.4, 59.6, 3599, 3600, 50_700)] == [
        "0 s",
        "59 s",
        "1 min 0 s",
        "59 min 59 s",
        "1 h 0 min",
        "14 h 5 min",
    ]
