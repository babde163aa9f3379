"""The law of the border: no more falls outside than who knows the true state could not help.

Any path with accelerations to 5 m/s2 and turns to 120 degrees a second, gusts, any mix of lags
beside each other, any field with holes, through messages; against a causal reference.
"""

from __future__ import annotations

import math
import os

import numpy as np
import shapely
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from shapely.affinity import rotate, translate

from companion.core.schedule import LagModel
from sitl.trajectory import Trajectory
from tests.border_law import MORE_M, MOST_M_S2, Flight, worse_than_reference_m
from tests.moving_flight import STEP_S, Stretch, way

FLIGHTS = 400 if os.environ.get("HYPOTHESIS_PROFILE") == "thorough" else 12
FLOWN = settings(max_examples=FLIGHTS, phases=[Phase.explicit, Phase.generate])
MOST_DEG_S = 120.0
SLOWEST_M_S, FASTEST_M_S = 1.2, 10.0
# Where a closing takes seconds, half its square times the acceleration says when it is due, and no
# message tells an acceleration: of a jump the filters have 20, 50, 70 and 85 % after one to four
# messages, a small one later. The difference of the last two messages knows it one decision sooner
# at most, and errs half as much again while nothing jumps (0.36 for 0.24 m/s2 rms, `flown`).
BELIEVED_S = 0.3


@st.composite
def ways(draw: st.DrawFn) -> Trajectory:
    """Straight, then anything that a vehicle may do; in gusts or without."""
    speed = draw(st.floats(2.5, 8.0))
    stretches, begins_m_s = [Stretch(2.5)], speed
    for _ in range(draw(st.integers(2, 6))):
        seconds = draw(st.floats(0.2, 1.5))
        gain = draw(st.one_of(st.just(0.0), st.floats(-MOST_M_S2, MOST_M_S2)))
        ends = min(max(speed + gain * seconds, SLOWEST_M_S), FASTEST_M_S)
        gain = (ends - speed) / seconds
        aside = math.sqrt(max(MOST_M_S2**2 - gain**2, 0.0)) / max(speed, ends)
        most = min(MOST_DEG_S, math.degrees(aside))
        turn = draw(st.one_of(st.just(0.0), st.floats(-most, most)))
        nose = draw(st.one_of(st.none(), st.floats(-MOST_DEG_S, MOST_DEG_S)))
        stretches.append(Stretch(seconds, gain, turn, nose))
        speed = ends
    count = sum(round(each.seconds / STEP_S) for each in stretches) + 1
    return way(
        stretches,
        speed_m_s=begins_m_s,
        course_deg=draw(st.floats(0.0, 360.0)),
        crab_deg=draw(st.floats(-40.0, 40.0)),
        pushed=gusts(count, draw(st.sampled_from([0.0, 0.3])), draw(st.integers(0, 99))),
    )


def gusts(count: int, sd_m_s: float, seed: int) -> np.ndarray:
    """Return what gusts add to the velocity; they last for 1.5 s."""
    keeps = math.exp(-STEP_S / 1.5)
    kicks = np.random.default_rng(seed).normal(size=(count, 2)) * sd_m_s * math.sqrt(1 - keeps**2)
    pushed = np.zeros((count, 2))
    for i in range(1, count):
        pushed[i] = keeps * pushed[i - 1] + kicks[i]
    return pushed


@st.composite
def flights(draw: st.DrawFn, *, slowest_s: float) -> Flight:
    """A field somewhere on the way, with holes on it; valves that take up to `slowest_s`."""
    flown = draw(ways())
    last = len(flown.time_s) - 1

    def place() -> tuple[float, float]:
        at = draw(st.integers(last // 4, last))
        return float(flown.east_m[at]), float(flown.north_m[at])

    field = rotate(shapely.box(-25.0, -25.0, 25.0, 25.0), draw(st.floats(0.0, 90.0)))
    east_m, north_m = place()
    aside = st.floats(-25.0, 25.0)
    field = translate(field, east_m + draw(aside), north_m + draw(aside))
    for radius_m in draw(st.lists(st.sampled_from([0.3, 1.5, 4.0]), max_size=3)):
        east_m, north_m = place()
        beside = st.floats(-3.0, 3.0)
        middle = shapely.Point(east_m + draw(beside), north_m + draw(beside))
        field = shapely.difference(field, middle.buffer(radius_m, quad_segs=3))
    short, own = st.floats(0.0, 0.1), st.floats(0.0, slowest_s)
    on_start_s, off_s, any_s = draw(own), draw(own), st.floats(0.1, 5.0)
    lag = LagModel(
        on_s=on_start_s + draw(short), off_s=off_s, up_s=draw(any_s), down_s=draw(any_s),
        on_start_s=on_start_s, off_end_s=off_s + draw(short), output_s=draw(st.floats(0.0, 0.03)),
    )  # fmt: skip
    return Flight(flown, field, lag)


@FLOWN
@given(flight=flights(slowest_s=0.15))
def test_valves_spray_no_more_outside_than_who_knows_the_true_state(flight: Flight) -> None:
    if shapely.area(flight.field) > 1.0:
        assert worse_than_reference_m(flight) <= MORE_M


@FLOWN
@given(flight=flights(slowest_s=0.15))
def test_noise_of_the_position_costs_no_more_than_one_decision(flight: Flight) -> None:
    if shapely.area(flight.field) > 1.0:
        assert worse_than_reference_m(flight, noisy=True, decisions=1) <= MORE_M


@FLOWN
@given(flight=flights(slowest_s=5.0))
def test_what_takes_seconds_to_close_does_so_as_soon_as_an_acceleration_is_believed(
    flight: Flight,
) -> None:
    if shapely.area(flight.field) > 1.0:
        worse_m = worse_than_reference_m(flight, believed_s=BELIEVED_S, decisions=1)
        assert worse_m <= MORE_M
