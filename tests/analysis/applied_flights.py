"""Flights as their journal has them, made by hand: straight passes at one speed, exact orders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from analysis.flown.applied_flight import AppliedFlight, Series, ValveChanges
from companion.core.nozzle import flow_for_rate
from companion.core.setup import Setup
from tests.builders import setup

SPEED_M_S = 5.0
HZ = 20.0
START_M, END_M = -15.0, 63.0
RATES = (20.0, 25.0, 15.0, 20.0)
PLOT_M = 12.0
# Between two passes: how long, from when until when before the next one along the north of the
# field (outside of which the aircraft seems to jump), and where.
BETWEEN_S = 30.0
BACK_S = (29.0, 1.0)
BACK_NORTH_M = 300.0
Row = tuple[float, int, float]


def eastwards(
    *,
    given: Setup | None = None,
    passes_north_m: Sequence[float] = (3.0,),
    late_s: float = 0.0,
    scale: float = 1.0,
    speed_m_s: float = SPEED_M_S,
    until_m: float = 48.0,
    shut_m: tuple[float, float] | None = None,
    inhibit: str = "",
) -> AppliedFlight:
    """Return passes over the plots of `tests.builders.setup`, each from the west to the east.

    Orders are given so that by the configured lags every step lies `late_s` of flight beyond its
    boundary; flows are `scale` times what they should be. `shut_m` closes all valves there, for
    the reason `inhibit`.
    """
    used = setup() if given is None else given
    length_s = (END_M - START_M) / speed_m_s
    times = np.arange(0.0, length_s, 1.0 / HZ)
    time_s, east_m, north_m, rows = [], [], [], []
    for number, pass_north_m in enumerate(passes_north_m):
        began_s = 100.0 + number * (length_s + BETWEEN_S)
        if number:
            # The way back leads around the field.
            back_s = began_s - BETWEEN_S + np.linspace(0.0, BETWEEN_S, 100)[1:-1]
            time_s.append(back_s)
            east_m.append(np.interp(back_s, began_s - np.array(BACK_S), (END_M, START_M)))
            north_m.append(np.full(len(back_s), BACK_NORTH_M))
        time_s.append(began_s + times)
        east_m.append(START_M + speed_m_s * times)
        north_m.append(np.full(len(times), pass_north_m))
        rows += _orders(used, began_s, late_s, scale, speed_m_s, until_m, shut_m)
    return _flight(
        used,
        np.concatenate(time_s),
        np.concatenate(east_m),
        np.concatenate(north_m),
        rows,
        speed_m_s,
        shut_m,
        inhibit,
    )


def _orders(
    used: Setup,
    began_s: float,
    late_s: float,
    scale: float,
    speed_m_s: float,
    until_m: float,
    shut_m: tuple[float, float] | None,
) -> list[Row]:
    lag, curve = used.lag, used.nozzle_sets[0].curve
    edges = [(PLOT_M * i, rate) for i, rate in enumerate(RATES) if PLOT_M * i < until_m]
    edges.append((until_m, 0.0))
    if shut_m is not None:
        after = [rate for at_m, rate in edges if at_m <= shut_m[1]][-1]
        edges = [edge for edge in edges if not shut_m[0] <= edge[0] <= shut_m[1]]
        edges = sorted([*edges, (shut_m[0], 0.0), (shut_m[1], after)])
    rows: list[Row] = []
    before = 0.0
    for at_m, rate in edges:
        duty = curve.duty_for(scale * flow_for_rate(rate, speed_m_s, used.boom.width_m))
        kind_s = (
            lag.on_s
            if before == 0.0
            else lag.off_s
            if duty == 0.0
            else lag.up_s
            if duty > before
            else lag.down_s
        )
        order_s = began_s + (at_m - START_M) / speed_m_s + late_s - kind_s - lag.output_s
        rows += [(order_s, valve, duty) for valve in range(len(used.boom.valves))]
        before = duty
    return rows


def _flight(
    used: Setup,
    time_s: np.ndarray,
    east_m: np.ndarray,
    north_m: np.ndarray,
    rows: Sequence[Row],
    speed_m_s: float,
    shut_m: tuple[float, float] | None,
    inhibit: str,
) -> AppliedFlight:
    count = len(time_s)
    shut = np.zeros(count, dtype=np.bool_)
    if shut_m is not None and inhibit:
        shut = (east_m >= shut_m[0]) & (east_m <= shut_m[1])
    latitude, longitude = used.frame.to_geographic_all(east_m.tolist(), north_m.tolist())
    inside = (east_m >= 0.0) & (east_m < PLOT_M * len(RATES))
    plot = np.clip((east_m / PLOT_M).astype(np.int64), 0, len(RATES) - 1)
    rate = np.where(inside, np.array(RATES)[plot], np.nan)
    flow = np.where(inside, flow_for_rate(1.0, speed_m_s, used.boom.width_m) * rate, 0.0)
    return AppliedFlight(
        path=Path("flight-0001.gpkg"),
        meta={"journal_version": "2", "training": "no"},
        setup=used,
        is_closed=True,
        lost=0,
        events=(),
        utc_offset_s=1.7e9,
        utc_source="autopilot",
        time_s=time_s,
        latitude_deg=np.array(latitude),
        longitude_deg=np.array(longitude),
        east_m=east_m,
        north_m=north_m,
        height_m=np.full(count, 3.5),
        speed_m_s=np.full(count, speed_m_s),
        course_deg=np.full(count, 90.0),
        heading_deg=np.full(count, 90.0),
        rate_l_ha=np.repeat(rate[:, np.newaxis], len(used.boom.valves), axis=1),
        target_flow_l_min=flow,
        flow_l_min=np.where(shut, 0.0, flow),
        inhibits=tuple(inhibit if each else "" for each in shut.tolist()),
        changes=changes_of(rows),
    )


def changes_of(rows: Sequence[Row]) -> ValveChanges:
    """Return rows (time, valve, duty) as the changes of a journal without real times."""
    table = np.array(rows, dtype=np.float64).reshape(-1, 3)
    return ValveChanges(
        planned_s=table[:, 0],
        actual_s=np.full(len(table), np.nan),
        valve=table[:, 1].astype(np.int64),
        duty=table[:, 2],
    )


def with_meter(flight: AppliedFlight, time_s: np.ndarray, count_ml: np.ndarray) -> AppliedFlight:
    """Return the flight with what a meter counted."""
    return replace(flight, meter_ml=Series(time_s=time_s, value=count_ml))
