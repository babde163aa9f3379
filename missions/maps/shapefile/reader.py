"""ESRI shapefiles: `.shp` and the files beside it, or a folder or zip that holds one.

Taken apart by hand, after the ESRI shapefile technical description of 1998: which record a shape
belongs to is known to the `.shx` alone (an edited file keeps its shapes out of order), and every
length is checked against the file before anything is read by it.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS
from shapely import MultiLineString, MultiPoint
from shapely.errors import ShapelyError
from shapely.geometry.base import BaseGeometry

from missions.maps.crs import parse_crs
from missions.maps.layer import MAX_RECORDS, Layer, check_coordinates, check_counts
from missions.maps.local import Area
from missions.maps.model import Problem, map_error
from missions.maps.rings import areas_of_records
from missions.maps.shapefile.dbf import read_columns
from missions.maps.shapefile.files import ShapeFiles, find_shapefile
from missions.maps.shapefile.side_units import with_units

_POLYGONS = frozenset({5, 15, 25})
# Why a record of another type has no ground.
_KINDS = {0: "null-geometry"} | {
    kind: f"not-a-polygon:{name}"
    for kind, name in (
        (1, "Point"), (3, "PolyLine"), (8, "MultiPoint"), (11, "PointZ"), (13, "PolyLineZ"),
        (18, "MultiPointZ"), (21, "PointM"), (23, "PolyLineM"), (28, "MultiPointM"),
        (31, "MultiPatch"),
    )
}  # fmt: skip
_POINTS, _MULTI_POINTS, _LINES = (1, 11, 21), (8, 18, 28), (3, 13, 23)
_HEADER_BYTES = 100
_MAGIC = 9994
# Of a polygon: type, bounds, the number of rings and of points; then the rings' first points.
_POLYGON_BYTES = 44
_EXPORT_AGAIN = "copy the whole set of files, or export the map again"

Ring = NDArray[np.float64]
_NO_POINTS, _NO_RINGS = np.empty((0, 2)), np.empty(0, np.int32)


def read_shapefile(path: Path, layer: str | None = None) -> Layer:
    """Return what a shapefile holds; `layer` names one of several in a folder or a zip."""
    files = find_shapefile(path, layer)
    offsets, problems = _index(files)
    shapes = list(_shapes(files, offsets))
    geometries = _grounds([rings for rings, _, _ in shapes], files.main)
    skipped = {
        index: reason or "no-area"
        for index, ((_, reason, _), area) in enumerate(zip(shapes, geometries, strict=True))
        if area is None
    }
    columns, encoding = read_columns(
        files.content.get(".dbf"),
        files.content.get(".cpg"),
        path=files.main,
        count=len(geometries),
    )
    return Layer(
        format="shapefile",
        crs=_crs(files),
        columns=with_units(columns, files.metadata),
        geometries=tuple(geometries),
        sha256=files.sha256,
        skipped=skipped,
        problems=(*problems, *encoding),
        marks={index: mark for index, (_, _, mark) in enumerate(shapes) if mark is not None},
    )


def _crs(files: ShapeFiles) -> CRS | None:
    prj = files.content.get(".prj")
    if prj is None or not prj.strip(b" \r\n\0"):
        return None
    text = prj.decode("utf-8-sig", errors="replace").strip("\0")
    return parse_crs(text, path=files.main.with_suffix(".prj"), source="its text")


def _shapes(
    files: ShapeFiles, offsets: Iterable[int]
) -> Iterator[tuple[list[Ring], str, BaseGeometry | None]]:
    """Yield every record's rings, or none and why, in the order of the table; and its marks."""
    shp = files.content[".shp"]
    vertices = 0
    for number, offset in enumerate(offsets, start=1):
        try:
            record = memoryview(shp)[offset + 8 : offset + 8 + _length(shp, offset)]
            points, firsts, reason = _rings(record)
            vertices += len(points)
            check_counts(files.main, records=number, vertices=vertices)
            check_coordinates(points)
            mark = _mark(record) if reason.startswith("not-a-polygon") else None
        except ValueError as error:
            raise map_error(
                files.main,
                f"record {number} of its shapes is broken ({str(error)[:120]})",
                fix=_EXPORT_AGAIN,
                code="truncated" if isinstance(error, _CutOffError) else "broken-geometry",
            ) from None
        yield ([points] if len(firsts) == 1 else np.split(points, firsts[1:])), reason, mark


def _mark(record: memoryview) -> BaseGeometry | None:
    """Return the points or lines of a record, None where it is neither or broken."""
    kind = int.from_bytes(record[:4], "little")
    try:
        if kind in _POINTS:
            return shapely.Point(_checked(np.frombuffer(record, "<f8", 2, 4))[0])
        if kind in _MULTI_POINTS:
            count = struct.unpack_from("<i", record, 36)[0]
            return MultiPoint(_checked(np.frombuffer(record, "<f8", 2 * count, 40)))
        if kind in _LINES:
            points, firsts, _ = _parts(record)
            lines = np.split(_checked(points), firsts[1:])
            return MultiLineString(lines)
    except (ValueError, struct.error, ShapelyError):
        pass
    return None


def _checked(numbers: NDArray[np.float64]) -> Ring:
    points = numbers.reshape(-1, 2)
    if not len(points):
        raise ValueError("there are no points")
    check_coordinates(points)
    return points


def _grounds(records: list[list[Ring]], main: Path) -> list[Area | None]:
    try:
        return areas_of_records(records)
    except (ValueError, ShapelyError) as error:
        raise map_error(
            main,
            f"its shapes are broken ({str(error)[:120]})",
            fix=_EXPORT_AGAIN,
            code="broken-geometry",
        ) from None


