"""KML and KMZ (OGC 12-007r2 and its forerunners): polygons, and their numbers in ExtendedData.

Coordinates are longitude, latitude and perhaps a height, on WGS84; nothing else is possible. The
text of a description is for people: no rate is read out of it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from urllib.parse import unquote
from xml.etree.ElementTree import Element

from shapely import MultiPolygon, Polygon

from companion.map_formats import KML_HEAD, KML_TAIL, kml_colour, kml_ground, kml_text, zipped
from companion.wording import typed
from missions.maps.bundle import MAX_ELEMENTS, Bundle, one_of, open_bundle, parse_xml
from missions.maps.crs import WGS84
from missions.maps.fields import column_of, stated_unit
from missions.maps.geopackage_layers import areas_of
from missions.maps.kml_polygons import Ground, ground_of, local_name
from missions.maps.model import (
    MAX_RECORDS,
    Column,
    Layer,
    MapZone,
    Problem,
    check_counts,
    digest,
    map_error,
    read_bytes,
    write_whole,
)
from missions.maps.outlines import BOUNDARY_NAME, outline_of

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
        shown = typed([name for name in names if name][:20]) or "none"
        raise map_error(
            path,
            f"there is no folder {layer!r}; the folders are {shown}",
            fix="name one of them with --layer, or leave --layer out",
            code="no-layer",
        )
    return found


# What KML placemarks say in ExtendedData, as columns.
#
# Three forms (OGC 12-007r2, section 9.4): `Data` with a name and a value, `SchemaData` with fields
# whose types a `Schema` declares, and elements of other namespaces. All of it is text.

_NUMERIC = frozenset({"int", "uint", "short", "ushort", "float", "double"})
_TRUTH = frozenset({"bool", "boolean"})
_NAME = "name"
_COLUMNS_MAX = 255  # as many as a shapefile can have
_CELLS_MAX = 10_000_000


@dataclass(slots=True)
class _Fields:
    """Types and titles that the file declares for its fields, by name."""

    types: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    titles: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))


def has_attributes(placemark: Element) -> bool:
    """Tell whether a placemark says anything in ExtendedData."""
    return any(True for _ in _pairs(placemark, _Fields()))


def columns_of(root: Element, placemarks: Sequence[Element], path: Path) -> tuple[Column, ...]:
    """Return a column for every name in ExtendedData, and one for the placemarks' names."""
    fields = _declared(root)
    rows = [_row(placemark, fields, path) for placemark in placemarks]
    names = list(dict.fromkeys(name for row in rows for name in row))
    if len(names) > _COLUMNS_MAX or len(names) * len(rows) > _CELLS_MAX:
        raise map_error(
            path,
            f"{len(names)} attributes of {len(rows)} placemarks are too many",
            fix="keep the rate and its unit",
            code="too-large",
        )
    columns = [
        column_of(
            name,
            [row.get(name) for row in rows],
            declared=bool(fields.types[name]) and fields.types[name] <= _NUMERIC,
            unit=stated_unit(fields.titles[name], column=name, path=path),
        )
        for name in names
    ]
    labels = [_text(placemark, _NAME) for placemark in placemarks]
    if any(labels) and _NAME not in (name.casefold() for name in names):
        columns.append(column_of(_NAME, labels))
    return tuple(columns)


def _declared(root: Element) -> _Fields:
    fields = _Fields()
    for element in root.iter():
        if local_name(element) == "SimpleField":
            name = element.get("name", "").strip()
            fields.types[name].add(element.get("type", "").rpartition(":")[2].casefold())
            title = _text(element, "displayName")
            if title:
                fields.titles[name].add(title)
    return fields


def _row(placemark: Element, fields: _Fields, path: Path) -> dict[str, str | None]:
    """Return one placemark's values by name; a name with two values is refused."""
    row: dict[str, str | None] = {}
    for name, text in _pairs(placemark, fields):
        value = text
        if value is not None and fields.types[name] & _TRUTH:
            value = {"1": "true", "0": "false"}.get(value, value)
        known = row.get(name)
        if known is not None and value is not None and known != value:
            raise map_error(
                path,
                f"a placemark says {name} twice: {known[:40]} and {value[:40]}",
                fix="keep one of them",
                code="several-columns",
            )
        row[name] = known if value is None else value
    return row


