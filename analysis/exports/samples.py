"""What was applied, sample by sample: the rows of points that most formats write.

A row stands for the time from halfway since the row before to halfway to the next. Its volume is
what the valves gave in that time, by the model that the evaluation uses, and its area what they
covered while they gave it; so volumes, areas and distances of the rows add up to the flight's,
however many rows there are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.flown.modelled_flow import ordered_s

if TYPE_CHECKING:
    from analysis.flight_record import FlightRecord
    from analysis.flown.applied_flight import AppliedFlight, Series, ValveChanges

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Below it a rate for each hectare says nothing: the aircraft hovers or turns on the spot.
SPEED_MIN_M_S = 0.3
# A valve that gives less than this [L/min] is closed: rounding of the model.
FLOW_MIN_L_MIN = 1e-6
# The boom may fly sideways, but a width of nothing would make a rate of anything.
_ACROSS_MIN = 0.05
# 1 L/ha on 1 m at 1 m/s is 0.006 L/min: the speed-and-width law of rate controllers.
_L_MIN_PER_L_HA_M2_S = 0.006
_ML_S_PER_L_MIN = 1000.0 / 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Samples:
    """One value a row; of valves, rows x valves. NaN where there is nothing.

    `rate_l_ha` is the mean of what is prescribed, over the width of the valves that have a rate;
    `applied_l_ha` the flow over the ground that the open valves cover at the actual speed;
    `width_m` the width of these, and `area_m2` the ground that they covered in the row's time.
    """

    index: Ints
    time_s: Floats
    utc_s: Floats
    latitude_deg: Floats
    longitude_deg: Floats
    height_m: Floats
    speed_m_s: Floats
    course_deg: Floats
    heading_deg: Floats
    distance_m: Floats
    rate_l_ha: Floats
    applied_l_ha: Floats
    target_flow_l_min: Floats
    flow_l_min: Floats
    volume_ml: Floats
    width_m: Floats
    area_m2: Floats
    duty: Floats
    pressure_kpa: Floats | None
    inhibits: tuple[str, ...]
    valve_rate_l_ha: Floats
    valve_flow_l_min: Floats
    valve_applied_l_ha: Floats
    valve_duty: Floats

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.time_s)


def samples_of(
    flight: AppliedFlight, record: FlightRecord, *, rate_hz: float | None = None
) -> Samples:
    """Return the samples of a flight, all or the first of each `1 / rate_hz` seconds."""
    index = _chosen(flight.time_s, rate_hz)
    time_s = flight.time_s[index]
    edges_s = np.concatenate((time_s[:1], 0.5 * (time_s[1:] + time_s[:-1]), time_s[-1:]))
    # What was released before the first sample or after the last is put to these.
    outer_s = edges_s.copy()
    outer_s[0], outer_s[-1] = min(edges_s[0], record.time_s[0]), max(edges_s[-1], record.time_s[-1])
    released = np.stack(
        [np.interp(outer_s, record.time_s, each) for each in record.volume_ml.T], axis=1
    )
    valve_ml = np.diff(released, axis=0)
    lasted_s = np.maximum(np.diff(edges_s), 1e-3)
    valve_flow = valve_ml / lasted_s[:, None] / _ML_S_PER_L_MIN
    valve_flow[valve_flow < FLOW_MIN_L_MIN] = 0.0
    widths_m = 2.0 * flight.setup.boom.half_width_m
    across = _across(flight.heading_deg[index], flight.course_deg[index])
    speed_m_s = flight.speed_m_s[index]
    width_m = (valve_flow > 0.0) @ widths_m
    rates = flight.rate_l_ha[index]
    duty = duty_at(flight.changes, time_s, len(widths_m))
    return Samples(
        index=index,
        time_s=time_s,
        utc_s=time_s + flight.utc_offset_s,
        latitude_deg=flight.latitude_deg[index],
        longitude_deg=flight.longitude_deg[index],
        height_m=flight.height_m[index],
        speed_m_s=speed_m_s,
        course_deg=flight.course_deg[index],
        heading_deg=flight.heading_deg[index],
        distance_m=np.diff(_along_m(flight, outer_s)),
        rate_l_ha=_weighted(rates, widths_m),
        applied_l_ha=_rate(valve_flow.sum(axis=1), speed_m_s, width_m * across),
        target_flow_l_min=flight.target_flow_l_min[index],
        flow_l_min=valve_flow.sum(axis=1),
        volume_ml=valve_ml.sum(axis=1),
        width_m=width_m,
        area_m2=_covered_m2(flight, record, outer_s, widths_m),
        duty=_mean_of_open(duty),
        pressure_kpa=_at(flight.pressure_kpa, time_s),
        inhibits=tuple(flight.inhibits[i] for i in index.tolist()),
        valve_rate_l_ha=rates,
        valve_flow_l_min=valve_flow,
        valve_applied_l_ha=np.stack(
            [
                _rate(each, speed_m_s, np.where(each > 0.0, width, 0.0) * across)
                for each, width in zip(valve_flow.T, widths_m.tolist(), strict=True)
            ],
            axis=1,
        ),
        valve_duty=duty,
    )


def duty_at(changes: ValveChanges, time_s: Floats, valve_count: int) -> Floats:
    """Return the ordered duty of every valve at given times."""
    order_s = ordered_s(changes)
    found = np.zeros((len(time_s), valve_count))
    for valve in range(valve_count):
        its = np.flatnonzero(changes.valve == valve)
        its = its[np.argsort(order_s[its], kind="stable")]
        duty = np.concatenate(([0.0], changes.duty[its]))
        found[:, valve] = duty[np.searchsorted(order_s[its], time_s, "right")]
    return found


def _chosen(time_s: Floats, rate_hz: float | None) -> Ints:
    """Return which samples to take; times that do not rise are left out."""
    latest = np.concatenate(([-np.inf], np.maximum.accumulate(time_s)[:-1]))
    rising = np.flatnonzero(time_s > latest)
    if rate_hz is None:
        return rising
    # A nanosecond's worth of rounding must not move a sample into the tick before its own.
    ticks = np.floor((time_s[rising] - time_s[0]) * rate_hz + 1e-6)
    return rising[np.unique(ticks, return_index=True)[1]]


def _across(heading_deg: Floats, course_deg: Floats) -> Floats:
    """Return the share of the boom's width that lies across the motion; 1 without a heading."""
    share = np.abs(np.cos(np.radians(heading_deg - course_deg)))
    return np.where(np.isfinite(share), np.maximum(share, _ACROSS_MIN), 1.0)


