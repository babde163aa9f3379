"""A vehicle that brakes, speeds up or turns over the border sprays nothing outside it.

Valves of 0.03 to 0.07 s fly beside a pump of up to 4 s, and beside atomisers: how far ahead the
slowest on board is ordered must not make the quick ones late.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import shapely
from shapely import Polygon

from companion.config import load
from companion.core.prescription import Prescription, Zone
from companion.core.setup import Setup
from missions.maps.compiling import compiled_setup
from sitl.drives import Ranges
from sitl.flight import FlightOptions, fly
from sitl.motor_parts import ranges_us
from sitl.profile import load_profile
from sitl.trajectory import Trajectory
from tests.moving_flight import Outside, Stretch, circle, fell_outside, way

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
# What noise of the position may make of it, beside a buffer of 10 cm.
OUTSIDE_MAX_M = 0.05
BEGINS_S = 6.0
Case = tuple[Trajectory, Polygon]


def braking(from_m_s: float, at_border_m_s: float, by_m_s2: float) -> Case:
    """Fly out of the field, braking from before its border until behind it."""
    braked_m = (from_m_s**2 - at_border_m_s**2) / (2.0 * by_m_s2)
    flown = way(
        [Stretch(BEGINS_S), Stretch((from_m_s - 1.5) / by_m_s2, -by_m_s2), Stretch(1.0)],
        speed_m_s=from_m_s,
    )
    return flown, shapely.box(-50.0, -50.0, BEGINS_S * from_m_s + braked_m, 50.0)


def inwards(from_m_s: float, to_m_s: float, at_border_m_s: float, by_m_s2: float) -> Case:
    """Fly into the field, faster and faster."""
    gained_m = (at_border_m_s**2 - from_m_s**2) / (2.0 * by_m_s2)
    flown = way(
        [Stretch(BEGINS_S), Stretch((to_m_s - from_m_s) / by_m_s2, by_m_s2), Stretch(1.0)],
        speed_m_s=from_m_s,
    )
    return flown, shapely.box(BEGINS_S * from_m_s + gained_m, -50.0, 200.0, 50.0)


def circles(radius_m: float, speed_m_s: float, beyond_m: float) -> Case:
    """Fly round and round, out of the field and into it; its border lies so far off the middle."""
    turn_deg_s = circle(radius_m, speed_m_s)
    flown = way(
        [Stretch(4.0), Stretch(500.0 / turn_deg_s, turn_deg_s=turn_deg_s)], speed_m_s=speed_m_s
    )
    return flown, shapely.box(-50.0, -50.0, 4.0 * speed_m_s + beyond_m, 50.0)


@cache
def example(name: str) -> tuple[Setup, Ranges]:
    config = load(EXAMPLES / name / "config.toml")
    made = replace(compiled_setup(config), centres_pulses=False)
    return made, ranges_us(config)


def flown(name: str, case: Case) -> tuple[Outside, float]:
    """Return what fell outside, and how much was sprayed [ml]."""
    flown, field = case
    made, ranges = example(name)
    zone = Zone(name="a", polygon=field, rate_l_ha=20.0)
    made = replace(made, prescription=Prescription([zone]))
    options = FlightOptions(fidelity="averaged", output="servo", drive_ranges_us=ranges)
    record = fly(made, flown, load_profile(name), options, speed_m_s=5.0).record
    strips = [(each.right_m, each.forward_m, each.width_m) for each in made.boom.valves]
    in_flight = record.time_s <= flown.time_s[-1]
    volume_ml = record.volume_ml[in_flight]
    outside = fell_outside(field, strips, flown.at(record.time_s[in_flight]), volume_ml)
    return outside, float(volume_ml[-1].sum())


@pytest.mark.parametrize("name", ["pump-sections", "atomiser"])
@pytest.mark.parametrize(
    "case",
    [
        lambda: braking(6.0, 5.0, 2.5),
        lambda: braking(4.0, 3.5, 2.5),
        lambda: braking(9.0, 7.0, 4.0),
        lambda: inwards(2.0, 6.0, 3.0, 2.5),
        lambda: inwards(2.0, 8.0, 4.0, 4.0),
        lambda: circles(6.0, 5.0, 3.0),
        lambda: circles(6.0, 5.0, 5.0),
        lambda: circles(6.0, 4.0, -4.0),
    ],
    ids=[
        "brakes from 6 m/s", "brakes from 4 m/s", "brakes from 9 m/s", "speeds up by 2.5 m/s2",
        "speeds up by 4 m/s2", "circles, half out", "circles, mostly in", "circles, mostly out",
    ],
)  # fmt: skip
def test_nothing_falls_outside_while_speed_or_course_changes(
    name: str, case: Callable[[], Case]
) -> None:
    outside, sprayed_ml = flown(name, case())
    assert outside.most_m <= OUTSIDE_MAX_M
    assert outside.area_m2 <= 6.0 * OUTSIDE_MAX_M
    assert sprayed_ml > 100.0
