"""Cells of a raster as rates: what is no data, what is zero, and what is neither.

No data and 0 L/ha are two things: over both the valves close, but one is outside the map. Nobody
but the file can say which number means no data, so a raster with -9999 in it and no word of that
is refused.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from companion.errors import MapError
from missions.maps.bundle import Bundle
from missions.maps.cells import corner
from missions.maps.crs import METRES_PER_DEGREE
from missions.maps.model import Affine, Band, Problem, cut_off, map_error

Cells = NDArray[Any]
Bools = NDArray[np.bool_]

# More are no zone numbers any more.
_CLASSES_MAX = 9
# No rate of anything, in any unit; programs fill with the largest number of a type.
_FILL_MIN = 1e30
# Types whose largest number is a fill. That of a byte, 255, may be a rate: it is none at the edge
# of the map and twice as large as all others.
_FILLED = ("int16", "uint16", "int32", "uint32", "int64", "uint64")
_BYTES, _FAR_TIMES = ("uint8", "int8"), 2.0
BYTE_FILL = "nodata-byte"


@dataclass(frozen=True, slots=True, kw_only=True)
class RawBand:
    """One band as the file has it; `hidden` are cells that a mask in the file leaves out."""

    name: str
    values: Cells
    nodata: float | None
    hidden: Bools | None = None
    scale: float = 1.0
    offset: float = 0.0
    unit: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadBand:
    """One band understood, and what to say of it."""

    band: Band
    problems: tuple[Problem, ...] = ()


def read_band(raw: RawBand, path: Path) -> ReadBand:
    """Return a band with NaN for no data."""
    # What a damaged file makes of numbers may overflow, and its NaN may "signal".
    with np.errstate(all="ignore"):
        return _read_band(raw, path)


def _read_band(raw: RawBand, path: Path) -> ReadBand:
    values = raw.values.astype(np.float64)
    missing = np.isnan(values)
    if raw.hidden is not None:
        missing |= raw.hidden
    problems = []
    if raw.nodata is not None and not np.isnan(raw.nodata):
        empty = values == _as_stored(raw.nodata, raw.values.dtype)
        count = int((empty & ~missing).sum())
        if raw.nodata == 0.0 and count:
            problems.append(_nodata_zero(raw.name, count))
        missing |= empty
    filled, byte = _filled(raw, missing), _byte(raw, missing)
    if byte is not None:
        problems.append(byte)
        edge = raw.values[[0, -1]].tolist(), raw.values[:, [0, -1]].tolist()
        largest = np.iinfo(raw.values.dtype).max
        filled = float(largest) if any(largest in row for side in edge for row in side) else None
    if (raw.scale, raw.offset) != (1.0, 0.0):
        if not (0.0 < abs(raw.scale) < 1e9 and abs(raw.offset) < 1e9):
            text = f"{raw.name} is to be multiplied by {raw.scale:g} with {raw.offset:g} added"
            raise map_error(path, text, fix="export the map again", code="bad-rate")
        values = values * raw.scale + raw.offset
    values[missing] = np.nan
    fault = filled_fault(raw, filled, path) if filled else _fault(raw, values, path)
    return ReadBand(
        band=Band(name=raw.name, values=values, unit=raw.unit, fault=fault),
        problems=tuple(problems),
    )


def usable(bands: Sequence[ReadBand]) -> tuple[Band, ...]:
    """Return the bands, or refuse when none of them can be a rate.

    One among several that can is not in the way: NDVI is below zero, and nobody sprays by it.
    """
    faults = [one.band.fault for one in bands if one.band.fault is not None]
    if faults and len(faults) == len(bands):
        raise faults[0]
    return tuple(one.band for one in bands)


def class_problem(band: Band) -> Problem | None:
    """Return the warning that a band looks like zone numbers 1, 2, 3, …, and not like rates."""
    values = band.values[~np.isnan(band.values)]
    if not values.size or not (values.min() >= 0.0 and values.max() <= _CLASSES_MAX):
        return None
    if not bool((values == np.rint(values)).all()):
        return None
    classes = np.flatnonzero(np.bincount(values.astype(np.int64))[1:]) + 1
    if len(classes) < 2 or len(classes) != classes[-1]:
        return None
    return Problem(
        severity="warning",
        code="class-raster",
        text=f"its values are {', '.join(map(str, classes.tolist()))}: these look like numbers of "
        "zones and not like rates",
        where=band.name,
        fix="make sure that they are rates, or export the map with the rate of each zone",
    )


def _as_stored(nodata: float, dtype: np.dtype[Any]) -> float:
    """Return the declared value as the cells' type holds it: -3.4e38 is cut to 32 bits."""
    if dtype.kind != "f":
        return nodata
    return float(dtype.type(nodata))


