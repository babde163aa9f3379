"""How late and how far off a receiver is beside the estimator: found message by message."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from companion.cli.web_parts import watched as watched_by
from companion.core.frame import METRES_PER_DEGREE
from companion.core.types import Fix, GnssReport, Input, SpeedReport, Telemetry
from companion.receiver import ReceiverOffset, ReceiverWatch

LATITUDE_DEG = 50.0
EAST_M_PER_DEG = METRES_PER_DEGREE * math.cos(math.radians(LATITUDE_DEG))


def position(boot_s: float, east_m: float, east_m_s: float) -> Telemetry:
    return Telemetry(
        received_s=boot_s + 40.0,
        boot_s=boot_s,
        latitude_deg=LATITUDE_DEG,
        longitude_deg=7.0 + east_m / EAST_M_PER_DEG,
        relative_altitude_m=4.0,
        velocity_north_m_s=0.0,
        velocity_east_m_s=east_m_s,
        velocity_down_m_s=0.0,
        heading_deg=90.0,
    )


def fix(boot_s: float, east_m: float, north_m: float = 0.0) -> GnssReport:
    return GnssReport(
        received_s=boot_s + 40.1,
        fix=Fix.RTK_FIXED,
        boot_s=boot_s,
        latitude_deg=LATITUDE_DEG + north_m / METRES_PER_DEGREE,
        longitude_deg=7.0 + east_m / EAST_M_PER_DEG,
    )


def to_and_fro(late_s: float, north_m: float, *, from_s: float = 0.0) -> Iterator[Input]:
    """Yield what is heard of 8 m to and fro within 12 s, for half a minute."""
    for number in range(600):
        at_s = from_s + number / 20.0
        turn = at_s * 2.0 * math.pi / 12.0
        east_m_s = 8.0 * 2.0 * math.pi / 12.0 * math.cos(turn)
        yield position(at_s, 8.0 * math.sin(turn), east_m_s)
        if number % 4 == 2:
            then_s = at_s - 0.013
            late = (then_s - late_s) * 2.0 * math.pi / 12.0
            yield fix(then_s, 8.0 * math.sin(late), north_m)
            yield SpeedReport(received_s=at_s + 40.0, ground_speed_m_s=1.0)


def watched(*items: Input, watch: ReceiverWatch | None = None) -> ReceiverOffset | None:
    watch = watch or ReceiverWatch()
    for item in items:
        watch.take(item)
    return watch.offset


def test_in_motion_the_delay_is_found_beside_the_offset() -> None:
    found = watched(*to_and_fro(0.09, 0.2))
    assert found is not None
    assert found.late_s == pytest.approx(0.09, abs=0.002)
    assert found.off_m == pytest.approx(0.2, abs=0.01)
    assert not found.is_unusual


def test_a_vehicle_that_stands_has_an_offset_only() -> None:
    standing = [each for n in range(40) for each in (position(n / 10, 0, 0), fix(n / 10, 0.6))]
    found = watched(*standing)
    assert found is not None
    assert found.late_s is None
    assert found.off_m == pytest.approx(0.6, abs=0.001)
    assert found.is_unusual
    assert "0.60 m" in found.words
    assert "UNUSUAL" in found.words


def test_one_straight_line_does_not_tell_a_delay_from_an_offset() -> None:
    straight = [
        each
        for n in range(200)
        for each in (position(n / 10, n / 2, 5.0), fix(n / 10 + 0.03, n / 2))
    ]
    assert watched(*straight) is None


def test_what_cannot_be_compared_is_left_out() -> None:
    whole = watched(*to_and_fro(0.09, 0.2))
    assert whole is not None
    # A place without a stamp, a stamp without a place, a place without its velocity.
    odd: list[Input] = []
    for item in to_and_fro(0.09, 0.2):
        odd.append(item)
        if isinstance(item, GnssReport):
            odd += [replace(item, boot_s=None, longitude_deg=0.0), replace(item, latitude_deg=None)]
        if isinstance(item, Telemetry):
            odd.append(replace(item, velocity_east_m_s=None, longitude_deg=0.0))
    assert watched(*odd) == whole
    # Over a pause of the positions, and over a new start of the clock, nothing is compared.
    gap = [position(0.0, 0.0, 2.0), *(fix(n / 10, 1e3) for n in range(1, 20)), position(2, 4, 2)]
    assert watched(*gap) is None
    again = watched(*to_and_fro(0.09, 0.2), *to_and_fro(0.09, 0.2))
    assert again is not None
    assert again.late_s == pytest.approx(0.09, abs=0.002)


def test_in_flight_what_was_long_ago_is_forgotten() -> None:
    watch = ReceiverWatch(20.0)
    watched(*to_and_fro(0.09, 0.0), watch=watch)
    found = watched(*to_and_fro(0.09, 0.6, from_s=30.0), watch=watch)
    assert found is not None
    assert found.off_m == pytest.approx(0.6, abs=0.02)
    assert found.is_unusual


@pytest.mark.parametrize(
    ("late_s", "off_m", "is_rtk", "is_unusual"),
    [
        (0.08, 0.25, True, False),
        (0.01, 0.0, True, True),
        (0.3, 0.0, True, True),
        (-0.08, 0.0, True, True),
        (0.08, 0.4, True, True),
        (0.08, 0.4, False, False),
        (None, 0.6, False, True),
        (None, 0.2, True, False),
        (math.nan, 0.2, True, True),
        (0.08, math.nan, False, True),
    ],
)
def test_an_unusual_delay_or_offset_is_said(
    late_s: float | None, off_m: float, is_rtk: bool, is_unusual: bool
) -> None:
    found = ReceiverOffset(late_s=late_s, off_m=off_m, is_rtk=is_rtk)
    assert found.is_unusual is is_unusual
    assert ("UNUSUAL" in found.words) is is_unusual
    assert ("the delay the autopilot assumes" in found.words) is (late_s is not None)


def test_the_operators_page_is_told() -> None:
    page, journal, link = (SimpleNamespace() for _ in range(3))
    journal.record_input = lambda item: None
    journal.fault, journal.lost, journal.free_bytes, journal.saved_age_s = None, 0, None, 0.0
    journal.path = Path("flight-0001.gpkg")
    link.on_event = lambda call: None
    link.statistics = link.tank_l = None
    link.component = SimpleNamespace(clock=SimpleNamespace(is_known=True, round_trip_s=None))
    both = watched_by(page, journal, link)  # type: ignore[arg-type]
    assert page.extras()["receiver"] is None
    for item in to_and_fro(0.09, 0.6):
        both.record_input(item)
    told = page.extras()["receiver"]
    assert told == {"late_s": pytest.approx(0.09, abs=0.003), "off_m": 0.6, "is_usual": False}
