"""What really fell where, counted from the truth of simulated flights: the judge of all figures.

Numpy and shapely only, and nothing of the product: path, strips and volumes come from the truth
file, ground from GeoJSON. Areas are exact polygons of what open valves swept; doses are sums of
drops over a fine raster. Ground is treated where a valve gives half of what it gives while open:
per metre, as a slow start with little flow treats its ground like any other.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# A valve is open from and to half of its usual flow: about where a sharp step would lie.
OPEN_FROM = 0.5
# Pulses are no openings: flows are means over about a period.
MEAN_S = 0.09
SLOWEST_M_S = 0.2
FINE_M = 0.05
PARTS = 4
PER_L_HA = 10.0  # mL/m2 to L/ha


@dataclass(frozen=True)
class Truth:
    """One flight: path of the reference, and each valve's strip and cumulative volume."""

    time_s: Floats
    east_m: Floats
    north_m: Floats
    heading_deg: Floats
    volume_ml: Floats
    right_m: Floats
    forward_m: Floats
    width_m: Floats
    origin_deg: tuple[float, float]

    @staticmethod
    def read(path: Path) -> Truth:
        """Return the flight of a `truth.npz` of `vrspray sitl fly`."""
        with np.load(path) as file:
            values = {name: file[name] for name in file.files}
        names = [name for name in Truth.__annotations__ if name != "origin_deg"]
        lat, lon = values["origin_deg"]
        return Truth(
            **{name: values[name].astype(np.float64) for name in names},
            origin_deg=(float(lat), float(lon)),
        )

    def edges(self, valve: int, right_m: float) -> Floats:
        """Return the way of a point of the boom, as (samples, 2)."""
        heading = np.radians(self.heading_deg)
        ahead_m = self.forward_m[valve]
        return np.column_stack(
            [
                self.east_m + right_m * np.cos(heading) + ahead_m * np.sin(heading),
                self.north_m - right_m * np.sin(heading) + ahead_m * np.cos(heading),
            ]
        )

    def sides(self, valve: int) -> tuple[Floats, Floats]:
        """Return the ways of both ends of a strip."""
        half_m = 0.5 * self.width_m[valve]
        middle_m = self.right_m[valve]
        return self.edges(valve, middle_m - half_m), self.edges(valve, middle_m + half_m)


def to_local(lon_lat: Floats, origin_deg: tuple[float, float]) -> Floats:
    """Return east and north of WGS84 positions, by the ellipsoid's own geometry (ECEF to ENU)."""
    a, e2 = 6378137.0, 0.0066943799901413165

    def ecef(lat: Floats, lon: Floats) -> Floats:
        n = a / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
        return np.stack(
            [
                n * np.cos(lat) * np.cos(lon),
                n * np.cos(lat) * np.sin(lon),
                n * (1 - e2) * np.sin(lat),
            ]
        )

    lat0, lon0 = np.radians(np.array(origin_deg))
    lat, lon = np.radians(lon_lat[:, 1]), np.radians(lon_lat[:, 0])
    x, y, z = ecef(lat, lon) - ecef(lat0, lon0)[:, None]
    east = -np.sin(lon0) * x + np.cos(lon0) * y
    north = -np.sin(lat0) * np.cos(lon0) * x - np.sin(lat0) * np.sin(lon0) * y + np.cos(lat0) * z
    return np.column_stack([east, north])


def ground_of(path: Path, origin_deg: tuple[float, float]) -> list[tuple[Any, dict[str, Any]]]:
    """Return shapes and properties of a GeoJSON file, in metres."""
    found = []
    for feature in json.loads(path.read_text(encoding="utf-8"))["features"]:
        shape = shapely.from_geojson(json.dumps(feature["geometry"]))
        local = shapely.transform(shape, lambda xy: to_local(xy, origin_deg))
        found.append((local, feature["properties"] or {}))
    return found