def _pairs(placemark: Element, fields: _Fields) -> Iterator[tuple[str, str | None]]:
    """Yield name and value of all that a placemark says; None for a blank."""
    for extended in placemark:
        if local_name(extended) != "ExtendedData":
            continue
        for element in extended:
            kind = local_name(element)
            if kind == "Data":
                name = element.get("name", "").strip()
                title = _text(element, "displayName")
                if title:
                    fields.titles[name].add(title)
                yield name, _text(element, "value")
            elif kind == "SchemaData":
                for simple in element:
                    if local_name(simple) == "SimpleData":
                        yield simple.get("name", "").strip(), (simple.text or "").strip() or None
            elif not len(element):
                yield kind, (element.text or "").strip() or None


def _text(element: Element, kind: str) -> str | None:
    text = next((child.text for child in element if local_name(child) == kind), None)
    return (text or "").strip() or None


# The XML of a KML file, or of a KMZ archive and the files that its own file links to.
#
# GDAL, and so QGIS, writes one file for each layer into an archive, and a `doc.kml` that holds
# nothing but network links to them. Links that lead out of the archive are never followed.

_MAIN = "doc.kml"


@dataclass(frozen=True, slots=True, kw_only=True)
class KmlFiles:
    """One tree with all linked files grafted into it, and the bytes of which it was made.

    `folder` is what is left of `--layer` when no file of that name was meant.
    """

    root: Element
    contents: tuple[bytes, ...]
    folder: str | None
    problems: tuple[Problem, ...] = ()


def read_files(path: Path, layer: str | None) -> KmlFiles:
    """Return the tree of a `.kml`, or of an archive or a folder with KML files."""
    if not path.is_dir() and path.suffix.casefold() not in (".kmz", ".zip"):
        content = read_bytes(path)
        root = parse_xml(content, path)
        problems = _problems(sum(1 for _ in _links(root)), path)
        return KmlFiles(root=root, contents=(content,), folder=layer, problems=problems)
    bundle = open_bundle(path)
    name, used = _main_file(bundle, layer)
    content = bundle.read(name)
    root = parse_xml(content, path, name=name)
    linked, lost = _graft(root, name, bundle, path)
    return KmlFiles(
        root=root,
        contents=(content, *linked),
        folder=None if used else layer,
        problems=_problems(lost, path),
    )


def _main_file(bundle: Bundle, layer: str | None) -> tuple[str, bool]:
    """Return the file that is meant, and whether `layer` was needed to say so.

    A KMZ archive's own file is `doc.kml` at its top; others beside it are for network links.
    """
    names = bundle.with_suffix(".kml")
    main = [name for name in names if name.casefold() == _MAIN]
    meant = main or names
    # By its suffix a name can only be that of a file; without it, it may be a folder's.
    named = [name for name in names if layer in (name, PurePosixPath(name).name)]
    if len(named) == 1:
        return named[0], True
    if len(meant) == 1:
        return meant[0], False
    return one_of(bundle, names, layer, kind="KML"), True


def _graft(root: Element, name: str, bundle: Bundle, path: Path) -> tuple[list[bytes], int]:
    """Put linked files of the archive in place of their links; the rest is counted.

    One level and each file once, so that links in a circle come to an end.
    """
    contents: list[bytes] = []
    done, lost = {name}, 0
    elements = sum(1 for _ in root.iter())
    for parent, link in list(_links(root)):
        target = _target(link, name)
        if target in done:
            continue
        if target not in bundle.files:
            lost += 1
            continue
        done.add(target)
        contents.append(bundle.read(target))
        tree = parse_xml(contents[-1], path, name=target)
        elements += sum(1 for _ in tree.iter())
        if elements > MAX_ELEMENTS:
            raise map_error(
                path,
                f"its files have more than {MAX_ELEMENTS} elements",
                fix="export the map of one field alone",
                code="too-large",
            )
        lost += sum(1 for _ in _links(tree))
        parent[list(parent).index(link)] = tree
    return contents, lost


def _links(root: Element) -> Iterator[tuple[Element, Element]]:
    """Yield every network link and the element around it."""
    for parent in root.iter():
        for child in parent:
            if local_name(child) == "NetworkLink":
                yield parent, child


def _target(link: Element, name: str) -> str:
    """Return the name in the archive that a link leads to, as far as it leads there."""
    text = next(
        (
            (href.text or "").strip()
            for place in link
            if local_name(place) in ("Link", "Url")
            for href in place
            if local_name(href) == "href"
        ),
        "",
    )
    return (PurePosixPath(name).parent / unquote(text)).as_posix()


def _problems(count: int, path: Path) -> tuple[Problem, ...]:
    if not count:
        return ()
    problem = Problem(
        severity="warning",
        code="network-link",
        text=f"{count} links to other files or servers are not followed",
        where=str(path),
        fix="save what they show as a file of its own, if it belongs to the map",
    )
    return (problem,)


