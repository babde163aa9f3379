"""The ADAPT Standard: a catalogue beside a GeoTIFF, or beside GeoParquet, which is read here.

The standard fixes the unit by the code of a variable: `AppliedVolumePerArea…` is L/ha, `…Mass…`
kg/ha, `…Count…` a count per ha (ADAPT Standard, adapt-data-type-definitions.json, versions 1.0.0
to 2.0.2). Codes of a program's own are defined in the file itself.

Coordinates are x before y, whatever the CRS says; without a CRS they are longitude and latitude
(GeoParquet 1.1.0, "crs" and "Coordinate axis order").
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pyproj import CRS

from companion.errors import MapError
from companion.wording import lack_of
from missions.maps.bundle import Bundle, files_beside, one_of, open_bundle
from missions.maps.crs import WGS84, parse_crs, stated
from missions.maps.geopackage_layers import CurvedError, Found, areas_of, polygons_in
from missions.maps.local import Area
from missions.maps.model import Column, Layer, Value, check_counts, digest, map_error, read_bytes
from missions.maps.units import rate_unit

# --------------------------------------------------------------------------------------- adapt.json

NAME = "adapt.json"
_MAX_BYTES = 16 * 1024 * 1024
_MAX_VARIABLES = 1_000
# What is to be done. Work records hold what was done: no map to spray by.
_DOCUMENTS = ("workOrders", "recommendations", "plans")
_RATE = re.compile(r"applied(volume|mass|count)perarea(target|actual|control)", re.IGNORECASE)
_UNITS = {"volume": "L/ha", "mass": "kg/ha", "count": "count/ha"}
EXPORT_AGAIN = "copy it again, or export the map again"

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
    return _object(content, path, f"this is not a readable {NAME}")


def _object(text: bytes, path: Path, refusal: str) -> Json:
    """Return a JSON object; what is none is refused in these words, and why."""
    try:
        found = json.loads(text.decode("utf-8-sig"))
        if not isinstance(found, dict):
            raise ValueError("it is not an object")
    except (ValueError, RecursionError) as error:
        raise map_error(
            path, f"{refusal} ({str(error)[:120]})", fix=EXPORT_AGAIN, code="truncated"
        ) from None
    return found


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
            fix=EXPORT_AGAIN,
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

    What is not a number, or beyond all, becomes NaN, which nobody takes for a rate.
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


# --------------------------------------------------------------------------------------- GeoParquet

SUFFIXES = (".parquet", ".geoparquet")


def read_geoparquet(path: Path, layer: str | None = None) -> Layer:
    """Return what a GeoParquet file holds: the file, or one in a folder or a zip."""
    if path.is_dir() or path.suffix.casefold() == ".zip":
        bundle = open_bundle(path)
        name = one_of(bundle, bundle.with_suffix(*SUFFIXES), layer, kind="GeoParquet")
        return layer_of_parquet(bundle, name)
    found = described_beside(path, layer)
    if found is not None:
        operation, content = found
        also = {"adapt.json": content}
        return layer_of_parquet(files_beside(path), path.name, operation=operation, also=also)
    if layer not in (None, path.stem):
        raise map_error(
            path, f"it is not the layer {layer!r}", fix="leave out --layer", code="no-layer"
        )
    return layer_of_parquet(files_beside(path), path.name)


def layer_of_parquet(
    bundle: Bundle,
    name: str,
    *,
    operation: Operation | None = None,
    also: dict[str, bytes] | None = None,
) -> Layer:
    """Return the GeoParquet file `name` of a bundle; `also` are files that others have read."""
    path = bundle.path / name
    content = bundle.read(name)
    table = read_table(content, path, geometry_of=lambda text: _primary(_geo(text, path), path)[0])
    _, about = _primary(_geo(table.geo, path), path)
    areas, skipped = _ground(table, path)
    columns = table.columns if operation is None else _described(table, operation, path)
    files = {**(also or {}), name: content}
    return Layer(
        format="geoparquet" if operation is None else "adapt",
        crs=stated(_crs, about, path),
        columns=columns,
        geometries=tuple(areas),
        sha256=digest(files[one] for one in sorted(files)),
        skipped=skipped,
    )


def _geo(text: bytes | None, path: Path) -> dict[str, Any]:
    """Return the file's own description of its geometry."""
    if text is None:
        raise map_error(
            path,
            "this is Parquet without geometry (it has no GeoParquet description)",
            fix="export the map as GeoParquet",
            code="no-polygon",
        )
    return _object(text, path, "its GeoParquet description is not readable")


