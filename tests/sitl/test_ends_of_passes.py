"""The end of a pass: a vehicle that brakes, cuts the corner and pivots, as autopilots do it.

Its accelerations grow by a jerk, its nose turns by an acceleration: neither is known before it has
begun. Nothing falls outside the field, nor once a planned line has been left, but what a causal
reference with the true state would let fall there too.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import shapely
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from shapely.affinity import rotate, translate

from companion.core.options.lines import Lines
from companion.core.prescription import Prescription, Zone
from companion.core.safety import Limits
from companion.core.schedule import LagModel
from companion.core.setup import Setup
from companion.core.types import Decision, HeartbeatReport, Input
from sitl.flight import FlightOptions, fly
from sitl.profile import load_profile
from sitl.trajectory import Trajectory
from tests.border_flight import flows
from tests.border_law import MORE_M, Flight, worse_than_reference_m
from tests.builders import LAG, boom, setup
from tests.moving_flight import STEP_S, executed

FLIGHTS = 400 if os.environ.get("HYPOTHESIS_PROFILE") == "thorough" else 12
FLOWN = settings(max_examples=FLIGHTS, phases=[Phase.explicit, Phase.generate])
PLANT = load_profile("wang-2024")
PASS_S, ENDS_S = 2.5, 3.5
COURSE_DEG, GROUND = 20.0, shapely.box(-90.0, -90.0, 90.0, 90.0)
# How late an autopilot's estimator tells its place, in the twin.
TOLD_LATE_S = FlightOptions().estimator_lag_s
DECIDED_S = 1.0 / FlightOptions().position_rate_hz


class End(NamedTuple):
    """How a pass ends: [s] after its straight part; accelerations grow by `jerk_m_s3`."""

    speed_m_s: float
    braking_m_s2: float
    lateral_m_s2: float
    cuts_after_s: float
    jerk_m_s3: float
    pivots_after_s: float
    yaw_deg_s2: float
    yaw_deg_s: float
    phase_s: float

    def flown(self) -> Trajectory:
        """Return the way, to the north."""
        time_s = np.arange(0.0, PASS_S + ENDS_S, STEP_S)
        since = time_s - PASS_S - self.phase_s
        along = np.clip(-since * self.jerk_m_s3, -self.braking_m_s2, 0.0)
        north = np.maximum(self.speed_m_s + summed(along), 0.0)
        side = math.copysign(1.0, self.lateral_m_s2)
        aside = np.clip((since - self.cuts_after_s) * self.jerk_m_s3, 0.0, abs(self.lateral_m_s2))
        east = np.clip(summed(side * aside), -4.0, 4.0)
        rate = np.clip((since - self.pivots_after_s) * self.yaw_deg_s2, 0.0, self.yaw_deg_s)
        return Trajectory(
            time_s=time_s, east_m=summed(east), north_m=summed(north),
            velocity_east_m_s=east, velocity_north_m_s=north,
            heading_deg=summed(side * rate), leg=np.zeros(len(time_s), dtype=np.int64),
            height_m=3.5,
        )  # fmt: skip


def summed(values: np.ndarray) -> np.ndarray:
    """Return the integral over time, from 0."""
    return np.concatenate(([0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * STEP_S)))


@st.composite
def ends(draw: st.DrawFn) -> End:
    speed, braking = draw(st.floats(2.0, 6.0)), draw(st.floats(1.0, 3.0))
    stops_s = speed / braking
    return End(
        speed_m_s=speed,
        braking_m_s2=braking,
        lateral_m_s2=draw(st.floats(0.5, 2.5)) * draw(st.sampled_from([-1.0, 1.0])),
        cuts_after_s=draw(st.floats(0.2, 1.0)) * stops_s,
        jerk_m_s3=draw(st.floats(2.0, 5.0)),
        pivots_after_s=draw(st.floats(0.2, 1.0)) * stops_s,
        yaw_deg_s2=draw(st.floats(60.0, 270.0)),
        yaw_deg_s=draw(st.floats(45.0, 120.0)),
        phase_s=draw(st.floats(0.0, 0.05)),
    )


@st.composite
def beside_borders(draw: st.DrawFn) -> Flight:
    """A border that the boom swings over, ahead or beside."""
    flown = draw(ends()).flown()
    at = draw(st.integers(round(PASS_S / STEP_S), len(flown.time_s) - 1))
    field = translate(shapely.box(-60.0, -60.0, 60.0, 0.0), 0.0, draw(st.floats(-0.5, 3.5)))
    field = rotate(field, draw(st.floats(-100.0, 100.0)), origin=(0.0, 0.0))
    field = translate(field, float(flown.east_m[at]), float(flown.north_m[at]))
    return Flight(flown, field, LAG)


@FLOWN
@given(flight=beside_borders())
def test_a_boom_that_begins_to_pivot_beside_the_border_sprays_nothing_more_outside(
    flight: Flight,
) -> None:
    assert worse_than_reference_m(flight) <= MORE_M


# ----------------------------------------------------------------------------------- planned lines


def by_pilot(items: Iterator[Input]) -> Iterator[Input]:
    """By position and course alone: no leg is told."""
    for item in items:
        yield replace(item, mode="GUIDED") if isinstance(item, HeartbeatReport) else item


def off_line(velocity_east: np.ndarray, velocity_north: np.ndarray) -> np.ndarray:
    """Return where a course is off a line to the north."""
    pace = np.hypot(velocity_east, velocity_north)
    return velocity_north < pace * math.cos(math.radians(COURSE_DEG))


def on_a_line(lag: LagModel, *, rate_l_ha: float = 20.0) -> Setup:
    """Return a sprayer over a field with one line."""
    line = ((0.0, -100.0), (0.0, 100.0))
    return setup(
        prescription=Prescription([Zone(name="a", polygon=GROUND, rate_l_ha=rate_l_ha)]),
        boom=boom(6), lag=lag,
        lines=Lines(polylines=(line,), aside_m=3.0, course_deg=COURSE_DEG),
        limits=Limits(modes=frozenset({"GUIDED"}), speed_min_m_s=0.1),
    )  # fmt: skip


def beyond_m(
    end: End, *, noisy: bool = False, said: list[Decision] | None = None
) -> tuple[float, float]:
    """Return how far the vehicle went on spraying after it had left its line: ours, reference."""
    flown, said = end.flown(), [] if said is None else said
    fly(
        on_a_line(replace(LAG, position_s=TOLD_LATE_S if noisy else 0.0)), flown, PLANT,
        FlightOptions(fidelity="averaged", noise=noisy),
        speed_m_s=5.0, observer=said.append, disturb=by_pilot,
    )  # fmt: skip
    # At a stand there is no course.
    moves = np.hypot(flown.velocity_east_m_s, flown.velocity_north_m_s) > 0.3
    left = off_line(flown.velocity_east_m_s, flown.velocity_north_m_s) & moves
    if not left.any():
        return 0.0, 0.0
    left_s = float(flown.time_s[left][0])
    way_m = summed(np.hypot(flown.velocity_east_m_s, flown.velocity_north_m_s))

    def went_m(until_s: float) -> float:
        one, other = np.interp([left_s, max(until_s, left_s)], flown.time_s, way_m)
        return float(other - one)

    last_s = LAG.off_end_s + LAG.output_s
    spans = [flows(each, first_s=0.0, last_s=last_s) for each in executed(said, 6)]
    assert all(spans)
    ours_s = max(until for each in spans for _, until in each)
    steps_s = np.array([each.now_s for each in said])
    at, before = flown.at(steps_s), flown.at(steps_s - STEP_S)
    then = [
        now + (now - was) / STEP_S * last_s
        for now, was in (
            (at.velocity_east_m_s, before.velocity_east_m_s),
            (at.velocity_north_m_s, before.velocity_north_m_s),
        )
    ]
    closes = steps_s[off_line(*then) & (steps_s > 1.0)]
    return went_m(ours_s), went_m(float(closes[0]) + last_s)


@FLOWN
@given(end=ends())
def test_who_turns_off_a_line_has_closed_as_soon_as_can_be_known(end: End) -> None:
    ours_m, theirs_m = beyond_m(end)
    assert ours_m <= theirs_m + MORE_M
    # Noise may cost one decision.
    ours_m, theirs_m = beyond_m(end, noisy=True)
    assert ours_m <= theirs_m + MORE_M + DECIDED_S * end.speed_m_s


@pytest.mark.parametrize("speed_m_s", [1.5, 5.0])
def test_who_stays_on_a_line_closes_nowhere(speed_m_s: float) -> None:
    straight = End(speed_m_s, 0.0, 0.0, 9.0, 5.0, 9.0, 0.0, 0.0, 0.0)
    said: list[Decision] = []
    beyond_m(straight, noisy=True, said=said)
    assert all(min(each.plan.duty_at(each.now_s)) > 0.0 for each in said if each.now_s > 1.0)


@pytest.mark.parametrize(("speed_m_s", "gain_m_s2"), [(1.0, 9.0), (2.0, 0.5)])
def test_slow_valves_are_open_on_a_line_that_is_flown_slowly_and_swaying(
    speed_m_s: float, gain_m_s2: float
) -> None:
    time_s = np.arange(0.0, 8.0, STEP_S)
    north = np.minimum(gain_m_s2 * time_s, speed_m_s)
    east = 0.06 * np.sin(2.0 * math.pi * time_s / 2.5)
    still = np.zeros(len(time_s))
    flown = Trajectory(
        time_s=time_s, east_m=summed(east), north_m=summed(north),
        velocity_east_m_s=east, velocity_north_m_s=north,
        heading_deg=still, leg=still.astype(np.int64), height_m=3.5,
    )  # fmt: skip
    lag = replace(LAG, off_s=0.3, off_end_s=0.3, position_s=TOLD_LATE_S)
    said: list[Decision] = []
    fly(
        on_a_line(lag, rate_l_ha=90.0), flown, PLANT, FlightOptions(fidelity="averaged"),
        speed_m_s=5.0, observer=said.append, disturb=by_pilot,
    )  # fmt: skip
    assert all(
        min(each.plan.duty_at(each.now_s)) > 0.0
        for each in said
        if each.now_s > 1.0 and np.interp(each.now_s, time_s, north) > 0.9
    )
