"""CSV: points with latitude and longitude, points in some projection, or polygons as WKT."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely
from pyproj import CRS
from shapely import MultiPolygon, Polygon
from shapely.errors import ShapelyError

from missions.maps.crs import WGS84, parse_crs
from missions.maps.csvfile.csv_points import cells_of_coordinates, cells_of_degrees
from missions.maps.csvfile.table import Table, read_table
from missions.maps.fields import words
from missions.maps.layer import (
    COORDINATE_MAX,
    Band,
    Column,
    Grid,
    Layer,
    Value,
    check_coordinates,
    check_counts,
    digest,
    read_bytes,
)
from missions.maps.model import Floats, map_error

# Names of columns in lower case, without blanks, underscores and brackets.
_LATITUDE = ("lat", "latitude", "latdeg", "latitudedeg", "latdd", "latwgs84")
_LONGITUDE = ("lon", "lng", "long", "longitude", "londeg", "longitudedeg", "londd", "lonwgs84")
_X = ("easting", "east", "eastm", "eastingm", "utme", "utmeast", "x", "xcoord", "pointx")
_Y = ("northing", "north", "northm", "northingm", "utmn", "utmnorth", "y", "ycoord", "pointy")
_WKT = ("wkt", "geometry", "geom", "thegeom", "wktgeom", "geomwkt")
_UNIT = frozenset(("unit", "units", "uom"))
# What WKT of ground begins with; others are left out unread. PostGIS puts the CRS before it.
_AREA = re.compile(r"\s*(?:SRID=(\d{1,6});)?\s*((?:MULTI)?POLYGON)\b", re.IGNORECASE | re.ASCII)
_KIND = re.compile(r"\s*(?:SRID=\d{1,6};)?\s*([A-Za-z]{1,20})", re.ASCII)
# Beyond any degrees: the operator has to say what the coordinates are.
_DEGREES_MAX = 400.0


def read_csv(path: Path, layer: str | None = None) -> Layer | Grid:
    """Return what a CSV file holds: cells around its points, or its polygons."""
    if layer is not None:
        raise map_error(path, "CSV has no layers", fix="leave out --layer", code="no-layer")
    content = read_bytes(path)
    table = read_table(content, path, wanted=lambda names: bool(_place_columns(names)))
    place = _place_columns(tuple(table.columns))
    if len(place) == 1 and not any(map(_AREA.match, table.columns[place[0]])):
        # Programs that write a point's geometry as text write its latitude and longitude too.
        place = _place_columns([name for name in table.columns if name not in place]) or place
    sha256 = digest([content])
    if len(place) == 1:
        return _layer(table, place[0], sha256)
    return _grid(table, place, sha256)


def _place_columns(names: Sequence[str]) -> tuple[str, ...]:
    """Return the column of polygons, or those of x (longitude) and y, or nothing."""
    for kinds in ((_WKT,), (_LONGITUDE, _LATITUDE), (_X, _Y)):
        found = [[name for name in names if _letters(name) in kind] for kind in kinds]
        if all(len(one) == 1 for one in found):
            return tuple(one[0] for one in found)
    return ()


def _letters(name: str) -> str:
    return re.sub(r"[\W_]+", "", name.casefold())


def _grid(table: Table, place: tuple[str, ...], sha256: str) -> Grid:
    x, y = (_coordinates(table, name) for name in place)
    values = {}
    for name in table.columns:
        numbers = None if name in place else table.numbers(name)
        if numbers is not None:
            values[name] = numbers
    if _letters(place[0]) in _LONGITUDE:
        _check_degrees(table, x, y)
        crs, transform, grids, problems = cells_of_degrees(x, y, values, table.path)
    else:
        crs, transform, grids, problems = cells_of_coordinates(x, y, values, table.path)
    units = _units(table, tuple(values))
    if not grids:
        for name in table.columns:
            if name not in place:
                table.refuse_bad_cell(name)
        raise map_error(
            table.path,
            "no column but those of the place holds numbers",
            fix="add the rates in a column of their own",
            code="no-rate-column",
        )
    return Grid(
        format="csv",
        crs=crs,
        transform=transform,
        bands=tuple(
            Band(name=name, values=grid, unit=units.get(name)) for name, grid in grids.items()
        ),
        sha256=sha256,
        unit=units.get(""),
        problems=problems,
    )


def _coordinates(table: Table, name: str) -> Floats:
    """Return a column that has to have a number in every row."""
    numbers = table.numbers(name)
    whole = None if numbers is None else np.abs(numbers) <= COORDINATE_MAX
    if numbers is not None and whole is not None and whole.all():
        return numbers
    index = table.first_text(name) if whole is None else int(np.argmin(whole))
    raise map_error(
        table.path,
        f"line {table.lines[index]}: {name} is {table.columns[name][index][:40]!r}, no coordinate",
        fix="write a number, with a point and not a comma, in every line",
        code="bad-number",
    )


def _check_degrees(table: Table, longitude_deg: Floats, latitude_deg: Floats) -> None:
    north = np.abs(latitude_deg) <= 90.0
    east = np.abs(longitude_deg) <= 180.0
    if north.all() and east.all():
        return
    index = int(np.argmin(north & east))
    exchanged = bool((np.abs(latitude_deg) <= 180.0).all() and (np.abs(longitude_deg) <= 90).all())
    raise map_error(
        table.path,
        f"line {table.lines[index]}: latitude {latitude_deg[index]:.10g}, longitude "
        f"{longitude_deg[index]:.10g} is no place"
        + ("; the two look exchanged" if exchanged else ""),
        fix="exchange the names of the two columns"
        if exchanged
        else "write degrees, or name the columns easting and northing and give --crs",
        code="swapped-axes" if exchanged else "out-of-range",
    )


def _units(table: Table, bands: Sequence[str]) -> dict[str, str]:
    """Return the unit that a column of text gives for a band, and for all under an empty name."""
    found: dict[str, str] = {}
    for name, values in table.columns.items():
        parts = words(name)
        if not _UNIT & set(parts):
            continue
        texts = sorted({value.strip() for value in values} - {""})
        others = [part for part in parts if part not in _UNIT]
        meant = [band for band in bands if words(band) == others] if others else [""]
        if not meant or not texts:
            continue
        if len(texts) > 1:
            raise map_error(
                table.path,
                f"{name} states several units: {', '.join(texts[:3])}",
                fix="convert the rates to one",
                code="unit-conflict",
            )
        found[meant[0]] = texts[0]
    return found


def _layer(table: Table, name: str, sha256: str) -> Layer:
    texts = table.columns[name]
    geometries: list[Polygon | MultiPolygon | None] = []
    skipped: dict[int, str] = {}
    systems: set[str] = set()
    for index, text in enumerate(texts):
        match = _AREA.match(text)
        if match is None:
            kind = _KIND.match(text)
            skipped[index] = f"not-a-polygon:{kind[1]}" if kind else "null-geometry"
            geometries.append(None)
            continue
        systems.add(match[1] or "")
        area = _ground(text[match.start(2) :], table, index)
        geometries.append(area)
        if area is None:
            skipped[index] = "no-area"
    areas = [area for area in geometries if area is not None]
    vertices = shapely.get_coordinates(areas)
    check_counts(table.path, records=len(texts), vertices=len(vertices))
    return Layer(
        format="csv",
        crs=_crs(systems, vertices, table.path),
        columns=tuple(_column(table, other) for other in table.columns if other != name),
        geometries=tuple(geometries),
        sha256=sha256,
        skipped=skipped,
    )


def _ground(text: str, table: Table, index: int) -> Polygon | MultiPolygon | None:
    try:
        area = shapely.force_2d(shapely.from_wkt(text.strip()))
        check_coordinates(shapely.get_coordinates(area))
    except (ShapelyError, ValueError, TypeError) as error:
        reason = str(error)[:80]
        raise map_error(
            table.path,
            f"line {table.lines[index]}: its polygon is broken ({reason})",
            fix="export the map again",
            code="broken-geometry",
        ) from None
    return area if isinstance(area, Polygon | MultiPolygon) and not area.is_empty else None


def _crs(systems: set[str], vertices: Floats, path: Path) -> CRS | None:
    """Return the CRS that the polygons name, else WGS84 where they can be degrees."""
    if len(systems) > 1:
        raise map_error(
            path,
            f"its polygons are in several systems (SRID {', '.join(sorted(systems))})",
            fix="export the map in longitude and latitude",
            code="wrong-crs",
        )
    code = next(iter(systems), "")
    if code not in ("", "0"):
        return parse_crs(f"EPSG:{code}", path=path, source=f"its SRID {code}")
    return WGS84 if float(np.abs(vertices).max(initial=0.0)) <= _DEGREES_MAX else None


def _column(table: Table, name: str) -> Column:
    numbers = table.numbers(name)
    values: tuple[Value, ...]
    if numbers is None:
        values = tuple(value.strip() or None for value in table.columns[name])
    else:
        values = tuple(None if np.isnan(value) else value for value in numbers.tolist())
    return Column(name=name, values=values, numeric=numbers is not None)
