"""A second judge of a flight: from the raw truth and the original map file, with numpy and shapely.

It shares nothing with the program, not even the reading of the map: a shapefile or GeoJSON is read
here byte by byte and laid flat by the radii of the ellipsoid. What it takes for true is where the
aircraft was, which way it looked, and what each valve had delivered, over time. Lag distances are
those of `independent_figures.py`, which imports nothing of the program either; it knows no
verdicts but `small` and `missed`.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from tests.independent_figures import ML_PER_M, PERIOD, Valve, lags

Floats = NDArray[np.float64]
# WGS84.
SEMI_MAJOR_M, ECCENTRICITY_2 = 6_378_137.0, 0.006_694_379_990_141_3
ELEMENT_M = 0.1
GRAZE_M = 0.1
MOVING_M_S = 0.5


@dataclass(frozen=True, kw_only=True)
class Truth:
    """What was flown and sprayed: (n) arrays, and (n, valves) cumulative volumes.

    Metres are east and north of `origin_deg`, latitude and longitude. `strips` has each valve's
    right_m, forward_m and width_m.
    """

    time_s: Floats
    east_m: Floats
    north_m: Floats
    heading_deg: Floats
    volume_ml: Floats
    strips: tuple[tuple[float, float, float], ...]
    origin_deg: tuple[float, float]
    period_s: float


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What the second judge found; no accuracy where the whole boom was never in the field."""

    lag_m: tuple[float, ...]
    missed: int
    misapplied_percent: float
    accuracy_percent: float
    off_target_ml: float

    @property
    def lag_mean_abs_m(self) -> float:
        return float(np.abs(self.lag_m).mean())

    @property
    def lag_mean_m(self) -> float:
        return float(np.mean(self.lag_m))


# ------------------------------------------------------------------------------------------ the map


def flat(lon_lat: Floats, origin_deg: tuple[float, float]) -> Floats:
    """Return east and north of places within some kilometres of an origin, to a millimetre."""
    lat_0, lon_0 = np.radians(origin_deg)
    lon, lat = np.radians(lon_lat).T
    east_radius = SEMI_MAJOR_M / np.sqrt(1.0 - ECCENTRICITY_2 * np.sin(lat) ** 2)
    middle = 1.0 - ECCENTRICITY_2 * np.sin(0.5 * (lat + lat_0)) ** 2
    north_radius = SEMI_MAJOR_M * (1.0 - ECCENTRICITY_2) / middle**1.5
    side_m = east_radius * np.cos(lat) * (lon - lon_0)
    # A meridian beside that of the origin leans: its parallels lie higher there.
    north_m = north_radius * (lat - lat_0) + 0.5 * side_m * np.sin(lat) * (lon - lon_0)
    return np.column_stack((side_m, north_m))


def shapefile(path: Path, field: str) -> list[tuple[list[Floats], float]]:
    """Return the rings (longitude, latitude) and the rate of every polygon of a shapefile."""
    shapes, table = path.read_bytes(), path.with_suffix(".dbf").read_bytes()
    count, head, length = struct.unpack_from("<IHH", table, 4)
    at, start, width = 32, 1, 0
    while table[at] != 0x0D:
        name, size = table[at : at + 11].split(b"\0")[0].decode(), table[at + 16]
        if name == field:
            width = size
            break
        start, at = start + size, at + 32
    rates = [
        float(table[head + i * length + start : head + i * length + start + width])
        for i in range(count)
    ]
    found, at = [], 100
    for rate in rates:
        (words,) = struct.unpack_from(">I", shapes, at + 4)
        kind, *_ = struct.unpack_from("<I4d", shapes, at + 8)
        assert kind == 5  # a polygon
        parts, points = struct.unpack_from("<II", shapes, at + 44)
        firsts = struct.unpack_from(f"<{parts}I", shapes, at + 52)
        values = struct.unpack_from(f"<{2 * points}d", shapes, at + 52 + 4 * parts)
        places = np.array(values).reshape(-1, 2)
        found.append((np.split(places, firsts[1:]), rate))
        at += 8 + 2 * words
    return found


def geojson(path: Path, field: str | None = None) -> list[tuple[list[Floats], float]]:
    """Return the rings and the rate (0 without a field) of every polygon of a GeoJSON file."""
    features = json.loads(path.read_text(encoding="utf-8"))["features"]
    found = []
    for each in features:
        geometry = each["geometry"]
        bodies = geometry["coordinates"]
        for rings in [bodies] if geometry["type"] == "Polygon" else bodies:
            rate = 0.0 if field is None else float(each["properties"][field])
            found.append(([np.array(ring)[:, :2] for ring in rings], rate))
    return found


