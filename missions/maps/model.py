"""What a prescription file says, before it becomes the core's `Prescription`.

Everything here is already decided: coordinates are WGS84 longitude and latitude, rates are L/ha.
What was found on the way is kept as `Problem`s, so that nothing is repaired in silence.

A reader knows its format and nothing of rates, units or zones; `assemble.py` makes sense of the
columns in the same way for all formats.
"""

from __future__ import annotations

import hashlib
import math
import re
import stat
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS
from shapely import MultiPolygon, Polygon
from shapely.errors import ShapelyError
from shapely.geometry.base import BaseGeometry

from companion.atomic_write import write_atomically
from companion.errors import MapError, Problem, Severity

__all__ = [
    "Affine", "MapCells", "MapFile", "MapZone", "Problem", "Severity", "map_error",
    "unusable_polygons",
]  # fmt: skip

Floats = NDArray[np.float64]

# A rate column holds at most this, in L/ha; the core refuses the same.
RATE_MAX_L_HA = 100_000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class MapZone:
    """One record of the file: its ground in longitude and latitude, and its rate.

    `rate_l_ha` None means that the file gives no rate here; 0 means that it says zero.
    """

    name: str
    geometry: Polygon | MultiPolygon
    rate_l_ha: float | None

    def __post_init__(self) -> None:
        if self.rate_l_ha is not None and not 0.0 <= self.rate_l_ha < RATE_MAX_L_HA:
            raise ValueError(f"rate of zone {self.name} is not a rate: {self.rate_l_ha}")

    @property
    def part_count(self) -> int:
        """Return the number of single polygons."""
        return int(shapely.get_num_geometries(self.geometry))

    @property
    def hole_count(self) -> int:
        """Return the number of holes in all parts."""
        return int(shapely.get_num_interior_rings(shapely.get_parts(self.geometry)).sum())


# x = a column + b row + c, y = d column + e row + f: from the corner of a cell to coordinates.
Affine = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class MapCells:
    """A map in rows and columns of cells, as the file has them.

    Args:
        rates_l_ha: (rows, columns); NaN where the file gives no rate, 0 where it says zero.
        transform: from (column, row) to x and y of `crs`; whole numbers are corners of cells, so
            the centre of the first cell is at (0.5, 0.5).
        crs: of x and y, always x (or longitude) first.
    """

    rates_l_ha: Floats
    transform: Affine
    crs: CRS

    def __post_init__(self) -> None:
        rates = self.rates_l_ha
        if rates.ndim != 2 or not rates.size:
            raise ValueError(f"cells need rows and columns: {rates.shape}")
        with np.errstate(invalid="ignore"):
            wrong = ~np.isnan(rates) & ~((rates >= 0.0) & (rates < RATE_MAX_L_HA))
        if wrong.any():
            raise ValueError(f"rate of a cell is not a rate: {rates[wrong][0]}")
        a, b, _, d, e, _ = self.transform
        if not (np.isfinite(self.transform).all() and a * e - b * d != 0.0):
            raise ValueError(f"the cells have no size: {self.transform}")


@dataclass(frozen=True, slots=True, kw_only=True)
class MapFile:
    """One prescription file, understood; `sha256` is over all bytes of its set of files.

    It holds either `zones` or `cells`. `boundary`, in longitude and latitude, is the outline of
    the field where the file has one; `default_rate_l_ha` is what the file prescribes inside it
    where there is no zone, `overlap` the rule that a flight map was compiled with.
    """

    path: Path
    format: str
    crs: str
    unit: str
    rate_field: str
    zones: tuple[MapZone, ...]
    sha256: str
    cells: MapCells | None = None
    boundary: MultiPolygon | None = None
    default_rate_l_ha: float | None = None
    problems: tuple[Problem, ...] = ()
    overlap: str | None = None

    def rule(self, given: str) -> str:
        """Return the rule where zones overlap: that of the file if it has one, else that given."""
        return given if self.overlap is None else self.overlap

    def __post_init__(self) -> None:
        if self.cells is not None and self.zones:
            raise ValueError("a map has zones or cells, not both")

    @property
    def rated(self) -> list[MapZone]:
        """Return the zones that have a rate."""
        return [zone for zone in self.zones if zone.rate_l_ha is not None]

    @property
    def rates_l_ha(self) -> tuple[float, ...]:
        """Return the different rates in the file, the least first."""
        if self.cells is not None:
            rates = self.cells.rates_l_ha
            return tuple(np.unique(rates[~np.isnan(rates)]).tolist())
        return tuple(sorted({zone.rate_l_ha for zone in self.zones if zone.rate_l_ha is not None}))


