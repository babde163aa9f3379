"""From where to where was sprayed: the ground that open valves went over, as polygons.

Of each valve the stretches of path during which it was open, from the executed changes moved by
the lags of on and off: where a sharp beginning and end of the spray lie. What the wind makes of it
is not known here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, tzinfo
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from companion.config.application_table import zone_named
from companion.core.frame import LocalFrame
from companion.errors import ConfigError

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


# Times of the report: whose clock they are by, and in which time zone they are written.

# Before there was this program: a clock that shows it was never set.
PLAUSIBLE_FROM = datetime(2024, 1, 1, tzinfo=UTC)
SOURCES = {
    "autopilot": "clock of the autopilot (UTC from its satellite receiver)",
    "computer": "clock of the companion, not verified",
    "operator": "given by the operator",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Clock:
    """Makes a time of day of a flight's seconds; `source` is a key of `SOURCES`."""

    offset_s: float
    source: str
    zone: tzinfo
    zone_name: str

    @property
    def is_verified(self) -> bool:
        """Return whether somebody vouches for the time: the autopilot, or the operator."""
        return self.source != "computer"

    @property
    def source_text(self) -> str:
        """Return in words whose clock it is."""
        return SOURCES[self.source]

    def at(self, time_s: float | None) -> datetime | None:
        """Return a moment of the flight; None for no time, or one that a clock never set shows."""
        if time_s is None or not math.isfinite(time_s + self.offset_s):
            return None
        try:
            moment = datetime.fromtimestamp(time_s + self.offset_s, self.zone)
        except (ValueError, OverflowError, OSError):
            return None
        return moment if moment >= PLAUSIBLE_FROM else None

    def text(self, time_s: float | None) -> str | None:
        """Return the moment as ISO 8601 with its offset from UTC, to the second."""
        moment = self.at(time_s)
        return None if moment is None else moment.isoformat(timespec="seconds")

    def moved_to(self, start_time: str, first_s: float | None) -> Clock:
        """Return a clock by which the first spraying was at `start_time`, as the operator says."""
        if first_s is None:
            return self
        moment = datetime.fromisoformat(start_time)
        return Clock(
            offset_s=moment.timestamp() - first_s,
            source="operator",
            zone=self.zone,
            zone_name=self.zone_name,
        )


def clock_of(flight: AppliedFlight, time_zone: str | None) -> Clock:
    """Return the flight's clock, in `time_zone` or in UTC; ConfigError where it is none."""
    return Clock(
        offset_s=flight.utc_offset_s,
        source=flight.utc_source,
        zone=zone_of(time_zone),
        zone_name=time_zone or "UTC",
    )


def zone_of(name: str | None) -> tzinfo:
    """Return the time zone of that name; UTC without one."""
    if name is None or name == "UTC":
        return UTC
    zone = zone_named(name)
    if zone is None:
        raise ConfigError(
            f"time zone {name}: not known here; write one such as Europe/Madrid or America/Chicago"
        )
    return zone


def duration_text(duration_s: float) -> str:
    """Return a duration for a person.

    >>> duration_text(142.4), duration_text(59.6), duration_text(3725.0)
    ('2 min 22 s', '1 min 0 s', '1 h 2 min')
    """
    whole = timedelta(seconds=round(duration_s))
    minutes, seconds = divmod(int(whole.total_seconds()), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {seconds} s" if minutes else f"{seconds} s"
