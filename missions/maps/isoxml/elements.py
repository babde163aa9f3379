"""The elements of ISOXML task data as they are written (ISO 11783-10, version 4)."""

from __future__ import annotations

from collections.abc import Iterable
from decimal import Decimal
from xml.etree.ElementTree import Element, SubElement

from shapely import MultiPolygon, Polygon

from missions.maps.local import frame_around, project

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
