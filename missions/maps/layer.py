"""What every reader hands over: columns and polygons as they stand in the file.

A reader knows its format and nothing of rates, units or zones; `assemble.py` makes sense of the
columns in the same way for all formats.
"""

from __future__ import annotations

import hashlib
import math
import re
import stat
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS
from shapely import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from companion.errors import MapError
from missions.maps.model import Affine, Problem, map_error

# Bounds on what is read from a file that nobody vouches for. Real maps have at most some
# 25 000 polygons; a million leaves room for gridded ones.
MAX_FILE_BYTES = 256 * 1024 * 1024
MAX_RECORDS = 1_000_000
MAX_VERTICES = 5_000_000
COORDINATE_MAX = 1e9

Value = str | float | None


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

    `crs` None: the file does not say. `unit`: what the file as a whole declares. `boundary`: the
    outline of the field, in longitude and latitude, where the file has one. `instead`: what else
    of the file could be sprayed, as an advice where this cannot. `marks` are the points and lines
    among the records that are left out, by number: trees and power lines of obstacle files.
    """

    format: str
    crs: CRS | None
    columns: tuple[Column, ...]
    geometries: tuple[Polygon | MultiPolygon | None, ...]
    sha256: str
    unit: str | None = None
    boundary: MultiPolygon | None = None
    instead: str = ""
    skipped: dict[int, str] = field(default_factory=dict)
    problems: tuple[Problem, ...] = ()
    marks: dict[int, BaseGeometry] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class Band:
    """One value for every cell: (rows, columns), NaN for no data; the rest as for a `Column`."""

    name: str
    values: NDArray[np.float64]
    unit: str | None = None
    is_rate: bool = False
    default: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """The content of one file of cells; `transform` as in `MapCells`, all bands of one shape."""

    format: str
    crs: CRS | None
    transform: Affine
    bands: tuple[Band, ...]
    sha256: str
    unit: str | None = None
    boundary: MultiPolygon | None = None
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
            raise ValueError(f"{text[:40]!r} is no number")
        return float(text)
    return None if value is None or math.isnan(value) else float(value)


def read_bytes(path: Path) -> bytes:
    """Return the whole file, whose size is checked first."""
    try:
        about = path.stat()
        if not stat.S_ISREG(about.st_mode):
            raise map_error(
                path, "this is no regular file", fix="name the map's file", code="no-file"
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
        raise ValueError("a coordinate is no finite number, or beyond a billion")


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
