"""CSV: points with latitude and longitude, points in some projection, or polygons as WKT."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from io import StringIO
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS
from shapely import MultiPolygon, Polygon
from shapely.errors import ShapelyError

from companion.errors import MapError
from companion.wording import counted, iconv
from missions.maps.crs import WGS84, parse_crs, stated
from missions.maps.csv_points import Places, cells_of_coordinates, cells_of_degrees
from missions.maps.fields import NONE, refuse_text, score
from missions.maps.model import (
    COORDINATE_MAX,
    MAX_FILE_BYTES,
    MAX_RECORDS,
    Band,
    Column,
    Floats,
    Grid,
    Layer,
    Problem,
    Stated,
    Value,
    check_coordinates,
    check_counts,
    cut_off,
    digest,
    map_error,
    read_bytes,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

# Names of columns in lower case, without blanks, underscores and brackets.
_LATITUDE = ("lat", "latitude", "latdeg", "latitudedeg", "latdd", "latwgs84")
_LONGITUDE = ("lon", "lng", "long", "longitude", "londeg", "longitudedeg", "londd", "lonwgs84")
_X = ("easting", "east", "eastm", "eastingm", "utme", "utmeast", "x", "xcoord", "pointx")
_Y = ("northing", "north", "northm", "northingm", "utmn", "utmnorth", "y", "ycoord", "pointy")
_WKT = ("wkt", "geometry", "geom", "thegeom", "wktgeom", "geomwkt")
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
    table, place = _placed(content, path)
    sha256 = digest([content])
    if len(place) == 1:
        return _layer(table, place[0], sha256)
    return _grid(table, place, sha256)


def _placed(content: bytes, path: Path) -> tuple[Table, tuple[str, ...]]:
    """Return the table, and its column of polygons or its two of places."""
    table = read_table(content, path, wanted=lambda names: bool(_place_columns(names)))
    place = _place_columns(tuple(table.columns))
    if len(place) == 1 and not any(map(_AREA.match, table.columns[place[0]])):
        # Programs that write a point's geometry as text write its latitude and longitude too.
        place = _place_columns([name for name in table.columns if name not in place]) or place
    return table, place


def read_point_table(path: Path) -> tuple[Floats, CRS | None, dict[str, Floats]] | None:
    """Return the points (x, y) of a CSV, their CRS where it says it, and its numbers by column.

    None for a file of polygons.
    """
    table, place = _placed(read_bytes(path), path)
    if len(place) == 1:
        return None
    x, y = (_coordinates(table, name) for name in place)
    in_degrees = _letters(place[0]) in _LONGITUDE
    if in_degrees:
        _check_degrees(table, x, y)
    found = {name: table.numbers(name) for name in table.columns if name not in place}
    numbers = {name: values for name, values in found.items() if values is not None}
    return np.column_stack([x, y]), WGS84 if in_degrees else None, numbers


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
    in_degrees = _letters(place[0]) in _LONGITUDE
    if in_degrees:
        _check_degrees(table, x, y)
    if not values:
        for name in table.columns:
            if name not in place:
                table.refuse_bad_cell(name)
                refuse_text(name, table.columns[name], table.path)
        raise map_error(
            table.path,
            "no column but those of the place holds numbers",
            fix="add the rates in a column of their own",
            code="no-rate-column",
        )
    # Programs round coordinates each in its own way: a decimetre apart is one place.
    digits = 6 if in_degrees else 1
    places = _Places(table, np.round(x, digits) + 1j * np.round(y, digits))
    once = {name: numbers[places.first] for name, numbers in values.items()}
    cells = cells_of_degrees if in_degrees else cells_of_coordinates
    crs, transform, grids, at, problems = cells(x[places.first], y[places.first], once, table.path)
    rated = ~np.all([np.isnan(numbers) for numbers in values.values()], axis=0)
    return Grid(
        format="csv",
        crs=crs,
        transform=transform,
        bands=tuple(
            Band(
                name=name,
                values=grid,
                fault=places.fault(name, values[name]),
                line_of=partial(places.line_of, at, once[name]),
            )
            for name, grid in grids.items()
        ),
        columns=tuple(
            Column(name=name, values=tuple(compress(texts, rated)), numeric=False)
            for name, texts in table.columns.items()
            if name not in place and name not in values
        ),
        sha256=sha256,
        problems=(*places.problems, *problems),
    )


class _Places:
    """The places of points: which rows stand first at theirs, and which lines rates are of."""

    def __init__(self, table: Table, points: NDArray[np.complex128]) -> None:
        _, first, which = np.unique(points, return_index=True, return_inverse=True)
        self._table, self._of = table, first[which]
        self.first = np.sort(first)

    def fault(self, name: str, numbers: Floats) -> MapError | None:
        """Return why a column can be no rate: it says two things of one place."""
        others = numbers[self._of]
        differ = np.flatnonzero((numbers != others) & ~(np.isnan(numbers) & np.isnan(others)))
        if not len(differ):
            return None
        rows = int(self._of[differ[0]]), int(differ[0])
        (one, own), (two, other) = ((self._table.lines[row], numbers[row]) for row in rows)
        return map_error(
            self._table.path,
            f"lines {one} and {two} are of one place, and {name} is {own:g} in one and {other:g} "
            "in the other",
            fix="keep the line that is right",
            code="two-rates",
        )

    @property
    def problems(self) -> tuple[Problem, ...]:
        """Return what there is to say of places that stand more than once."""
        again = np.flatnonzero(self._of != np.arange(len(self._of)))
        if not len(again):
            return ()
        one, two = (self._table.lines[row] for row in (self._of[again[0]], again[0]))
        problem = Problem(
            severity="warning",
            code="duplicate-points",
            text=f"{counted(len(again), 'row')} of places that stand before are left out; line "
            f"{two} is of the place of line {one}",
            where=str(self._table.path),
            fix="compare the number of points with that of the program that made the map",
        )
        return (problem,)

    def line_of(self, at: Places, numbers: Floats, row: int, column: int) -> int:
        """Return the line of a cell's point, of several that with the least or largest value."""
        here = np.flatnonzero((at[0] == column) & (at[1] == row))
        values = np.nan_to_num(numbers[here])
        worst = int(np.argmin(values) if values.min() < 0.0 else np.argmax(values))
        return self._table.lines[int(self.first[here[worst]])]


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
        f"{longitude_deg[index]:.10g} is not a place"
        + ("; the two look exchanged" if exchanged else ""),
        fix="exchange the names of the two columns"
        if exchanged
        else "write degrees, or name the columns easting and northing and give --crs",
        code="swapped-axes" if exchanged else "out-of-range",
    )


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


