"""Treated ground in the journal: one row a tile of the raster, only those that changed.

`flight` are tiles as they stand with this flight, `before` what earlier flights had treated when
it began: the guard's first look, which a replay needs. The rows say cells of 0.2 m in the flight's
own frame; a picture of them is made where somebody looks (`coverage_area.py`), not in flight.
"""

from __future__ import annotations

import sqlite3
import zlib
from typing import Literal

from companion.core.options.coverage import (
    CELL_M,
    TILE_BYTES,
    TILE_CELLS,
    TILES_MAX,
    Coverage,
    TileKey,
)

_Kind = Literal["before", "flight"]
_TABLE = (
    "CREATE TABLE IF NOT EXISTS coverage_tiles (id INTEGER PRIMARY KEY NOT NULL, "
    "kind TEXT NOT NULL, tile_east INTEGER NOT NULL, tile_north INTEGER NOT NULL, "
    "cells BLOB NOT NULL, UNIQUE (kind, tile_east, tile_north))",
    "INSERT OR IGNORE INTO gpkg_contents (table_name, data_type, identifier, description) VALUES "
    f"('coverage_tiles', 'attributes', 'coverage_tiles', 'treated ground: {TILE_CELLS} x "
    f"{TILE_CELLS} cells of {CELL_M} m a row, one bit each, deflated')",
)
_PUT = (
    "INSERT INTO coverage_tiles (kind, tile_east, tile_north, cells) VALUES (?, ?, ?, ?) "
    "ON CONFLICT (kind, tile_east, tile_north) DO UPDATE SET cells = excluded.cells"
)
_DROP = "DELETE FROM coverage_tiles WHERE kind = ? AND tile_east = ? AND tile_north = ?"
_SET_META = (
    "INSERT INTO meta (key, value) VALUES (?, ?) "
    "ON CONFLICT (key) DO UPDATE SET value = excluded.value"
)
AHEAD_KEY = "coverage_ahead_s"
# A number of a tile that is no damage: 655 ha are some 250 tiles across.
_NUMBER_MAX = 2**24


def write_coverage(
    connection: sqlite3.Connection, coverage: Coverage, before: Coverage | None
) -> None:
    """Write what differs from `before`, the coverage that was written last.

    Within the caller's transaction. A tile that is the same object as before is not touched.
    """
    _write(connection, "flight", coverage, before)
    connection.execute(_SET_META, (AHEAD_KEY, repr(coverage.ahead_s)))


def write_treated(connection: sqlite3.Connection, treated: Coverage | None) -> None:
    """Write what earlier flights treated; nothing for a flight that begins on bare ground."""
    if treated is not None:
        _write(connection, "before", treated, None)


def read_coverage(
    connection: sqlite3.Connection, *, unread: list[str] | None = None
) -> Coverage | None:
    """Return all that was treated when the flight ended, by it and before it.

    None where the journal keeps no coverage; ValueError where its tiles are damaged. With `unread`
    it is said there how many are, and they are left out.
    """
    flight = _read(connection, "flight", unread)
    if flight is None:
        return None
    before = _read(connection, "before", unread)
    found = _ahead(connection, unread)
    if found is None and not flight.tiles:
        return None  # it was never told any: recording was off
    tiles = (flight if before is None else before.joined(flight)).tiles
    return Coverage(tiles=tiles, ahead_s=0.0 if found is None else float(found[0]))


def _ahead(connection: sqlite3.Connection, unread: list[str] | None) -> tuple[str] | None:
    sql = "SELECT value FROM meta WHERE key = ?"
    try:
        found: tuple[str] | None = connection.execute(sql, (AHEAD_KEY,)).fetchone()
    except sqlite3.DatabaseError as error:
        if unread is None:
            raise
        unread.append(f"treated ground: how far it is told ahead: {error}")
        return None
    return found


def read_treated(
    connection: sqlite3.Connection, unread: list[str] | None = None
) -> Coverage | None:
    """Return what earlier flights had treated; None where the flight was not to know.

    With `unread`, which is told what is damaged, as far as it can be read.
    """
    before = _read(connection, "before", unread)
    return before if before is not None and before.tiles else None


def _write(
    connection: sqlite3.Connection, kind: _Kind, coverage: Coverage, before: Coverage | None
) -> None:
    for sql in _TABLE if before is None else ():
        connection.execute(sql)
    last = {} if before is None else before.tiles
    if coverage.tiles is last:
        return
    connection.executemany(
        _PUT,
        (
            (kind, *key, zlib.compress(tile, level=1))
            for key, tile in coverage.tiles.items()
            if last.get(key) is not tile
        ),
    )
    gone = [(kind, *key) for key in last if key not in coverage.tiles]
    connection.executemany(_DROP, gone)


def _read(
    connection: sqlite3.Connection, kind: _Kind, unread: list[str] | None = None
) -> Coverage | None:
    sql = "SELECT 1 FROM sqlite_master WHERE name = 'coverage_tiles'"
    if connection.execute(sql).fetchone() is None:
        return None
    query = "SELECT tile_east, tile_north, cells FROM coverage_tiles WHERE kind = ? LIMIT ?"
    if unread is None:
        rows = connection.execute(query, (kind, TILES_MAX))
        return Coverage(tiles={_key(east, north): _tile(cells) for east, north, cells in rows})
    tiles, damaged = {}, 0
    try:
        for east, north, cells in connection.execute(query, (kind, TILES_MAX)):
            try:
                tiles[_key(east, north)] = _tile(cells)
            except ValueError:
                damaged += 1
    except sqlite3.DatabaseError as error:
        text = f"treated ground behind the first {len(tiles)} tiles: {error}"
        if text not in unread:  # one table: what the flight and what earlier ones treated
            unread.append(text)
    if damaged:
        unread.append(f"treated ground: {damaged} of {damaged + len(tiles)} tiles are damaged")
    return Coverage(tiles=tiles)


def _key(east: object, north: object) -> TileKey:
    if not (isinstance(east, int) and isinstance(north, int)):
        raise ValueError("the coverage has a tile without a place")
    if not (abs(east) < _NUMBER_MAX and abs(north) < _NUMBER_MAX):
        raise ValueError(f"the coverage has a tile at {east}, {north}")
    return east, north


def _tile(cells: object) -> bytes:
    worker = zlib.decompressobj()
    try:
        tile = worker.decompress(cells, TILE_BYTES + 1) if isinstance(cells, bytes) else b""
    except zlib.error as error:
        raise ValueError(f"a tile of the coverage is damaged: {error}") from error
    if len(tile) != TILE_BYTES or not worker.eof:
        raise ValueError("a tile of the coverage is damaged")
    return tile
