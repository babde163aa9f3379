"""From where to where was sprayed, as polygons, and what became of the field's ground.

Of each valve the stretches of path during which it was open, from the executed changes moved by
the lags of on and off: where a sharp beginning and end of the spray lie. What the wind makes of it
is not known here.

Ground that this flight was to treat is that of the planned lines that it flew; without any, all
that the boom came over, and gaps between two passes. Bare ground is missed there, and left to other
flights elsewhere.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from analysis.changes import ground_rates
from analysis.flown.modelled_flow import ordered_s
from companion.core.boom import Valve
from companion.core.frame import LocalFrame

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from analysis.flight_record import FlightRecord
    from analysis.flown.applied_flight import AppliedFlight, Floats
    from analysis.strips import Strip
    from analysis.track import Bools

# Points of an edge that lie this near to a straight line say nothing of the ground.
SIMPLIFY_M = 0.03
# Slits of this width between strips are the rounding of two edges, not ground left out.
CLOSE_M = 0.02
# Where the vehicle stands, nothing is swept.
LENGTH_MIN_M = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Treated:
    """The ground sprayed, in the flight's frame; times are those of the valves' first and last.

    `twice` is what two openings went over, of one valve or of two.
    """

    area: BaseGeometry
    twice: BaseGeometry
    first_s: float | None
    last_s: float | None

    @property
    def area_ha(self) -> float:
        """Return its area; ground sprayed twice counts once."""
        return float(self.area.area) / 1e4

    def as_geojson(self, frame: LocalFrame) -> dict[str, Any]:
        """Return a MultiPolygon in WGS84, longitude first, seven decimals (RFC 7946)."""
        polygons = []
        for part in shapely.get_parts(self.area):
            if isinstance(part, shapely.Polygon) and not part.is_empty:
                oriented = shapely.orient_polygons(part)
                rings = [oriented.exterior, *oriented.interiors]
                polygons.append([_positions(frame, ring) for ring in rings])
        return {"type": "MultiPolygon", "coordinates": polygons}


def treated_of(*flights: AppliedFlight) -> Treated:
    """Return the ground that a flight sprayed, or several; only of one flight the times count."""
    strips: list[BaseGeometry] = []
    spans: list[tuple[float, float]] = []
    for flight in flights:
        heading_deg = _headings(flight)
        if heading_deg is None:
            continue
        for number, valve in enumerate(flight.setup.boom.valves):
            for begin_s, end_s in open_spans(flight, number):
                strip = _strip(flight, heading_deg, valve, begin_s, end_s)
                if strip is not None:
                    strips.append(strip)
                    spans.append((begin_s, end_s))
    area = shapely.union_all(strips) if strips else shapely.MultiPolygon()
    # Strips of neighbouring valves share an edge but for rounding: without the slits.
    area = area.buffer(CLOSE_M, join_style="mitre").buffer(-CLOSE_M, join_style="mitre")
    return Treated(
        area=shapely.simplify(area, SIMPLIFY_M),
        twice=_twice(strips),
        first_s=min((span[0] for span in spans), default=None),
        last_s=max((span[1] for span in spans), default=None),
    )


def _twice(strips: Sequence[BaseGeometry]) -> BaseGeometry:
    """Return where strips overlap; neighbours whose edges were rounded apart do not."""
    shapes = np.array(strips, dtype=object)
    one, other = shapely.STRtree(shapes).query(shapes, predicate="intersects")
    first = one < other
    both = shapely.union_all(shapely.intersection(shapes[one[first]], shapes[other[first]]))
    return both.buffer(-CLOSE_M, join_style="mitre").buffer(CLOSE_M, join_style="mitre")


def open_spans(flight: AppliedFlight, valve: int) -> Iterator[tuple[float, float]]:
    """Yield from when to when a valve sprayed: its executed changes, later by their lags."""
    lag, changes = flight.setup.lag, flight.changes
    mine = changes.valve == valve
    at_s = ordered_s(changes)[mine]
    edges = np.flatnonzero(np.diff(changes.duty[mine] > 0.0, prepend=False))
    opens_s = (at_s[edges[::2]] + lag.on_s + lag.output_s).tolist()
    closes_s = (at_s[edges[1::2]] + lag.off_s + lag.output_s).tolist()
    if len(opens_s) > len(closes_s):
        closes_s.append(float(flight.time_s[-1]) if len(flight.time_s) else -math.inf)
    for opened_s, closed_s in zip(opens_s, closes_s, strict=True):
        if closed_s > opened_s:
            yield opened_s, closed_s


def _headings(flight: AppliedFlight) -> Floats | None:
    """Return the heading of every sample, continuous; course where the heading is unknown."""
    if len(flight.time_s) < 2:
        return None
    heading_deg = np.where(np.isfinite(flight.heading_deg), flight.heading_deg, flight.course_deg)
    known = np.isfinite(heading_deg)
    if not known.any():
        return None
    index = np.flatnonzero(known)
    continuous = np.unwrap(np.radians(heading_deg[index]))
    return np.degrees(np.interp(flight.time_s, flight.time_s[index], continuous))


def _strip(
    flight: AppliedFlight, heading_deg: Floats, valve: Valve, begin_s: float, end_s: float
) -> BaseGeometry | None:
    first, last = (
        np.searchsorted(flight.time_s, begin_s, "right"),
        flight.time_s.searchsorted(end_s),
    )
    inner = flight.time_s[first:last]
    at_s = np.concatenate([[begin_s], inner, [end_s]])
    east_m = np.interp(at_s, flight.time_s, flight.east_m)
    north_m = np.interp(at_s, flight.time_s, flight.north_m)
    if not np.hypot(np.diff(east_m), np.diff(north_m)).sum() >= LENGTH_MIN_M:
        return None
    heading = np.radians(np.interp(at_s, flight.time_s, heading_deg))
    edges = []
    for right_m in (valve.right_m - valve.width_m / 2, valve.right_m + valve.width_m / 2):
        x_m = east_m + right_m * np.cos(heading) + valve.forward_m * np.sin(heading)
        y_m = north_m - right_m * np.sin(heading) + valve.forward_m * np.cos(heading)
        edges.append(_simplified(np.column_stack([x_m, y_m])))
    ring = np.vstack([edges[0], edges[1][::-1]])
    strip: BaseGeometry = shapely.make_valid(shapely.Polygon(ring))
    return strip if strip.area > 0.0 else None


def _simplified(points_m: Floats) -> Floats:
    """Return an edge without the points that lie near to a straight line.

    One that goes ahead all the way cannot cross itself: nobody has to look whether it does.
    """
    along = np.diff(points_m, axis=0) @ (points_m[-1] - points_m[0])
    edge = shapely.simplify(
        shapely.linestrings(points_m), SIMPLIFY_M, preserve_topology=not (along > 0.0).all()
    )
    return shapely.get_coordinates(edge)


def _positions(frame: LocalFrame, ring: shapely.LinearRing) -> list[list[float]]:
    east_m, north_m = np.array(ring.coords)[:, :2].T
    latitude_deg, longitude_deg = frame.to_geographic_all(east_m.tolist(), north_m.tolist())
    return [
        [round(longitude, 7), round(latitude, 7)]
        for latitude, longitude in zip(latitude_deg, longitude_deg, strict=True)
    ]


# What became of the field's ground, counted on points of a lattice.

POINTS = 200_000
# No finer: the strips themselves are good to some centimetres.
POINT_M = 0.1
# Not along any row of passes: a lattice that lies along an edge counts it all in or all out.
LATTICE_RAD = 0.5536


@dataclass(frozen=True, slots=True, kw_only=True)
class Ground:
    """Areas of the field in square metres; litres prescribed where it was treated, and where not.

    `untreated_m2` has a rate and was not treated in this flight: `missed_m2` of it lay under what
    this flight flew, `between_m2` of that between two passes; all else is left to other flights.
    `own` is the ground of the planned lines that were flown; None without any lines. `marks` says
    of each point, where asked for, whether it was treated, treated twice, and to be treated.
    """

    treated_m2: float
    doubled_m2: float
    untreated_m2: float
    missed_m2: float
    between_m2: float
    asked_l: float
    untreated_l: float
    rated_m2: float
    own: BaseGeometry | None = None
    marks: bytes | None = None


def ground_of(
    flight: AppliedFlight,
    record: FlightRecord,
    strips: Sequence[Strip],
    treated: Treated,
    *,
    also: Sequence[tuple[AppliedFlight, FlightRecord, Sequence[Strip]]] = (),
    marked: bool = False,
) -> Ground:
    """Return what became of the field, in a flight or with those that went on after it."""
    field = record.prescription.field
    if field.is_empty:
        return Ground(
            treated_m2=0.0, doubled_m2=0.0, untreated_m2=0.0, missed_m2=0.0, between_m2=0.0,
            asked_l=0.0, untreated_l=0.0, rated_m2=0.0,
        )  # fmt: skip
    east_m, north_m = _lattice(field)
    each_m2 = field.area / max(len(east_m), 1)
    rates = np.nan_to_num(ground_rates(record.prescription, east_m, north_m))
    is_wet = within(treated.area, east_m, north_m)
    bare = np.flatnonzero((rates > 0.0) & ~is_wet)
    every = ((flight, record, strips), *also)
    grounds = [_flown(*each) for each in every]
    swept, own = (shapely.union_all(each) for each in zip(*grounds, strict=True))
    due = within(own, east_m, north_m) & (rates > 0.0)
    if record.treated is not None:
        due &= ~record.treated.covered_at(east_m, north_m)
    missed = due[bare]
    between = missed & ~within(swept, east_m[bare], north_m[bare])
    marks = None
    if marked:
        each_one = [is_wet, within(treated.twice, east_m, north_m), due]
        marks = zlib.compress(np.packbits(each_one, axis=1).tobytes())
    return Ground(
        treated_m2=treated.area.area,
        doubled_m2=treated.twice.area,
        untreated_m2=len(bare) * each_m2,
        missed_m2=int(missed.sum()) * each_m2,
        between_m2=int(between.sum()) * each_m2,
        asked_l=float(rates[is_wet].sum()) * each_m2 / 1e4,
        untreated_l=float(rates[bare].sum()) * each_m2 / 1e4,
        rated_m2=int((rates > 0.0).sum()) * each_m2,
        own=None if all(each[2][0].track.planned is None for each in every) else own,
        marks=marks,
    )


def _lattice(field: BaseGeometry) -> tuple[Floats, Floats]:
    """Return points of the field, evenly over it."""
    west, south, east, north = field.bounds
    step_m = max(math.sqrt(field.area / POINTS), POINT_M)
    reach_m = 0.5 * math.hypot(east - west, north - south)
    along = np.arange(-reach_m, reach_m, step_m)
    u, v = (each.ravel() for each in np.meshgrid(along, along))
    cos, sin = math.cos(LATTICE_RAD), math.sin(LATTICE_RAD)
    east_m = 0.5 * (west + east) + cos * u - sin * v
    north_m = 0.5 * (south + north) + sin * u + cos * v
    inside = within(field, east_m, north_m)
    return east_m[inside], north_m[inside]


def within(area: BaseGeometry, east_m: Floats, north_m: Floats) -> Bools:
    """Return which of many points lie in an area."""
    shapely.prepare(area)
    return np.asarray(shapely.contains_xy(area, east_m, north_m), dtype=np.bool_)


def _flown(
    flight: AppliedFlight, record: FlightRecord, strips: Sequence[Strip]
) -> tuple[BaseGeometry, BaseGeometry]:
    """Return the ground that the boom came over, and that which it was to treat."""
    planned = strips[0].track.planned
    half_m = max(abs(v.right_m) + 0.5 * v.width_m for v in record.boom.valves)
    path = shapely.LineString(np.column_stack([flight.east_m, flight.north_m])).simplify(SIMPLIFY_M)
    swept = path.buffer(half_m, cap_style="flat")
    if planned is None:
        return swept, swept.buffer(half_m).buffer(-half_m)
    return swept, shapely.union_all(
        [way.buffer(half_m, cap_style="flat") for way in planned.ways(record)]
    )