def _primary(geo: dict[str, Any], path: Path) -> tuple[str, dict[str, Any]]:
    """Return the name of the geometry, and what the file says of it."""
    name, columns = geo.get("primary_column"), geo.get("columns")
    about = columns.get(name) if isinstance(columns, dict) and isinstance(name, str) else None
    if not isinstance(name, str) or not isinstance(about, dict):
        raise map_error(
            path,
            "its GeoParquet description does not say which column is the geometry",
            fix=EXPORT_AGAIN,
            code="truncated",
        )
    if str(about.get("encoding")).upper() != "WKB":
        raise map_error(
            path,
            f"its geometry is stored as {str(about.get('encoding'))[:20]!r}",
            fix="export it with the geometry as WKB",
            code="unknown-format",
        )
    return name, about


def _crs(about: dict[str, Any], path: Path) -> CRS | None:
    """Return the CRS; absent is longitude and latitude, null is not known."""
    if "crs" not in about:
        return WGS84
    if about["crs"] is None:
        return None
    return parse_crs(json.dumps(about["crs"]), path=path, source="the crs of its geometry")


def _ground(table: Table, path: Path) -> tuple[list[Area | None], dict[int, str]]:
    """Return every record's ground, and why it has none.

    A geometry that several records share is read once, and counted for each.
    """
    known: dict[bytes, Found] = {}
    found: list[Found | None] = []
    vertices = 0
    for index, blob in enumerate(table.geometry):
        one = None
        if blob is not None:
            one = known[blob] if blob in known else _found(blob, index, path)
            known[blob] = one
            vertices += one.vertex_count
            check_counts(path, records=index, vertices=vertices)
        found.append(one)
    reasons = ["null-geometry" if one is None else one.reason for one in found]
    try:
        areas = areas_of([[] if one is None else one.polygons for one in found])
    except ValueError as error:
        raise map_error(
            path, f"a geometry is broken ({str(error)[:120]})", fix=EXPORT_AGAIN,
            code="broken-geometry",
        ) from None  # fmt: skip
    return areas, {index: reason for index, reason in enumerate(reasons) if reason}


def _found(blob: bytes, index: int, path: Path) -> Found:
    try:
        return polygons_in(blob)
    except CurvedError as error:
        raise map_error(
            path,
            f"record {index + 1} has round edges ({error})",
            fix="turn curves into straight edges (in QGIS: Convert to straight segments)",
            code="curved-geometry",
        ) from None
    except ValueError as error:
        raise map_error(
            path,
            f"the geometry of record {index + 1} is broken ({str(error)[:120]})",
            fix=EXPORT_AGAIN,
            code="broken-geometry",
        ) from None


def _described(table: Table, operation: Operation, path: Path) -> tuple[Column, ...]:
    """Return the columns with the names, units and products of the description."""
    columns = {column.name: column for column in table.columns}
    for variable in operation.variables:
        stored = _stored_name(variable, table)
        column = columns.get(stored) if stored is not None else None
        if column is None or stored is None:
            raise map_error(
                path,
                f"its adapt.json names the column {str(variable.column or variable.index)[:60]!r}, "
                "which is not there",
                fix="copy the files again, or export the map again",
                code="wrong-description",
            )
        columns[stored] = replace(
            column,
            name=variable.name,
            unit=variable.unit,
            is_rate=variable.is_rate,
            default=variable.default,
        )
    return tuple(columns.values())


def _stored_name(variable: Variable, table: Table) -> str | None:
    if variable.column is not None or variable.index is None:
        return variable.column
    inside = 1 <= variable.index <= len(table.names)
    return table.names[variable.index - 1] if inside else None


# The bytes of a Parquet file, taken apart by pyarrow within bounds.
#
# Text and geometry stay in dictionaries while they are read: a file of a few kilobytes can repeat
# one long value a million times.

_COLUMNS_MAX = 255  # as many as a shapefile can have
# A million records of ten columns, or 40 000 of 250.
_CELLS_MAX = 10_000_000
_ROW_GROUPS_MAX = 10_000
_UNPACKED_MAX_BYTES = 512 * 1024 * 1024


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """The flat columns of a file; `names` are those of all, in the order of the file."""

    columns: tuple[Column, ...]
    geometry: tuple[bytes | None, ...]
    geo: bytes | None
    names: tuple[str, ...]


