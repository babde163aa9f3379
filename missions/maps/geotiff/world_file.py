"""World files (`.tfw`): where a picture lies, said in six lines beside it.

Lines five and six are the centre of the first cell, not its corner (ESRI, World files for raster
datasets). Some programs write the corner there, which moves the map by half a cell.
"""

from __future__ import annotations

import math
from pathlib import Path, PurePosixPath

import numpy as np
from pyproj import CRS

from missions.maps.bundle import Bundle
from missions.maps.cells import corner
from missions.maps.crs import METRES_PER_DEGREE
from missions.maps.layer import cut_off
from missions.maps.model import Affine, Problem, map_error

SUFFIXES = (".tfw", ".tifw", ".tiffw", ".wld")
_MAX_BYTES = 4096
# The same place: numbers in world files are often cut to six decimals or ten.
_SAME_CELLS = 0.02
# Half a cell, with the same allowance; and from where on two files are of two places.
_HALF, _OTHER_PLACE_CELLS = 0.5, 1.0


def world_file_of(bundle: Bundle, name: str) -> str | None:
    """Return the name of the world file that lies beside a picture, or None."""
    picture = PurePosixPath(name)
    found = [
        other
        for other in bundle.with_suffix(*SUFFIXES)
        if PurePosixPath(other).parent == picture.parent
        and PurePosixPath(other).stem.casefold() == picture.stem.casefold()
    ]
    if len(found) > 1:
        raise map_error(
            bundle.path,
            f"{found[0]} and {found[1]} both say where {picture.name} lies",
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
            f"this is no world file of six numbers ({str(error)[:80]})",
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
        raise ValueError(f"{text} is no finite number")
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