@dataclass(frozen=True)
class Field:
    """Rates by ground, the outline, and the planned lines where there are any."""

    zones: list[tuple[Any, float]]
    outline: Any
    lines: list[Any] = field(default_factory=list)

    @staticmethod
    def read(
        map_file: Path,
        origin_deg: tuple[float, float],
        *,
        rate: str = "rate",
        lines_file: Path | None = None,
    ) -> Field:
        """Return the field of a map file; the outline is that of all zones."""
        zones = [(shape, float(said[rate])) for shape, said in ground_of(map_file, origin_deg)]
        every = [] if lines_file is None else ground_of(lines_file, origin_deg)
        # The ways between passes stand there too.
        lines = [shape for shape, said in every if said.get("kind") == "spray"]
        outline = shapely.union_all([shape for shape, _ in zones], grid_size=1e-4)
        return Field(zones=zones, outline=outline, lines=lines)

    @property
    def rated(self) -> Any:
        """Return the ground that has a rate."""
        return shapely.intersection(
            shapely.union_all([shape for shape, rate in self.zones if rate > 0.0], grid_size=1e-4),
            self.outline,
        )

    def rates_at(self, xy: Floats) -> Floats:
        """Return the rate under each point; NaN outside."""
        found = np.full(len(xy), np.nan)
        for shape, rate in self.zones:
            shapely.prepare(shape)
            found[shapely.contains_xy(shape, xy)] = rate
        found[~shapely.contains_xy(self.outline, xy)] = np.nan
        return found


def swept(left: Floats, right: Floats) -> Any:
    """Return the ground between two ways."""
    quads = np.stack([left[:-1], left[1:], right[1:], right[:-1], left[:-1]], axis=1)
    # Ten steps at a time: straight to a centimetre, and few polygons.
    shapes = shapely.polygons(quads)
    return shapely.union_all(shapes[shapely.is_valid(shapes) & (shapely.area(shapes) > 0.0)])


def flows_of(truth: Truth) -> Floats:
    """Return each valve's flow [mL/s] between samples, as means over a period."""
    step_s = float(np.median(np.diff(truth.time_s)))
    over = max(round(MEAN_S / step_s), 1)
    box = np.ones(over) / over
    flow = np.diff(truth.volume_ml, axis=0) / step_s
    return np.column_stack([np.convolve(each, box, "same") for each in flow.T])


def openings_of(truth: Truth) -> list[Any]:
    """Return the ground of each time that a valve was open."""
    flow, found = flows_of(truth), []
    step_s = float(np.median(np.diff(truth.time_s)))
    for valve in range(flow.shape[1]):
        its = flow[:, valve]
        if not (its > 1e-6).any():
            continue
        left, right = truth.sides(valve)
        speed = np.hypot(*np.diff(0.5 * (left + right), axis=0).T) / step_s
        its = its / np.maximum(speed, SLOWEST_M_S)
        runs = np.flatnonzero(np.diff(its > 1e-6, prepend=False, append=False))
        for first, end in zip(runs[::2], runs[1::2], strict=True):
            # What is half of the usual is by what flows around it: a rate may be half of another.
            near = np.array(its[first:end])
            usual = np.median(near)
            is_open = its[first:end] >= OPEN_FROM * min(usual, near.max())
            edges = np.flatnonzero(np.diff(is_open, prepend=False, append=False)) + first
            for begin, until in zip(edges[::2], edges[1::2], strict=True):
                picked = np.arange(begin, until + 1)
                # Every fifth sample is a centimetre from straight; both ends count.
                picked = np.unique(np.append(picked[::5], picked[-1]))
                found.append(swept(left[picked], right[picked]))
    return [shape for shape in found if not shape.is_empty]