def _rate(flow_l_min: Floats, speed_m_s: Floats, width_m: Floats) -> Floats:
    """Return the rate [L/ha]; 0 without flow, NaN where the aircraft hardly moves."""
    covered = speed_m_s * width_m * _L_MIN_PER_L_HA_M2_S
    moving = (speed_m_s >= SPEED_MIN_M_S) & (covered > 0.0)
    rate = np.divide(flow_l_min, covered, out=np.full(len(covered), np.nan), where=moving)
    return np.where(flow_l_min > 0.0, rate, 0.0)


def _weighted(rates: Floats, widths_m: Floats) -> Floats:
    """Return the mean rate over the width of the valves that have one; NaN where none has."""
    known = np.isfinite(rates)
    width = known @ widths_m
    total = np.where(known, rates, 0.0) @ widths_m
    found: Floats = np.divide(total, width, out=np.full(len(width), np.nan), where=width > 0.0)
    return found


def _mean_of_open(duty: Floats) -> Floats:
    """Return the mean duty of the valves that are open; 0 where none is."""
    count = (duty > 0.0).sum(axis=1)
    found: Floats = np.divide(duty.sum(axis=1), count, out=np.zeros(len(duty)), where=count > 0)
    return found


def _along_m(flight: AppliedFlight, time_s: Floats) -> Floats:
    """Return how far the aircraft has flown by each time."""
    flown = np.hypot(np.diff(flight.east_m), np.diff(flight.north_m))
    along = np.concatenate(([0.0], np.cumsum(flown)))
    return np.interp(time_s, np.maximum.accumulate(flight.time_s), along)


def _covered_m2(
    flight: AppliedFlight, record: FlightRecord, edges_s: Floats, widths_m: Floats
) -> Floats:
    """Return the ground that the valves covered between edges while they gave something."""
    steps_s = np.diff(record.time_s)
    least_ml = FLOW_MIN_L_MIN * _ML_S_PER_L_MIN * steps_s
    width_m = (np.diff(record.volume_ml, axis=0) > least_ml[:, None]) @ widths_m
    middles_s = record.time_s[:-1] + 0.5 * steps_s
    all_across = _across(flight.heading_deg, flight.course_deg)
    across = np.interp(middles_s, np.maximum.accumulate(flight.time_s), all_across)
    covered = width_m * across * np.diff(_along_m(flight, record.time_s))
    total = np.concatenate(([0.0], np.cumsum(covered)))
    return np.diff(np.interp(edges_s, record.time_s, total))


def _at(series: Series | None, time_s: Floats) -> Floats | None:
    """Return what a sensor last said before each time; None without a sensor."""
    if series is None or not len(series.time_s):
        return None
    latest = np.searchsorted(series.time_s, time_s, "right") - 1
    return np.where(latest >= 0, series.value[np.maximum(latest, 0)], np.nan)