def map_error(path: Path, text: str, *, fix: str, code: str = "unusable") -> MapError:
    """Return the error for a file that cannot be used: one line with file, reason and fix."""
    line = " ".join(f"{path}: {text}; {fix}".split())
    return MapError(line if len(line) <= 600 else f"{line[:597]}...", code=code, fix=fix)


def unusable_polygons(path: Path, error: ShapelyError) -> MapError:
    """Return the error for polygons with which geometry itself fails."""
    return map_error(
        path,
        f"its polygons cannot be used ({str(error)[:120]})",
        fix="repair the map where it is made, and export it again",
        code="broken-geometry",
    )


# ------------------------------------------------------------------------------------------- layers

# Bounds on what is read from a file that nobody vouches for. Real maps have at most some
# 25 000 polygons; a million leaves room for gridded ones.
MAX_FILE_BYTES = 256 * 1024 * 1024
MAX_RECORDS = 1_000_000
MAX_VERTICES = 5_000_000
COORDINATE_MAX = 1e9

Value = str | float | None
# A CRS; None: the file does not say; else why what it says cannot be used.
Stated = CRS | MapError | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """One attribute of all records; `numeric` is what the file declares or all values are.

    A format that says which attribute is a rate (ISOXML, ADAPT) sets `is_rate`; with several such
    columns, each is a product. `unit` is what the file says of this column, `default` what it
    prescribes inside the field where there is no record, in that unit.
    """

    name: str
    values: tuple[Value, ...]
    numeric: bool
    unit: str | None = None
    is_rate: bool = False
    default: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Layer:
    """The content of one file; None among `geometries` is explained in `skipped`.

    `unit`: what the file as a whole declares. `boundary`: the
    outline of the field, in longitude and latitude, where the file has one. `rateless`: why a file
    that has only that has no rates. `instead`: what else
    of the file could be sprayed, as an advice where this cannot. `marks` are the points and lines
    among the records that are left out, by number: trees and power lines of obstacle files.
    """

    format: str
    crs: Stated
    columns: tuple[Column, ...]
    geometries: tuple[Polygon | MultiPolygon | None, ...]
    sha256: str
    unit: str | None = None
    boundary: MultiPolygon | None = None
    instead: str = ""
    skipped: dict[int, str] = field(default_factory=dict)
    problems: tuple[Problem, ...] = ()
    marks: dict[int, BaseGeometry] = field(default_factory=dict)
    rateless: MapError | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Band:
    """One value for every cell: (rows, columns), NaN for no data; the rest as for a `Column`.

    `fault` is why it can be no rate, where that is so; `line_of` tells which line of a text file a
    cell (row, column) is of.
    """

    name: str
    values: NDArray[np.float64]
    unit: str | None = None
    is_rate: bool = False
    default: float | None = None
    fault: MapError | None = None
    line_of: Callable[[int, int], int] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """The content of one file of cells; `transform` as in `MapCells`, all bands of one shape.

    `columns` are texts of the points that it was made of, which may state units.
    """

    format: str
    crs: Stated
    transform: Affine
    bands: tuple[Band, ...]
    sha256: str
    unit: str | None = None
    boundary: MultiPolygon | None = None
    columns: tuple[Column, ...] = ()
    instead: str = ""
    problems: tuple[Problem, ...] = ()


_DECIMAL = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)