def _crs(systems: set[str], vertices: Floats, path: Path) -> Stated:
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
        named = partial(parse_crs, path=path, source=f"its SRID {code}")
        return stated(named, f"EPSG:{code}")
    return WGS84 if float(np.abs(vertices).max(initial=0.0)) <= _DEGREES_MAX else None


def _column(table: Table, name: str) -> Column:
    numbers = table.numbers(name)
    values: tuple[Value, ...]
    if numbers is None:
        values = tuple(value.strip() or None for value in table.columns[name])
    else:
        values = tuple(None if np.isnan(value) else value for value in numbers.tolist())
    return Column(name=name, values=values, numeric=numbers is not None)


# Text in columns with a header: what the delimiter is, which lines are whole, what is a number.
#
# A decimal comma is refused, never read: `1,500` is fifteen hundred to one program and one and a
# half to another.

DELIMITERS = (",", ";", "\t")
MAX_COLUMNS = 255
MAX_FIELDS = 10_000_000
_TURNED_ROWS = 10_000
_BLANK = frozenset(("", "na", "n/a", "nan", "null", "none"))
_PLAIN = re.compile(r"[0-9eE+.\s-]*", re.ASCII)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,3})?", re.ASCII)
_COMMA = re.compile(r"[+-]?\d+,\d+", re.ASCII)
_AS_CSV = "save it as CSV in UTF-8, with a point in its numbers"


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """The columns of a file in its order, as text, and the line that each row ends on."""

    path: Path
    columns: dict[str, tuple[str, ...]]
    lines: tuple[int, ...]

    def numbers(self, name: str) -> Floats | None:
        """Return a column of numbers, NaN for blanks; None for text and for nothing at all.

        A column that is called like a rate may not have a single cell of text among its numbers:
        it would be left aside as a whole.
        """
        found = self._numbers(name)
        if found is None and score(Column(name=name, values=(), numeric=True)) > NONE:
            self.refuse_bad_cell(name)
        if found is not None and np.isinf(found).any():
            index = int(np.argmax(np.isinf(found)))
            raise map_error(
                self.path,
                f"line {self.lines[index]}: {name} is {self.columns[name][index][:40]!r}, "
                "beyond all numbers",
                fix="correct it, or leave it blank",
                code="bad-number",
            )
        return found

    def first_text(self, name: str) -> int:
        """Return the row of the first cell that is not a number, 0 where all are."""
        values = self.columns[name]
        return next((i for i, one in enumerate(values) if not _NUMBER.fullmatch(one.strip())), 0)

    def refuse_bad_cell(self, name: str) -> None:
        """Refuse a column most of whose cells are numbers, and name the first that is none."""
        tidy = [value.strip() for value in self.columns[name]]
        full = [index for index, value in enumerate(tidy) if value.casefold() not in _BLANK]
        bad = [index for index in full if _NUMBER.fullmatch(tidy[index]) is None]
        if not bad or 2 * len(bad) >= len(full):
            return
        raise map_error(
            self.path,
            f"line {self.lines[bad[0]]}: {name} is {tidy[bad[0]][:40]!r}, which is not a number",
            fix="write a number like 12.5, or leave it blank",
            code="bad-number",
        )

    def _numbers(self, name: str) -> Floats | None:
        values = self.columns[name]
        if _PLAIN.fullmatch("".join(values)) is not None:
            try:
                # Not an array of text: one long cell would make all of them as wide as itself.
                return np.fromiter(map(float, values), dtype=np.float64, count=len(values))
            except ValueError:
                pass  # a blank, or no number after all
        tidy = [value.strip() for value in values]
        full = [value for value in tidy if value.casefold() not in _BLANK]
        if not full:
            return None
        if all(_NUMBER.fullmatch(value) for value in full):
            return np.array(
                [np.nan if value.casefold() in _BLANK else float(value) for value in tidy]
            )
        self._refuse_commas(name, tidy, full)
        return None

    def _refuse_commas(self, name: str, tidy: Sequence[str], full: Sequence[str]) -> None:
        if not all(_NUMBER.fullmatch(value) or _COMMA.fullmatch(value) for value in full):
            return
        index = next(index for index, value in enumerate(tidy) if _COMMA.fullmatch(value))
        raise map_error(
            self.path,
            f"line {self.lines[index]}: {name} is {tidy[index][:40]!r}, with a decimal comma",
            fix=_AS_CSV,
            code="decimal-comma",
        )


