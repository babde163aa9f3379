"""Reads a journal into arrays: the one way from a file to an `AppliedFlight`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from datetime import datetime
from pathlib import Path

import numpy as np

from analysis.applied_flight import AppliedFlight, Series, ValveChanges
from companion.core.controller import Setup
from companion.core.frame import course_deg
from companion.core.types import (
    Decision,
    FlowReport,
    Input,
    PressureReport,
    SprayPlan,
    TankReport,
    WindReport,
)
from companion.record.reader import JournalContent, read_journal

_NAN = float("nan")


def read_applied(path: Path) -> AppliedFlight:
    """Return the flight in `path`; JournalError, in one line, where it cannot be read."""
    content = read_journal(path)
    items = list(content.items())
    decisions = [item for item in items if isinstance(item, Decision)]
    return _flight(content, decisions, [item for item in items if not isinstance(item, Decision)])


def _flight(
    content: JournalContent, decisions: Sequence[Decision], inputs: Sequence[Input]
) -> AppliedFlight:
    setup = content.setup
    known = [(each, each.state) for each in decisions if each.state is not None]
    east_m = np.array([state.east_m for _, state in known])
    north_m = np.array([state.north_m for _, state in known])
    latitude_deg, longitude_deg = _places(setup, east_m, north_m)
    started_s = float(content.meta["started_s"])
    started_utc = datetime.fromisoformat(content.meta["started_utc"])
    motion = [(state.velocity_east_m_s, state.velocity_north_m_s) for _, state in known]
    return AppliedFlight(
        path=content.path,
        meta=content.meta,
        setup=setup,
        is_closed=content.is_closed,
        lost=content.lost,
        events=content.events,
        utc_offset_s=started_utc.timestamp() - started_s,
        utc_source="computer",
        time_s=np.array([each.now_s for each, _ in known]),
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
        east_m=east_m,
        north_m=north_m,
        height_m=np.array([state.height_m for _, state in known]),
        speed_m_s=np.array([math.hypot(*each) for each in motion]),
        course_deg=np.array([course_deg(*each) for each in motion]),
        heading_deg=np.array([_number(state.heading_deg) for _, state in known]),
        rate_l_ha=np.array(
            [[_number(rate) for rate in each.rate_l_ha] for each, _ in known]
        ).reshape(-1, len(setup.boom.valves)),
        target_flow_l_min=np.array([each.target_flow_l_min for each, _ in known]),
        flow_l_min=np.array([each.flow_l_min for each, _ in known]),
        inhibits=tuple(" ".join(sorted(each.inhibits)) for each, _ in known),
        changes=changes_of([each.plan for each in decisions], len(setup.boom.valves)),
        meter_ml=_series(
            (item.received_s, _NAN if item.fault else item.volume_ml)
            for item in inputs
            if isinstance(item, FlowReport)
        ),
        pressure_kpa=_series(
            (item.received_s, item.pressure_kpa)
            for item in inputs
            if isinstance(item, PressureReport)
        ),
        tank_l=_series(
            (item.received_s, item.level_l) for item in inputs if isinstance(item, TankReport)
        ),
        wind_m_s=_series(
            (item.received_s, item.speed_m_s) for item in inputs if isinstance(item, WindReport)
        ),
    )


def changes_of(plans: Sequence[SprayPlan], valve_count: int) -> ValveChanges:
    """Return what the plans brought about: each holds until the next, or its lease, ends it."""
    rows: list[tuple[float, int, float]] = []
    duty = [0.0] * valve_count

    def take(at_s: float, valve: int, value: float) -> None:
        if duty[valve] != value:
            duty[valve] = value
            rows.append((at_s, valve, value))

    for plan, after in zip(plans, [*plans[1:], None], strict=True):
        until_s = plan.lease_until_s
        if after is not None:
            until_s = min(until_s, after.issued_s)
        for valve, value in enumerate(plan.duty):
            take(plan.issued_s, valve, value)
        for change in plan.changes:
            if change.at_s > until_s:
                break
            take(change.at_s, change.valve, change.duty)
        if after is None or after.issued_s > plan.lease_until_s:
            for valve in range(valve_count):
                take(plan.lease_until_s, valve, 0.0)
    return ValveChanges(
        planned_s=np.array([row[0] for row in rows], dtype=np.float64),
        actual_s=np.full(len(rows), _NAN),
        valve=np.array([row[1] for row in rows], dtype=np.int64),
        duty=np.array([row[2] for row in rows], dtype=np.float64),
    )


def _places(setup: Setup, east_m: np.ndarray, north_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if not len(east_m):
        return np.empty(0), np.empty(0)
    places = [setup.frame.to_geographic(e, n) for e, n in zip(east_m, north_m, strict=True)]
    latitude_deg, longitude_deg = np.array(places).T
    return latitude_deg, longitude_deg


def _series(rows: Iterable[tuple[float, float | None]]) -> Series | None:
    pairs = [(at_s, _number(value)) for at_s, value in rows]
    if not pairs:
        return None
    time_s, value = np.array(pairs).T
    return Series(time_s=time_s, value=value)


def _number(value: float | None) -> float:
    return _NAN if value is None else value
