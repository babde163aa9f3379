"""GeoParquet 1.0 and 1.1: polygons as well-known binary in one column, attributes in the others.

Coordinates are x before y, whatever the CRS says; without a CRS they are longitude and latitude
(GeoParquet 1.1.0, "crs" and "Coordinate axis order").
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from pyproj import CRS

from missions.maps.adapt.catalogue import Operation, Variable, described_beside
from missions.maps.adapt.parquet_file import EXPORT_AGAIN, Table, read_table
from missions.maps.bundle import Bundle, files_beside, open_bundle
from missions.maps.crs import WGS84, parse_crs
from missions.maps.geopackage.wkb import CurvedError, Found, areas_of, polygons_in
from missions.maps.layer import Column, Layer, check_counts, digest
from missions.maps.local import Area
from missions.maps.model import map_error
from missions.maps.one_of import one_of

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
        crs=_crs(about, path),
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
    try:
        found = json.loads(text)
        if not isinstance(found, dict):
            raise ValueError("it is no object")
    except (ValueError, RecursionError) as error:
        raise map_error(
            path,
            f"its GeoParquet description is not readable ({str(error)[:80]})",
            fix=EXPORT_AGAIN,
            code="truncated",
        ) from None
    return found


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
