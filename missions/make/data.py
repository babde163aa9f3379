"""A field's data, of any kind, as values at the places of its passes.

Three kinds: rasters (a band, or an index of several), points (a harvester's, a sensor's, counts of
weeds) and polygons with a value. What is read is a stranger's file, within the bounds of the
map readers.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import shapely
from pyproj import CRS, Transformer

from companion.core.frame import METRES_PER_DEGREE, LocalFrame
from companion.csv_table import csv_text
from companion.errors import MapError
from companion.map_formats import geojson_feature, geojson_text
from companion.wording import typed
from missions.make.cleaning import (
    STEPS,
    Cleaned,
    Ints,
    Step,
    Track,
    cleaned,
    is_track,
    pass_width_m,
)
from missions.make.passes import Places
from missions.maps.assemble import crs_of, ground_of, zone_names
from missions.maps.cells import to_cells_of
from missions.maps.convert.rasterise import painted, spans_of
from missions.maps.crs import WGS84, parse_crs, to_longitude_latitude
from missions.maps.csvfile import read_point_table
from missions.maps.geotiff import read_bands
from missions.maps.local import places as local_places
from missions.maps.local import project_all
from missions.maps.model import (
    Affine,
    Column,
    Floats,
    Grid,
    Layer,
    as_number,
    map_error,
    write_whole,
)
from missions.maps.registry import read_layer
from missions.strips import Objects

# Indices by the bands they are made of. Normalised differences: NDVI (Rouse et al. 1974), GNDVI
# (Gitelson et al. 1996), NDRE (Barnes et al. 2000), NDMI (Gao 1996); CIRE is a ratio less one
# (Gitelson et al. 2003).
INDICES: dict[str, tuple[str, str]] = {
    "NDVI": ("nir", "red"),
    "GNDVI": ("nir", "green"),
    "NDRE": ("nir", "rededge"),
    "NDMI": ("nir", "swir"),
    "CIRE": ("nir", "rededge"),
}
# What bands are called, in lower case without blanks; Sentinel-2's numbers are the last.
BAND_NAMES: dict[str, tuple[str, ...]] = {
    "green": ("green", "g", "b3", "b03"),
    "red": ("red", "r", "b4", "b04"),
    "rededge": ("rededge", "re", "b5", "b05"),
    "nir": ("nir", "nearinfrared", "n", "b8", "b08"),
    "swir": ("swir", "swir1", "b11"),
}
SPEED_NAMES = ("speed", "speedms", "groundspeed", "velocity", "speedkmh", "vehiclspeed")
# Places in one bite: the arrays of all of them at once would take gigabytes.
BITE = 1_000_000
# What is said of rates is none of measurements.
OF_RATES = ("nodata-zero", "class-raster")
# Points around a place that count, and to how many pass widths away.
AROUND, REACH_WIDTHS = 12, 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """Which values of a file are meant; `bands` say what a raster's bands are, by name."""

    value: str | None = None
    bands: Mapping[str, str] = field(default_factory=dict)
    band_offset: float = 0.0
    crs: str | None = None
    layer: str | None = None
    steps: tuple[Step, ...] | None = None
    width_m: float | None = None
    ends_m: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Points:
    """Points as longitude and latitude, with what their file says of them."""

    degrees: Floats
    columns: Mapping[str, Floats]


@dataclass(frozen=True, slots=True, kw_only=True)
class Values:
    """One layer of values: its name, how fine it is, and what it says at places.

    `removed` counts the points that were removed, of `count` in all, and `kept` are the others;
    None where there are none.
    """

    name: str
    grain_m: float
    at: Callable[[Places], Floats]
    said: tuple[str, ...] = ()
    count: int | None = None
    removed: Mapping[str, int] | None = None
    kept: Points | None = None


def read_values(path: Path, wanted: Wanted, frame: LocalFrame) -> Values:
    """Return the values of a file around the origin of `frame`."""
    suffix = path.suffix.casefold()
    if suffix in (".tif", ".tiff"):
        return _raster(path, wanted, frame)
    if suffix == ".csv":
        table = read_point_table(path)
        if table is not None:
            points, crs, columns = table
            return _points(path, in_degrees(points, crs, wanted.crs, path), columns, wanted, frame)
    found = read_layer(path, layer=wanted.layer)
    if isinstance(found, Grid):
        return _of_grid(path, found, wanted, frame)
    crs, _ = crs_of(found, path, wanted.crs)
    numbers = _numbers(found.columns)
    if found.marks:
        native, where = points_of(found)
        degrees = shapely.get_coordinates(to_longitude_latitude(native, crs, path=path))
        chosen = {name: values[where] for name, values in numbers.items()}
        return _points(path, degrees, chosen, wanted, frame)
    return _areas(path, found, crs, numbers, wanted, frame)


