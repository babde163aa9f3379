"""ESRI shapefiles: `.shp` and the files beside it, or a folder or zip that holds one.

Taken apart by hand, after the ESRI shapefile technical description of 1998: which record a shape
belongs to is known to the `.shx` alone (an edited file keeps its shapes out of order), and every
length is checked against the file before anything is read by it.
"""

from __future__ import annotations

import json
import struct
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import shapefile
import shapely
from numpy.typing import NDArray
from pyproj import CRS
from shapely import MultiLineString, MultiPoint, MultiPolygon, Polygon, STRtree
from shapely.errors import ShapelyError
from shapely.geometry.base import BaseGeometry

from companion.map_formats import shapefile_rings, shapefile_set, table_text, zipped
from missions.maps.crs import parse_crs, stated
from missions.maps.dbf import ShapeFiles, find_shapefile, read_columns
from missions.maps.local import Area, as_area
from missions.maps.model import (
    MAX_RECORDS,
    Column,
    Layer,
    MapZone,
    Problem,
    check_coordinates,
    check_counts,
    map_error,
    not_written,
    write_whole,
)
from missions.maps.outlines import BOUNDARY_NAME

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
    columns, stands, encoding = read_columns(
        files.content.get(".dbf"),
        files.content.get(".cpg"),
        path=files.main,
        count=len(offsets),
    )
    shapes = list(_shapes(files, [offsets[index] for index in stands]))
    geometries = _grounds([rings for rings, _, _ in shapes], files.main)
    skipped = {
        index: reason or "no-area"
        for index, ((_, reason, _), area) in enumerate(zip(shapes, geometries, strict=True))
        if area is None
    }
    return Layer(
        format="shapefile",
        crs=stated(_crs, files),
        columns=with_units(columns, files.metadata),
        geometries=tuple(geometries),
        sha256=files.sha256,
        skipped=skipped,
        problems=(*problems, *encoding),
        marks={index: mark for index, (_, _, mark) in enumerate(shapes) if mark is not None},
    )


def _crs(files: ShapeFiles) -> CRS | None:
    prj = files.content.get(".prj")
    if prj is None:
        return None
    if not prj.strip(b" \r\n\0"):
        raise map_error(
            files.main,
            "its .prj is empty: the file does not say its coordinate reference system",
            fix="give it with --crs, or copy the file again",
            code="no-crs",
        )
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


# From rings to polygons with holes, as a shapefile leaves it to the reader.
#
# A shapefile record is a list of rings in any order: clockwise is outside, anticlockwise is a hole
# (ESRI shapefile technical description, 1998, page 8), and which hole belongs to which outside is
# for the reader to find.

Floats = NDArray[np.float64]
Objects = NDArray[np.object_]


def areas_of_records(records: Sequence[Sequence[Floats]]) -> list[Area | None]:
    """Return `area_of_rings` of every record.

    Records of a single ring, which most are, are made at once: there is nothing to sort out.
    """
    single = [index for index, rings in enumerate(records) if _is_plain(rings)]
    made = _polygons([records[index][0] for index in single])
    quick = {
        index: polygon
        for index, polygon, area in zip(single, made, shapely.area(made), strict=True)
        if area > 0.0
    }
    return [
        quick[index] if index in quick else area_of_rings(rings)
        for index, rings in enumerate(records)
    ]


def _is_plain(rings: Sequence[Floats]) -> bool:
    return len(rings) == 1 and len(rings[0]) >= 4 and bool((rings[0][0] == rings[0][-1]).all())


def area_of_rings(rings: Sequence[Floats]) -> Area | None:
    """Return the polygon or multipolygon of one record, or None where no ring has an area."""
    shells, holes = [], []
    for ring in map(_closed, rings):
        turn = signed_area(ring) if len(ring) >= 4 else 0.0
        if turn > 0.0:
            holes.append(ring)
        elif turn < 0.0 or _crosses_itself(ring):
            shells.append(ring)
    return as_area(_assigned(shells, holes))


