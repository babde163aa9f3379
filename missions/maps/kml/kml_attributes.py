"""What KML placemarks say in ExtendedData, as columns.

Three forms (OGC 12-007r2, section 9.4): `Data` with a name and a value, `SchemaData` with fields
whose types a `Schema` declares, and elements of other namespaces. All of it is text.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element

from missions.maps.attributes import column_of, stated_unit
from missions.maps.kml.geometry import local_name
from missions.maps.layer import Column
from missions.maps.model import map_error

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