class _CutOffError(ValueError):
    """A length that does not fit into the file."""


def _rings(record: memoryview) -> tuple[Ring, NDArray[np.int32], str]:
    """Return the points of all rings and where each begins, or none and why."""
    kind = int.from_bytes(record[:4], "little")
    if kind not in _POLYGONS:
        if kind not in _KINDS:
            raise ValueError(f"there is no shape of type {kind}")
        return _NO_POINTS, _NO_RINGS, _KINDS[kind]
    return _parts(record)


def _parts(record: memoryview) -> tuple[Ring, NDArray[np.int32], str]:
    """Return the points of all parts and where each begins: polygons and lines are laid out alike.

    Raises `ValueError` where they do not fit into the record.
    """
    if len(record) < _POLYGON_BYTES:
        raise _CutOffError(f"it has {len(record)} bytes")
    parts, points = struct.unpack_from("<2i", record, 36)
    start = _POLYGON_BYTES + 4 * parts
    if not (parts >= 0 and points >= 0 and start + 16 * points <= len(record)):
        raise _CutOffError(f"{parts} rings of {points} points do not fit into its length")
    firsts = np.frombuffer(record, "<i4", parts, _POLYGON_BYTES)
    if not parts:
        return _NO_POINTS, _NO_RINGS, ""
    if firsts[0] != 0 or firsts[-1] > points or (firsts[1:] < firsts[:-1]).any():
        raise ValueError("its rings are out of order")
    # Heights and measures of PolygonZ and PolygonM stand behind the points.
    x_y = np.frombuffer(record, "<f8", 2 * points, start).reshape(-1, 2)
    return x_y, firsts, ""


def _length(shp: bytes, offset: int) -> int:
    """Return the content length of the record at `offset`, which has to fit into the file."""
    if not _HEADER_BYTES <= offset <= len(shp) - 8:
        raise _CutOffError(f"it starts at byte {offset} of {len(shp)}")
    length = 2 * int(struct.unpack_from(">i", shp, offset + 4)[0])
    if not 4 <= length <= len(shp) - offset - 8:
        raise _CutOffError(f"its length is {length} bytes, the file is cut off or damaged")
    return length


def _index(files: ShapeFiles) -> tuple[list[int], tuple[Problem, ...]]:
    """Return where each record's shape starts.

    From the `.shx` where there is one: programs that edit a shapefile in place append the
    changed shape at the end and leave the old one lying.
    """
    shp, shx = files.content[".shp"], files.content.get(".shx")
    _check_header(shp, files.main)
    if shx is not None:
        _check_header(shx, files.main.with_suffix(".shx"))
        # Behind its own end the file may hold anything.
        count = (2 * struct.unpack_from(">i", shx, 24)[0] - _HEADER_BYTES) // 8
        check_counts(files.main, records=count, vertices=0)
        words = np.frombuffer(shx, ">i4", 2 * count, _HEADER_BYTES).astype(np.int64)
        found = (2 * words[::2]).tolist()
        covered = int((2 * words[1::2] + 8).sum())
        return found, _strays(shp, found, covered, files.main)
    offsets: list[int] = []
    position = _HEADER_BYTES
    try:
        while position < len(shp) and len(offsets) <= MAX_RECORDS:
            offsets.append(position)
            position += 8 + _length(shp, position)
    except _CutOffError as error:
        text = f"record {len(offsets)} of its shapes is broken ({error})"
        raise map_error(files.main, text, fix=_EXPORT_AGAIN, code="truncated") from None
    check_counts(files.main, records=len(offsets), vertices=0)
    problem = Problem(
        severity="warning",
        code="no-shx",
        text="the .shx is missing; shapes are taken in the order in which they stand",
        where=str(files.main),
        fix="copy the whole set of files",
    )
    return offsets, (problem,)


def _strays(shp: bytes, indexed: list[int], covered_bytes: int, main: Path) -> tuple[Problem, ...]:
    """Return a warning for whole shapes in the file that the index does not name.

    They are old versions that an editing program left lying, or the `.shx` and the table are of
    another export than the `.shp`; which of the two, no file says.
    """
    end = 2 * struct.unpack_from(">i", shp, 24)[0]
    if covered_bytes >= end - _HEADER_BYTES:
        return ()
    named, count, strays, position = set(indexed), 0, 0, _HEADER_BYTES
    try:
        while position < end and count < MAX_RECORDS:
            after = position + 8 + _length(shp, position)
            count += 1
            strays += position not in named
            position = after
    except _CutOffError:
        pass  # bytes that are no shape
    if not strays:
        return ()
    problem = Problem(
        severity="warning",
        code="stray-records",
        text=f"{strays} of {count} shapes in the .shp stand in no record of the .shx and are left "
        "out: old versions that a program left there, or files of two exports",
        where=str(main),
        fix="compare the area with that of the program that made the map, or export it again",
    )
    return (problem,)


def _check_header(content: bytes, path: Path) -> None:
    """Refuse what is no part of a shapefile, and one that is shorter than it says.

    Longer is common: programs leave bytes behind that nothing points to.
    """
    suffix = path.suffix.casefold()
    if len(content) < _HEADER_BYTES or struct.unpack_from(">i", content)[0] != _MAGIC:
        raise map_error(
            path,
            f"this is no {suffix} file" if content else "the file is empty",
            fix=_EXPORT_AGAIN,
            code="truncated",
        )
    length = 2 * struct.unpack_from(">i", content, 24)[0]
    if length > len(content):
        raise map_error(
            path,
            f"the file is cut off: it has {len(content)} bytes and says {length}",
            fix=_EXPORT_AGAIN,
            code="truncated",
        )
