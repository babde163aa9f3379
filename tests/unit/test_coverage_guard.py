"""The guard against spraying twice: it closes where treated ground begins, and only closes."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.core.controller import Memory, Setup, step
from companion.core.coverage import Coverage
from companion.core.crossings import Crossing, Route
from companion.core.overlap_guard import STRETCH_MIN_M, OverlapGuard, cut
from companion.core.prescription import Prescription
from companion.core.schedule import rate_at
from companion.core.types import TimedChange
from tests.builders import LAG, flying, plots, setup

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
    assert memory.swath is not None
    again, _ = opened(own, memory=replace(memory, plan=None), start_s=30.0)
    assert not opening(again)


def test_a_valve_does_not_see_its_own_wake() -> None:
    guarded, _ = opened(field(overlap=OverlapGuard(switch_off_percent=1.0)))
    free, _ = opened(field())
    assert guarded == free


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
        border = draw(st.booleans())
        found.append(Crossing(at_s, draw(RATES), border, SPEED))
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
    made = cut(route, own, strict_s=0.1)
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
    made = cut(route, own, strict_s=0.1)
    times = sorted({step.at_s for step in (*route, *made)})
    for begin, end in itertools.pairwise(times):
        middle = 0.5 * (begin + end)
        if any(first <= middle < last for first, last in own):
            continue
        if rate_at(made, middle) is None and rate_at(route, middle) is not None:
            assert (end - begin) * SPEED < STRETCH_MIN_M


def test_a_change_at_the_border_is_by_the_borders_rule() -> None:
    route = (Crossing(0.0, None, False, SPEED), Crossing(2.0, 20.0, True, SPEED))
    opens = cut(route, [(1.0, 2.05)], strict_s=0.1)[-1]
    assert (opens.at_s, opens.border) == (2.05, True)
    later = cut(route, [(1.0, 2.5)], strict_s=0.1)[-1]
    assert (later.at_s, later.border) == (2.5, False)


def test_without_spans_a_route_is_itself() -> None:
    route = (Crossing(0.0, 20.0, False, SPEED), Crossing(2.0, None, True, SPEED))
    assert cut(route, [], strict_s=0.1) == route
