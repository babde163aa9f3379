"""What the other tests of interlock, estimator and schedule let pass.

Each of these fails for a mutation of its own (docs/contributing/testing.md).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from companion.core.crossings import Crossing, Route
from companion.core.estimator import Track, estimate, observe
from companion.core.nozzle import flow_for_rate
from companion.core.safety import Limits, closed_plan, guard, inhibits
from companion.core.schedule import Timing, orders, resolve, schedule
from companion.core.types import (
    ClockReport,
    HeartbeatReport,
    Inhibit,
    SprayPlan,
    Telemetry,
    TimedChange,
    VehicleState,
)
from companion.output.pwm import RESTART_DUTY
from sitl.outputs import SERVO_FRAME_S
from tests import builders
from tests.builders import CURVE, LAG, SPRAYING, setup

NAN = math.nan
BOUNDS = (0.0, -1.0, 48.0, 7.0)


# ------------------------------------------------------------------------------- interlock


def open_plan() -> SprayPlan:
    return SprayPlan(
        sequence=7,
        issued_s=10.0,
        duty=(0.5, 0.0),
        changes=(TimedChange(at_s=10.1, valve=1, duty=0.6),),
        lease_until_s=10.3,
    )


@pytest.mark.parametrize("reason", list(Inhibit))
def test_any_reason_makes_the_closed_plan_of_an_open_one(reason: Inhibit) -> None:
    closed = guard(open_plan(), frozenset({reason}), lease_s=0.3)
    assert closed.is_off
    assert (closed.sequence, len(closed.duty)) == (7, 2)


def test_without_a_reason_the_plan_passes_as_it_is() -> None:
    assert guard(open_plan(), frozenset(), lease_s=0.3) == open_plan()


def test_a_closed_plan_has_the_whole_lease() -> None:
    plan = closed_plan(sequence=1, valve_count=2, now_s=10.0, lease_s=0.3)
    assert plan.lease_until_s == pytest.approx(10.3)


def found(**change: object) -> frozenset[Inhibit]:
    state: VehicleState = replace(SPRAYING, **change)  # type: ignore[arg-type]
    return inhibits(state, Limits(), field_bounds_m=BOUNDS, now_s=10.0)


@pytest.mark.parametrize(
    ("change", "reasons"),
    [
        (
            {"velocity_east_m_s": NAN},
            {Inhibit.SPEED_BELOW_MIN, Inhibit.SPEED_ABOVE_MAX, Inhibit.SPEED_DISAGREES},
        ),
        ({"height_m": NAN}, {Inhibit.HEIGHT_BELOW_MIN, Inhibit.HEIGHT_ABOVE_MAX}),
        ({"wind_m_s": NAN}, {Inhibit.WIND_ABOVE_MAX}),
        ({"wind_m_s": -0.1}, {Inhibit.WIND_ABOVE_MAX}),
        ({"position_received_s": NAN}, {Inhibit.STALE_POSITION}),
        ({"position_received_s": 10.2}, {Inhibit.STALE_POSITION}),
        ({"heartbeat_received_s": NAN}, {Inhibit.STALE_HEARTBEAT}),
        ({"heartbeat_received_s": 10.2}, {Inhibit.STALE_HEARTBEAT}),
        ({"east_m": NAN}, {Inhibit.FAR_FROM_FIELD}),
        ({"north_m": NAN}, {Inhibit.FAR_FROM_FIELD}),
        ({"north_m": 20_008.0}, {Inhibit.FAR_FROM_FIELD}),
        ({"north_m": -20_002.0}, {Inhibit.FAR_FROM_FIELD}),
    ],
)
def test_each_limit_by_itself_refuses_what_is_no_number(
    change: dict[str, object], reasons: set[Inhibit]
) -> None:
    assert found(**change) == reasons


# ------------------------------------------------------------------------------- estimator


def position(boot_s: float, received_s: float, east_m: float) -> Telemetry:
    return builders.position(received_s, east_m, 3.0, boot_s=boot_s)


def test_an_autopilot_that_restarted_within_a_second_has_a_clock_of_its_own() -> None:
    given, track = setup(), Track()
    for i in range(20):
        track = observe(track, position(0.1 * i, 10.0 + 0.1 * i, 0.5 * i), given)
    # Up for 1.9 s; 0.1 s later it says 1.2 s: that may be a copy, until TIMESYNC says the same.
    for i in range(4):
        if i == 2:
            track = observe(
                track, ClockReport(received_s=12.15, offset_s=10.8, round_trip_s=0.01), given
            )
        track = observe(track, position(1.2 + 0.1 * i, 12.0 + 0.1 * i, 10.0 + 0.5 * i), given)
        state = estimate(track, 12.0 + 0.1 * i)
        assert state is not None
        assert state.east_m == pytest.approx(10.0 + 0.5 * i, abs=1e-6)
        assert state.position_valid == (i < 2)


def test_a_clock_that_is_seconds_late_is_old_until_it_has_stayed_so() -> None:
    given, track = setup(), Track()
    for i in range(20):
        track = observe(track, position(0.1 * i, 10.0 + 0.1 * i, 0.5 * i), given)
    for i in range(70):
        # Five seconds late, with nobody to say whether it is the clock or the way.
        now_s = 17.0 + 0.1 * i
        track = observe(track, position(2.0 + 0.1 * i, now_s, 10.0 + 0.5 * i), given)
        state = estimate(track, now_s)
        assert state is not None
        if i < 45:
            assert state.position_received_s == pytest.approx(now_s - 5.0, abs=0.2)
            assert state.clock_agrees == (i < 3)
    # Nothing is enabled and it has lasted for five seconds: that is its time now.
    assert state.position_received_s == pytest.approx(now_s)
    assert state.east_m == pytest.approx(10.0 + 0.5 * 69, abs=1e-6)
    assert state.clock_agrees


def test_a_heartbeat_and_a_position_are_as_old_as_they_are() -> None:
    beat = HeartbeatReport(received_s=10.05, autopilot="ardupilot", armed=True, mode="AUTO")
    track = observe(Track(), position(0.0, 10.0, 0.0), setup())
    state = estimate(observe(track, beat, setup()), 14.0)
    assert state is not None
    assert (state.heartbeat_received_s, state.position_received_s) == (10.05, 10.0)


@pytest.mark.parametrize(
    "change", [{"longitude_deg": 114.5 + 360.0}, {"latitude_deg": 144.0}, {"longitude_deg": NAN}]
)
def test_what_is_on_no_globe_is_no_place(change: dict[str, float]) -> None:
    before = observe(Track(), position(0.0, 10.0, 0.0), setup())
    after = observe(before, replace(position(0.1, 10.1, 0.5), **change), setup())
    assert after.motion == before.motion
    assert not after.position_valid


# -------------------------------------------------------------------------------- schedule


def route(
    *entries: tuple[float, float | None], border: bool = False, speed_m_s: float = 5.0
) -> Route:
    return tuple(Crossing(at_s, rate, border, speed_m_s) for at_s, rate in entries)


def rates(resolved: Route) -> list[Any]:
    return [(crossing.at_s, crossing.rate_l_ha) for crossing in resolved]


@pytest.mark.parametrize("after", [20.0, 25.0])
def test_closed_ground_shorter_than_the_lag_stays_closed(after: float) -> None:
    given = route((0.0, 20.0), (1.0, None), (1.05, after))
    resolved, dropped = resolve(given, 0.2)
    assert rates(resolved) == rates(given)
    assert dropped == 0


def test_a_short_zone_before_closed_ground_is_closed_already() -> None:
    given = route((0.0, 20.0), (1.0, 25.0), (1.05, None))
    assert rates(resolve(given, 0.2)[0]) == [(0.0, 20.0), (1.0, None)]


def test_an_opening_shorter_than_the_lag_is_not_made() -> None:
    given = route((0.0, None), (1.0, 25.0), (1.05, None), (2.0, 20.0))
    assert rates(resolve(given, 0.2)[0]) == [(0.0, None), (2.0, 20.0)]


def test_a_short_zone_after_closed_ground_opens_with_the_next_rate() -> None:
    given = route((0.0, None), (1.0, 25.0), (1.05, 20.0))
    assert rates(resolve(given, 0.2)[0]) == [(0.0, None), (1.0, 20.0)]


@pytest.mark.parametrize(
    ("short", "expected"),
    [(21.0, [(0.0, 20.0), (1.05, 30.0)]), (29.0, [(0.0, 20.0), (1.0, 30.0)])],
)
def test_a_short_zone_takes_the_nearer_of_its_neighbours(
    short: float, expected: list[tuple[float, float | None]]
) -> None:
    given = route((0.0, 20.0), (1.0, short), (1.05, 30.0))
    resolved, dropped = resolve(given, 0.2)
    assert rates(resolved) == expected
    assert dropped == 1


def timing(**change: float) -> Timing:
    leads: dict[str, float] = {
        "on_s": 0.1, "off_s": 0.1, "up_s": 0.1, "down_s": 0.1,
        "border_on_s": 0.05, "border_off_s": 0.2, "dwell_min_s": 0.0,
    }  # fmt: skip
    return Timing(**(leads | change))


def duty_of(rate_l_ha: float, speed_m_s: float) -> float:
    return rate_l_ha * speed_m_s / 200.0


def test_an_order_due_before_the_one_ahead_of_it_takes_its_place() -> None:
    given = route((0.0, 20.0), (1.0, 25.0), (1.05, 10.0))
    made = orders(given, timing(down_s=0.3), duty_of)
    assert [order.rate_l_ha for order in made] == [20.0, 10.0]
    assert made[1].at_s == pytest.approx(0.75)


def test_the_rate_told_is_that_of_the_ground_below_and_not_of_the_ground_ahead() -> None:
    told = schedule(
        route((0.0, 20.0), (1.0, 25.0), (2.0, 15.0)),
        valve=0,
        timing=timing(),
        dosing=duty_of,
        in_force=duty_of(20.0, 5.0),
        speed_soon_m_s=5.0,
        now_s=0.95,
        until_s=1.25,
    )
    assert told.rate_now_l_ha == 20.0


@pytest.mark.parametrize(
    ("name", "value"), [("on_start_s", 0.101), ("off_end_s", 0.109), ("off_end_s", NAN)]
)
def test_lags_that_contradict_each_other_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        replace(LAG, **{name: value})  # type: ignore[arg-type]


# ----------------------------------------------------------------------------------- trims


def trimmed(in_force: float, *crossings: tuple[float, float | None]) -> list[Any]:
    found = schedule(
        route((0.0, 20.0), *crossings),
        valve=0,
        timing=timing(),
        dosing=duty_of,
        in_force=in_force,
        speed_soon_m_s=5.0,
        now_s=1.0,
        until_s=1.3,
    )
    return [(change.at_s, change.duty) for change in found.changes]


@pytest.mark.parametrize("slower", [1.0, 0.985, 1.015])
def test_a_change_that_was_ordered_is_not_taken_back_when_the_speed_wavers(slower: float) -> None:
    """On the flat part of the curve 1 % of speed is 3 % of duty, and the crossing moves a little.

    Beside PX4 the valves went half way back to the zone before, for 0.1 s.
    """

    def duty(rate_l_ha: float, speed_m_s: float) -> float:
        return CURVE.duty_for(flow_for_rate(rate_l_ha, speed_m_s, 6.0))

    lead_s = timing().down_s
    found = schedule(
        route((0.0, 21.0), (1.0 + lead_s + 0.03, 18.0), speed_m_s=4.75 * slower),
        valve=0,
        timing=timing(),
        dosing=duty,
        in_force=duty(18.0, 4.75),
        speed_soon_m_s=4.75 * slower,
        now_s=1.0,
        until_s=1.3,
    )
    for change in found.changes:
        assert change.duty == pytest.approx(duty(18.0, 4.75 * slower), abs=0.002)


def test_no_trim_holds_up_a_change_that_is_nearly_due() -> None:
    assert duty_of(20.0, 5.0) == 0.5
    assert trimmed(0.51, (1.12, 30.0)) == [(pytest.approx(1.02), 0.75)]
    assert trimmed(0.51, (1.15, 30.0)) == [(1.0, 0.5), (pytest.approx(1.05), 0.75)]


@pytest.mark.parametrize("in_force", [0.47, 0.53])
def test_a_trim_stays_below_what_restarts_a_driver_board(in_force: float) -> None:
    (first_s, first), (second_s, second) = trimmed(in_force)
    for before, after in ((in_force, first), (first, second)):
        assert 0.0 < abs(after - before) < RESTART_DUTY
        assert abs(after - 0.5) < abs(before - 0.5)
    assert second_s - first_s > SERVO_FRAME_S  # no frame holds both


def test_the_second_half_of_a_trim_holds_up_no_change() -> None:
    halves = trimmed(0.53, (1.15, 30.0))
    assert [at_s for at_s, _ in halves] == [1.0, pytest.approx(1.05)]


def test_no_change_is_planned_beyond_the_lease() -> None:
    assert trimmed(0.5, (1.39, 30.0)) == [(pytest.approx(1.29), 0.75)]
    assert trimmed(0.5, (1.41, 30.0)) == []