# KML (OGC 12-007r2) for maps on a screen: zones coloured by rate, rates in ExtendedData.

# From light yellow to dark green, red, green and blue: ever darker, so that it can be read in grey
# and by people who do not tell red from green.
_RAMP = (
    (255, 250, 190), (220, 238, 150), (172, 219, 128), (113, 193, 112),
    (55, 158, 88), (12, 117, 65), (0, 74, 42),
)  # fmt: skip
_NO_RATE = "none"
# 1e-12 degrees are a ten-thousandth of a millimetre.
_COORDINATE_DECIMALS = 12
_RATE_DECIMALS = 6
_HEAD = f"{KML_HEAD}<Document>\n<name>prescription</name>\n"
# A document in the document: a schema belongs to one (section 9.7), and GDAL looks for the schema
# of a layer in an archive nowhere else.
_ZONES_HEAD = """<Document>
<name>prescription</name>
<Schema name="prescription" id="prescription">
<SimpleField type="double" name="rate"></SimpleField>
<SimpleField type="string" name="unit"></SimpleField>
</Schema>
"""


def write_kml(
    zones: Sequence[MapZone], path: Path, *, boundary: MultiPolygon | None = None
) -> None:
    """Write zones with their rates in L/ha; a path that ends in `.kmz` gets the zipped form.

    The outline of the field goes into a folder "boundary". A zone without a rate has no element
    for it: many programs read an empty one as 0.
    """
    content = "".join(_document(zones, boundary)).encode()
    write_whole(path, zipped({"doc.kml": content}) if path.suffix.casefold() == ".kmz" else content)


def _document(zones: Sequence[MapZone], boundary: MultiPolygon | None) -> Iterator[str]:
    yield _HEAD
    yield from _styles()
    rates = [zone.rate_l_ha for zone in zones if zone.rate_l_ha is not None]
    least, most = min(rates, default=0.0), max(rates, default=0.0)
    yield _ZONES_HEAD
    for zone in zones:
        yield from _placemark(zone, _style(zone.rate_l_ha, least, most))
    yield "</Document>\n"
    if boundary is not None:
        yield f"<Folder>\n<name>{BOUNDARY_NAME}</name>\n<Placemark>\n<name>{BOUNDARY_NAME}</name>\n"
        yield f"<styleUrl>#{BOUNDARY_NAME}</styleUrl>\n"
        yield f"{_ground(boundary)}\n"
        yield "</Placemark>\n</Folder>\n"
    yield f"</Document>\n{KML_TAIL}"


def _styles() -> Iterator[str]:
    """Yield a style for every colour of the ramp."""
    for index, colour in enumerate(_RAMP):
        yield _shape_style(f"rate{index}", f"<color>{kml_colour(colour, opacity='c0')}</color>")
    yield _shape_style(_NO_RATE, "<color>40808080</color>")
    yield _shape_style(BOUNDARY_NAME, "<fill>0</fill>")


def _shape_style(name: str, fill: str) -> str:
    return (
        f'<Style id="{name}">\n<LineStyle><color>ff404040</color><width>1</width></LineStyle>\n'
        f"<PolyStyle>{fill}</PolyStyle>\n</Style>\n"
    )


def _style(rate_l_ha: float | None, least: float, most: float) -> str:
    if rate_l_ha is None:
        return _NO_RATE
    share = (rate_l_ha - least) / (most - least) if most > least else 0.5
    return f"rate{round(share * (len(_RAMP) - 1))}"


def _placemark(zone: MapZone, style: str) -> Iterator[str]:
    yield f"<Placemark>\n<name>{kml_text(zone.name)}</name>\n"
    yield f"<styleUrl>#{style}</styleUrl>\n"
    yield '<ExtendedData><SchemaData schemaUrl="#prescription">\n'
    if zone.rate_l_ha is not None:
        rate = _decimal(zone.rate_l_ha, _RATE_DECIMALS)
        yield f'<SimpleData name="rate">{rate}</SimpleData>\n'
    yield '<SimpleData name="unit">L/ha</SimpleData>\n</SchemaData></ExtendedData>\n'
    yield f"{_ground(zone.geometry)}\n"
    yield "</Placemark>\n"


def _ground(area: Polygon | MultiPolygon) -> str:
    return kml_ground(area, decimals=_COORDINATE_DECIMALS)


def _decimal(value: float, decimals: int) -> str:
    """Return a number without exponent and without idle zeros.

    >>> _decimal(12.50, 6), _decimal(100.0, 6), _decimal(1e-5, 6)
    ('12.5', '100', '0.00001')
    """
    return f"{value:.{decimals}f}".rstrip("0").rstrip(".")
