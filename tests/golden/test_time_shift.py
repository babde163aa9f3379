"""That no decision depends on what the clocks say is asked of each flight in `test_golden.py`."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, get_args

import pytest

from analysis.replay import FlownCore
from companion.core.types import Decision, Input, TimedChange
from tests.golden.checking import replayed, unpacked
from tests.golden.test_golden import AT_A_LIMIT
from tests.golden.time_shift import LENGTHS, OURS, UTC, OtherClocks, is_alike, is_time


def test_every_time_of_an_input_is_known_here() -> None:
    known = OURS | LENGTHS | UTC | {"boot_s", "offset_s"}
    times = {one.name for kind in get_args(Input) for one in fields(kind) if is_time(one.name)}
    assert times <= known, times - known


def test_a_core_that_looks_at_the_clock_itself_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    decide = FlownCore.decide

    def by_the_clock(self: FlownCore, now_s: float) -> Decision:
        made = decide(self, now_s)
        return replace(made, late_count=made.late_count + (now_s > 5500.0))

    monkeypatch.setattr(FlownCore, "decide", by_the_clock)
    other = OtherClocks(1000.1, 0.0)
    with unpacked("ardupilot-cut") as path:
        replayed(path, beside=other)
    assert len(other.found) > AT_A_LIMIT


@pytest.mark.parametrize(
    ("change", "is_so"),
    [
        ({}, True),
        ({"at_s": 8.0}, False),
        ({"at_s": 9.0 + 2e-6}, False),
        ({"duty": 0.5 + 2e-6}, False),
        ({"valve": 3}, False),
        ({"restart": False}, False),
    ],
)
def test_what_moves_with_the_clock_and_nothing_else_is_alike(
    change: dict[str, Any], is_so: bool
) -> None:
    here = TimedChange(at_s=8.0, valve=2, duty=0.5)
    there = replace(here, **{"at_s": 9.0, **change})
    assert is_alike((here, "a", None), (there, "a", None), 1.0) == is_so
    assert not is_alike((here, None), (there, 0.0), 1.0)
    assert not is_alike((here, here), (there,), 1.0)