class Ground:
    """The zones as the file has them, in the truth's metres, and where spraying is allowed."""

    def __init__(
        self, map_file: Path, field: str, boundary: Path, origin_deg: tuple[float, float]
    ) -> None:
        read = shapefile if map_file.suffix == ".shp" else geojson
        zones = read(map_file, field)
        self.polygons = np.array([_area(rings, origin_deg) for rings, _ in zones])
        self.rates = np.array([rate for _, rate in zones])
        self.field = shapely.union_all([_area(rings, origin_deg) for rings, _ in geojson(boundary)])
        shapely.prepare(self.polygons)
        shapely.prepare(self.field)

    def all_rates(self, east_m: Floats, north_m: Floats) -> Floats:
        """Return the rate at points; 0 outside the field and where nothing is prescribed."""
        found = np.zeros(len(east_m))
        for polygon, rate in zip(self.polygons, self.rates, strict=True):
            found[shapely.contains_xy(polygon, east_m, north_m)] = rate
        found[~shapely.contains_xy(self.field, east_m, north_m)] = 0.0
        return found

    def rate(self, east_m: float, north_m: float) -> float:
        """Return the rate at a point."""
        return float(self.all_rates(np.array([east_m]), np.array([north_m]))[0])


def _area(rings: list[Floats], origin_deg: tuple[float, float]) -> shapely.Geometry:
    # Odd and even: a hole is a ring within a ring, whichever way it turns.
    area: shapely.Geometry = shapely.Polygon()
    for ring in rings:
        area = area.symmetric_difference(shapely.Polygon(flat(ring, origin_deg)))
    return area


# --------------------------------------------------------------------------------------- the flight


class _Strip(Valve):
    """One valve's strip on the original map."""

    def __init__(self, truth: Truth, number: int, ground: Ground) -> None:
        right_m, forward_m, self.width_m = truth.strips[number]
        self.time_s = truth.time_s
        heading = np.unwrap(np.radians(truth.heading_deg))
        self.sin, self.cos = np.sin(heading), np.cos(heading)
        self.x = truth.east_m + self.sin * forward_m + self.cos * right_m
        self.y = truth.north_m + self.cos * forward_m - self.sin * right_m
        self.s = np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(self.x), np.diff(self.y)))))
        self.step_s = float(self.time_s[-1] - self.time_s[0]) / (len(self.time_s) - 1)
        self.volume = truth.volume_ml[:, number]
        self.rates = ground.all_rates(self.x, self.y)
        half_m = max(0.5 * self.width_m - GRAZE_M, 0.25 * self.width_m)
        self.inside = np.ones(len(self.x), dtype=np.bool_)
        for side_m in (-half_m, half_m):
            self.inside &= shapely.contains_xy(ground.field, *self.beside(side_m))
        self.across = self.width_m * self._square(self.sin, self.cos)
        self.edges = [self._edge(row, ground) for row in np.flatnonzero(np.diff(self.rates))]
        self.asked = self._asked()

    def beside(self, side_m: float) -> tuple[Floats, Floats]:
        return self.x + self.cos * side_m, self.y - self.sin * side_m

    def off_target_ml(self, ground: Ground) -> float:
        """Return what fell outside the field, a tenth of a metre of the strip at a time."""
        drops = np.diff(self.volume)
        count = int(np.ceil(self.width_m / ELEMENT_M - 1e-9))
        total_ml = 0.0
        for part in (np.arange(count) + 0.5) / count - 0.5:
            x, y = (0.5 * (each[1:] + each[:-1]) for each in self.beside(part * self.width_m))
            total_ml += float(drops[~shapely.contains_xy(ground.field, x, y)].sum()) / count
        return total_ml


def judge(truth: Truth, ground: Ground) -> Verdict:
    """Return the figures of a flight."""
    period_s = PERIOD["s"] = truth.period_s
    strips = [_Strip(truth, number, ground) for number in range(len(truth.strips))]
    found = [lags(strip, period_s) for strip in strips]
    wrong_ml = asked_ml = 0.0
    given, wanted = np.zeros(len(truth.time_s)), np.zeros(len(truth.time_s))
    counts = np.ones(len(truth.time_s), dtype=np.bool_)
    for strip in strips:
        run_m = strip.over(strip.s, period_s)
        its, due = strip.over(strip.volume, period_s), strip.over(strip.asked, period_s)
        moves = strip.inside & (run_m > MOVING_M_S * period_s)
        weight = np.gradient(strip.s)[moves] / run_m[moves]
        wrong_ml += float((np.abs(its - due)[moves] * weight).sum())
        asked_ml += float((due[moves] * weight).sum())
        given += its / period_s
        wanted += strip.rates * ML_PER_M * strip.across * run_m / period_s
        counts &= moves
    counts &= wanted > 0.0
    right = 1.0 - np.abs(given - wanted)[counts] / wanted[counts]
    return Verdict(
        lag_m=tuple(lag for its, _ in found for lag in its),
        missed=sum(missed for _, missed in found),
        misapplied_percent=100.0 * wrong_ml / asked_ml,
        accuracy_percent=100.0 * float(right.mean()) if len(right) else float("nan"),
        off_target_ml=sum(strip.off_target_ml(ground) for strip in strips),
    )
