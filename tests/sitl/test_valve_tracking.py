"""Valves tracked over a whole flight of the twin, whose truth knows nothing of the filter."""

from __future__ import annotations

from companion.core.options.valve_tracking import ValveTracking
from tests.bench.valve_tracking import BLOCKED, tracked


def test_a_valve_that_loses_15_percent_in_flight_is_named() -> None:
    found = tracked(4, is_blocked=True, settings=ValveTracking())
    assert found.track is not None
    assert BLOCKED in [finding.valve for finding in found.track.findings]
    assert found.track.nozzles.shares[BLOCKED] < 0.95