def points_of(layer: Layer) -> tuple[Objects, Ints]:
    """Return the points of a layer, whether each is a feature or one of several, and their rows."""
    rows = np.array([*layer.marks], dtype=np.int64)
    parts, of = shapely.get_parts(
        np.array([*layer.marks.values()], dtype=object), return_index=True
    )
    points = shapely.get_type_id(parts) == shapely.GeometryType.POINT
    return parts[points], rows[of[points]]


def _numbers(columns: Sequence[Column]) -> dict[str, Floats]:
    found = {}
    for column in columns:
        if column.numeric:
            values = [as_number(value) for value in column.values]
            found[column.name] = np.array(
                [np.nan if value is None else value for value in values], dtype=np.float64
            )
    return found


def in_degrees(points: Floats, crs: CRS | None, asked: str | None, path: Path) -> Floats:
    """Return points (x, y) of a file as longitude and latitude."""
    if crs is None:
        if asked is None:
            raise map_error(
                path,
                "its coordinates are not degrees, and it does not say its coordinate system",
                fix="give it with --crs, such as EPSG:32633",
                code="no-crs",
            )
        crs = parse_crs(asked, path=path, source=f"--crs {asked!r}")
    there = Transformer.from_crs(crs, WGS84, always_xy=True)
    return np.column_stack(there.transform(points[:, 0], points[:, 1]))


def _column(path: Path, columns: Mapping[str, Floats], wanted: str | None) -> str:
    """Return the name of the column that is meant."""
    names = {name.casefold(): name for name in columns}
    if wanted is not None and wanted.casefold() in names:
        return names[wanted.casefold()]
    if wanted is None and len(names) == 1:
        return next(iter(names.values()))
    shown = typed(list(columns)[:12]) or "none"
    raise map_error(
        path,
        f"it has no column {wanted!r} of numbers; it has {shown}"
        if wanted is not None
        else f"several columns hold numbers: {shown}"
        if columns
        else "no column holds numbers",
        fix="name one with --value",
        code="no-rate-column" if not columns else "several-columns",
    )


# Rasters.


def _raster(path: Path, wanted: Wanted, frame: LocalFrame) -> Values:
    grid = read_bands(path, wanted.layer)
    return _of_grid(path, grid, wanted, frame)


def _of_grid(path: Path, grid: Grid, wanted: Wanted, frame: LocalFrame) -> Values:
    crs, _ = crs_of(grid, path, wanted.crs)
    name, values = _band(path, grid, wanted)
    rows, columns = values.shape
    warp = to_cells_of(grid.transform, crs, (rows, columns), frame, path)
    size_m = _cell_m(grid.transform, crs, frame)

    def at(places: Places) -> Floats:
        found = np.full(len(places.row), np.nan)
        for first in range(0, len(found), BITE):
            part = slice(first, first + BITE)
            east, north = places.points(part).T
            column, row = warp(east, north)
            there = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
            found[part][there] = values[row[there].astype(np.int64), column[there].astype(np.int64)]
        return found

    said = tuple(one.text for one in grid.problems if one.code not in OF_RATES)
    return Values(name=name, grain_m=size_m, at=at, said=said)


def _cell_m(transform: Affine, crs: CRS, frame: LocalFrame) -> float:
    a, b, _, d, e, _ = transform
    size = abs(a * e - b * d)
    if crs.is_geographic:
        return float(METRES_PER_DEGREE * np.sqrt(size * np.cos(np.radians(frame.latitude_deg))))
    return float(np.sqrt(size)) * float(crs.axis_info[0].unit_conversion_factor or 1.0)