def as_number(value: Value) -> float | None:
    """Return a cell as a number, None where it is blank or NaN; ValueError for other text.

    Text counts when it is a plain decimal number. A decimal comma does not: `1,500` is fifteen
    hundred to one program and one and a half to another.

    >>> as_number(" 12.5 "), as_number(""), as_number(None), as_number("nan")
    (12.5, None, None, None)
    """
    if isinstance(value, str):
        text = value.strip()
        if not text or text.casefold() == "nan":
            return None
        if _DECIMAL.fullmatch(text) is None:
            raise ValueError(f"{text[:40]!r} is not a number")
        return float(text)
    return None if value is None or math.isnan(value) else float(value)


def read_bytes(path: Path) -> bytes:
    """Return the whole file, whose size is checked first."""
    try:
        about = path.stat()
        if not stat.S_ISREG(about.st_mode):
            raise map_error(
                path, "this is not a regular file", fix="name the map's file", code="no-file"
            )
        size_bytes = about.st_size
        if not size_bytes <= MAX_FILE_BYTES:
            limit_mb = MAX_FILE_BYTES // 1024**2
            raise map_error(
                path,
                f"the file has {size_bytes // 1024**2} MB, more than {limit_mb} MB",
                fix="cut the map to one field",
                code="too-large",
            )
        return path.read_bytes()
    except FileNotFoundError:
        raise map_error(
            path, "there is no such file", fix="check the path", code="no-file"
        ) from None
    except (OSError, ValueError) as error:
        raise map_error(
            path, f"cannot be read ({error})", fix="check path and rights", code="no-file"
        ) from None


def cut_off(path: Path, line: int, last: str) -> MapError:
    """Return the refusal of a text whose last line has no end.

    Cut short inside its last number, `12.5` reads as 12 or as 1; nothing but the end of the line
    says that a number is whole.
    """
    return map_error(
        path,
        f"line {line} is the last and has no line end: a file cut short inside its last number "
        f"({last[:40]!r}) looks the same",
        fix="copy the file again; if it is whole, add a line end behind that line",
        code="truncated",
    )


def digest(parts: Iterable[bytes]) -> str:
    """Return the SHA-256 of the files' bytes one after the other.

    For a single file this is what `sha256sum` prints.
    """
    sha256 = hashlib.sha256()
    for part in parts:
        sha256.update(part)
    return sha256.hexdigest()


def check_coordinates(points: NDArray[np.float64]) -> None:
    """Raise a `ValueError` where a coordinate is nowhere on earth, in any unit.

    Before any sum or product of coordinates, which could overflow.
    """
    if not (np.abs(points) <= COORDINATE_MAX).all():
        raise ValueError("a coordinate is not a finite number, or beyond a billion")


def check_counts(path: Path, *, records: int, vertices: int) -> None:
    """Refuse a file that would take the vehicle's memory.

    >>> check_counts(Path("a.shp"), records=10, vertices=100)
    """
    for name, count, limit in (
        ("records", records, MAX_RECORDS),
        ("vertices", vertices, MAX_VERTICES),
    ):
        if not 0 <= count <= limit:
            raise map_error(
                path,
                f"{count} {name} are more than {limit}",
                fix="cut the map to one field",
                code="too-large",
            )


# -------------------------------------------------------------------------------------- whole files


def write_whole(path: Path, content: bytes) -> None:
    """Write a file beside `path` and move it there, so that nobody ever sees half of it."""
    try:
        write_atomically(path, content)
    except OSError as error:
        raise not_written(path, error) from None


def check_folder(path: Path) -> None:
    """Refuse a file that no folder is there for, before there is anything to write.

    Raises:
        MapError: as `write_whole` would.
    """
    if not path.parent.is_dir():
        raise map_error(
            path,
            f"cannot be written (no folder {path.parent})",
            fix="make the folder first, or name another",
            code="not-written",
        )


def not_written(path: Path, error: OSError) -> MapError:
    """Return the refusal of a file that the system does not let us write."""
    return map_error(
        path,
        f"cannot be written ({error.strerror or error})",
        fix="check folder, rights and free space",
        code="not-written",
    )
