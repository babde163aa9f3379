"""Flights along logs of flights that were really flown; VRSPRAY_REAL says where those are."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sitl.along import AlongOptions, Bed, figures_of, fly_method, prepare

LOGS = Path(os.environ.get("VRSPRAY_REAL", "")) / "flights"
needs_logs = pytest.mark.skipif(
    "VRSPRAY_REAL" not in os.environ, reason="no logs of real flights: set VRSPRAY_REAL"
)


@needs_logs
def test_the_smoothed_path_stays_by_what_was_told():
    bed = prepare(AlongOptions(log=LOGS / "q130.BIN"))
    assert any("0.02 m apart" in note for note in bed.notes)
    path, states = bed.path.at(bed.flight.states.time_s), bed.flight.states
    off_m_s = np.hypot(
        path.velocity_east_m_s - states.east_m_s, path.velocity_north_m_s - states.north_m_s
    )
    assert float(np.sqrt((off_m_s**2).mean())) < 0.06


@needs_logs
def test_a_piece_of_a_real_flight_is_sprayed_better_the_more_is_known():
    bed = prepare(AlongOptions(log=LOGS / "q130.BIN", position_rate_hz=10.0))
    bed = piece(bed, 6808.0, 6818.0)
    found = [figures_of(bed, fly_method(bed, m, 1)) for m in ("perfect", "vrspray", "none")]
    perfect, ours, none = (each["misapplied_percent"] for each in found)
    assert perfect < ours < none
    assert perfect < 6.0


def piece(bed: Bed, begin_s: float, end_s: float) -> Bed:
    """A few seconds of a flight."""
    within = [
        (each >= begin_s) & (each <= end_s)
        for each in (bed.path.time_s, bed.flight.states.time_s, bed.told.time_s)
    ]
    return replace(
        bed,
        path=bed.path.at(bed.path.time_s[within[0]]),
        flight=replace(bed.flight, states=bed.flight.states[within[1]]),
        told=bed.told[within[2]],
    )
