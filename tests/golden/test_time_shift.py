"""That no decision depends on what the clocks say is asked of each flight in `test_golden.py`."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import get_args

import pytest

from analysis.replay import FlownCore
from companion.core.types import Decision, Input
from tests.golden.checking import replayed, unpacked
from tests.golden.test_golden import AT_A_LIMIT
from tests.golden.time_shift import LENGTHS, OURS, UTC, OtherClocks, is_time


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
