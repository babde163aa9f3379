"""What can still be read of a damaged journal, row by row, into a new file beside it."""

from __future__ import annotations

import os
import re
import sqlite3
from collections import Counter
from collections.abc import Container, Iterable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

from analysis.journals.stray_rows import KeptPages, kept_pages, stray_rows, torn_rows
from companion.atomic_write import sync_folder
from companion.core.frame import LocalFrame
from companion.journal import folder as journal_folder
from companion.journal.folder import Recovery, Told
from companion.journal.geopackage import (
    APPLICATION_ID,
    JOURNAL_VERSION,
    LOCAL_ID,
    USER_VERSION,
    WGS84_ID,
    box_of_points,
    set_box,
)
from companion.journal.leaf_page import COLUMNS, Row, is_of
from companion.journal.read_only import (
    DAMAGE,
    TABLES,
    check_beside,
    columns_of,
    empty_tables,
    known_tables,
    one_line,
    own_tables,
    read_only,
    salvaged_name,
)
from companion.journal.reader import missing_tables, readable_rows, tolerate_damage
from companion.journal.writer import LITRES_KEY, SET_META, applied_l

# Without a row of any of these a file is not a journal, or nothing of one.
_OF_A_FLIGHT = ("meta", "applied", "blocks", "valve_changes")
_TELL_VERSION = "INSERT OR IGNORE INTO meta (key, value) VALUES ('journal_version', ?)"
_NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")
_KINDS = frozenset(
    {"BLOB", "DATETIME", "DOUBLE", "GEOMETRY", "INTEGER", "POINT", "TEXT", "TINYINT"}
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Salvaged:
    """How many rows were copied; which tables are not whole.

    `stray` says of each table how many of these rows came from pages that nothing leads to.
    """

    rows: int
    lost_tables: tuple[str, ...]
    stray: Mapping[str, int]


def salvage(path: Path) -> Salvaged:
    """Copy all rows that can be read.

    What went wrong otherwise is a `sqlite3.Error`, a ValueError or an OSError: then there is no
    copy.
    """
    check_beside(path)
    target = salvaged_name(path)
    draft = target.with_name(f".new-{os.getpid()}-salvaged.gpkg")
    draft.unlink(missing_ok=True)
    try:
        with (
            kept_pages(path) as pages,
            read_only(path, timeout_s=0.0) as source,
            closing(sqlite3.connect(draft, isolation_level=None)) as copy,
        ):
            found = _copy_all(source, pages, copy)
        with draft.open("rb") as file:
            os.fsync(file.fileno())
        draft.rename(target)
        sync_folder(path.parent)
        return found
    finally:
        draft.unlink(missing_ok=True)


def _copy_all(source: sqlite3.Connection, pages: KeptPages, copy: sqlite3.Connection) -> Salvaged:
    tolerate_damage(source)
    source.text_factory = _text
    tables = _tables(source)
    copy.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    copy.execute(f"PRAGMA user_version = {USER_VERSION}")
    copy.execute("BEGIN")
    rows: Counter[str] = Counter()
    lost, torn = [], torn_rows(pages)
    for name in tables:
        try:
            _make(copy, name, _columns(source, name))
            copied, is_whole = _copy(source, copy, name, torn)
        except (sqlite3.Error, ValueError):  # a name, or a list of columns, that is none
            copied, is_whole = 0, False
        rows[name] = copied
        if not is_whole:
            lost.append(name)
    # Of tables too that could be read to their ends: a tree may lead past a page without notice.
    stray = _copy_strays(pages, copy, tables)
    lost += [name for name in stray if name not in lost]
    if not any((rows + stray)[name] for name in _OF_A_FLIGHT):
        raise ValueError("no row of a flight is left")
    if "records" not in tables:
        copy.execute(_TELL_VERSION, (JOURNAL_VERSION,))
    if "applied" in lost:
        tell_litres_again(copy)
    if {"applied", "gpkg_contents", "gpkg_geometry_columns"} & set(lost):
        register_again(copy)
    copy.execute(SET_META, ("closed", "salvaged"))
    copy.execute("COMMIT")
    return Salvaged(rows=(rows + stray).total(), lost_tables=tuple(lost), stray=stray)


def _tables(source: sqlite3.Connection) -> list[str]:
    """Return the tables of a journal: by the file's list, and by what it must have said.

    What is in it besides, such as a map viewer's styles, is not for a journal's copy.
    """
    found: list[str] = []
    is_whole = False
    try:
        for name, _ in source.execute(TABLES):
            if name in known_tables():
                found.append(name)
        is_whole = not missing_tables("1" if "records" in found else "2", found)
    except (sqlite3.DatabaseError, ValueError):
        pass
    return found if is_whole else [*own_tables(), *(set(found) - own_tables().keys())]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Column:
    name: str
    kind: str
    is_key: bool


def _columns(source: sqlite3.Connection, table: str) -> tuple[_Column, ...]:
    """Return the columns of a table as the file has them; none where that is damaged."""
    try:
        rows = source.execute(f'PRAGMA table_xinfo("{table}")').fetchall()
    except sqlite3.DatabaseError:
        return ()
    if any(row[6] for row in rows):
        raise ValueError(f"{table} has computed columns")
    return tuple(_Column(name=row[1], kind=row[2].upper(), is_key=bool(row[5])) for row in rows)


def _make(copy: sqlite3.Connection, table: str, columns: Sequence[_Column]) -> None:
    """Make a table as it is today, or with the columns that an older journal has.

    By a statement of our own in any case: the file's text is nobody's.
    """
    own_sql, own_names = own_tables().get(table, (None, ()))
    names = tuple(column.name for column in columns)
    is_older = bool(names) and len(names) != len(own_names) and all(map(_is_sound, columns))
    if own_sql is not None and not is_older:
        copy.execute(own_sql)
        return
    if not is_older:
        raise ValueError(f"{table} has no columns that a journal has")
    parts = [f'"{column.name}" {column.kind}' for column in columns]
    keys = ", ".join(f'"{column.name}"' for column in columns if column.is_key)
    parts += [f"PRIMARY KEY ({keys})"] if keys else []
    parts += ["UNIQUE (key)"] if table == "meta" and "key" in names else []
    copy.execute(f'CREATE TABLE "{table}" ({", ".join(parts)})')


def _is_sound(column: _Column) -> bool:
    return bool(_NAME.fullmatch(column.name)) and column.kind in _KINDS


def _copy_strays(pages: KeptPages, copy: sqlite3.Connection, tables: Iterable[str]) -> Counter[str]:
    """Copy what SQLite finds no way to; return how many rows of which table."""
    known: dict[str, set[int]] = {}
    for name in tables:
        if _is_known(copy, name):
            known[name] = {row[0] for row in copy.execute(f'SELECT rowid FROM "{name}"')}
    count: Counter[str] = Counter()
    for name, row in stray_rows(pages, known) if known else ():
        count[name] += _put(copy, name, row)
    return +count


def _is_known(copy: sqlite3.Connection, name: str) -> bool:
    """Return whether a table has the columns that it has today."""
    _, own = own_tables().get(name, ("", ()))
    return name in COLUMNS and columns_of(copy, name) == (own or columns_of(copy, name))


def _put(copy: sqlite3.Connection, name: str, row: Row) -> int:
    marks = ", ".join("?" * len(row))
    return copy.execute(f'INSERT OR IGNORE INTO "{name}" VALUES ({marks})', row).rowcount


def _text(raw: bytes) -> str:
    return raw.decode("utf-8", errors="replace")


def _copy(
    source: sqlite3.Connection, copy: sqlite3.Connection, name: str, torn: Container[object]
) -> tuple[int, bool]:
    """Copy one table from both its ends, up to the damage in its middle."""
    whole = [True]
    count = 0
    is_known = _is_known(copy, name)
    for row in readable_rows(source, name, whole):
        # A page that lies where another one belongs has the other's rows.
        if is_known and ((name, row[0]) in torn or not is_of(name, row[1:])):
            whole[0] = False
            continue
        count += _put(copy, name, row[1:])
    return count, whole[0]


def tell_litres_again(connection: sqlite3.Connection) -> None:
    """Have `meta` say what the rows come to that are there: a part of what was told before."""
    connection.execute("DELETE FROM meta WHERE key = ?", (LITRES_KEY,))
    try:
        found_l = applied_l(connection, {})
    except (TypeError, ValueError):  # rows that are none
        return
    connection.execute("INSERT INTO meta (key, value) VALUES (?, ?)", (LITRES_KEY, repr(found_l)))


def salvaged(path: Path, reason: str) -> Told:
    """Copy what can still be read beside the file, which stays as it is; say what came of it."""
    try:
        found = salvage(path)
    except DAMAGE as error:
        text = one_line(error)
        return Told(
            "failed", f"{reason}; nothing could be read ({text}); the file is kept as it is"
        )
    text = f"{reason}; the file is kept, {found.rows} rows are in {salvaged_name(path).name}"
    if found.stray:
        strays = ", ".join(f"{name} {count}" for name, count in found.stray.items())
        text += f", of these from pages that nothing leads to: {strays}"
    if found.lost_tables:
        text += f"; not all of {', '.join(found.lost_tables)}"
    return Told("salvaged", text)


def recover_folder(folder: Path) -> list[Recovery]:
    """Recover every journal that was cut, and copy what can be read of a damaged one."""
    return journal_folder.recover_folder(folder, salvaged)


def recover(path: Path) -> Recovery | None:
    """Recover one journal, or copy what can be read of it; None where there is nothing to do."""
    return journal_folder.recover(path, salvaged)


# What a GeoPackage must have besides the flight's rows, written again where damage took it.

# Layers: geometry, and the system that they lie in.
_LAYERS = {
    "applied": ("POINT", WGS84_ID),
    "zones": ("GEOMETRY", LOCAL_ID),
    "field": ("GEOMETRY", LOCAL_ID),
}
_SYSTEM = "INSERT OR IGNORE INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)"
_CONTENT = (
    "INSERT OR IGNORE INTO gpkg_contents (table_name, data_type, identifier, description, srs_id) "
    "VALUES (?, ?, ?, ?, ?)"
)
_GEOMETRY = "INSERT OR IGNORE INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, 0, 0)"
_ORIGIN = "SELECT value FROM meta WHERE key = 'origin_{}_deg'"


def register_again(connection: sqlite3.Connection) -> None:
    """Fill in what is missing of the registers, and the extent of what there is now.

    Without them no map viewer opens the file; what cannot be told is left out.
    """
    with empty_tables() as empty:
        systems = empty.execute("SELECT * FROM gpkg_spatial_ref_sys").fetchall()
        sql = "SELECT table_name, data_type, identifier, description, srs_id FROM gpkg_contents"
        contents = empty.execute(sql).fetchall()
    contents += [(name, "features", name, "", system) for name, (_, system) in _LAYERS.items()]
    contents.append(("coverage_tiles", "attributes", "coverage_tiles", "treated ground", None))
    with suppress(sqlite3.Error):
        connection.executemany(_SYSTEM, systems)
        connection.executemany(_CONTENT, contents)
        connection.executemany(
            _GEOMETRY, [(name, kind, system) for name, (kind, system) in _LAYERS.items()]
        )
    with suppress(sqlite3.Error, ValueError):
        set_box(connection, "applied", box_of_points(connection, "applied"))
    with suppress(sqlite3.Error, ValueError, TypeError, LookupError):
        _register_frame(connection)


def _register_frame(connection: sqlite3.Connection) -> None:
    """Fill in the flight's own system from its origin, which is in `meta`."""
    latitude_deg, longitude_deg = (
        float(connection.execute(_ORIGIN.format(name)).fetchone()[0])
        for name in ("latitude", "longitude")
    )
    if not (abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 180.0):
        return
    definition = LocalFrame(latitude_deg, longitude_deg).crs.to_wkt("WKT1_GDAL")
    what = "metres east and north of the flight's origin"
    connection.execute(_SYSTEM, ("Flight", LOCAL_ID, "NONE", LOCAL_ID, definition, what))
