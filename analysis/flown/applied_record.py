"""A flown journal as a `FlightRecord`, so that every metric can be had of a real flight.

The path is the autopilot's, the volume is the modelled one of the executed changes: what position,
lags and curves are wrong by nobody can see from here. docs/explanation/flight-figures.md says how
far that is from the truth of simulated flights.
"""

from __future__ import annotations

import tomllib
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from analysis.flight_record import FlightMeta, FlightRecord, Orders
from analysis.flown.holes import with_gaps
from analysis.flown.modelled_flow import ordered_s, pumped_ml, valve_flows
from companion.errors import VrsprayError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.flight_record import Spans
    from analysis.flown.applied_flight import AppliedFlight, Floats

STEP_S = 0.01
SAMPLES_MIN = 3


class EvaluationError(VrsprayError):
    """A flight of which nothing can be evaluated."""


def record_of(flight: AppliedFlight) -> FlightRecord:
    """Return the flight as the metrics take it; EvaluationError where it never had a position."""
    samples = int(flight.duration_s / STEP_S + 1e-6) + 1
    if samples < SAMPLES_MIN:
        raise EvaluationError(
            f"{flight.path}: the flight has {len(flight.time_s)} decisions with a position; "
            "there is nothing to evaluate"
        )
    setup = flight.setup
    time_s = flight.time_s[0] + STEP_S * np.arange(samples, dtype=np.float64)
    makes_flow = setup.pumping is not None
    limits = (0.0, float("inf")) if makes_flow else (setup.pwm.duty_min, setup.pwm.duty_max)
    return FlightRecord(
        time_s=time_s,
        east_m=np.interp(time_s, flight.time_s, flight.east_m),
        north_m=np.interp(time_s, flight.time_s, flight.north_m),
        heading_deg=heading_deg(flight, time_s),
        volume_ml=modelled_ml(flight, time_s),
        boom=setup.boom,
        prescription=setup.prescription,
        lines=setup.lines,
        guard=setup.overlap,
        treated=setup.treated,
        pwm_period_s=setup.pwm.period_s,
        duty_limits=limits,
        nozzle_sets=() if makes_flow else setup.nozzle_sets,
        orders=executed_orders(flight),
        meta=_meta(flight),
        ferried=_ferried(flight),
        unknown=with_gaps(flight.unknown, flight.time_s, valves=len(setup.boom.valves)),
    )


def _ferried(flight: AppliedFlight) -> Spans:
    """Return when nothing was asked for and nothing held the valves: the way led to no line."""
    idle = np.isnan(flight.rate_l_ha).all(axis=1) & (flight.flow_l_min == 0.0)
    idle &= np.array([not reasons for reasons in flight.inhibits], dtype=np.bool_)
    edges = np.flatnonzero(np.diff(idle, prepend=False, append=False))
    ends_s = np.append(flight.time_s, flight.time_s[-1:])[edges].tolist()
    return tuple(zip(ends_s[::2], ends_s[1::2], strict=True))


def modelled_ml(flight: AppliedFlight, time_s: Floats) -> Floats:
    """Return the modelled cumulative volume, one column a valve."""
    setup = flight.setup
    if setup.pumping is not None:
        return pumped_ml(flight, time_s)
    changes = flight.changes
    lags = [setup.lag.of_valve(valve) for valve in setup.boom.valves]
    flows = valve_flows(changes, setup.nozzle_sets, lags, setup.timings)
    return np.stack([flow.volume_ml(time_s) for flow in flows], axis=1)


def executed_orders(flight: AppliedFlight) -> Orders:
    """Return the changes as the output carried them out, in order of time."""
    order_s = ordered_s(flight.changes)
    rows = np.argsort(order_s, kind="stable")
    return Orders(order_s[rows], flight.changes.valve[rows], flight.changes.duty[rows])


def heading_deg(flight: AppliedFlight, time_s: Floats) -> Floats:
    """Return the nose's direction at any times; the course where no heading is known."""
    known = np.where(np.isfinite(flight.heading_deg), flight.heading_deg, flight.course_deg)
    # A course is not finite, or anything at all, while the aircraft stands.
    usable: NDArray[np.bool_] = np.isfinite(known)
    if not usable.any():
        return np.zeros(len(time_s))
    unwrapped = np.unwrap(known[usable], period=360.0)
    turned: Floats = np.interp(time_s, flight.time_s[usable], unwrapped) % 360.0
    return turned


def _meta(flight: AppliedFlight) -> FlightMeta:
    flying = flight.speed_m_s[flight.flow_l_min > 0.0]
    every = flying if len(flying) else flight.speed_m_s
    meta = FlightMeta(
        speed_m_s=float(np.median(every)),
        method=flight.setup.method.value,
        fidelity="averaged",
        output=_output(flight.meta.get("config_toml", "")),
        seed=0,
    )
    return replace(meta, training=flight.training)


@lru_cache(maxsize=8)
def _output(config_toml: str) -> str:
    """Return the kind of output that a configuration names."""
    try:
        table = tomllib.loads(config_toml).get("output", {})
    except tomllib.TOMLDecodeError:
        return "unknown"
    return str(table.get("kind", "unknown"))
