"""From where to where was sprayed: the ground that open valves went over, as polygons.

Of each valve the stretches of path during which it was open, from the executed changes moved by
the lags of on and off: where a sharp beginning and end of the spray lie. What the wind makes of it
is not known here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from companion.core.frame import LocalFrame

if TYPE_CHECKING:
    from collections.abc import Iterator

    from analysis.flown.applied_flight import AppliedFlight, Floats
    from companion.core.boom import Valve

# Points of an edge that lie this near to a straight line say nothing of the ground.
SIMPLIFY_M = 0.03
# Slits of this width between strips are the rounding of two edges, not ground left out.
CLOSE_M = 0.02
# Where the vehicle stands, nothing is swept.
LENGTH_MIN_M = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Treated:
    """The ground sprayed, in the flight's frame; times are those of the valves' first and last."""

    area: BaseGeometry
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


def treated_of(flight: AppliedFlight) -> Treated:
    """Return the ground that a flight sprayed."""
    strips: list[BaseGeometry] = []
    spans: list[tuple[float, float]] = []
    heading_deg = _headings(flight)
    if heading_deg is not None:
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
        first_s=min((span[0] for span in spans), default=None),
        last_s=max((span[1] for span in spans), default=None),
    )


def open_spans(flight: AppliedFlight, valve: int) -> Iterator[tuple[float, float]]:
    """Yield from when to when a valve sprayed: its executed changes, later by their lags."""
    lag, changes = flight.setup.lag, flight.changes
    mine = changes.valve == valve
    at_s = np.where(np.isfinite(changes.actual_s), changes.actual_s, changes.planned_s)[mine]
    opened_s: float | None = None
    for time_s, duty in zip(at_s.tolist(), changes.duty[mine].tolist(), strict=True):
        if duty > 0.0 and opened_s is None:
            opened_s = time_s + lag.on_s + lag.output_s
        elif not duty > 0.0 and opened_s is not None:
            closed_s = time_s + lag.off_s + lag.output_s
            if closed_s > opened_s:
                yield opened_s, closed_s
            opened_s = None
    if opened_s is not None and len(flight.time_s) and flight.time_s[-1] > opened_s:
        yield opened_s, float(flight.time_s[-1])


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
    inner = flight.time_s[(flight.time_s > begin_s) & (flight.time_s < end_s)]
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
        edge = shapely.simplify(shapely.linestrings(np.column_stack([x_m, y_m])), SIMPLIFY_M)
        edges.append(shapely.get_coordinates(edge))
    ring = np.vstack([edges[0], edges[1][::-1]])
    strip: BaseGeometry = shapely.make_valid(shapely.Polygon(ring))
    return strip if strip.area > 0.0 else None


def _positions(frame: LocalFrame, ring: shapely.LinearRing) -> list[list[float]]:
    east_m, north_m = np.array(ring.coords)[:, :2].T
    latitude_deg, longitude_deg = frame.to_geographic_all(east_m.tolist(), north_m.tolist())
    return [
        [round(longitude, 7), round(latitude, 7)]
        for latitude, longitude in zip(latitude_deg, longitude_deg, strict=True)
    ]