@dataclass(frozen=True)
class Verdict:
    """Litres and square metres of one flight, or of several of one field."""

    applied_l: float
    outside_ml: float
    off_line_ml: float
    field_m2: float
    treated_m2: float
    twice_m2: float
    bare_m2: float
    missed_m2: float
    asked_l: float
    treated: Any

    @property
    def asked_rate_l_ha(self) -> float:
        """Return the mean rate of the map on the ground treated."""
        return self.asked_l / self.treated_m2 * 1e4


def judge(flights: list[Truth], ground: Field) -> Verdict:
    """Return the figures of all flights together."""
    openings = [shape for truth in flights for shape in openings_of(truth)]
    shapes = np.array(openings, dtype=object)
    treated = shapely.union_all(shapes) if openings else shapely.Polygon()
    one, other = shapely.STRtree(shapes).query(shapes, predicate="intersects")
    pairs = one < other
    both = shapely.intersection(shapes[one[pairs]], shapes[other[pairs]])
    twice = shapely.union_all([shape for shape in both if shape.area > 1e-4])
    rated = ground.rated
    bare = rated.difference(treated)
    dropped = [drops_of(truth, ground) for truth in flights]
    return Verdict(
        applied_l=sum(float((t.volume_ml[-1] - t.volume_ml[0]).sum()) for t in flights) / 1e3,
        outside_ml=sum(each[0] for each in dropped),
        off_line_ml=sum(each[1] for each in dropped),
        field_m2=float(rated.area),
        treated_m2=float(treated.area),
        twice_m2=float(twice.area),
        bare_m2=float(bare.area),
        missed_m2=float(bare.intersection(passed_of(flights, ground)).area),
        asked_l=sum(shape.intersection(treated).area * rate for shape, rate in ground.zones) / 1e4,
        treated=treated,
    )


def passed_of(flights: list[Truth], ground: Field) -> Any:
    """Return the ground of the lines that were flown, whole; without lines what the boom swept."""
    found = []
    for truth in flights:
        reach_m = float((np.abs(truth.right_m) + truth.width_m / 2.0).max())
        way = np.column_stack([truth.east_m, truth.north_m])
        path = shapely.linestrings(way[::5])
        wet = way[1:][np.diff(truth.volume_ml.sum(axis=1)) > 0.0][::5]
        if not ground.lines:
            found.append(path.buffer(reach_m, cap_style="flat"))
        for line in ground.lines:
            # Flown is a line that the reference followed for most of its length, and sprayed: a
            # ferry may lead along a line of another sortie.
            around = line.buffer(1.0, cap_style="flat")
            there = shapely.points(wet[shapely.contains_xy(around, wet)])
            metres = np.unique(np.floor(shapely.line_locate_point(line, there)))
            is_wet = len(metres) > 0.3 * line.length
            if is_wet and path.intersection(around).length > 0.7 * line.length:
                found.append(line.buffer(reach_m, cap_style="flat"))
    return shapely.union_all(found)


@dataclass(frozen=True)
class Exported:
    """What a file of swaths holds, where there is no truth: litres, and the ground under them."""

    applied_l: float
    treated_m2: float
    outside_ml: float


def swaths_of(path: Path, origin_deg: tuple[float, float], ground: Field) -> Exported:
    """Return the figures of a GeoJSON of swaths, each spread evenly over its own polygon."""
    swaths = ground_of(path, origin_deg)
    outline = ground.outline.buffer(1e-3)
    outside_ml = sum(
        float(said["volume_ml"]) * shape.difference(outline).area / shape.area
        for shape, said in swaths
        if shape.area > 0.0
    )
    return Exported(
        applied_l=sum(float(said["volume_ml"]) for _, said in swaths) / 1e3,
        treated_m2=float(shapely.union_all([shape for shape, _ in swaths], grid_size=1e-4).area),
        outside_ml=outside_ml,
    )