def _band(path: Path, grid: Grid, wanted: Wanted) -> tuple[str, Floats]:
    """Return the band that is meant, or the index of two."""
    asked = wanted.value
    if asked is None and len(grid.bands) == 1:
        return grid.bands[0].name, grid.bands[0].values
    if asked is not None and asked.upper() in INDICES and not _named(grid, asked):
        return asked.upper(), _index(path, grid, asked.upper(), wanted)
    number = None if asked is None else _named(grid, asked)
    if number is None:
        shown = ", ".join(f"{at} {band.name}" for at, band in enumerate(grid.bands[:12], 1))
        raise map_error(
            path,
            f"it has no band {asked!r}; its bands are {shown}"
            if asked is not None
            else f"it has several bands: {shown}",
            fix=f"name a band or an index ({', '.join(INDICES)}) with --value",
            code="several-bands",
        )
    return grid.bands[number - 1].name, grid.bands[number - 1].values


def _letters(name: str) -> str:
    return re.sub(r"[\W_]+", "", name.casefold())


def _named(grid: Grid, name: str) -> int | None:
    """Return the number of a band, by its number or its name."""
    if name.isascii() and name.isdigit():
        return int(name) if 1 <= int(name) <= len(grid.bands) else None
    names = [_letters(band.name) for band in grid.bands]
    return names.index(_letters(name)) + 1 if names.count(_letters(name)) == 1 else None


def _index(path: Path, grid: Grid, index: str, wanted: Wanted) -> Floats:
    found = []
    for colour in INDICES[index]:
        given = wanted.bands.get(colour)
        names = BAND_NAMES[colour] if given is None else (given,)
        numbers = [number for number in (_named(grid, name) for name in names) if number]
        if not numbers:
            shown = ", ".join(f"{at} {band.name}" for at, band in enumerate(grid.bands[:12], 1))
            raise map_error(
                path,
                f"{index} takes a band {colour}, and no band has that name; its bands are {shown}",
                fix=f"say which it is with --band {colour}=NUMBER",
                code="no-band",
            )
        found.append(grid.bands[numbers[0] - 1].values + wanted.band_offset)
    return index_of(index, found[0], found[1])


def index_of(index: str, first: Floats, second: Floats) -> Floats:
    """Return an index of two bands of reflectance, NaN where they say nothing.

    >>> index_of("NDVI", np.array([0.5, 0.0]), np.array([0.1, 0.0])).round(3).tolist()
    [0.667, nan]
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = first / second
        found = ratio - 1.0 if index == "CIRE" else (first - second) / (first + second)
    found[~np.isfinite(found)] = np.nan
    return found


# Points.


def _points(
    path: Path, degrees: Floats, columns: dict[str, Floats], wanted: Wanted, frame: LocalFrame
) -> Values:
    name = _column(path, columns, wanted.value)
    points = local_places(list(zip(degrees[:, 1], degrees[:, 0], strict=True)), frame)
    if not len(points):
        raise map_error(path, "it has no points", fix="export the data again", code="no-polygon")
    track = is_track(points)
    width_m = wanted.width_m or pass_width_m(points)
    speed = next((columns[one] for one in columns if _letters(one) in SPEED_NAMES), None)
    data = Track(
        points=points, values=columns[name], speed_m_s=speed, width_m=width_m,
        ends_m=2.0 * width_m if wanted.ends_m is None else wanted.ends_m,
    )  # fmt: skip
    steps = wanted.steps if wanted.steps is not None else STEPS if track else ()
    found = cleaned(data, steps)
    if np.count_nonzero(found.kept) < 3:
        raise map_error(
            path,
            f"of its {len(points)} points {np.count_nonzero(found.kept)} are left after cleaning "
            f"({counts_text(found)})",
            fix="leave out steps with --clean, or none at all with --clean none",
            code="too-few-points",
        )
    at = _average_around(points[found.kept], columns[name][found.kept], width_m)
    return Values(
        name=name, grain_m=width_m, at=at, count=len(points), removed=found.removed,
        kept=Points(
            degrees=degrees[found.kept],
            columns={each: column[found.kept] for each, column in columns.items()},
        ),
    )  # fmt: skip


POINT_SUFFIXES = (".csv", ".geojson")


def write_points(path: Path, points: Points) -> None:
    """Write points with their columns, as CSV or GeoJSON; what is no number stays empty."""
    names = [*points.columns]
    rows = zip(points.degrees.tolist(), *(points.columns[name].tolist() for name in names),
               strict=True)  # fmt: skip
    if path.suffix.casefold() == ".csv":
        table: list[list[str]] = [["lat", "lon", *names]]
        for (lon, lat), *values in rows:
            shown = ["" if math.isnan(value) else repr(value) for value in values]
            table.append([f"{lat:.8f}", f"{lon:.8f}", *shown])
        write_whole(path, csv_text(table).encode("utf-8"))
        return
    features = [
        geojson_feature(
            shapely.Point(lon, lat),
            {
                name: None if math.isnan(value) else value
                for name, value in zip(names, values, strict=True)
            },
        )
        for (lon, lat), *values in rows
    ]
    write_whole(path, geojson_text(features).encode("utf-8"))


def counts_text(found: Cleaned) -> str:
    """Return what was removed, in words."""
    return ", ".join(f"{name} {count}" for name, count in found.removed.items() if count)


def _average_around(points: Floats, values: Floats, width_m: float) -> Callable[[Places], Floats]:
    """Return the average of the points around a place, the near ones counting most."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    reach_m, count = REACH_WIDTHS * width_m, min(AROUND, len(points))

    def at(places: Places) -> Floats:
        found = np.full(len(places.row), np.nan)
        for first in range(0, len(found), BITE):
            part = slice(first, first + BITE)
            away, which = tree.query(places.points(part), k=count, distance_upper_bound=reach_m)
            away, which = away.reshape(-1, count), which.reshape(-1, count)
            there = np.isfinite(away)
            weight = np.where(there, 1.0 / (np.where(there, away, 0.0) ** 2 + width_m**2 / 4), 0.0)
            total = weight.sum(axis=1)
            near = values[np.where(there, which, 0)]
            some = total > 0.0
            found[part][some] = (weight * near).sum(axis=1)[some] / total[some]
        return found

    return at