def signed_area(ring: Floats) -> float:
    """Return the area of a closed ring by the shoelace formula, positive anticlockwise.

    >>> signed_area(np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0], [0.0, 0.0]]))
    2.0
    """
    # From the first point, so that large coordinates do not swallow a small area.
    x, y = (ring - ring[0]).T
    return float(np.dot(x[:-1], y[1:]) - np.dot(x[1:], y[:-1])) / 2.0


def _crosses_itself(ring: Floats) -> bool:
    """Tell a ring whose loops cancel out, which is for the repair, from one that is a line."""
    return len(ring) >= 4 and Polygon(ring).convex_hull.area > 0.0


def _closed(ring: Floats) -> Floats:
    if len(ring) and not np.array_equal(ring[0], ring[-1]):
        return np.vstack([ring, ring[:1]])
    return ring


def _polygons(rings: Sequence[Floats]) -> Objects:
    """Return a polygon without holes for every closed ring."""
    if not rings:
        return np.empty(0, dtype=object)
    owner = np.repeat(np.arange(len(rings)), [len(ring) for ring in rings])
    return np.array(shapely.polygons(shapely.linearrings(np.vstack(rings), indices=owner)))


def _owners(inner: Objects, outer: Objects) -> dict[int, list[int]]:
    """Return, for each inner polygon, the outer ones around it, the smallest first.

    One point tells which rings of a record lie in each other, as they do not cross; but what is
    smaller is not around it, it is an island whose ground the point happens to hit.
    """
    points = shapely.point_on_surface(inner)
    found = defaultdict(list)
    own, areas = shapely.area(inner), shapely.area(outer)
    for i, j in STRtree(outer).query(points, predicate="within").T.tolist():
        if areas[j] >= own[i]:
            found[i].append(j)
    return {i: sorted(around, key=lambda j: float(areas[j])) for i, around in found.items()}


def _assigned(shells: list[Floats], holes: list[Floats]) -> list[Polygon]:
    """Return the shells, each with the holes whose smallest surrounding shell it is.

    A hole that no shell surrounds shows that the writer paid no heed to the turns.
    """
    if not holes:
        return [Polygon(ring) for ring in shells]
    owners = _owners(_polygons(holes), _polygons(shells))
    if len(owners) < len(holes):
        return _by_depth([*shells, *holes])
    mine: dict[int, list[Floats]] = defaultdict(list)
    for index, around in owners.items():
        mine[around[0]].append(holes[index])
    return [Polygon(shell, mine.get(index)) for index, shell in enumerate(shells)]


def _by_depth(rings: list[Floats]) -> list[Polygon]:
    """Return polygons by how many others lie around each ring: even is ground, odd is a hole."""
    areas = _polygons(rings)
    owners = _owners(areas, areas)
    around = {
        index: [j for j in owners.get(index, []) if j != index] for index in range(len(rings))
    }
    holes: dict[int, list[Floats]] = defaultdict(list)
    for index, outer in around.items():
        if len(outer) % 2:
            holes[outer[0]].append(rings[index])
    return [
        Polygon(rings[index], holes.get(index))
        for index, outer in around.items()
        if len(outer) % 2 == 0
    ]


# Units of columns from the file that John Deere's programs write beside a shapefile.
#
# `<name>-Deere-Metadata.json` lists the columns as `DataAttributes`, with a unit for each, such as
# `gal1ac-1`. What cannot be read in it is nothing: the unit is then asked for, as without the file.

_BYTES_MAX = 1024 * 1024
_DBF_NAME = 10
_UNIT_MEMBERS = ("unit", "units", "unitid", "uom")