def read_table(content: bytes, path: Path, *, geometry_of: Callable[[bytes | None], str]) -> Table:
    """Return the columns of a Parquet file; `geometry_of` finds the geometry by its description."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        text, fix = lack_of("pyarrow")
        raise map_error(path, text, fix=fix, code="missing-library") from None
    broken = (
        pyarrow.ArrowException, OSError, ValueError, TypeError, KeyError, OverflowError,
        MemoryError, NotImplementedError,
    )  # fmt: skip
    try:
        return _table(pyarrow, content, path, geometry_of)
    except MapError:
        raise
    except broken as error:
        reason = " ".join(str(error).split())[:120]
        raise map_error(
            path,
            f"the Parquet file is cut short or damaged ({reason})",
            fix=EXPORT_AGAIN,
            code="truncated",
        ) from None


def _table(
    pyarrow: Any, content: bytes, path: Path, geometry_of: Callable[[bytes | None], str]
) -> Table:
    buffer = pyarrow.BufferReader(content)
    about = pyarrow.parquet.read_metadata(buffer)
    _check_size(about, path)
    geo = (about.metadata or {}).get(b"geo")
    geometry_name = geometry_of(geo)
    buffer.seek(0)
    # Kinds by the file's own schema: what is text or bytes there is read as a dictionary.
    kinds = pyarrow.parquet.ParquetFile(buffer, metadata=about).schema_arrow
    texts = [field.name for field in kinds if _is_text(pyarrow, field.type)]
    buffer.seek(0)
    file = pyarrow.parquet.ParquetFile(
        buffer, metadata=about, read_dictionary=texts, pre_buffer=False
    )
    names = [field.name for field in kinds if _is_flat(pyarrow, field.type)]
    _check_names(names, geometry_name, path)
    read = file.read(columns=names, use_threads=False)
    columns = []
    geometry: tuple[bytes | None, ...] = ()
    for name, chunks in zip(read.column_names, read.columns, strict=True):
        if name == geometry_name:
            geometry = tuple(_blobs(pyarrow, chunks))
        elif not pyarrow.types.is_binary(_plain(pyarrow, chunks.type)):
            columns.append(_column(pyarrow, name, chunks))
    return Table(columns=tuple(columns), geometry=geometry, geo=geo, names=tuple(kinds.names))


def _check_size(about: Any, path: Path) -> None:
    """Refuse what would take the vehicle's memory; the end of the file says it all."""
    check_counts(path, records=about.num_rows, vertices=0)
    groups = about.num_row_groups
    unpacked = 0
    if groups <= _ROW_GROUPS_MAX:
        unpacked = sum(about.row_group(index).total_byte_size for index in range(groups))
    for count, limit, of in (
        (about.num_columns, _COLUMNS_MAX, "columns"),
        (about.num_columns * about.num_rows, _CELLS_MAX, "values"),
        (groups, _ROW_GROUPS_MAX, "row groups"),
        (unpacked, _UNPACKED_MAX_BYTES, "bytes unpacked"),
    ):
        if not 0 <= count <= limit:
            raise map_error(
                path,
                f"its {count} {of} are more than {limit}",
                fix="keep the rate and its unit, and cut the map to one field",
                code="too-large",
            )


def _check_names(names: list[str], geometry: str, path: Path) -> None:
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise map_error(
            path,
            f"it has the column {twice[:60]!r} twice",
            fix=EXPORT_AGAIN,
            code="several-columns",
        )
    if geometry not in names:
        raise map_error(
            path,
            f"its geometry column {geometry[:60]!r} is missing",
            fix=EXPORT_AGAIN,
            code="truncated",
        )


def _plain(pyarrow: Any, kind: Any) -> Any:
    """Return the type of the values, in a dictionary or not, large or not."""
    kind = kind.value_type if pyarrow.types.is_dictionary(kind) else kind
    return pyarrow.binary() if pyarrow.types.is_large_binary(kind) else kind


def _is_text(pyarrow: Any, kind: Any) -> bool:
    types, kind = pyarrow.types, _plain(pyarrow, kind)
    return bool(types.is_string(kind) or types.is_large_string(kind) or types.is_binary(kind))


def _is_number(pyarrow: Any, kind: Any) -> bool:
    types, kind = pyarrow.types, _plain(pyarrow, kind)
    return bool(types.is_integer(kind) or types.is_floating(kind) or types.is_decimal(kind))


def _is_flat(pyarrow: Any, kind: Any) -> bool:
    return _is_text(pyarrow, kind) or _is_number(pyarrow, kind)


def _column(pyarrow: Any, name: str, chunks: Any) -> Column:
    numeric = _is_number(pyarrow, chunks.type)
    if not numeric:
        texts: list[Value] = list(_values(pyarrow, chunks))
        return Column(name=name, values=tuple(texts), numeric=False)
    if pyarrow.types.is_dictionary(chunks.type):
        chunks = chunks.cast(chunks.type.value_type)
    numbers = chunks.cast(pyarrow.float64(), safe=False).to_pylist()
    values = tuple(None if one is None or math.isnan(one) else one for one in numbers)
    return Column(name=name, values=values, numeric=True)


def _blobs(pyarrow: Any, chunks: Any) -> Iterator[bytes | None]:
    for blob in _values(pyarrow, chunks):
        if not (blob is None or isinstance(blob, bytes)):
            raise ValueError("its geometry is text")
        yield blob


def _values(pyarrow: Any, chunks: Any) -> Iterator[Any]:
    """Yield the values one after the other, each as one object however often it stands there."""
    for chunk in chunks.chunks:
        if not pyarrow.types.is_dictionary(chunk.type):
            yield from chunk.to_pylist()
            continue
        values = chunk.dictionary.to_pylist()
        for index in chunk.indices.to_pylist():
            yield None if index is None else values[index]