def _nodata_zero(name: str, count: int) -> Problem:
    return Problem(
        severity="warning",
        code="nodata-zero",
        text=f"the file declares 0 as no data: {count} cells count as outside the map, not as "
        "0 L/ha (the valves close over both)",
        where=name,
        fix="export the map with -9999 for no data if 0 is meant as a rate",
    )


def _filled(raw: RawBand, missing: Bools) -> float | None:
    """Return the number that a program left where there is nothing, or None."""
    dtype = raw.values.dtype
    if dtype.name in _FILLED:
        largest = np.iinfo(dtype).max
        found = bool(((raw.values == largest) & ~missing).any())
        return float(largest) if found else None
    if dtype.kind == "f":
        found_cells = (raw.values >= _FILL_MIN) & ~missing & np.isfinite(raw.values)
        return float(raw.values[found_cells][0]) if found_cells.any() else None
    return None


def _byte(raw: RawBand, missing: Bools) -> Problem | None:
    """Return what to say of the largest number of a byte, far from all others."""
    there = raw.values[~missing]
    if raw.values.dtype.name not in _BYTES or not there.size:
        return None
    largest = np.iinfo(raw.values.dtype).max
    others = there[there != largest]
    if others.size in (0, there.size) or float(others.max()) * _FAR_TIMES > largest:
        return None
    return Problem(
        severity="warning",
        code=BYTE_FILL,
        text=f"{there.size - others.size} cells hold {largest}, the largest number of a byte, and "
        f"all others at most {others.max()}: it may stand for no data",
        where=raw.name,
        fix=f"export the map with {largest} declared as no data, or as numbers of 16 bits",
    )


def filled_fault(raw: RawBand, value: float, path: Path) -> MapError:
    """Return the refusal of a number that stands for no data, which the file does not say."""
    beside = "" if raw.nodata is None else f" beside its no-data value {raw.nodata:.6g}"
    return map_error(
        path,
        f"{raw.name} holds {value:.6g}{beside}, which is not a rate and not declared as no data",
        fix=f"export the map again with {value:.6g} declared as its no-data value"
        + (", or as numbers of 16 bits" if raw.values.dtype.name in _BYTES else ""),
        code="nodata-undeclared",
    )


def _fault(raw: RawBand, values: NDArray[np.float64], path: Path) -> MapError | None:
    """Return why a band can be no rate: infinite or negative numbers."""
    wrong = np.isinf(values) | (values < 0.0)
    if not wrong.any():
        return None
    found = values[wrong]
    if bool((found == found[0]).all()) and np.isfinite(found[0]):
        return filled_fault(raw, float(found[0]), path)
    row, column = np.argwhere(wrong)[0].tolist()
    return map_error(
        path,
        f"{raw.name} holds {float(found[0]):.6g} in row {row + 1}, column {column + 1}, and "
        f"{len(found)} such numbers in all, which are not rates",
        fix="correct the values, or export the map again",
        code="bad-rate",
    )


# World files (`.tfw`): where a picture lies, said in six lines beside it.
#
# Lines five and six are the centre of the first cell, not its corner (ESRI, World files for raster
# datasets). Some programs write the corner there, which moves the map by half a cell.

SUFFIXES = (".tfw", ".tifw", ".tiffw", ".wld")
_MAX_BYTES = 4096
# The same place: numbers in world files are often cut to six decimals or ten.
_SAME_CELLS = 0.02
# Half a cell, with the same allowance; and from where on two files are of two places.
_HALF, _OTHER_PLACE_CELLS = 0.5, 1.0


def world_file_of(bundle: Bundle, name: str) -> str | None:
    """Return the name of the world file that lies beside a picture, or None."""
    return beside(bundle, name, *(str(PurePosixPath(name).with_suffix(end)) for end in SUFFIXES))


