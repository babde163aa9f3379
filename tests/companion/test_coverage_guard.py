"""The guard against spraying twice: it closes where treated ground begins, and only closes."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from companion.core.boom import Boom, Valve
from companion.core.controller import Memory, step
from companion.core.crossings import Crossing, Route, rate_at
from companion.core.options.coverage import Coverage
from companion.core.options.overlap import STRETCH_MIN_M, OverlapGuard, cut, wake_m
from companion.core.options.treated_area import SNAPSHOTS_MAX
from companion.core.prescription import Prescription
from companion.core.schedule import orders
from companion.core.setup import Setup
from companion.core.types import TimedChange
from tests.builders import LAG, along, flying, plots, setup

SPEED = 5.0
HALF = OverlapGuard(switch_off_percent=50.0)
OUTLINE = ((0.0, 0.0), (48.0, 0.0), (48.0, 6.0), (0.0, 6.0))
WHOLE = Coverage().stamped([OUTLINE])


def field(**change: object) -> Setup:
    """Three rows of one rate, 48 m long; passes lie 6 m apart from north 3 on."""
    zones = plots([[20.0] * 4] * 3)
    return setup(**({"prescription": Prescription(zones), "border": "volume"} | change))


def opened(
    own: Setup,
    *,
    north_m: float = 3.0,
    memory: Memory | None = None,
    noise_m: float = 0.0,
    start_s: float = 10.0,
    end_m: float = 58.0,
) -> tuple[list[TimedChange], Memory]:
    """Return what an executor carries out on a pass eastwards, and what it leaves."""
    rng = np.random.default_rng(7)
    memory = memory or Memory()
    done: list[TimedChange] = []
    pending: list[TimedChange] = []
    for i in range(round((end_m + 10.0) / SPEED * 20.0)):
        now = start_s + i / 20.0
        done += [change for change in pending if change.at_s <= now]
        aside = float(noise_m * rng.standard_normal())
        state = flying(now, -10.0 + 0.25 * i, north_m + aside)
        decision, memory = step(own, state, memory, now)
        pending = list(decision.plan.changes)
    return done, memory


def opening(changes: list[TimedChange]) -> set[int]:
    return {change.valve for change in changes if change.duty > 0.0}


def test_a_pass_over_treated_ground_opens_nothing() -> None:
    changes, _ = opened(field(overlap=HALF, treated=WHOLE))
    assert not opening(changes)
    assert opening(opened(field(treated=WHOLE))[0]) == set(range(6))


def test_the_same_pass_again_applies_nothing() -> None:
    own = field(overlap=HALF)
    first, memory = opened(own)
    assert opening(first) == set(range(6))
    assert memory.watched.area is not None
    again, _ = opened(own, memory=replace(memory, plan=None), start_s=30.0)
    assert not opening(again)


def test_a_valve_does_not_see_its_own_wake() -> None:
    guarded, _ = opened(field(overlap=OverlapGuard(switch_off_percent=1.0)))
    free, _ = opened(field())
    assert guarded == free


def staggered(stagger_m: float, strip_m: float) -> Boom:
    """Six valves 1 m apart, every other one ahead of the rest, with strips of any width."""
    valves = tuple(
        Valve(
            name=str(k + 1),
            right_m=k - 2.5,
            forward_m=stagger_m * (0.5 if k % 2 else -0.5),
            width_m=strip_m,
        )
        for k in range(6)
    )
    return Boom(width_m=6.0, valves=valves)


def slow_field(own: Boom) -> Setup:
    """A field with a rate that the nozzles deliver at walking pace."""
    zones = plots([[80.0] * 4] * 3)
    limits = replace(setup().limits, speed_min_m_s=0.3)
    return field(boom=own, prescription=Prescription(zones), limits=limits)


def at_speed(own: Setup, speeds: Sequence[float], *, until_m: float) -> tuple[list[float], Memory]:
    """Return the duties in force of every step of a pass, whose speed changes every second."""
    memory, done = Memory(), []
    now, east_m = 10.0, -8.0
    pace = itertools.cycle([speed for speed in speeds for _ in range(10)])
    while east_m < until_m:
        speed = next(pace)
        state = flying(now, east_m, 3.0, **along(90.0, speed))
        decision, memory = step(own, state, memory, now)
        done += decision.plan.duty
        now, east_m = now + 0.1, east_m + 0.1 * speed
    return done, memory


def test_a_staggered_boom_does_not_see_the_wake_of_its_front_row() -> None:
    # Rows 3 m apart at 1.2 m/s: the rear one comes 2.5 s later.
    own = slow_field(staggered(3.0, 2.0))
    free, _ = at_speed(own, [1.2], until_m=20.0)
    guarded, memory = at_speed(replace(own, overlap=HALF), [1.2], until_m=20.0)
    assert any(free)
    assert guarded == free
    # Not because it sees nothing: farther back than its wake it does.
    assert memory.watched.area is not None
    seen = memory.watched.area.before(1e9, here=(20.0, 3.0), behind_m=wake_m(own.boom))
    assert seen is not None
    assert seen.area_m2 > 50.0


@settings(max_examples=15, deadline=None)
@example(stagger_m=6.0, strip_m=2.5, percent=20.0, speeds=[0.6])
@example(stagger_m=4.0, strip_m=2.0, percent=50.0, speeds=[0.6, 3.0])
@given(
    stagger_m=st.floats(0.0, 6.0),
    strip_m=st.floats(1.0, 2.5),
    percent=st.floats(10.0, 100.0),
    speeds=st.lists(st.floats(0.6, 5.0), min_size=1, max_size=4),
)
def test_on_bare_ground_a_straight_pass_is_the_same_with_a_guard(
    stagger_m: float, strip_m: float, percent: float, speeds: list[float]
) -> None:
    own = slow_field(staggered(stagger_m, strip_m))
    guard = OverlapGuard(switch_off_percent=percent)
    free, _ = at_speed(own, speeds, until_m=12.0)
    guarded, _ = at_speed(replace(own, overlap=guard), speeds, until_m=12.0)
    assert guarded == free


def test_its_own_ground_is_seen_again_when_it_comes_back() -> None:
    own = replace(slow_field(staggered(3.0, 1.0)), overlap=HALF)
    first, memory = opened(own)
    assert opening(first) == set(range(6))
    again, _ = opened(own, memory=replace(memory, plan=None), start_s=30.0)
    assert not opening(again)


def test_whoever_hardly_moves_keeps_what_lies_farther_back() -> None:
    # Half a metre a second, stamped every other second: still more than a wake is remembered.
    own = replace(slow_field(staggered(3.0, 2.0)), overlap=HALF)
    _, memory = at_speed(own, [4.0] * 4 + [0.5] * 26, until_m=20.0)
    assert memory.watched.area is not None
    first = memory.watched.area.older[0]
    assert len(memory.watched.area.older) == SNAPSHOTS_MAX
    assert memory.watched.area.way_m - first.way_m >= wake_m(own.boom)


@pytest.mark.parametrize(("spread_m", "wake"), [(0.0, 1.0), (3.0, 4.0), (90.0, 25.0)])
def test_the_wake_is_as_long_as_the_boom_and_bounded(spread_m: float, wake: float) -> None:
    assert wake_m(staggered(spread_m, 1.0)) == pytest.approx(wake)


@pytest.mark.parametrize(
    ("aside_m", "open_valves"),
    [(0.7, {0}), (1.7, {0, 1}), (2.2, {0, 1}), (3.0, {0, 1, 2}), (5.3, {0, 1, 2, 3, 4})],
)
def test_strips_close_where_half_of_them_is_treated(aside_m: float, open_valves: set[int]) -> None:
    # Aside to the north, flying east: the left valves (0, 1, ...) leave the treated ground first.
    changes, _ = opened(field(overlap=HALF, treated=WHOLE), north_m=3.0 + aside_m)
    assert opening(changes) == open_valves


@pytest.mark.parametrize(("percent", "is_open"), [(20.0, False), (35.0, False), (45.0, True)])
def test_the_percentage_is_of_the_width_of_a_strip(percent: float, is_open: bool) -> None:
    guard = OverlapGuard(switch_off_percent=percent)
    changes, _ = opened(field(overlap=guard, treated=WHOLE), north_m=3.0 + 5.62)
    assert (5 in opening(changes)) is is_open
    assert opening(changes) >= {0, 1, 2, 3, 4}


def test_the_next_pass_at_its_spacing_is_not_touched() -> None:
    # Noise as an RTK position has it, and the edge that a noisy pass has left.
    own = field(overlap=HALF)
    _, memory = opened(own, noise_m=0.03)
    guarded, _ = opened(
        own, north_m=9.0, noise_m=0.03, memory=replace(memory, plan=None), start_s=30.0
    )
    closing = [change for change in guarded if change.duty == 0.0]
    assert opening(guarded) == set(range(6))
    # Closed once, at the end of the field.
    assert len(closing) == 6
    assert min(change.at_s for change in closing) > 30.0 + (10.0 + 47.0) / SPEED


def test_it_closes_and_opens_ahead_of_the_boundary_by_each_changes_own_lag() -> None:
    patch = Coverage().stamped([((16.0, -9.0), (30.0, -9.0), (30.0, 20.0), (16.0, 20.0))])
    changes, _ = opened(field(overlap=HALF, treated=patch))
    own = [change for change in changes if change.valve == 2 and change.restart]
    assert [change.duty > 0.0 for change in own] == [True, False, True, False]
    _, off, on, _ = own
    assert off.at_s == pytest.approx(10.0 + 26.0 / SPEED - LAG.off_s - LAG.output_s, abs=0.03)
    assert on.at_s == pytest.approx(10.0 + 40.0 / SPEED - LAG.on_s - LAG.output_s, abs=0.03)


def test_a_speck_of_treated_ground_closes_nothing_and_a_gap_opens_nothing() -> None:
    speck = Coverage().stamped([((20.0, -9.0), (20.4, -9.0), (20.4, 20.0), (20.0, 20.0))])
    changes, _ = opened(field(overlap=HALF, treated=speck))
    assert [change.duty > 0.0 for change in changes if change.valve == 0] == [True, False]
    gap = Coverage().stamped(
        [
            ((-1.0, -9.0), (20.0, -9.0), (20.0, 20.0), (-1.0, 20.0)),
            ((20.4, -9.0), (49.0, -9.0), (49.0, 20.0), (20.4, 20.0)),
        ]
    )
    assert not opening(opened(field(overlap=HALF, treated=gap))[0])


def test_far_from_treated_ground_the_decisions_are_the_same() -> None:
    far = Coverage().stamped([tuple((x + 500.0, y) for x, y in OUTLINE)])  # type: ignore[arg-type]
    assert opened(field(overlap=HALF, treated=far))[0] == opened(field())[0]


@pytest.mark.parametrize(
    "wrong",
    [
        {"switch_off_percent": 0.0},
        {"switch_off_percent": 100.1},
        {"switch_off_percent": math.nan},
        {"switch_off_percent": 50.0, "fresh_s": 0.1},
        {"switch_off_percent": 50.0, "fresh_s": math.nan},
    ],
)
def test_a_guard_that_cannot_be_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="must lie in"):
        OverlapGuard(**wrong)


# ------------------------------------------------------------------------------------ the law

RATES = st.sampled_from([None, 10.0, 20.0])


@st.composite
def routes(draw: st.DrawFn) -> Route:
    at_s, found = 0.0, []
    for _ in range(draw(st.integers(1, 6))):
        rate = draw(RATES)
        found.append(Crossing(at_s, rate, rate is None and draw(st.booleans()), SPEED))
        at_s += draw(st.floats(0.02, 2.0))
    return tuple(found)


@st.composite
def spans(draw: st.DrawFn) -> list[tuple[float, float]]:
    ends = sorted(draw(st.lists(st.floats(-1.0, 9.0), min_size=2, max_size=6, unique=True)))
    pairs = list(zip(ends[::2], ends[1::2], strict=False))
    return [*pairs[:-1], (pairs[-1][0], math.inf)] if draw(st.booleans()) else pairs


@given(route=routes(), own=spans(), at_s=st.floats(0.0, 12.0))
def test_what_was_closed_stays_closed_and_treated_ground_is(
    route: Route, own: list[tuple[float, float]], at_s: float
) -> None:
    made = cut(route, own)
    rate = rate_at(made, at_s)
    assert rate is None or rate == rate_at(route, at_s)
    if any(begin <= at_s < end for begin, end in own):
        assert rate is None
    times = [step.at_s for step in made]
    assert times == sorted(set(times))
    assert made[0].at_s == route[0].at_s


@given(route=routes(), own=spans())
def test_it_closes_beside_treated_ground_only_what_is_too_short(
    route: Route, own: list[tuple[float, float]]
) -> None:
    made = cut(route, own)
    times = sorted({step.at_s for step in (*route, *made)})
    for begin, end in itertools.pairwise(times):
        middle = 0.5 * (begin + end)
        if any(first <= middle < last for first, last in own):
            continue
        if rate_at(made, middle) is None and rate_at(route, middle) is not None:
            assert (end - begin) * SPEED < STRETCH_MIN_M


def test_treated_ground_at_the_edge_leaves_the_border_its_rule() -> None:
    route = (
        Crossing(0.0, None, True, SPEED), Crossing(2.0, 20.0, False, SPEED),
        Crossing(5.0, None, True, SPEED),
    )  # fmt: skip
    timing = setup().timing
    # Treated to just inside the border, and far beyond it: by the first flow, by the volume.
    for end_s, at_s in ((2.01, 2.0 - timing.border_on_s), (2.5, 2.5 - timing.on_s)):
        opens = next(o for o in orders(cut(route, [(1.0, end_s)]), timing, dosing) if o.duty)
        assert opens.at_s == pytest.approx(at_s)
    for begin_s, at_s in ((4.99, 5.0 - timing.border_off_s), (4.5, 4.5 - timing.off_s)):
        closes = orders(cut(route, [(begin_s, 6.0)]), timing, dosing)[-1 if begin_s > 4.9 else -2]
        assert (closes.at_s, closes.duty) == (pytest.approx(at_s), 0.0)


def dosing(rate_l_ha: float, speed_m_s: float) -> float:
    return rate_l_ha * speed_m_s / 200.0


def test_without_spans_a_route_is_itself() -> None:
    route = (Crossing(0.0, 20.0, False, SPEED), Crossing(2.0, None, True, SPEED))
    assert cut(route, []) == route
