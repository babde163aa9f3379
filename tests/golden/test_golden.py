"""Recorded flights of every kind decide today as they did when they were recorded.

And as they do with other clocks: both are asked of one replay, which takes half a second.
"""

from __future__ import annotations

import platform
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import pytest

from analysis.journals.content import read_journal
from analysis.replay import FlownCore
from companion.core.setup import Setup
from companion.core.types import Decision, Inhibit
from tests.builders import setup
from tests.golden.checking import (
    Replayed,
    difference,
    is_of_this_arithmetic,
    names,
    replayed,
    unpacked,
)
from tests.golden.flights import FLIGHTS
from tests.golden.time_shift import SHIFTS, OtherClocks

Change = Callable[[Decision], Decision]


# A limit that is met to the last bit, as by reports exactly two seconds apart, may be judged met
# one step later.
AT_A_LIMIT = 3
BRIEF_S = 0.06


@cache
def flown(name: str) -> tuple[Replayed, list[tuple[float, str]]]:
    """Return what differs from the record, and what with the clocks of this flight's shift."""
    other = OtherClocks(*SHIFTS[names().index(name) % len(SHIFTS)])
    with unpacked(name) as path:
        return replayed(path, is_tolerant=None, beside=other), other.found


@pytest.mark.parametrize("name", names())
def test_a_recorded_flight_is_decided_to_the_bit_as_it_was(name: str) -> None:
    found, _ = flown(name)
    assert found.first is None
    assert (found.differences, found.cells or 0, found.is_left_out) == (0, 0, 0)


@pytest.mark.parametrize("name", names())
def test_a_flight_is_decided_alike_whatever_the_clocks_say(name: str) -> None:
    _, found = flown(name)
    assert len(found) <= AT_A_LIMIT, found[:5]
    if found:
        assert found[-1][0] - found[0][0] <= BRIEF_S, found
        assert all("inhibits" in what or "plan" in what for _, what in found), found


def test_the_last_bit_is_asked_of_a_python_that_sums_as_the_one_that_recorded() -> None:
    here = {"python": platform.python_version(), "machine": platform.machine()}
    other = "3.11.7" if sys.version_info >= (3, 12) else "3.13.0"
    assert is_of_this_arithmetic(here)
    assert not is_of_this_arithmetic(here | {"machine": "sparc"})
    assert not is_of_this_arithmetic(here | {"python": other})


def test_every_flight_of_the_list_is_recorded() -> None:
    assert names() == sorted(FLIGHTS)


class OtherCore(FlownCore):
    """The core, but that some decisions of it are changed."""

    def __init__(self, given: Setup, change: Change) -> None:
        super().__init__(given)
        self._change = change

    def decide(self, now_s: float) -> Decision:
        decision = super().decide(now_s)
        return self._change(decision) if decision.plan.changes else decision


def later(by_s: float) -> Change:
    def change(decision: Decision) -> Decision:
        first, *rest = decision.plan.changes
        moved = replace(first, at_s=first.at_s - by_s)
        return replace(decision, plan=replace(decision.plan, changes=(moved, *rest)))

    return change


def opened_wider(by: float) -> Change:
    def change(decision: Decision) -> Decision:
        *rest, last = decision.plan.changes
        moved = replace(last, duty=abs(last.duty - by))
        return replace(decision, plan=replace(decision.plan, changes=(*rest, moved)))

    return change


def other_valve(decision: Decision) -> Decision:
    *rest, last = decision.plan.changes
    moved = replace(last, valve=(last.valve + 1) % len(decision.plan.duty))
    return replace(decision, plan=replace(decision.plan, changes=(*rest, moved)))


def other_flow(decision: Decision) -> Decision:
    return replace(decision, target_flow_l_min=decision.target_flow_l_min * (1.0 + 1e-8))


def of_another_hour(decision: Decision) -> Decision:
    """Change what came to the core after the flight was recorded."""
    assert decision.state is not None
    return replace(decision, state=replace(decision.state, utc_offset_s=1.0))


def inhibited(decision: Decision) -> Decision:
    return replace(decision, inhibits=frozenset({Inhibit.LEAK}))


@pytest.mark.parametrize(
    ("change", "exact", "tolerant"),
    [
        (later(5e-7), "plan.changes[0].at_s", None),
        (later(2e-6), "plan.changes[0].at_s", "plan.changes[0].at_s"),
        (opened_wider(1e-10), "].duty", None),
        (opened_wider(1e-8), "].duty", "].duty"),
        (other_valve, "].valve", "].valve"),
        (other_flow, "target_flow_l_min", "target_flow_l_min"),
        (inhibited, "inhibits", "inhibits"),
        (of_another_hour, "state.utc_offset_s", "state.utc_offset_s"),
    ],
)
def test_what_is_decided_otherwise_is_named(
    change: Change, exact: str, tolerant: str | None
) -> None:
    def core(given: Setup) -> OtherCore:
        return OtherCore(given, change)

    with unpacked("ardupilot-cut") as path:
        found = replayed(path, core=core, until_s=13.0)
        nearly = replayed(path, core=core, until_s=13.0, is_tolerant=True)
        meta = read_journal(path).meta
    assert found.first is not None
    # A Python that sums otherwise differs before that.
    assert exact in found.first or not is_of_this_arithmetic(meta)
    assert found.is_left_out
    if tolerant is None:
        assert nearly.first is None
    else:
        assert nearly.first is not None
        assert tolerant in nearly.first


@pytest.mark.parametrize(
    ("was", "now", "is_tolerant", "is_same"),
    [
        (float("nan"), float("nan"), False, True),
        (float("nan"), 1.0, True, False),
        (0.0, -0.0, False, False),
        (0.0, -0.0, True, True),
        (float("inf"), 1e300, True, False),
        (1, 1.0, True, False),
        (True, 1, False, False),
        ((1.0,), (1.0, 2.0), True, False),
        ("a", "b", True, False),
        (None, 0.0, True, False),
    ],
)
def test_values_are_the_same_only_where_they_are(
    was: Any, now: Any, is_tolerant: bool, is_same: bool
) -> None:
    assert (difference(was, now, "value", is_tolerant=is_tolerant) is None) == is_same


def test_what_is_no_value_of_the_core_is_not_compared() -> None:
    with pytest.raises(AssertionError, match="not a value of the core"):
        difference([setup()], [setup()], "setups")
