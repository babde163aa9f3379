"""What was applied, as ground: a polygon for every valve and stretch of one rate.

A stretch ends where the valve opens or closes, where what is prescribed under its strip's centre
changes, and after `LENGTH_M`, so that what speed and duty did to the rate can be seen. Its edges
are those of the strip along the path, at the times that the model of the flow gives: lags are in.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import MultiPoint, MultiPolygon, Polygon

from analysis.exports.output import geographic
from analysis.exports.samples import FLOW_MIN_L_MIN, duty_at
from analysis.strips import Strip, strips_of

if TYPE_CHECKING:
    from shapely import MultiPolygon, Polygon

    from analysis.exports.output import Ground
    from analysis.flight_record import FlightRecord
    from analysis.flown.applied_flight import AppliedFlight
    from analysis.track import Track


# The outline of the ground that a strip swept between two samples of its path.

# Corners of the edges lie so far apart at most; what is straighter than a centimetre loses them.
_CORNER_M = 0.5
_STRAIGHT_M = 0.01
# What is no area at all is given this much, so that it can be drawn.
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


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

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
