"""Times of a plan against those of the firmwares themselves, recorded beside their simulations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from missions.corners import LAGS_S, PX4_DRAG_S, PX4_TURNING_S, Motion, parts_s
from missions.energy import VERTICALS
from missions.plan import JERKS_M_S3, Leg, Settings, Sortie
from missions.stops import timed, waypoints_of
from sitl.vehicle import Leg as Flown
from sitl.vehicle import Route, Vehicle

Ways = Sequence[tuple[float, float]]


def zigzag(count: int, step_m: float, bend_deg: float) -> Ways:
    """Return 40 m north, so many steps that bend to and fro, and 40 m north again."""
    found, course = [(0.0, 10.0), (0.0, 50.0)], 0.0
    for number in range(count):
        course += bend_deg if number % 2 == 0 else -bend_deg
        east_m, north_m = found[-1]
        turned = math.radians(course)
        found.append((east_m - step_m * math.sin(turned), north_m + step_m * math.cos(turned)))
    return [*found, (found[-1][0], found[-1][1] + 40.0)]


def passes(length_m: float, aside_m: float, count: int) -> Ways:
    """Return passes to and fro."""
    found = []
    for number in range(count):
        ends = (10.0, 10.0 + length_m)[:: 1 if number % 2 == 0 else -1]
        found += [(number * aside_m, end) for end in ends]
    return found


# From the first waypoint reached to the last, in AUTO with AUTO_OPTIONS 3 and all else as it comes
# (WPNAV_ACCEL 250, WPNAV_JERK 1, WPNAV_RADIUS 200): ArduCopter 4.7, software in the loop.
FLOWN: dict[str, tuple[Ways, float, float]] = {
    "straight on, every 10 m": (zigzag(6, 10.0, 0.0), 5.0, 41.92),
    "straight on, every 3 m": (zigzag(8, 3.0, 0.0), 5.0, 41.42),
    "15 degrees every 12 m": (zigzag(6, 12.0, 15.0), 5.0, 42.98),
    "45 degrees every 15 m": (zigzag(6, 15.0, 45.0), 5.0, 44.38),
    "90 degrees every 8 m": (zigzag(6, 8.0, 90.0), 5.0, 40.78),
    "135 degrees every 20 m": (zigzag(6, 20.0, 135.0), 5.0, 50.76),
    "passes at 8 m/s": (passes(100.0, 6.0, 3), 8.0, 54.68),
    "passes at 3 m/s": (passes(50.0, 4.0, 3), 3.0, 59.92),
    "passes 30 m apart": ([*passes(100.0, 30.0, 2), (60.0, 10.0), (60.0, 40.0)], 5.0, 62.98),
}


def bends_deg(places: Ways) -> list[float]:
    courses = [math.degrees(math.atan2(b[0] - a[0], b[1] - a[1])) for a, b in pairwise(places)]
    return [abs((b - a + 180.0) % 360.0 - 180.0) for a, b in pairwise(courses)]


@pytest.mark.parametrize("name", FLOWN)
def test_a_way_takes_as_long_as_arducopter_took(name: str) -> None:
    places, speed_m_s, flown_s = FLOWN[name]
    motion = Settings(swath_width_m=6.0, speed_m_s=speed_m_s).motion
    whole = [(0.0, 0.0), *places]
    lengths_m = [math.dist(a, b) for a, b in pairwise(whole)]
    found = parts_s(
        lengths_m, bends_deg(whole), [motion.at(speed_m_s)] * len(lengths_m), "ardupilot"
    )
    # The first waypoint counts as reached midway through its corner.
    spared_s = motion.leg_s(lengths_m[1]) - found[1]
    assert sum(found[1:]) + spared_s / 2.0 == pytest.approx(flown_s, rel=0.025)


# The same ways, in MISSION with all parameters as they come: PX4 1.16, SIH quadrotor, five times as
# fast as the clock.
FLOWN_BY_PX4 = {
    "straight on, every 10 m": 31.14,
    "straight on, every 3 m": 31.08,
    "15 degrees every 12 m": 33.56,
    "45 degrees every 15 m": 46.34,
    "90 degrees every 8 m": 39.56,
    "135 degrees every 20 m": 65.48,
    "passes at 8 m/s": 61.24,
    "passes at 3 m/s": 63.10,
    "passes 30 m apart": 76.47,
}


# A zigzag of square corners, none of which the speed is reached between: no way of a field.
LONGER = {"90 degrees every 8 m": 0.11}


def turns_deg(places: Ways) -> list[float]:
    courses = [math.degrees(math.atan2(b[0] - a[0], b[1] - a[1])) for a, b in pairwise(places)]
    return [(b - a + 180.0) % 360.0 - 180.0 for a, b in pairwise(courses)]


@pytest.mark.parametrize("name", FLOWN_BY_PX4)
def test_a_way_takes_as_long_as_px4_took(name: str) -> None:
    places, speed_m_s, _ = FLOWN[name]
    motion = Settings(swath_width_m=6.0, speed_m_s=speed_m_s, autopilot="px4").motion
    whole = [(0.0, 0.0), *places]
    lengths_m = [math.dist(a, b) for a, b in pairwise(whole)]
    courses = [motion.at(speed_m_s)] * len(lengths_m)
    found = parts_s(lengths_m, turns_deg(whole), courses, "px4")
    # A waypoint counts as reached where the next leg begins: 2 m before it.
    assert -0.02 <= sum(found[1:]) / FLOWN_BY_PX4[name] - 1.0 <= LONGER.get(name, 0.05)


@pytest.mark.parametrize("name", FLOWN)
@pytest.mark.parametrize("corners", ["ardupilot", "px4"])
def test_the_twin_takes_as_long_by_a_law_of_its_own(
    corners: Literal["ardupilot", "px4"], name: str
) -> None:
    places, speed_m_s, flown_s = FLOWN[name]
    legs = [Flown(east_m=east, north_m=north, speed_m_s=speed_m_s) for east, north in places]
    route = Route(start_east_m=0.0, start_north_m=0.0, legs=tuple(legs))
    path = Vehicle(
        route, start_s=0.0, seed=1, corners=corners,
        acceleration_m_s2=2.5 if corners == "ardupilot" else 3.0,
    ).fly_to_end()  # fmt: skip
    begins = int(np.searchsorted(path.leg, 1))
    last_m = np.hypot(path.east_m - places[-1][0], path.north_m - places[-1][1])
    ends = len(path.leg) - 1
    if corners == "px4":
        # Its last waypoint counts as reached within the radius, before it stands.
        flown_s = FLOWN_BY_PX4[name]
        ends = int(np.flatnonzero((last_m < 2.0) & (path.leg == len(legs) - 1))[0])
    assert path.time_s[ends] - path.time_s[begins] == pytest.approx(flown_s, rel=0.035)


def test_px4_from_the_last_waypoint_to_disarmed() -> None:
    # Flown from 61 and 116 m away, 3.5 m high: 62.6 and 77.8 s; it returns at 30 m.
    settings = Settings(swath_width_m=6.0, speed_m_s=5.0, autopilot="px4")
    course = settings.motion.at(5.0)
    # From 4 m away it lands without climbing: 17.2 s.
    assert settings.vertical.return_s(3.5, 4.0) == pytest.approx(17.2, abs=4.0)
    for away_m, flown_s in ((61.0, 62.6), (116.0, 77.8)):
        (home_s,) = parts_s([away_m], [], [course], "px4")
        assert settings.vertical.return_s(3.5) + home_s == pytest.approx(flown_s, rel=0.08)


@pytest.mark.parametrize("rule", ["stop", "ardupilot", "px4"])
@given(
    lengths_m=st.lists(st.floats(0.7, 400.0), min_size=1, max_size=12),
    bends=st.lists(st.floats(0.0, 180.0), min_size=12, max_size=12),
    speed_m_s=st.floats(1.0, 12.0), jerk_m_s3=st.one_of(st.none(), st.floats(0.5, 20.0)),
)  # fmt: skip
def test_no_way_is_flown_faster_than_its_speed_nor_slower_than_from_rest_to_rest(
    rule: str, lengths_m: list[float], bends: list[float], speed_m_s: float,
    jerk_m_s3: float | None,
) -> None:  # fmt: skip
    motion = Motion(speed_m_s=speed_m_s, acceleration_m_s2=2.5, jerk_m_s3=jerk_m_s3, corners=rule)  # type: ignore[arg-type]
    courses = [motion.at(speed_m_s)] * len(lengths_m)
    found = parts_s(lengths_m, bends[: len(lengths_m) - 1], courses, motion.corners)
    rest_s = motion.legs_s(np.array(lengths_m))
    assert all(part_s > 0.0 for part_s in found)
    # Two speedings up of one leg may overlap with its neighbours, but no metre is flown twice as
    # fast.
    assert sum(found) >= sum(lengths_m) / speed_m_s - 1e-6
    # Corners flown late; behind PX4's the drag is learnt anew, at most from the opposite course.
    # With less jerk than it comes with it brakes much longer than it speeds up.
    late_s = 2.0 * PX4_DRAG_S + PX4_TURNING_S if rule == "px4" else LAGS_S
    if rule != "px4" or jerk_m_s3 is None or jerk_m_s3 >= JERKS_M_S3["px4"]:
        assert sum(found) <= float(rest_s.sum()) + late_s * len(lengths_m) + 1e-6


@given(lengths_m=st.lists(st.floats(0.5, 300.0), min_size=2, max_size=40))
def test_lines_in_a_row_never_spare_more_than_they_take(lengths_m: list[float]) -> None:
    lengths = np.array(lengths_m)
    for autopilot in ("ardupilot", "px4"):
        motion = Settings(swath_width_m=6.0, speed_m_s=6.0, autopilot=autopilot).motion  # type: ignore[arg-type]
        spared_s = motion.spared_straight_s(lengths[:-1], lengths[1:])
        whole_s = float(motion.legs_s(lengths).sum() - spared_s.sum())
        assert whole_s >= lengths.sum() / 6.0 - 1e-6


def test_an_outline_of_a_point_a_metre_is_not_flown_in_no_time() -> None:
    around = [(30.0 * math.cos(a), 30.0 * math.sin(a)) for a in np.linspace(0.0, 6.28, 190)]
    lines = [Leg(kind="spray", points=pair, speed_m_s=6.0) for pair in pairwise(around)]
    legs = [
        Leg(kind="ferry", points=((60.0, 0.0), around[0]), speed_m_s=6.0), *lines,
        Leg(kind="ferry", points=(around[-1], (60.0, 0.0)), speed_m_s=6.0),
    ]  # fmt: skip
    settings = Settings(swath_width_m=6.0, speed_m_s=6.0)
    (found,) = timed([Sortie(number=1, depot=0, legs=tuple(legs))], settings)
    around_m = sum(line.length_m for line in lines)
    spraying_s = sum(leg.seconds for leg in found.legs if leg.kind == "spray")
    # ArduCopter creeps from one to the next: straight on every 3 m, it flew 1.2 m/s.
    assert spraying_s > around_m / 1.6


@pytest.mark.parametrize("through", [True, False])
def test_ends_of_lines_that_are_one_waypoint_take_no_stop(through: bool) -> None:
    def border(gap_m: float) -> float:
        half = (100.0 + gap_m, 0.0)
        legs = (
            Leg(kind="ferry", points=((0.0, -50.0), (0.0, 0.0)), speed_m_s=5.0),
            Leg(kind="spray", points=((0.0, 0.0), (100.0, 0.0)), speed_m_s=5.0),
            Leg(kind="transit", points=((100.0, 0.0), half), speed_m_s=5.0, through=through),
            Leg(kind="spray", points=(half, (half[0] + 96.0, 28.0)), speed_m_s=5.0),
            Leg(kind="ferry", points=((half[0] + 96.0, 28.0), (0.0, -50.0)), speed_m_s=5.0),
        )
        (found,) = timed(
            [Sortie(number=1, depot=0, legs=legs)], Settings(swath_width_m=6.0, speed_m_s=5.0)
        )
        return sum(leg.seconds for leg in found.legs[:-1])

    # Their one waypoint is in the middle: what lies between them is flown without a stop.
    assert border(0.5) == pytest.approx(border(0.0) + 0.5 / 5.0, abs=0.01)


@given(
    side_m=st.floats(1.5, 4.0), bend_deg=st.floats(0.5, 12.0), gap_m=st.floats(0.0, 0.55),
    aside_m=st.floats(-0.2, 0.2),
)  # fmt: skip
def test_a_row_of_short_lines_is_timed_between_the_waypoints_that_are_written(
    side_m: float, bend_deg: float, gap_m: float, aside_m: float
) -> None:
    settings = Settings(swath_width_m=6.0, speed_m_s=6.0)
    home = here = (0.0, -40.0)
    start, legs = (0.0, 0.0), []
    for number in range(12):
        course = math.radians(number * bend_deg)
        end = (start[0] + side_m * math.sin(course), start[1] + side_m * math.cos(course))
        kind: Literal["ferry", "transit"] = "transit" if number else "ferry"
        legs += [
            Leg(kind=kind, points=(here, start), speed_m_s=6.0),
            Leg(kind="spray", points=(start, end), speed_m_s=6.0),
        ]
        here, start = end, (end[0] + aside_m, end[1] + gap_m)
    legs.append(Leg(kind="ferry", points=(here, home), speed_m_s=6.0))
    (found,) = timed([Sortie(number=1, depot=0, legs=tuple(legs))], settings)
    places = [stop.place for stop in waypoints_of(found)]
    ways = [(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(places)]
    courses = [math.degrees(math.atan2(*way)) for way in ways]
    flown_s = parts_s(
        [math.hypot(*way) for way in ways],
        [(after - before + 180.0) % 360.0 - 180.0 for before, after in pairwise(courses)],
        [settings.motion.at(6.0)] * len(ways),
        settings.motion.corners,
    )
    assert sum(leg.seconds for leg in found.legs[:-1]) == pytest.approx(sum(flown_s), rel=1e-6)


def test_a_flight_of_arducopter_from_take_off_to_disarmed() -> None:
    # Flown: 7.2 s until the way begins, 3.5 m high; 48.4 s from the last waypoint, 26 m away, of
    # which the way home takes about ten.
    vertical = VERTICALS["ardupilot"]
    motion = Settings(swath_width_m=6.0, speed_m_s=5.0).motion
    assert vertical.climb_s(3.5) == pytest.approx(7.2, abs=1.0)
    assert vertical.return_s(3.5) + motion.leg_s(26.0) == pytest.approx(48.4, rel=0.03)
    assert JERKS_M_S3["ardupilot"] == 1.0
