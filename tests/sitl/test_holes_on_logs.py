"""The bar the other way: over fields with holes valves close no earlier than there is need."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from sitl.along import AlongOptions, prepare
from tests import flown_logs
from tests.holes_judge import bars, judged

needs_logs = pytest.mark.skipif(
    "VRSPRAY_REAL" not in os.environ, reason="no logs of real flights: set VRSPRAY_REAL"
)


def held(log: Path, seed: int) -> None:
    ours, theirs = judged(
        [prepare(AlongOptions(log=log, position_rate_hz=10.0, seed=seed))], [seed]
    )
    assert ours.closings > 5
    assert [name for name, value, limit in bars(ours, theirs) if not value <= limit] == []


def test_on_a_made_up_log_valves_close_no_earlier_than_there_is_need(tmp_path: Path) -> None:
    held(flown_logs.telemetry(tmp_path / "a.tlog"), 1)


@needs_logs
@pytest.mark.parametrize("name", ["q116.BIN", "q130.BIN"])
def test_on_flown_logs_valves_close_no_earlier_than_there_is_need(name: str) -> None:
    held(Path(os.environ["VRSPRAY_REAL"]) / "flights" / name, 1)
