"""What the schedule promises, one test a promise; docs/explanation/timing.md has the table."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.core.controller import Memory, step
from companion.core.crossings import Crossing, Route
from companion.core.nozzle import allowed_duty
from companion.core.schedule import Timing, has_passed, in_zone, orders, resolve, schedule
from companion.core.types import PwmLimits, SprayPlan, TimedChange
from companion.output.pwm import PulseEngine
from tests.builders import LAG, flying, setup

PWM = PwmLimits(frequency_hz=11.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01)
T = PWM.period_s
DWELL_S = 0.2
# A pump's lags: changes of one kind overtake those of the other.
TIMING = Timing(
    on_s=0.1, off_s=0.11, up_s=1.9, down_s=1.4, border_on_s=0.05, border_off_s=0.2,
    dwell_min_s=DWELL_S,
)  # fmt: skip


def dosing(rate_l_ha: float, speed_m_s: float) -> float:
    return min(rate_l_ha * speed_m_s / 200.0, 1.0)


@st.composite
def routes(draw: st.DrawFn) -> Route:
    waits = draw(st.lists(st.floats(0.01, 0.6), max_size=12))
    rates = st.sampled_from([None, None, 0.0, 15.0, 20.0, 25.0, 30.0])
    at_s, made = 0.0, [Crossing(0.0, draw(rates), False, 5.0)]
    for wait_s in waits:
        at_s, rate = at_s + wait_s, draw(rates)
        outside = rate is None and draw(st.booleans())
        if rate != made[-1].rate_l_ha or outside != made[-1].outside:
            made.append(Crossing(at_s, rate, outside, 5.0))
    return tuple(made)


def rate_at(route: Route, at_s: float) -> float | None:
    return next(each.rate_l_ha for each in reversed(route) if each.at_s <= at_s)


# ------------------------------------------------------ changes closer than the plant can follow


@given(route=routes())
def test_no_zone_is_kept_that_is_shorter_than_a_change_takes(route: Route) -> None:
    kept, _ = resolve(route, DWELL_S)
    for crossing, following in pairwise(kept[1:]):
        assert crossing.rate_l_ha is None or following.at_s - crossing.at_s >= DWELL_S
        assert crossing[1:3] != following[1:3]


@given(route=routes())
def test_closed_ground_stays_closed_whatever_is_given_up(route: Route) -> None:
    kept, _ = resolve(route, DWELL_S)
    for crossing, following in pairwise([*route, Crossing(99.0, None, False, 5.0)]):
        if crossing.rate_l_ha is None:
            middle_s = 0.5 * (crossing.at_s + following.at_s)
            assert rate_at(kept, crossing.at_s) is None
            assert rate_at(kept, middle_s) is None


@given(route=routes())
def test_what_is_given_up_is_counted_and_nothing_else_changes(route: Route) -> None:
    kept, dropped = resolve(route, DWELL_S)
    assert (dropped == 0) == (kept == route)
    assert kept[-1].rate_l_ha == route[-1].rate_l_ha


# -------------------------------------------------------------- two boundaries inside one lag


@given(route=routes())
def test_orders_never_overtake_and_end_with_the_last_zone(route: Route) -> None:
    made = orders(route, TIMING, dosing)
    assert all(a.at_s < b.at_s for a, b in pairwise(made))
    assert made[-1].rate_l_ha == route[-1].rate_l_ha


def test_two_boundaries_inside_one_lag_are_both_ordered_by_their_own() -> None:
    # 25 m at 5 m/s are 0.5 s, a quarter of the lag: both orders lie before the first boundary.
    route = tuple(
        Crossing(at_s, rate, False, 5.0) for at_s, rate in ((0.0, 20.0), (5.0, 25.0), (5.6, 30.0))
    )
    made = orders(route, TIMING, dosing)
    assert [order.at_s for order in made[1:]] == pytest.approx([3.1, 3.7])
    found = schedule(
        route, valve=0, timing=TIMING, dosing=dosing, in_force=0.5, speed_soon_m_s=5.0,
        now_s=3.0, until_s=4.0,
    )  # fmt: skip
    assert [change.at_s for change in found.changes] == pytest.approx([3.1, 3.7])
    assert found.rate_now_l_ha == 20.0


# ------------------------------------------------------------------- planned anew for the speed


@pytest.mark.parametrize("speed", [4.6, 5.4])
def test_a_change_is_moved_when_the_speed_changes(speed: float) -> None:
    given_setup = setup()
    decision, memory = step(given_setup, flying(10.0, 10.5), Memory(), 10.0)
    ahead = [change for change in decision.plan.changes if change.at_s > 10.0]
    assert len(ahead) == 6
    state = flying(10.02, 10.6, velocity_east_m_s=speed, checked_speed_m_s=speed)
    decision, _ = step(given_setup, state, memory, 10.02)
    later = [change for change in decision.plan.changes if change.at_s > 10.02]
    moved = [change for change in later if change.restart]
    expected_s = 10.02 + 1.4 / speed - LAG.up_s - LAG.output_s
    assert [change.at_s for change in moved] == pytest.approx([expected_s] * 6, abs=1e-6)
    assert abs(moved[0].at_s - ahead[0].at_s) > 0.015
    assert decision.late_count == 0


# ------------------------------------------------------------------------- duty window and dither


@given(duty=st.floats(-1.0, 2.0))
def test_no_duty_is_ordered_below_the_window(duty: float) -> None:
    held = allowed_duty(duty, PWM)
    assert held == 0.0 or PWM.duty_min <= held <= 1.0
    assert allowed_duty(held, PWM) == held


def test_what_is_no_duty_is_closed() -> None:
    assert allowed_duty(math.nan, PWM) == 0.0


@pytest.mark.parametrize("overrun_s", [0.0, 0.006])
@pytest.mark.parametrize(
    "pwm",
    [PWM, PwmLimits(frequency_hz=10.0, duty_min=0.2, duty_max=0.8, min_on_s=0.02, min_off_s=0.01)],
    ids=["gap too short", "window narrower"],
)
@pytest.mark.parametrize("share", [0.1, 0.25, 0.5, 0.8])
def test_between_the_last_duty_and_open_whole_periods_take_turns(
    share: float, pwm: PwmLimits, overrun_s: float
) -> None:
    last = min(pwm.duty_max, 1.0 - pwm.min_off_s / pwm.period_s)
    duty, count = last + share * (1.0 - last), 200
    engine = PulseEngine(pwm, 1, start_s=0.0, overrun_s=overrun_s)
    lease_s = (count + 5) * pwm.period_s
    engine.submit(
        SprayPlan(sequence=1, issued_s=0.0, duty=(duty,), changes=(), lease_until_s=lease_s),
        now_s=0.0,
    )
    edges = engine.advance(count * pwm.period_s)
    moves = [edge for a, edge in zip([None, *edges], edges, strict=False)
             if a is None or a.is_open != edge.is_open]  # fmt: skip
    gaps = [b.at_s - a.at_s for a, b in pairwise(moves) if not a.is_open]
    shortest_s = (1.0 - last) * pwm.period_s
    assert min(gaps) >= shortest_s - overrun_s - 1e-9
    assert min(gaps) >= pwm.min_off_s - 1e-9
    # Far fewer gaps than periods: the others are open throughout.
    assert len(gaps) == pytest.approx((1.0 - share) * count, abs=0.1 * count + 2)
    whole_s = count * pwm.period_s
    open_s = whole_s - sum(gaps) - moves[0].at_s
    delivered_s = open_s + overrun_s * len(gaps)
    low = min(last + overrun_s / pwm.period_s, 1.0)
    expected = low + share * (1.0 - low)
    assert delivered_s / whole_s == pytest.approx(expected, abs=2e-3)


# --------------------------------------------------------------------------- stagger of the phases


def test_the_valves_do_not_open_together() -> None:
    engine = PulseEngine(PWM, 6, start_s=0.0)
    changes = tuple(TimedChange(at_s=0.5, valve=valve, duty=0.5) for valve in range(6))
    engine.submit(
        SprayPlan(sequence=1, issued_s=0.0, duty=(0.0,) * 6, changes=changes, lease_until_s=40.0),
        now_s=0.0,
    )
    edges = engine.advance(20.0)
    opened = sorted(e.at_s % T for e in edges if e.is_open and 19.0 <= e.at_s < 19.0 + T)
    assert len(opened) == 6
    apart = [(b - a) % T for a, b in pairwise([*opened, opened[0]])]
    assert apart == pytest.approx([T / 6] * 6, abs=1e-6)


# ------------------------------------------- what is found for one valve and serves its neighbours

RATES = st.sampled_from([None, 0.0, 15.0, 20.0, 25.0, 30.0])
DUTIES = st.sampled_from([0.0, 0.2, 0.375, 0.376, 0.5, 0.51, 0.625, 0.75, 1.0])


@given(
    first=RATES,
    second=RATES,
    behind_s=st.floats(0.0, 0.5),
    in_force=DUTIES,
    speed_m_s=st.floats(4.5, 5.5),
)
def test_behind_its_last_crossing_a_valve_does_what_its_schedule_says(
    first: float | None, second: float | None, behind_s: float, in_force: float, speed_m_s: float
) -> None:
    now_s = 7.0
    route = (Crossing(6.0, first, False, 5.0), Crossing(now_s - behind_s, second, False, 5.0))
    assert has_passed(route, now_s) is (first != second)
    if first == second:
        return
    quick = in_zone(second, 3, dosing, in_force, speed_m_s, now_s, has_entered=True)
    whole = schedule(
        route, valve=3, timing=TIMING, dosing=dosing, in_force=in_force, speed_soon_m_s=speed_m_s,
        now_s=now_s, until_s=now_s + 0.3,
    )  # fmt: skip
    assert quick == whole


def test_what_lies_ahead_or_is_the_border_is_not_passed() -> None:
    inside, zone = Crossing(6.0, 15.0, False, 5.0), Crossing(7.0, 20.0, False, 5.0)
    assert has_passed((inside, zone), 7.0)
    assert not has_passed((inside, zone), 6.999)
    assert not has_passed((inside,), 7.0)
    assert not has_passed((inside, zone, Crossing(7.1, 15.0, False, 5.0)), 7.2)
    assert not has_passed((Crossing(6.0, None, True, 5.0), zone), 7.0)
    assert not has_passed((inside, Crossing(7.0, None, True, 5.0)), 7.0)
    assert not has_passed((inside, Crossing(math.nan, 20.0, False, 5.0)), 7.0)


@pytest.mark.parametrize("restart", [True, False])
def test_a_change_of_another_valve_is_the_same_change(restart: bool) -> None:
    change = TimedChange(at_s=1.5, valve=0, duty=0.25, restart=restart)
    assert change.of_valve(4) == TimedChange(at_s=1.5, valve=4, duty=0.25, restart=restart)
