"""What was applied, as the rows of files: sample by sample, or as ground of one rate.

A row stands for the time from halfway since the row before to halfway to the next. Its volume is
what the valves gave in that time, by the model that the evaluation uses, and its area what they
covered while they gave it; so volumes, areas and distances of the rows add up to the flight's,
however many rows there are.

A stretch ends where the valve opens or closes, where what is prescribed under its strip's centre
changes, and after `LENGTH_M`, so that what speed and duty did to the rate can be seen. Its edges
are those of the strip along the path, at the times that the model of the flow gives: lags are in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import MultiPoint, MultiPolygon, Polygon

from analysis.exports.output import geographic
from analysis.flown.modelled_flow import ordered_s
from analysis.strips import Strip, strips_of

if TYPE_CHECKING:
    from analysis.exports.output import Ground
    from analysis.flight_record import FlightRecord
    from analysis.flown.applied_flight import AppliedFlight, Series, ValveChanges
    from analysis.track import Track

# ------------------------------------------------------------------------------------------- points

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


# ------------------------------------------------------------------------------------------- ground

# The outline of the ground that a strip swept between two samples of its path.

# Corners of the edges lie so far apart at most; what is straighter than a centimetre loses them.
_CORNER_M = 0.5
_STRAIGHT_M = 0.01
# What is not an area at all is given this much, so that it can be drawn.
_HAIR_M = 0.001


def outlines(track: Track, first: Ints, last: Ints) -> list[Ground]:
    """Return the ground of each stretch in metres: left edge there, right edge back."""
    if not len(first):
        return []
    half_m = 0.5 * track.width_m
    right_e, right_n = half_m * np.cos(track.heading_rad), -half_m * np.sin(track.heading_rad)
    left = np.stack((track.east_m - right_e, track.north_m - right_n), axis=1)
    right = np.stack((track.east_m + right_e, track.north_m + right_n), axis=1)
    corners = [
        _corners(track.distance_m, begin, end)
        for begin, end in zip(first.tolist(), last.tolist(), strict=True)
    ]
    edges = [np.concatenate((left[at], right[at[::-1]])) for at in corners]
    number = np.repeat(np.arange(len(edges)), [len(edge) for edge in edges])
    lines = np.asarray(shapely.linearrings(np.concatenate(edges), indices=number), dtype=object)
    areas = np.asarray(shapely.polygons(lines), dtype=object)
    rings = np.asarray(shapely.simplify(areas, _STRAIGHT_M), dtype=object)
    is_good = shapely.is_valid(rings) & ~shapely.is_empty(rings)
    found = cast("list[Ground]", rings.tolist())
    for at in np.flatnonzero(~is_good).tolist():
        found[at] = _of_pieces(left[corners[at]], right[corners[at]])
    return found


def _corners(distance_m: Floats, first: int, last: int) -> Ints:
    """Return the samples at which an outline has its corners, both ends among them."""
    steps = np.floor((distance_m[first:last] - distance_m[first]) / _CORNER_M)
    inner = first + 1 + np.flatnonzero(steps[1:] != steps[:-1])
    return np.concatenate(([first], inner, [last]))


def _of_pieces(left: Floats, right: Floats) -> Ground:
    """Return the ground of an edge that crosses itself: all pieces between corners, as one."""
    corners = np.stack((left[:-1], left[1:], right[1:], right[:-1]), axis=1)
    pieces = [MultiPoint(each).convex_hull for each in corners]
    found = shapely.union_all([each for each in pieces if isinstance(each, Polygon)])
    if isinstance(found, Polygon | MultiPolygon) and not found.is_empty:
        return found
    return MultiPoint(np.concatenate((left, right))).convex_hull.buffer(_HAIR_M)


LENGTH_M = 10.0
# Less ground than this is a valve open over one spot: no polygon, its volume is said in `unmapped`.
_AREA_MIN_M2 = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class Swaths:
    """One value a polygon; `polygons` in longitude and latitude.

    `applied_l_ha` is the volume over the ground that the strip swept, `area_m2`; what it swept
    twice, in a turn, counts twice. `unmapped_ml` came out over no ground.
    """

    polygons: tuple[Polygon | MultiPolygon, ...]
    valve: Ints
    start_s: Floats
    end_s: Floats
    utc_offset_s: float
    longitude_deg: Floats
    latitude_deg: Floats
    height_m: Floats
    speed_m_s: Floats
    heading_deg: Floats
    distance_m: Floats
    rate_l_ha: Floats
    applied_l_ha: Floats
    volume_ml: Floats
    area_m2: Floats
    width_m: Floats
    duty: Floats
    unmapped_ml: float

    def __len__(self) -> int:
        """Return the number of polygons."""
        return len(self.polygons)


@dataclass(frozen=True, slots=True)
class _Stretches:
    """Stretches of all strips, between samples of the record: one value a stretch."""

    strip: Ints
    first: Ints
    last: Ints
    rate_l_ha: Floats
    area_m2: Floats
    volume_ml: Floats


def swaths_of(flight: AppliedFlight, record: FlightRecord) -> Swaths:
    """Return the ground that was treated, in order of time."""
    strips = strips_of(record)
    found = _all_stretches(strips)
    order = np.argsort(record.time_s[found.first], kind="stable")
    mapped = order[found.area_m2[order] >= _AREA_MIN_M2]
    strip, first, last = found.strip[mapped], found.first[mapped], found.last[mapped]
    area_m2, volume_ml = found.area_m2[mapped], found.volume_ml[mapped]
    rings = np.empty(len(strip), dtype=object)
    distance_m = np.zeros(len(strip))
    for number, each in enumerate(strips):
        its = np.flatnonzero(strip == number)
        rings[its] = outlines(each.track, first[its], last[its])
        distance_m[its] = each.track.distance_m[last[its]] - each.track.distance_m[first[its]]
    middle = (first + last) // 2
    start_s, end_s = record.time_s[first], record.time_s[last]
    middle_s = 0.5 * (start_s + end_s)
    centre_m = np.array(
        [
            (strips[number].track.east_m[at], strips[number].track.north_m[at])
            for number, at in zip(strip.tolist(), middle.tolist(), strict=True)
        ]
    ).reshape(-1, 2)
    latitude_deg, longitude_deg = flight.setup.frame.to_geographic_all(*centre_m.T.tolist())
    duty = duty_at(flight.changes, middle_s, len(strips))
    return Swaths(
        polygons=tuple(geographic(rings.tolist(), flight.setup.frame)),
        valve=strip,
        start_s=start_s,
        end_s=end_s,
        utc_offset_s=flight.utc_offset_s,
        longitude_deg=np.array(longitude_deg),
        latitude_deg=np.array(latitude_deg),
        height_m=np.interp(middle_s, flight.time_s, flight.height_m),
        speed_m_s=distance_m / np.maximum(end_s - start_s, record.step_s),
        heading_deg=record.heading_deg[middle],
        distance_m=distance_m,
        rate_l_ha=found.rate_l_ha[mapped],
        # 1 L/ha is 0.1 mL on a square metre.
        applied_l_ha=10.0 * volume_ml / area_m2,
        volume_ml=volume_ml,
        area_m2=area_m2,
        width_m=np.array([strips[number].track.width_m for number in strip.tolist()]),
        duty=duty[np.arange(len(strip)), strip],
        unmapped_ml=float(found.volume_ml.sum() - volume_ml.sum()),
    )


def _all_stretches(strips: list[Strip]) -> _Stretches:
    each = [_stretches(strip, number) for number, strip in enumerate(strips)]
    return _Stretches(
        *(
            np.concatenate([getattr(one, name) for one in each])
            for name in ("strip", "first", "last", "rate_l_ha", "area_m2", "volume_ml")
        )
    )


def _stretches(strip: Strip, number: int) -> _Stretches:
    """Return the stretches of one strip; between them the valve is closed."""
    track = strip.track
    dropped_ml = np.diff(track.volume_ml)
    least_ml = FLOW_MIN_L_MIN * track.step_s * 1000.0 / 60.0
    is_open = dropped_ml > least_ml
    rate = strip.rates_at(0.5 * (track.time_s[1:] + track.time_s[:-1]))
    opened = np.concatenate(([True], is_open[1:] != is_open[:-1]))
    changed = opened | np.concatenate(([False], rate[1:] != rate[:-1]))
    begins_m = np.maximum.accumulate(np.where(changed, track.distance_m[:-1], -np.inf))
    piece = np.floor((track.distance_m[:-1] - begins_m) / LENGTH_M)
    changed |= np.concatenate(([False], piece[1:] != piece[:-1]))
    first = np.flatnonzero(changed)
    last = np.concatenate((first[1:], [len(is_open)]))
    across = 0.5 * (track.across_m[1:] + track.across_m[:-1])
    swept_m2 = np.concatenate(([0.0], np.cumsum(across * np.diff(track.distance_m))))
    keep = is_open[first]
    first, last = first[keep], last[keep]
    return _Stretches(
        strip=np.full(len(first), number, dtype=np.int64),
        first=first,
        last=last,
        rate_l_ha=rate[first],
        area_m2=swept_m2[last] - swept_m2[first],
        volume_ml=track.volume_ml[last] - track.volume_ml[first],
    )


_Rows = TypeVar("_Rows", Samples, Swaths)


def joined(parts: Sequence[_Rows]) -> _Rows:
    """Return the rows of all sorties, one after the other, by the clock of the first."""
    first: Any = parts[0]

    def together(name: str) -> Any:
        values: list[Any] = [getattr(each, name) for each in parts]
        if name in ("start_s", "end_s"):
            offsets_s = [getattr(each, "utc_offset_s", 0.0) for each in parts]
            values = [
                its + at_s - offsets_s[0] for its, at_s in zip(values, offsets_s, strict=True)
            ]
        if any(each is None for each in values) or name == "utc_offset_s":
            return values[0] if name == "utc_offset_s" else None
        if isinstance(values[0], np.ndarray):
            return np.concatenate(values)
        return sum(values[1:], values[0])

    found: _Rows = replace(first, **{each.name: together(each.name) for each in fields(first)})
    return found