def read_table(content: bytes, path: Path, *, wanted: Callable[[Sequence[str]], bool]) -> Table:
    """Return the table in a file, whose delimiter is the one that gives the columns `wanted`."""
    text = _text(content, path)
    with _large_fields():
        try:
            table = _table(text, path, _delimiter(text, path, wanted))
        except csv.Error as error:
            raise map_error(
                path,
                f"this is not a whole CSV file ({str(error)[:80]})",
                fix=_AS_CSV,
                code="truncated",
            ) from None
    _check_end(text, table)
    return table


def _check_end(text: str, table: Table) -> None:
    """Refuse a last line without an end, unless its last field shows that it is whole.

    A quotation mark closes a field, and a text is not a rate. A number and a blank may be what is
    left of a longer number.
    """
    last = [values[-1] for values in table.columns.values()][-1].strip()
    if text.endswith('"') or not (last.casefold() in _BLANK or _NUMBER.fullmatch(last)):
        return
    if not text.endswith(("\n", "\r")):
        raise cut_off(table.path, table.lines[-1], last)


@contextmanager
def _large_fields() -> Iterator[None]:
    """Let a field be as long as a file: the text of a polygon can have thousands of corners."""
    before = csv.field_size_limit(MAX_FILE_BYTES)
    try:
        yield
    finally:
        csv.field_size_limit(before)