def with_units(columns: Sequence[Column], metadata: bytes | None) -> tuple[Column, ...]:
    """Return the columns with the units that the metadata states for them.

    Where it states two for one column, it states none.
    """
    if metadata is None or len(metadata) > _BYTES_MAX:
        return tuple(columns)
    stated: dict[str, set[str]] = {}
    for name, unit in _attributes(metadata):
        # The table cuts names at ten characters, the metadata does not.
        stated.setdefault(name[:_DBF_NAME].casefold(), set()).add(unit)
    units = {name: next(iter(said)) for name, said in stated.items() if len(said) == 1}
    return tuple(
        replace(column, unit=units.get(column.name[:_DBF_NAME].casefold())) for column in columns
    )


def _attributes(metadata: bytes) -> list[tuple[str, str]]:
    """Return names and units of all columns for which there is a unit."""
    try:
        document = json.loads(metadata.decode("utf-8-sig"))
    except (ValueError, RecursionError):
        return []
    attributes = document.get("DataAttributes") if isinstance(document, dict) else None
    found = []
    for attribute in attributes if isinstance(attributes, list) else ():
        if not isinstance(attribute, dict):
            continue
        members = {str(key).casefold(): value for key, value in attribute.items()}
        name = members.get("name")
        unit = next((members[key] for key in _UNIT_MEMBERS if members.get(key)), None)
        if isinstance(name, str) and isinstance(unit, str) and unit.strip():
            found.append((name.strip(), unit.strip()[:40]))
    return found


# A prescription as a shapefile: five files side by side, or in one zip as terminals take it.

UNIT = "L/ha"
# Four decimals hold a rate to a ten-thousandth of a litre; the core's limit is 100 000 L/ha.
_RATE_WIDTH, _RATE_DECIMALS = 12, 4


def write_shapefile(
    zones: Sequence[MapZone], path: Path, *, boundary: MultiPolygon | None = None
) -> None:
    """Write a `.shp` and the files that belong to it, or all of them in a `.zip`.

    A shapefile has one kind of record and so no place for the outline of the field; the zip
    holds it as another shapefile, in a folder of its own.
    """
    if not zones:
        raise map_error(
            path, "there is no zone to write", fix="take a map with zones", code="no-polygon"
        )
    content = _files(zones)
    if path.suffix.casefold() == ".zip":
        members = {f"{path.stem}{suffix}": one for suffix, one in content.items()}
        if boundary is not None:
            outline = MapZone(name=BOUNDARY_NAME, geometry=boundary, rate_l_ha=None)
            members |= {
                f"{BOUNDARY_NAME}/{BOUNDARY_NAME}{suffix}": one
                for suffix, one in _files([outline]).items()
            }
        write_whole(path, zipped(dict(sorted(members.items()))))
        return
    # The .shp goes first and comes last: what there is without it is no map to anybody.
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise not_written(path, error) from None
    for suffix in sorted(content, key=lambda suffix: suffix == ".shp"):
        write_whole(path if suffix == ".shp" else path.with_suffix(suffix), content[suffix])


def _files(zones: Sequence[MapZone]) -> dict[str, bytes]:
    """Return the content of each file of the set, by its suffix."""
    shp, shx, dbf = BytesIO(), BytesIO(), BytesIO()
    names = [_fitting(zone.name) for zone in zones]
    with shapefile.Writer(
        shp=shp, shx=shx, dbf=dbf, shapeType=shapefile.POLYGON, encoding="utf-8"
    ) as writer:
        writer.field("name", "C", size=max(1, *(len(name.encode()) for name in names)))
        writer.field("rate", "N", size=_RATE_WIDTH, decimal=_RATE_DECIMALS)
        writer.field("unit", "C", size=len(UNIT))
        for name, zone in zip(names, zones, strict=True):
            writer.poly(shapefile_rings(zone.geometry))
            writer.record(name, zone.rate_l_ha, UNIT)
    return shapefile_set(shp=shp.getvalue(), shx=shx.getvalue(), dbf=dbf.getvalue())


def _fitting(name: str) -> str:
    """Return a name on one line, cut between letters where it is wider than a column can be."""
    return table_text(" ".join(name.replace("\0", " ").split())).rstrip()
