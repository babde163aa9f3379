"""Which layers a GeoPackage has, and which one is the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from missions.maps.attributes import column_of
from missions.maps.geopackage.sqlite import Cell, Database, not_a_table, quoted
from missions.maps.layer import Value, check_counts
from missions.maps.model import map_error
from missions.maps.outline import BOUNDARY_NAME

# Declared types that can hold no polygon; GEOMETRY and the others can.
_NO_GROUND = frozenset({"POINT", "MULTIPOINT", "LINESTRING", "MULTILINESTRING"})
_NUMERIC = frozenset(
    {
        "TINYINT", "SMALLINT", "MEDIUMINT", "INT", "INTEGER", "BIGINT", "FLOAT", "DOUBLE",
        "DOUBLE PRECISION", "REAL", "NUMERIC", "DECIMAL",
    }
)  # fmt: skip
_LAYERS_MAX = 200
_COLUMNS_MAX = 255  # as many as a shapefile can have
# A million records of ten columns, or 40 000 of 250.
_CELLS_MAX = 10_000_000
_EXPORT_AGAIN = "export the map again"


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerTable:
    """A layer as the GeoPackage's own tables describe it; `columns` without the geometry."""

    name: str
    geometry: str
    kind: str
    srs_id: int
    is_view: bool
    columns: tuple[tuple[str, str, bool], ...] = ()


def layers_of(database: Database) -> list[LayerTable]:
    """Return the layers of polygons that the GeoPackage lists, views among them."""
    path = database.path
    for needed in ("gpkg_contents", "gpkg_geometry_columns", "gpkg_spatial_ref_sys"):
        if needed in database.tables:
            database.check(needed)
        elif needed == "gpkg_contents":
            raise map_error(
                path,
                "this is an SQLite database, but no GeoPackage",
                fix=_EXPORT_AGAIN,
                code="unknown-format",
            )
    listed = [
        str(name)
        for name, kind in database.rows("SELECT table_name, data_type FROM gpkg_contents")
        if str(kind).casefold() == "features"
    ]
    if not listed or "gpkg_geometry_columns" not in database.tables:
        raise map_error(
            path,
            "the GeoPackage holds no layer of polygons (pictures and plain tables at most)",
            fix="export the zones as polygons",
            code="no-polygon",
        )
    if len(listed) > _LAYERS_MAX:
        raise map_error(
            path,
            f"{len(listed)} layers are more than {_LAYERS_MAX}",
            fix="export the map alone",
            code="too-large",
        )
    return [_described(database, name) for name in listed]


def _described(database: Database, name: str) -> LayerTable:
    found = [
        (str(geometry), str(kind).upper(), srs_id if isinstance(srs_id, int) else None)
        for table, geometry, kind, srs_id in database.rows(
            "SELECT table_name, column_name, geometry_type_name, srs_id FROM gpkg_geometry_columns"
        )
        if str(table).casefold() == name.casefold()
    ]
    geometry, kind, srs_id = found[0] if len(found) == 1 else ("", "", None)
    if srs_id is None:
        raise _damaged(database, f"it does not say where the geometry of the layer {name} is")
    real = database.tables.get(name.casefold())
    table = LayerTable(
        name=real or name, geometry=geometry, kind=kind, srs_id=srs_id, is_view=real is None
    )
    if real is None:
        return table
    columns = database.columns(real)
    if len(columns) > _COLUMNS_MAX:
        raise map_error(
            database.path,
            f"{len(columns)} columns of the layer {real} are more than {_COLUMNS_MAX}",
            fix="keep the rate and its unit",
            code="too-large",
        )
    own = next((one for one, _, _ in columns if one.casefold() == geometry.casefold()), None)
    if own is None:
        raise _damaged(database, f"the layer {real} has no column {geometry}")
    rest = tuple(column for column in columns if column[0] != own)
    return replace(table, geometry=own, columns=rest)


def chosen_layer(database: Database, tables: Sequence[LayerTable], layer: str | None) -> LayerTable:
    """Return the layer that is meant: asked for, the only one, or the only one with numbers."""
    if layer is not None:
        candidates = [one for one in tables if one.name.casefold() == layer.casefold()]
    else:
        candidates = [one for one in tables if one.kind not in _NO_GROUND] or list(tables)
        if len(candidates) > 1:
            candidates = [one for one in candidates if _may_hold_rates(database, one)] or candidates
    if len(candidates) != 1:
        names = ", ".join(one.name for one in (candidates or tables)[:20])
        raise map_error(
            database.path,
            f"there is no layer {layer!r}; the layers are {names}"
            if layer is not None
            else f"it holds several layers: {names}",
            fix="name one of them with --layer",
            code="several-layers" if layer is None else "no-layer",
        )
    if candidates[0].is_view:
        raise not_a_table(
            database.path,
            f"the layer {candidates[0].name} is a view or missing, not a table of its own",
        )
    return candidates[0]


def _may_hold_rates(database: Database, table: LayerTable) -> bool:
    """Tell whether a layer has numbers beside its key; of a view nobody knows."""
    if table.is_view or any(is_numeric(kind) and not key for _, kind, key in table.columns):
        return True
    return any(
        column_of(name, values).numeric
        for name, kind, key in table.columns
        if not key and kind.upper() != "BOOLEAN"
        for values in [_column_values(database, table, name)]
    )


def _column_values(database: Database, table: LayerTable, name: str) -> list[Value]:
    check_size(database, table)
    sql = f"SELECT {quoted(name)} FROM {quoted(table.name)}"
    return [value_of(cell, "") for (cell,) in database.rows(sql)]


def is_numeric(kind: str) -> bool:
    """Tell whether a declared type is one of numbers.

    >>> is_numeric("double"), is_numeric("DECIMAL(8, 2)"), is_numeric("TEXT(20)")
    (True, True, False)
    """
    return kind.split("(")[0].strip().upper() in _NUMERIC


def value_of(cell: Cell, kind: str) -> Value:
    """Return a cell of a column of the declared type `kind`; true and false are no numbers."""
    if cell is None or isinstance(cell, str):
        return cell
    if isinstance(cell, bytes):
        return "(blob)"
    if kind.upper() == "BOOLEAN":
        return "true" if cell else "false"
    return float(cell)


def is_outline(database: Database, table: LayerTable, chosen: LayerTable) -> bool:
    """Tell whether a layer is the outline of the field: called so, and without numbers."""
    return (
        table is not chosen
        and not table.is_view
        and table.name.casefold() == BOUNDARY_NAME
        and not _may_hold_rates(database, table)
    )


def check_size(database: Database, table: LayerTable) -> None:
    """Refuse a damaged table, and one that would take the vehicle's memory."""
    database.check(table.name)
    sql = f"SELECT count(*) FROM {quoted(table.name)}"
    count = int(next(database.rows(sql))[0] or 0)
    check_counts(database.path, records=count, vertices=0)
    if count * (len(table.columns) + 1) > _CELLS_MAX:
        raise map_error(
            database.path,
            f"{count} records of {len(table.columns)} columns are too many",
            fix="keep the rate and its unit",
            code="too-large",
        )


def _damaged(database: Database, text: str) -> Exception:
    return map_error(database.path, text, fix=_EXPORT_AGAIN, code="truncated")