def beside(bundle: Bundle, name: str, *wanted: str) -> str | None:
    """Return which of these names, in any case, a bundle holds; two of them are refused."""
    folded = [one.casefold() for one in wanted]
    found = [other for other in bundle.names if other.casefold() in folded]
    if len(found) > 1:
        raise map_error(
            bundle.path,
            f"{found[0]} and {found[1]} both say of {PurePosixPath(name).name} what it is",
            fix="remove the wrong one",
            code="several-files",
        )
    return found[0] if found else None


def parse_world_file(content: bytes, path: Path, *, alone: bool = False) -> Affine:
    """Return from (column, row) of corners of cells to x and y.

    `alone`: nothing else says where the map lies, so that a last number that is cut short would
    move it unseen.
    """
    try:
        if len(content) > _MAX_BYTES:
            raise ValueError("it is too long")
        a, d, b, e, x, y = (_number(text) for text in content.decode("ascii").split())
        if not abs(a * e - b * d) > 0.0:
            raise ValueError("its cells have no size")
    except ValueError as error:
        raise map_error(
            path,
            f"this is not a world file of six numbers ({str(error)[:80]})",
            fix="export the map again; numbers take a decimal point, not a comma",
            code="bad-world-file",
        ) from None
    if alone and not content[-1:].isspace():
        lines = content.decode("ascii").splitlines()
        raise cut_off(path, len(lines), lines[-1].strip())
    return (a, b, x - (a + b) / 2.0, d, e, y - (d + e) / 2.0)


def _number(text: str) -> float:
    number = float(text)
    if not abs(number) <= 1e9:
        raise ValueError(f"{text} is not a finite number")
    return number


def difference(
    own: Affine, world: Affine, shape: tuple[int, int], crs: CRS | None, path: Path
) -> Problem | None:
    """Return what to say where the picture itself and its world file differ.

    The picture's own position holds: it says which part of the cell it means. A world file that
    is elsewhere altogether belongs to another picture, or is in another coordinate system.
    """
    shifts = _shifts_cells(own, world, shape)
    largest = float(np.abs(shifts).max())
    if largest <= _SAME_CELLS:
        return None
    if not largest <= _OTHER_PLACE_CELLS:
        raise map_error(
            path,
            f"the map and its world file are {largest:.3g} cells apart",
            fix="remove the world file, or copy the one that belongs to the map",
            code="georeference-conflict",
        )
    half = all(
        abs(value) <= _SAME_CELLS or abs(abs(value) - _HALF) <= _SAME_CELLS
        for value in shifts.ravel().tolist()
    )
    apart = _length(own, shifts[0], crs)
    if half:
        text = (
            f"the world file has the corner of the first cell where its centre belongs: half a "
            f"cell, {apart}; the position in the map itself is used"
        )
    else:
        text = f"the world file is up to {apart} off; the position in the map itself is used"
    return Problem(
        severity="warning",
        code="half-pixel" if half else "world-file",
        text=text,
        where=str(path),
        fix="remove the world file, and compare one point on the ground",
    )


def _shifts_cells(
    own: Affine, world: Affine, shape: tuple[int, int]
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Return by how many columns and rows the four corners of the picture differ."""
    rows, columns = shape
    at_column, at_row = np.array([0.0, columns, 0.0, columns]), np.array([0.0, 0.0, rows, rows])
    x, y = corner(world, at_column, at_row)
    own_x, own_y = corner(own, at_column, at_row)
    a, b, _, d, e, _ = own
    with np.errstate(all="ignore"):  # cells next to nothing wide: the shift is infinite
        shift = np.linalg.solve(np.array([[a, b], [d, e]]), np.array([x - own_x, y - own_y]))
    return shift.T


def _length(
    transform: Affine, shift: np.ndarray[tuple[int, ...], np.dtype[np.float64]], crs: CRS | None
) -> str:
    """Return a shift of cells in metres, where the CRS tells."""
    a, b, _, d, e, y = transform
    x_units, y_units = float(a * shift[0] + b * shift[1]), float(d * shift[0] + e * shift[1])
    if crs is None:
        return f"{math.hypot(x_units, y_units):.3g} of its units"
    if crs.is_geographic:
        narrow = math.cos(math.radians(max(-90.0, min(90.0, y))))
        return f"{METRES_PER_DEGREE * math.hypot(x_units * narrow, y_units):.2f} m"
    unit_m = crs.axis_info[0].unit_conversion_factor or 1.0
    return f"{unit_m * math.hypot(x_units, y_units):.2f} m"
