"""ESRI shapefiles: `.shp` and the files beside it, or a folder that holds one.

`pyshp` takes the bytes apart. Three things it leaves to us: which record a shape belongs to (an
edited file keeps its shapes out of order, and only the `.shx` knows), what a number means (a
`12.5` in a column declared without decimals is not 12), and to stop at a length that is no length.
"""

from __future__ import annotations

import struct
import warnings
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import shapefile
from numpy.typing import NDArray
from pyproj import CRS
from shapely import MultiPolygon, Polygon
from shapely.errors import ShapelyError

from companion.maps.crs import parse_crs
from companion.maps.dbf import BROKEN, read_columns
from companion.maps.layer import (
    MAX_RECORDS,
    Layer,
    check_coordinates,
    check_counts,
    digest,
    read_bytes,
)
from companion.maps.model import Problem, map_error
from companion.maps.rings import area_of_rings

_SUFFIXES = (".cpg", ".dbf", ".prj", ".shp", ".shx")
_POLYGONS = frozenset({shapefile.POLYGON, shapefile.POLYGONZ, shapefile.POLYGONM})
_HEADER_BYTES = 100
_MAGIC = 9994
_EXPORT_AGAIN = "export the map again"


def read_shapefile(path: Path, layer: str | None = None) -> Layer:
    """Return what a shapefile holds; `layer` names one of several in a folder."""
    main = _main_file(path, layer)
    files = {suffix: read_bytes(file) for suffix, file in _set_of(main).items()}
    shapes = _shapes(main, files)
    count = len(shapes.geometries)
    columns = read_columns(files.get(".dbf"), files.get(".cpg"), path=main, count=count)
    return Layer(
        format="shapefile",
        crs=_crs(main, files.get(".prj")),
        columns=columns,
        geometries=tuple(shapes.geometries),
        sha256=digest(files[suffix] for suffix in sorted(files)),
        skipped=shapes.skipped,
        problems=shapes.problems,
    )


def _main_file(path: Path, layer: str | None) -> Path:
    """Return the `.shp` that is meant."""
    if not path.is_dir():
        if layer not in (None, path.stem):
            raise map_error(path, f"it is not the layer {layer!r}", fix="leave out --layer")
        return path
    found = sorted(file for file in path.iterdir() if file.suffix.casefold() == ".shp")
    meant = [file for file in found if layer is None or file.stem == layer]
    if len(meant) == 1:
        return meant[0]
    names = ", ".join(file.stem for file in found)
    raise map_error(
        path,
        f"the folder holds the shapefiles {names}" if found else "the folder holds no shapefile",
        fix="name one of them, or its --layer" if found else "name the file",
    )


def _set_of(main: Path) -> dict[str, Path]:
    """Return the files of a shapefile by suffix; suffixes come in either case."""
    try:
        beside = sorted(main.parent.iterdir())
    except OSError as error:
        raise map_error(main, f"cannot be read ({error})", fix="check path and rights") from None
    found = {
        file.suffix.casefold(): file
        for file in beside
        if file.stem == main.stem and file.suffix.casefold() in _SUFFIXES and file.is_file()
    }
    return found | {".shp": main}


def _crs(main: Path, prj: bytes | None) -> CRS | None:
    if prj is None or not prj.strip(b" \r\n\0"):
        return None
    text = prj.decode("utf-8-sig", errors="replace").strip("\0")
    return parse_crs(text, path=main.with_suffix(".prj"), source="its text")


@dataclass(slots=True)
class _Shapes:
    geometries: list[Polygon | MultiPolygon | None]
    skipped: dict[int, str]
    problems: tuple[Problem, ...]


def _shapes(main: Path, files: dict[str, bytes]) -> _Shapes:
    """Return the ground of every record, in the order of the attribute table."""
    shp = files[".shp"]
    if len(shp) < _HEADER_BYTES or struct.unpack(">i", shp[:4])[0] != _MAGIC:
        raise map_error(main, "this is no .shp file", fix="name the .shp, or export the map again")
    offsets, problems = _index(main, shp, files.get(".shx"))
    found = _Shapes([], {}, problems)
    vertices = 0
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", shapefile.PossiblyCorruptFileHeader)
            reader = shapefile.Reader(shp=BytesIO(shp)).shp_reader
        for index, offset in enumerate(offsets):
            length = _length(shp, offset)
            shape = reader.shape(index, offset=offset, shape_len_B=length)
            vertices += len(shape.points)
            check_counts(main, records=len(offsets), vertices=vertices)
            geometry, reason = _area(shape)
            found.geometries.append(geometry)
            if reason:
                found.skipped[index] = reason
    except (*BROKEN, ShapelyError) as error:
        where = f"record {len(found.geometries) + 1} of its shapes is broken"
        raise map_error(main, f"{where} ({str(error)[:120]})", fix=_EXPORT_AGAIN) from None
    return found


def _area(shape: shapefile.Shape) -> tuple[Polygon | MultiPolygon | None, str]:
    """Return a shape's ground, or None and why it has none."""
    if shape.shapeType == shapefile.NULL:
        return None, "null-geometry"
    if shape.shapeType not in _POLYGONS:
        return None, f"not-a-polygon:{shape.shapeTypeName}"
    # Points carry heights and measures behind x and y in some files.
    points = np.array([point[:2] for point in shape.points], dtype=np.float64).reshape(-1, 2)
    check_coordinates(points)
    starts = list(shape.parts)
    if starts and (starts[0] != 0 or starts != sorted(starts) or starts[-1] > len(points)):
        raise ValueError("its parts are out of order")
    area = area_of_rings(np.split(points, starts[1:]))
    return area, "" if area is not None else "no-area"


def _length(shp: bytes, offset: int) -> int:
    """Return the content length of the record at `offset`, which has to fit into the file."""
    if not _HEADER_BYTES <= offset <= len(shp) - 8:
        raise ValueError(f"it starts at byte {offset} of {len(shp)}")
    words = struct.unpack(">i", shp[offset + 4 : offset + 8])[0]
    if not 4 <= 2 * words <= len(shp) - offset - 8:
        raise ValueError(f"its length is {2 * words} bytes, the file is cut off or damaged")
    return int(2 * words)


def _index(main: Path, shp: bytes, shx: bytes | None) -> tuple[list[int], tuple[Problem, ...]]:
    """Return where each record's shape starts.

    From the `.shx` where there is one: programs that edit a shapefile in place append the
    changed shape at the end and leave the old one lying.
    """
    if shx is not None:
        entries: NDArray[np.int32] = np.frombuffer(
            shx[_HEADER_BYTES : len(shx) - (len(shx) - _HEADER_BYTES) % 8], dtype=">i4"
        )
        check_counts(main, records=len(entries) // 2, vertices=0)
        return [2 * int(offset) for offset in entries[::2]], ()
    offsets: list[int] = []
    position = _HEADER_BYTES
    try:
        while position < len(shp) and len(offsets) <= MAX_RECORDS:
            offsets.append(position)
            position += 8 + _length(shp, position)
    except ValueError as error:
        text = f"record {len(offsets)} of its shapes is broken ({error})"
        raise map_error(main, text, fix=_EXPORT_AGAIN) from None
    check_counts(main, records=len(offsets), vertices=0)
    problem = Problem(
        severity="warning",
        code="no-shx",
        text="the .shx is missing; shapes are taken in the order in which they stand",
        where=str(main),
        fix="copy the whole set of files",
    )
    return offsets, (problem,)
