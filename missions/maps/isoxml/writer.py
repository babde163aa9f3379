"""Writing ISOXML 4 task data: zones as polygons, cells as a grid of type 2, rates by DDI 0001.

A raw value of DDI 0001 is 0.0001 L/ha. The treatment zones for default, position lost and out of
field are always there, the latter two with rate 0. A grid of type 2 has a value in every cell: a
cell without a rate gets the default inside the field where the map has one, else 0, which both
close the nozzles as before.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon
from shapely.errors import ShapelyError

from companion.map_formats import zipped
from missions.maps.local import frame_around, polygons_of, project
from missions.maps.model import MapCells, MapFile, MapZone, map_error, not_written, write_whole

GRID_NAME = "GRD00001"
_TASK_DATA = "TASKDATA.XML"


def write_isoxml(map_file: MapFile, path: Path) -> None:
    """Write a map as `….xml` with its grid beside, as a `.zip`, or as a folder (no suffix)."""
    suffix = "" if path.is_dir() else path.suffix.casefold()
    if suffix not in (".xml", ".zip", ""):
        raise map_error(
            path,
            f"ISOXML is not written as {suffix}",
            fix="name a TASKDATA.XML, a .zip, or a folder",
            code="unknown-format",
        )
    task_data, grid = _content(map_file, path)
    if suffix == ".zip":
        write_whole(path, _zipped(task_data, grid))
    elif suffix == ".xml":
        _write_files(path, task_data, grid)
    else:
        _write_folder(path, task_data, grid)


def _content(map_file: MapFile, path: Path) -> tuple[bytes, bytes | None]:
    """Return the bytes of TASKDATA.XML, and of the grid where there is one."""
    root, task = new_task_data(printable(map_file.path.stem))
    boundary = map_file.boundary
    default_l_ha = map_file.default_rate_l_ha if boundary is not None else None
    default_raw = raw_rate(default_l_ha or 0.0)
    if boundary is None:
        boundary = outline(map_file.zones, path)
    if boundary is not None:
        add_field(root, task, boundary)
    for code, (name, raw) in enumerate(
        (("Default", default_raw), ("PositionLost", 0), ("OutOfField", 0)), DEFAULT_CODE
    ):
        add_treatment_zone(task, code, name, raw)
    grid = None
    if map_file.cells is None:
        for code, zone in enumerate(grouped(map_file.zones, path), DEFAULT_CODE + 3):
            add_polygons(add_treatment_zone(task, code, zone.name, zone.raw), zone.polygons)
    else:
        grid = _add_grid(task, map_file.cells, default_raw, path)
    indent(root)
    return tostring(root, encoding="UTF-8", xml_declaration=True) + b"\n", grid


def _add_grid(task: Element, cells: MapCells, default_raw: int, path: Path) -> bytes:
    """Add the GRD to a task and return its bytes, rows from south to north."""
    a, b, west, d, e, south = cells.transform
    if cells.crs.to_epsg() != 4326 or b != 0.0 or d != 0.0:
        raise map_error(
            path,
            "an ISOXML grid has its rows and columns along latitude and longitude, which this "
            "map has not",
            fix="convert it to zones or to cells in EPSG:4326 first",
            code="grid-crs",
        )
    rates = cells.rates_l_ha
    rows, columns = rates.shape
    if a < 0.0:
        rates, west, a = rates[:, ::-1], west + columns * a, -a
    if e < 0.0:
        rates, south, e = rates[::-1], south + rows * e, -e
    raw = np.where(np.isnan(rates), default_raw, np.rint(rates * 1e4)).astype("<i4")
    SubElement(
        task,
        "GRD",
        A=decimal(south), B=decimal(west), C=decimal(e), D=decimal(a), E=str(columns), F=str(rows),
        G=GRID_NAME, H=str(4 * raw.size), I="2", J=str(DEFAULT_CODE),
    )  # fmt: skip
    return raw.tobytes()


def _zipped(task_data: bytes, grid: bytes | None) -> bytes:
    """Return a zip with a folder TASKDATA, as terminals look for on a stick."""
    members = {_TASK_DATA: task_data} | ({f"{GRID_NAME}.BIN": grid} if grid else {})
    folder = {f"TASKDATA/{name}": content for name, content in members.items()}
    # A grid of a few rates would shrink so much that it looks like a zip bomb.
    return zipped(folder, as_is=[name for name in folder if name.endswith(".BIN")])


def _write_files(path: Path, task_data: bytes, grid: bytes | None) -> None:
    """Write the XML, after its grid; the grid of another task beside it is left alone."""
    if grid is not None:
        beside = {file.name.casefold(): file for file in path.parent.glob("*") if file.is_file()}
        there = beside.get(f"{GRID_NAME}.bin".casefold())
        if there is not None and not path.exists():
            raise map_error(
                path,
                f"there is a {there.name} of another task beside it",
                fix="write into a folder of its own",
                code="file-exists",
            )
        write_whole(there or path.with_name(f"{GRID_NAME}.BIN"), grid)
    write_whole(path, task_data)


def _write_folder(path: Path, task_data: bytes, grid: bytes | None) -> None:
    """Write into a folder; a new one appears with both files or not at all."""
    if path.is_dir():
        _write_files(path / _TASK_DATA, task_data, grid)
        return
    part = path.with_name(f".{path.name}.part")
    try:
        try:
            part.mkdir()
            _write_files(part / _TASK_DATA, task_data, grid)
            part.rename(path)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    except OSError as error:
        raise not_written(path, error) from None


# Zones of a map as treatment zones of a task, which has room for only so many.

# Codes go from 0 to 254 (ISO 11783-10), three of which are for the special cases.
ZONES_MAX = 252


@dataclass(frozen=True, slots=True, kw_only=True)
class ZoneGroup:
    """What becomes one treatment zone; `raw` None where no rate is prescribed."""

    name: str
    raw: int | None
    polygons: tuple[Polygon, ...]


def grouped(zones: Sequence[MapZone], path: Path) -> list[ZoneGroup]:
    """Return each zone by itself, or where they are too many, all of one rate together."""
    if len(zones) <= ZONES_MAX:
        return [
            ZoneGroup(
                name=printable(zone.name),
                raw=_raw(zone),
                polygons=tuple(polygons_of(zone.geometry)),
            )
            for zone in zones
        ]
    by_raw: dict[int | None, list[MapZone]] = {}
    for zone in zones:
        by_raw.setdefault(_raw(zone), []).append(zone)
    if len(by_raw) > ZONES_MAX:
        raise map_error(
            path,
            f"the map has {len(by_raw)} different rates, and ISOXML has room for {ZONES_MAX} "
            "treatment zones",
            fix="round the rates (--round), or convert the map to another format",
            code="too-many-rates",
        )
    return [
        ZoneGroup(
            name="no rate" if raw is None else f"{raw / 1e4:.10g} L/ha",
            raw=raw,
            polygons=tuple(part for zone in ones for part in polygons_of(zone.geometry)),
        )
        for raw, ones in by_raw.items()
    ]


def outline(zones: Sequence[MapZone], path: Path) -> MultiPolygon | None:
    """Return the ground of all zones together, as the outline of a field that has none."""
    if not zones:
        return None
    try:
        united = shapely.union_all(np.array([zone.geometry for zone in zones], dtype=object))
    except ShapelyError as error:
        raise map_error(
            path,
            f"the zones have no outline ({str(error)[:120]})",
            fix="give the map a boundary, or repair its zones",
            code="broken-geometry",
        ) from None
    return MultiPolygon(polygons_of(united))


def _raw(zone: MapZone) -> int | None:
    return None if zone.rate_l_ha is None else raw_rate(zone.rate_l_ha)


# The elements of ISOXML task data as they are written (ISO 11783-10, version 4).

# Treatment zones of the special cases: default, position lost, out of field.
DEFAULT_CODE = 0
# DDI 0001 has 0.01 mm3/m2 a step (ISO 11783-11), so 10 000 steps are 1 L/ha.
RAW_PER_L_HA = 10_000
_NAME_MAX = 32
_FIELD, _ZONE = "1", "2"
_PRESENTATION = "VPN1"


def raw_rate(rate_l_ha: float) -> int:
    """Return a rate as the raw value of DDI 0001.

    >>> raw_rate(49.0)
    490000
    """
    return round(rate_l_ha * RAW_PER_L_HA)


def decimal(number: float) -> str:
    """Return a number with all of its digits and without an exponent.

    >>> decimal(1.1178e-05)
    '0.000011178'
    """
    return format(Decimal(repr(float(number))), "f")


def printable(name: str) -> str:
    """Return a name without what XML cannot hold, as long as a designator may be."""
    return " ".join("".join(one for one in name if one.isprintable()).split())[:_NAME_MAX]


def new_task_data(name: str) -> tuple[Element, Element]:
    """Return the root, and in it the one task, planned, with its codes and no zones yet."""
    root = Element(
        "ISO11783_TaskData",
        VersionMajor="4",
        VersionMinor="3",
        ManagementSoftwareManufacturer="vrspray",
        ManagementSoftwareVersion="1",
        DataTransferOrigin="1",
    )
    SubElement(root, "VPN", A=_PRESENTATION, B="0", C=decimal(1 / RAW_PER_L_HA), D="2", E="l/ha")
    task = SubElement(root, "TSK", A="TSK1", B=name or "Prescription", G="1")
    for key, code in zip("HIJ", range(DEFAULT_CODE, DEFAULT_CODE + 3), strict=True):
        task.set(key, str(code))
    return root, task


def add_field(root: Element, task: Element, boundary: MultiPolygon) -> None:
    """Add the field with its outline before the task, which refers to it."""
    local = project(boundary, frame_around([boundary]))
    field = Element("PFD", A="PFD1", C=task.get("B", ""), D=str(round(local.area)))
    add_polygons(field, boundary.geoms, kind=_FIELD)
    root.insert(list(root).index(task), field)
    task.set("E", "PFD1")


def add_treatment_zone(task: Element, code: int, name: str, raw: int | None) -> Element:
    """Add a treatment zone with its value of DDI 0001, or without any."""
    zone = SubElement(task, "TZN", A=str(code))
    if name:
        zone.set("B", name)
    if raw is not None:
        SubElement(zone, "PDV", A="0001", B=str(raw), E=_PRESENTATION)
    return zone


def add_polygons(parent: Element, polygons: Iterable[Polygon], *, kind: str = _ZONE) -> None:
    """Add polygons with their rings, before the values that a zone has already."""
    for index, polygon in enumerate(polygons):
        element = Element("PLN", A=kind)
        parent.insert(index, element)
        for ring_kind, ring in (
            ("1", polygon.exterior),
            *(("2", interior) for interior in polygon.interiors),
        ):
            line = SubElement(element, "LSG", A=ring_kind)
            for east, north in ring.coords:
                # Nine decimals of a degree are 0.1 mm.
                SubElement(line, "PNT", A="2", C=f"{north:.9f}", D=f"{east:.9f}")
