"""Laws of judging single valves: what they share is no fault, and no number is no health."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from companion.core.types import FaultKind
from companion.ground.clicks import (
    NOTHING_SHARE,
    SUPPLY_SHARE,
    ClickFlow,
    ClickLaw,
    judge_clicks,
    limit_of,
)

FLOW_ML_S, OPEN_S, WINDOW_S = 17.0, 2.0, 4.0
LAW = ClickLaw(valve_ml_s=(FLOW_ML_S,) * 6, step_ml=0.2)
NAMES = {FaultKind.STUCK_CLOSED, FaultKind.CLOG, FaultKind.LEAK, None}


def flows(*shares: float) -> list[ClickFlow]:
    return [
        ClickFlow(
            valve=valve,
            open_s=OPEN_S,
            window_s=WINDOW_S,
            metered_ml=share * FLOW_ML_S * OPEN_S,
        )
        for valve, share in enumerate(shares)
    ]


def kinds(found: list[ClickFlow], law: ClickLaw = LAW) -> list[FaultKind | None]:
    return [each.kind for each in judge_clicks(law, found).valves]


healthy = st.lists(st.floats(0.97, 1.03), min_size=6, max_size=6)
shares = st.lists(st.floats(0.0, 2.0), min_size=6, max_size=6)
no_numbers = st.sampled_from([math.nan, math.inf, -math.inf, -1.0])


@given(healthy, st.floats(SUPPLY_SHARE + 0.05, 2.0))
def test_what_all_valves_share_is_no_fault_of_a_valve(each: list[float], common: float) -> None:
    said = judge_clicks(LAW, flows(*(share * common for share in each)))
    assert [one.kind for one in said.valves] == [None] * 6
    assert said.fault is None


@given(healthy, st.floats(NOTHING_SHARE + 0.05, SUPPLY_SHARE - 0.05))
def test_too_little_of_all_is_the_supply(each: list[float], common: float) -> None:
    assert judge_clicks(LAW, flows(*(share * common for share in each))).fault is FaultKind.SUPPLY


@given(shares, st.permutations(range(6)))
def test_the_order_of_the_valves_tells_nothing(each: list[float], order: list[int]) -> None:
    found = flows(*each)
    said = {one.valve: one.kind for one in judge_clicks(LAW, found).valves}
    again = judge_clicks(LAW, [found[valve] for valve in order])
    assert {one.valve: one.kind for one in again.valves} == said


@given(healthy, st.integers(0, 5), st.floats(0.0, 0.85))
def test_a_valve_that_gives_too_little_is_named_and_it_alone(
    each: list[float], valve: int, left: float
) -> None:
    found = flows(*(left if number == valve else share for number, share in enumerate(each)))
    said = kinds(found)
    assert said[valve] in (FaultKind.CLOG, FaultKind.STUCK_CLOSED)
    assert [kind for number, kind in enumerate(said) if number != valve] == [None] * 5


@given(healthy, st.integers(0, 5), no_numbers)
def test_a_count_that_is_no_number_is_no_health(
    each: list[float], valve: int, count: float
) -> None:
    found = flows(*each)
    found[valve] = replace(found[valve], metered_ml=count)
    said = kinds(found)
    assert said[valve] is FaultKind.METER_FAULT
    assert [kind for number, kind in enumerate(said) if number != valve] == [None] * 5


@given(healthy, no_numbers)
def test_an_idle_flow_that_is_no_number_proves_nothing(each: list[float], idle_ml: float) -> None:
    said = judge_clicks(replace(LAW, idle_ml=idle_ml), flows(*each))
    assert {one.kind for one in said.valves} == {FaultKind.METER_FAULT}
    assert said.fault is FaultKind.METER_FAULT


@given(shares, st.integers(0, 5), st.floats(0.0, 0.5))
def test_with_less_flow_a_wanting_valve_does_not_become_healthy(
    each: list[float], valve: int, less: float
) -> None:
    found = flows(*each)
    before = judge_clicks(LAW, found)
    share = before.valves[valve].share
    assume(before.valves[valve].kind in (FaultKind.CLOG, FaultKind.STUCK_CLOSED))
    assume(share is not None and share < 0.5)
    found[valve] = replace(found[valve], metered_ml=found[valve].metered_ml * less)
    # Only with no other valve flowing is there nothing left to compare it with.
    assert judge_clicks(LAW, found).valves[valve].kind is not None


@given(healthy, st.integers(0, 5))
def test_a_valve_that_stays_open_is_the_one_whose_order_changes_nothing(
    each: list[float], valve: int
) -> None:
    law = replace(LAW, idle_ml=FLOW_ML_S * 9.0, idle_s=9.0)
    found = [
        replace(
            flow,
            metered_ml=FLOW_ML_S * WINDOW_S + (0.0 if flow.valve == valve else flow.metered_ml),
        )
        for flow in flows(*each)
    ]
    said = judge_clicks(law, found)
    assert [one.kind for one in said.valves].count(FaultKind.STUCK_OPEN) == 1
    assert said.valves[valve].kind is FaultKind.STUCK_OPEN
    assert said.fault is None


@given(shares)
def test_every_valve_gets_a_verdict(each: list[float]) -> None:
    said = judge_clicks(LAW, flows(*each))
    assert [one.valve for one in said.valves] == list(range(6))
    assert {one.kind for one in said.valves} <= NAMES


@given(st.floats(0.1, 5.0), st.floats(0.05, 2.0))
def test_a_longer_click_sees_no_less(open_s: float, step_ml: float) -> None:
    law = replace(LAW, step_ml=step_ml)
    short = ClickFlow(valve=0, open_s=open_s, window_s=open_s, metered_ml=0.0)
    longer = replace(short, open_s=2.0 * open_s, window_s=2.0 * open_s)
    assert limit_of(law, longer) <= limit_of(law, short)


def test_nothing_at_all_is_no_flow_and_a_leak_is_a_leak() -> None:
    assert judge_clicks(LAW, flows(*(0.0,) * 6)).fault is FaultKind.NO_FLOW
    leaking = replace(LAW, idle_ml=0.3 * FLOW_ML_S * 9.0, idle_s=9.0)
    assert judge_clicks(leaking, flows(*(1.6,) * 6)).fault is FaultKind.LEAK


def test_two_silent_valves_beside_one_open_are_not_told_apart() -> None:
    law = replace(LAW, idle_ml=FLOW_ML_S * 9.0, idle_s=9.0)
    found = [
        replace(flow, metered_ml=flow.metered_ml + FLOW_ML_S * WINDOW_S)
        for flow in flows(1.0, 1.0, 0.0, 0.0, 1.0, 1.0)
    ]
    said = judge_clicks(law, found)
    assert said.fault is FaultKind.STUCK_OPEN
    assert [one.kind for one in said.valves][2:4] == [FaultKind.STUCK_CLOSED] * 2


def test_two_valves_alone_are_compared_with_the_table() -> None:
    law = ClickLaw(valve_ml_s=(FLOW_ML_S,) * 2, step_ml=0.2)
    assert kinds(flows(1.0, 1.1), law) == [None, None]
    assert kinds(flows(1.0, 0.5), law) == [None, FaultKind.CLOG]


@pytest.mark.parametrize(
    "wrong",
    [
        {"valve_ml_s": ()},
        {"valve_ml_s": (math.nan,)},
        {"step_ml": 0.0},
        {"idle_s": math.nan},
        {"meter_spread": 0.0},
        {"closed_share": 1.0},
    ],
)
def test_a_law_that_is_none_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="must"):
        replace(LAW, **wrong)  # type: ignore[arg-type]