def points_of(truth: Truth) -> tuple[Floats, Floats]:
    """Return places and millilitres of all that fell, in pieces of a few centimetres."""
    places, drops = [], []
    given = np.diff(truth.volume_ml, axis=0)
    for valve in range(given.shape[1]):
        wet = np.flatnonzero(given[:, valve] > 0.0)
        count = int(np.ceil(truth.width_m[valve] / FINE_M))
        # Within a step too: a cell of a metre is twenty steps long, and one more is 5 %.
        for part in (np.arange(PARTS) + 0.5) / PARTS:
            left, right = (
                (side[:-1] + part * np.diff(side, axis=0))[wet] for side in truth.sides(valve)
            )
            for share in (np.arange(count) + 0.5) / count:
                places.append(left + share * (right - left))
                drops.append(given[wet, valve] / count / PARTS)
    return np.concatenate(places), np.concatenate(drops)


def drops_of(truth: Truth, ground: Field) -> tuple[float, float]:
    """Return what fell outside the field, and inside it but off the planned lines [mL]."""
    places, drops = points_of(truth)
    shapely.prepare(ground.outline)
    # The edge itself is inside, to a millimetre.
    inside = shapely.contains_xy(ground.outline.buffer(1e-3), places)
    if not ground.lines:
        return float(drops[~inside].sum()), 0.0
    reach_m = float((np.abs(truth.right_m) + truth.width_m / 2.0).max())
    planned = shapely.union_all(
        [line.buffer(reach_m + 0.5, cap_style="flat") for line in ground.lines]
    )
    shapely.prepare(planned)
    on_line = shapely.contains_xy(planned, places)
    return float(drops[~inside].sum()), float(drops[inside & ~on_line].sum())


@dataclass(frozen=True)
class Doses:
    """Of each square cell: dose [L/ha] on the ground in the field, and that ground [m2]."""

    dose_l_ha: Floats
    ground_m2: Floats
    asked_l_ha: Floats


def doses_of(
    flights: list[Truth],
    ground: Field,
    west_m: float,
    south_m: float,
    cell_m: float,
    shape: tuple[int, int],
) -> Doses:
    """Return what fell on each cell of a grid, over all flights, with cells cut at the outline.

    Dose is over the ground of the cell under a line that was flown, or under the boom where there
    are no lines: the rest is nobody's dose.
    """
    rows, columns = shape
    per = max(round(cell_m / 0.1), 1)
    fine_m = cell_m / per
    volume = np.zeros(rows * columns)

    def number(xy: Floats, size_m: float, count: tuple[int, int]) -> NDArray[np.int64]:
        column = np.floor((xy[:, 0] - west_m) / size_m).astype(np.int64)
        row = np.floor((xy[:, 1] - south_m) / size_m).astype(np.int64)
        beside = (row < 0) | (row >= count[0]) | (column < 0) | (column >= count[1])
        return np.where(beside, -1, row * count[1] + column)

    for truth in flights:
        places, drops = points_of(truth)
        cells = number(places, cell_m, shape)
        inside = (cells >= 0) & shapely.contains_xy(ground.outline, places)
        volume += np.bincount(cells[inside], weights=drops[inside], minlength=rows * columns)
    row, column = np.divmod(np.arange(rows * columns * per**2), columns * per)
    xy = np.column_stack([west_m + (column + 0.5) * fine_m, south_m + (row + 0.5) * fine_m])
    rates = ground.rates_at(xy)
    passed = passed_of(flights, ground)
    shapely.prepare(passed)
    counts = shapely.contains_xy(passed, xy) & np.isfinite(rates)
    coarse = (row // per) * columns + column // per
    area = np.bincount(coarse[counts], minlength=rows * columns) * fine_m**2
    asked = np.bincount(coarse[counts], weights=rates[counts], minlength=rows * columns)
    with np.errstate(invalid="ignore", divide="ignore"):
        return Doses(
            dose_l_ha=(PER_L_HA * volume / area).reshape(shape),
            ground_m2=area.reshape(shape),
            asked_l_ha=(asked * fine_m**2 / area).reshape(shape),
        )
