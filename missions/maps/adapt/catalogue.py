"""`adapt.json` of the ADAPT Standard: which band or column of which file is the rate of what.

The standard fixes the unit by the code of a variable: `AppliedVolumePerArea…` is L/ha, `…Mass…`
kg/ha, `…Count…` a count per ha (ADAPT Standard, adapt-data-type-definitions.json, versions 1.0.0
to 2.0.2). Codes of a program's own are defined in the file itself.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from missions.maps.layer import read_bytes
from missions.maps.model import map_error
from missions.maps.units import rate_unit

NAME = "adapt.json"
_MAX_BYTES = 16 * 1024 * 1024
_MAX_VARIABLES = 1_000
# What is to be done. Work records hold what was done: no map to spray by.
_DOCUMENTS = ("workOrders", "recommendations", "plans")
_RATE = re.compile(r"applied(volume|mass|count)perarea(target|actual|control)", re.IGNORECASE)
_UNITS = {"volume": "L/ha", "mass": "kg/ha", "count": "count/ha"}
_EXPORT_AGAIN = "copy it again, or export the map again"

Json = dict[str, object]


@dataclass(frozen=True, slots=True, kw_only=True)
class Variable:
    """One quantity: in band `index` of a raster, in `column` or column `index` of a table."""

    name: str
    unit: str | None
    is_rate: bool
    index: int | None
    column: str | None
    default: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Operation:
    """One pass over a field, and the file that holds its map."""

    name: str
    file: str
    variables: tuple[Variable, ...]


def operations_in(content: bytes, path: Path) -> list[Operation]:
    """Return the operations that have a map, in the order of the file."""
    root = _parsed(content, path)
    catalog, documents = _member(root, "catalog"), _member(root, "documents")
    products = {
        str(_member(product, "id").get("referenceId")): _text(product.get("name"))
        for product in _items(catalog, "products")
    }
    units = _own_units(catalog)
    operations = []
    for kind in _DOCUMENTS:
        for document in _items(documents, kind):
            for operation in _items(document, "operations"):
                file = operation.get("spatialRecordsFile")
                if isinstance(file, str) and file:
                    name = _text(operation.get("name")) or _text(file)
                    variables = _variables(operation, products, units, path)
                    operations.append(Operation(name=name, file=file, variables=variables))
    return operations


def described_beside(path: Path, layer: str | None) -> tuple[Operation, bytes] | None:
    """Return what an `adapt.json` in the same folder says of a file, and that file's bytes."""
    try:
        beside = sorted(path.parent.iterdir())
    except OSError:
        return None  # the map itself will not be found either
    found = next((one for one in beside if one.name.casefold() == NAME and one.is_file()), None)
    if found is None:
        return None
    content = read_bytes(found)
    named = [
        operation
        for operation in operations_in(content, found)
        if operation.file.casefold() == path.name.casefold()
    ]
    meant = chosen(named, layer, path) if named else None
    return (meant, content) if meant is not None else None


def chosen(operations: list[Operation], layer: str | None, path: Path) -> Operation:
    """Return the operation that is meant: the only one, or the one asked for."""
    meant = [
        one
        for one in operations
        if layer is None or layer in (one.name, one.file, Path(one.file).stem)
    ]
    if len(meant) == 1:
        return meant[0]
    names = ", ".join(dict.fromkeys(f"{one.name} ({one.file})" for one in operations[:8]))
    raise map_error(
        path,
        f"it holds the operations {names}" + ("" if meant else f", and no {layer!r}"),
        fix="name one of them, or its file, with --layer",
        code="several-layers" if meant else "no-layer",
    )


def _parsed(content: bytes, path: Path) -> Json:
    if len(content) > _MAX_BYTES:
        raise map_error(
            path,
            f"the description has {len(content) // 1024**2} MB",
            fix="export the map of one field alone",
            code="too-large",
        )
    try:
        root = json.loads(content.decode("utf-8-sig"))
        if not isinstance(root, dict):
            raise ValueError("it is no object")
    except (ValueError, RecursionError) as error:
        raise map_error(
            path,
            f"this is no readable {NAME} ({str(error)[:120]})",
            fix=_EXPORT_AGAIN,
            code="truncated",
        ) from None
    return root


def _member(parent: Json, key: str) -> Json:
    value = parent.get(key)
    return value if isinstance(value, dict) else {}


def _items(parent: Json, key: str) -> list[Json]:
    value = parent.get(key)
    return [one for one in value if isinstance(one, dict)] if isinstance(value, list) else []


def _text(value: object) -> str:
    return " ".join(value.split())[:60] if isinstance(value, str) else ""


def _own_units(catalog: Json) -> dict[str, str]:
    """Return the units of the codes that the file defines itself."""
    units = {}
    for one in _items(catalog, "customDataTypeDefinitions"):
        unit = _member(one, "numericDataTypeDefinitionAttributes").get("unitOfMeasureCode")
        if isinstance(unit, str) and unit.strip():
            units[str(one.get("definitionCode")).casefold()] = unit.strip()[:40]
    return units


def _variables(
    operation: Json, products: dict[str, str], units: dict[str, str], path: Path
) -> tuple[Variable, ...]:
    listed = _items(operation, "variables")
    if len(listed) > _MAX_VARIABLES:
        raise map_error(
            path, f"an operation has {len(listed)} variables", fix="export the map alone",
            code="too-large",
        )  # fmt: skip
    found = [(_variable(one, products, units), str(one.get("definitionCode"))) for one in listed]
    stored = [(one, code) for one, code in found if one.index is not None or one.column is not None]
    places = Counter((one.index, one.column) for one, _ in stored)
    twice = next((place for place, count in places.items() if count > 1), None)
    if twice is not None:
        raise map_error(
            path,
            f"it puts two variables in the same place, {twice[1] or f'band {twice[0]}'}",
            fix=_EXPORT_AGAIN,
            code="duplicate-code",
        )
    return _told_apart(stored)


def _variable(one: Json, products: dict[str, str], units: dict[str, str]) -> Variable:
    code = str(one.get("definitionCode")).casefold()
    product = products.get(str(one.get("productId"))) if "productId" in one else None
    match = _RATE.fullmatch(code)
    unit = _UNITS[match[1].casefold()] if match else units.get(code)
    of_product = "productId" in one and unit is not None and rate_unit(unit) is not None
    # Version 1.0.0 has one index for both, 2.0.0 an index of bands and a name of columns.
    index = one.get("geoTIFFBandIndex", one.get("fileDataIndex"))
    column, default = one.get("geoParquetColumnName"), one.get("defaultRate")
    return Variable(
        name=product or _text(one.get("name")) or "variable",
        unit=unit,
        is_rate=match is not None or of_product,
        index=index if isinstance(index, int) and not isinstance(index, bool) else None,
        column=column if isinstance(column, str) else None,
        default=_number(default),
    )


def _number(value: object) -> float | None:
    """Return a rate that is a number, None for what is not there.

    What is no number, or beyond all, becomes NaN, which nobody takes for a rate.
    """
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e12:
        return float("nan")
    return float(value)


def _told_apart(found: Iterable[tuple[Variable, str]]) -> tuple[Variable, ...]:
    """Return the variables by names that differ: a product may have several of one pass."""
    pairs = list(found)
    names = Counter(one.name for one, _ in pairs)
    named = [
        one if names[one.name] == 1 else replace(one, name=f"{one.name} ({code})")
        for one, code in pairs
    ]
    again = Counter(one.name for one in named)
    return tuple(
        one if again[one.name] == 1 else replace(one, name=f"{one.name} {number}")
        for number, one in enumerate(named, start=1)
    )
