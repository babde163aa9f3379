"""KML and KMZ (OGC 12-007r2 and its forerunners): polygons, and their numbers in ExtendedData.

Coordinates are longitude, latitude and perhaps a height, on WGS84; nothing else is possible. The
text of a description is for people: no rate is read out of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

from missions.maps.crs import WGS84
from missions.maps.geopackage.wkb import areas_of
from missions.maps.kml.files import KmlFiles, read_files
from missions.maps.kml.geometry import Ground, ground_of, local_name
from missions.maps.kml.kml_attributes import columns_of, has_attributes
from missions.maps.layer import MAX_RECORDS, Layer, check_counts, digest
from missions.maps.model import map_error
from missions.maps.outline import BOUNDARY_NAME, outline_of

_CONTAINERS = ("kml", "Document", "Folder")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Placemark:
    """One placemark, and the names of the folders around it, the outermost first."""

    element: Element
    folders: tuple[str, ...]


def read_kml(path: Path, layer: str | None = None) -> Layer:
    """Return what a KML file or a KMZ archive holds; `layer` names one of its folders.

    A folder called "boundary" without ExtendedData is the outline of the field, where there are
    polygons outside of it.
    """
    files = read_files(path, layer)
    root = files.root
    if local_name(root) not in (*_CONTAINERS, "Placemark"):
        raise map_error(
            path,
            f"this is XML, but not KML (it begins with {local_name(root)[:40]})",
            fix="export the map again",
            code="unknown-format",
        )
    placemarks = list(_placemarks(root))
    check_counts(path, records=len(placemarks), vertices=0)
    if not placemarks:
        raise _empty(files, path)
    grounds = _grounds(placemarks, path)
    areas = areas_of([ground.polygons for ground in grounds])
    outline = _outline(placemarks, grounds)
    boundary = outline_of([areas[index] for index in sorted(outline)], WGS84, path)
    chosen = [index for index in range(len(placemarks)) if index not in outline]
    if files.folder is not None:
        chosen = _inside(placemarks, chosen, files.folder, path)
    return Layer(
        format="kml",
        crs=WGS84,
        columns=columns_of(root, [placemarks[index].element for index in chosen], path),
        geometries=tuple(areas[index] for index in chosen),
        sha256=digest(files.contents),
        boundary=boundary,
        skipped={
            position: grounds[index].reason
            for position, index in enumerate(chosen)
            if grounds[index].reason
        },
        problems=files.problems,
        marks={
            position: mark
            for position, index in enumerate(chosen)
            if (mark := grounds[index].mark) is not None
        },
    )


def _empty(files: KmlFiles, path: Path) -> Exception:
    if files.problems:
        return map_error(
            path,
            "it holds no zones itself, only links to other files or servers",
            fix="save what they show as a file of its own",
            code="network-link",
        )
    return map_error(
        path, "there is no zone in it", fix="export the zones as polygons", code="no-polygon"
    )


def _placemarks(element: Element, folders: tuple[str, ...] = ()) -> Iterator[_Placemark]:
    """Yield all placemarks in documents and folders, however deep; `parse_xml` bounds the depth."""
    if local_name(element) == "Placemark":
        yield _Placemark(element=element, folders=folders)
        return
    for child in element:
        kind = local_name(child)
        if kind == "Placemark":
            yield _Placemark(element=child, folders=folders)
        elif kind in _CONTAINERS:
            yield from _placemarks(child, (*folders, _name(child)))


def _name(element: Element) -> str:
    text = next((child.text for child in element if local_name(child) == "name"), None)
    return " ".join((text or "").split())


def _grounds(placemarks: Sequence[_Placemark], path: Path) -> list[Ground]:
    grounds: list[Ground] = []
    vertices = 0
    for number, placemark in enumerate(placemarks, 1):
        try:
            ground = ground_of(placemark.element)
        except ValueError as error:
            label = _name(placemark.element)[:40] or "without a name"
            raise map_error(
                path,
                f"the polygon of placemark {number} ({label}) is broken ({error})",
                fix="export the map again",
                code="broken-geometry",
            ) from None
        vertices += sum(len(ring) for rings in ground.polygons for ring in rings)
        check_counts(path, records=min(number, MAX_RECORDS), vertices=vertices)
        grounds.append(ground)
    return grounds


def _outline(placemarks: Sequence[_Placemark], grounds: Sequence[Ground]) -> frozenset[int]:
    """Return which placemarks are the outline of the field and no zones."""
    inside = {
        index
        for index, placemark in enumerate(placemarks)
        if any(folder.casefold() == BOUNDARY_NAME for folder in placemark.folders)
        and not has_attributes(placemark.element)
    }
    others = any(ground.polygons for index, ground in enumerate(grounds) if index not in inside)
    here = any(grounds[index].polygons for index in inside)
    return frozenset(inside) if others and here else frozenset()


def _inside(
    placemarks: Sequence[_Placemark], chosen: Sequence[int], layer: str, path: Path
) -> list[int]:
    found = [index for index in chosen if layer in placemarks[index].folders]
    if not found:
        names = dict.fromkeys(name for index in chosen for name in placemarks[index].folders)
        shown = ", ".join([name for name in names if name][:20]) or "none"
        raise map_error(
            path,
            f"there is no folder {layer!r}; the folders are {shown}",
            fix="name one of them with --layer, or leave --layer out",
            code="no-layer",
        )
    return found