# Polygons.


def _areas(
    path: Path, layer: Layer, crs: CRS, numbers: dict[str, Floats], wanted: Wanted,
    frame: LocalFrame,
) -> Values:  # fmt: skip
    name = _column(path, numbers, wanted.value)
    ground, _ = ground_of(layer, crs, zone_names(layer), path)
    some = [index for index, area in enumerate(ground) if area is not None]
    local = project_all(np.array([ground[index] for index in some], dtype=object), frame)
    values = numbers[name][some]

    def at(places: Places) -> Floats:
        passes = places.passes
        edges = passes.edges_m

        def numbered(points: Floats) -> Floats:
            turned = passes.turned(points)
            row = np.interp(turned[:, 1], edges, np.arange(len(edges))) * places.rows
            return np.column_stack([(turned[:, 0] - places.start_m) / places.step_m, row])

        widest = float(np.diff(edges).max())
        fine = shapely.segmentize(local, widest / 2.0)
        found = np.full(places.shape, np.nan)
        spans = spans_of(shapely.transform(fine, numbered), places.shape, path=path)
        for owner, cell in painted(spans, places.columns, path=path):
            found.reshape(-1)[cell] = values[owner]
        result: Floats = found[places.row, places.column]
        return result

    sizes = shapely.area(local)
    return Values(name=name, grain_m=float(np.sqrt(np.median(sizes))) / 2.0, at=at)


def filled(values: Floats, places: Places, path: Path) -> tuple[Floats, float]:
    """Return values with none missing, each from the nearest place, and how much was missing."""
    missing = np.isnan(values)
    share = float(places.area_m2[missing].sum() / places.area_m2.sum())
    if not missing.any():
        return values, 0.0
    if share > MISSING_MAX:
        raise _elsewhere(path, share)
    from scipy.ndimage import distance_transform_edt

    known = places.spread(~missing, missing=False)
    width_m = float(places.row_m.mean())
    nearest = distance_transform_edt(
        ~known, sampling=(width_m, places.step_m), return_distances=False, return_indices=True
    )
    lattice = places.spread(values, np.nan)
    row, column = nearest[:, places.row[missing], places.column[missing]]
    whole = values.copy()
    whole[missing] = lattice[row, column]
    return whole, share


# More of the field without data is not a gap that neighbours could fill.
MISSING_MAX = 0.5


def _elsewhere(path: Path, share: float) -> MapError:
    return map_error(
        path,
        f"{100 * share:.0f} % of the field has no data",
        fix="check that data and boundary are of the same field, and --crs if you gave it",
        code="no-data",
    )