def _text(content: bytes, path: Path) -> str:
    where, text = "", "\0"
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        where = f": byte 0x{content[error.start]:02X} in line {line}"
    if "\0" in text:
        # Which letter such a byte is depends on the program that wrote it: it is not guessed.
        raise map_error(
            path, f"this is not text in UTF-8{where}", code="encoding",
            fix=f"{_AS_CSV}, or: {iconv(content, path)}",
        )  # fmt: skip
    return text


def _delimiter(text: str, path: Path, wanted: Callable[[Sequence[str]], bool]) -> str:
    headers = {delimiter: _header(text, delimiter) for delimiter in DELIMITERS}
    found = [delimiter for delimiter, names in headers.items() if wanted(names)]
    if found:
        return max(found, key=lambda delimiter: len(headers[delimiter]))
    names = max(headers.values(), key=len)
    shown = ", ".join(names)[:80]
    headless = bool(names) and all(_NUMBER.fullmatch(name) for name in names)
    raise map_error(
        path,
        "the file is empty"
        if not any(names)
        else f"its first line ({shown}) is not a header"
        if headless
        else f"no columns say where the rates belong; its columns are {shown}",
        fix="name the columns in the first line: lat and lon, or easting and northing, or wkt",
        code="no-coordinates",
    )


def _header(text: str, delimiter: str) -> list[str]:
    try:
        return tidy_names(next(csv.reader(StringIO(text, newline=""), delimiter=delimiter), []))
    except csv.Error:
        return []


def tidy_names(names: Sequence[str]) -> list[str]:
    """Return the names of columns without the blanks around them."""
    return [" ".join(name.split()) for name in names]


def _table(text: str, path: Path, delimiter: str) -> Table:
    reader = csv.reader(StringIO(text, newline=""), delimiter=delimiter, strict=True)
    names = tidy_names(next(reader))
    names = [name or f"column {number}" for number, name in enumerate(names, 1)]
    _check_names(names, path)
    columns: list[list[str]] = [[] for _ in names]
    rows: list[list[str]] = []
    lines: list[int] = []
    for row in reader:
        if not any(row):
            continue
        if len(row) != len(names):
            raise map_error(
                path,
                f"line {reader.line_num} has {len(row)} fields, the header {len(names)}",
                fix=_AS_CSV,
                code="bad-line",
            )
        if not (len(lines) < MAX_RECORDS and len(lines) * len(names) < MAX_FIELDS):
            raise map_error(
                path,
                f"more than {min(MAX_RECORDS, MAX_FIELDS // len(names))} rows",
                fix="cut the map to one field, and keep the rate and its place",
                code="too-large",
            )
        rows.append(row)
        lines.append(reader.line_num)
        if len(rows) == _TURNED_ROWS:
            _turn(rows, columns)
    if not lines:
        raise map_error(path, "there are no rows", fix="export the map again", code="truncated")
    _turn(rows, columns)
    return Table(
        path=path, columns=dict(zip(names, map(tuple, columns), strict=True)), lines=tuple(lines)
    )


def _turn(rows: list[list[str]], columns: list[list[str]]) -> None:
    """Move rows to the columns; a million lists at once would keep the collector busy."""
    for column, values in zip(columns, zip(*rows, strict=True), strict=False):
        column.extend(values)
    rows.clear()


def _check_names(names: Sequence[str], path: Path) -> None:
    if not len(names) <= MAX_COLUMNS:
        text = f"{len(names)} columns are more than {MAX_COLUMNS}"
        raise map_error(path, text, fix="keep the rate and its place", code="too-large")
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise map_error(
            path,
            f"the column {twice[:40]} is there {names.count(twice)} times",
            fix="give every column a name of its own",
            code="duplicate-column",
        )
