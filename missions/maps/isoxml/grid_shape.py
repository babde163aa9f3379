"""Place and size of an ISOXML grid, and whether its binary is as long as that asks for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

from missions.maps.isoxml.values import EXPORT_AGAIN, integer, number, required, text
from missions.maps.model import Affine, Problem, map_error

# Cells of all bands together; 16 million are 128 MB.
CELLS_MAX = 16_000_000
_SIDE_MAX = 1_000_000
_BYTES_MAX = 2**32


@dataclass(frozen=True, slots=True, kw_only=True)
class GridShape:
    """What a GRD says of its cells."""

    name: str
    rows: int
    columns: int
    transform: Affine
    type: int
    declared_bytes: int | None


def grid_shape(element: Element, path: Path) -> GridShape:
    """Return what a GRD element says, within bounds."""
    south = number(element, "A", path, low=-90.0, high=90.0, code="out-of-range")
    west = number(element, "B", path, low=-180.0, high=180.0, code="out-of-range")
    north_deg = number(element, "C", path, low=1e-9, high=1.0)
    east_deg = number(element, "D", path, low=1e-9, high=1.0)
    columns = integer(element, "E", path, low=1, high=_SIDE_MAX)
    rows = integer(element, "F", path, low=1, high=_SIDE_MAX)
    kind = integer(element, "I", path, low=1, high=2)
    length = text(element, "H")
    shape = GridShape(
        name=required(element, "G", path),
        rows=rows,
        columns=columns,
        transform=(east_deg, 0.0, west, 0.0, north_deg, south),
        type=kind,
        declared_bytes=None
        if length is None
        else integer(element, "H", path, low=0, high=_BYTES_MAX),
    )
    if not (south + rows * north_deg <= 90.0 and west + columns * east_deg <= 180.0):
        raise map_error(
            path,
            f"its grid {shape.name[:40]} reaches beyond 90 degrees of latitude or 180 of longitude",
            fix=EXPORT_AGAIN,
            code="out-of-range",
        )
    return shape


def check_length(
    shape: GridShape, content: bytes, path: Path, *, cell_bytes: int, bands: int
) -> None:
    """Refuse a binary that does not hold what the grid says, before anything is made of it."""
    if shape.rows * shape.columns * bands > CELLS_MAX:
        raise map_error(
            path,
            f"its grid has {shape.rows} x {shape.columns} cells for {bands} values, more than "
            f"{CELLS_MAX} in all",
            fix="export one field, or larger cells",
            code="too-large",
        )
    expected = shape.rows * shape.columns * cell_bytes * bands
    if len(content) != expected:
        values = f" x {bands} values" if bands > 1 else ""
        each = "byte" if cell_bytes == 1 else "bytes"
        raise map_error(
            path,
            f"its grid {shape.name[:40]} has {len(content)} bytes, but {shape.rows} rows x "
            f"{shape.columns} columns x {cell_bytes} {each}{values} are {expected}",
            fix="export the task again, and copy all of its files",
            code="binary-length",
        )


def declared_length(shape: GridShape, content: bytes) -> list[Problem]:
    """Return a warning where the declared length is wrong and the file is as it has to be."""
    if shape.declared_bytes is None or shape.declared_bytes == len(content):
        return []
    problem = Problem(
        severity="warning",
        code="binary-length",
        text=f"the task declares {shape.declared_bytes} bytes for its grid, which has "
        f"{len(content)}, as its rows and columns ask for",
        where=shape.name,
        fix=EXPORT_AGAIN,
    )
    return [problem]
