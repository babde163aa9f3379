"""Flights along logs of flights that were really flown; VRSPRAY_REAL says where those are."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sitl.along import AlongOptions, figures_of, fly_method, prepare
from sitl.earth import Earth
from sitl.recorded import read_flight
from sitl.smoother import true_path

LOGS = Path(os.environ.get("VRSPRAY_REAL", "")) / "flights"
needs_logs = pytest.mark.skipif(
    "VRSPRAY_REAL" not in os.environ, reason="no logs of real flights: set VRSPRAY_REAL"
)


@needs_logs
def test_the_smoothed_path_stays_by_what_was_told():
    flight = read_flight(LOGS / "q130.BIN")
    earth = Earth(float(flight.latitude_deg[0]), float(flight.longitude_deg[0]))
    path = true_path(flight, earth).at(flight.time_s)
    east_m, north_m = earth.to_local_all(flight.latitude_deg, flight.longitude_deg)
    off_m = np.hypot(path.east_m - east_m, path.north_m - north_m)
    assert float(np.sqrt((off_m**2).mean())) < 0.03
    off_m_s = np.hypot(
        path.velocity_east_m_s - flight.velocity_east_m_s,
        path.velocity_north_m_s - flight.velocity_north_m_s,
    )
    assert float(np.sqrt((off_m_s**2).mean())) < 0.06


@needs_logs
def test_rates_leave_rows_out_or_put_some_between_and_none_into_a_gap():
    flight = read_flight(LOGS / "q130.BIN").between(6803.0, 6813.0)
    assert np.isin(flight.at_rate(5.0).time_s, flight.time_s).all()
    assert len(flight.at_rate(5.0).time_s) == pytest.approx(len(flight.time_s) / 2, abs=1)
    keep = np.delete(np.arange(len(flight.time_s)), slice(40, 50))
    gap = flight._rows(keep).at_rate(20.0)
    assert float(np.diff(gap.time_s).max()) == pytest.approx(1.1, abs=0.02)
    assert float(np.median(np.diff(gap.time_s))) == pytest.approx(0.05, abs=0.002)


@needs_logs
def test_a_piece_of_a_real_flight_is_sprayed_better_the_more_is_known():
    bed = prepare(AlongOptions(log=LOGS / "q130.BIN", position_rate_hz=10.0))
    begin_s, end_s = 6808.0, 6818.0
    where = (bed.path.time_s >= begin_s) & (bed.path.time_s <= end_s)
    arrays = ("time_s", "east_m", "north_m", "velocity_east_m_s", "velocity_north_m_s")
    piece = {name: getattr(bed.path, name)[where] for name in (*arrays, "heading_deg", "leg")}
    bed = replace(
        bed,
        path=replace(bed.path, **piece),
        flight=bed.flight.between(begin_s, end_s),
        told=bed.told.between(begin_s, end_s),
    )
    found = {m: figures_of(bed, fly_method(bed, m, 1)) for m in ("perfect", "vrspray", "none")}
    perfect, ours, none = (each.misapplied_percent for each in found.values())
    assert perfect < ours < none
    assert perfect < 6.0
