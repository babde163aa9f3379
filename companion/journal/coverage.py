"""Treated ground in the journal: one row a tile of the raster, only those that changed.

`flight` are tiles as they stand with this flight, `before` what earlier flights had treated when
it began: the guard's first look, which a replay needs. The rows say cells of 0.2 m in the flight's
own frame; areas of them are made where somebody looks, not in flight, and so is what carries them
into the frame of another flight.
"""

from __future__ import annotations

import sqlite3
import zlib
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from companion.core.frame import LocalFrame
from companion.core.options.coverage import (
    CELL_M,
    TILE_BYTES,
    TILE_CELLS,
    TILES_MAX,
    Coverage,
    TileKey,
)
from companion.journal.writer import COVERAGE_AHEAD_KEY

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

TILE_M = TILE_CELLS * CELL_M
# Boxes of neighbouring cells overlap by this, so that their union has no hairline gaps.
_SEAM_M = 1e-6


def polygons(coverage: Coverage) -> MultiPolygon:
    """Return the outline of all treated cells, in the frame of the coverage.

    Cells that lie in a row are one box, and equal rows above each other are one box.
    """
    boxes = [_boxes(key, cells) for key, cells in coverage.unpacked()]
    if not boxes:
        return MultiPolygon()
    west, south, east, north = np.concatenate(boxes).T
    seam = _SEAM_M
    joined = shapely.union_all(shapely.box(west - seam, south - seam, east + seam, north + seam))
    return as_polygons(joined)


def as_polygons(area: BaseGeometry) -> MultiPolygon:
    """Return what has ground of an area."""
    parts = [part for part in shapely.get_parts(area) if isinstance(part, Polygon)]
    return MultiPolygon([part for part in parts if part.area > 0.0])


def carried(area: BaseGeometry, source: LocalFrame, target: LocalFrame) -> MultiPolygon:
    """Return an area of one flight's frame in another's."""
    return as_polygons(
        shapely.transform(area, lambda places: carried_places(places, source, target))
    )


def carried_places(places: Floats, source: LocalFrame, target: LocalFrame) -> Floats:
    """Return places (n, 2), east and north, of one flight's frame in another's."""
    return np.stack(_carried(places, source, target), axis=1)


def _boxes(key: TileKey, cells: Bools) -> Floats:
    """Return west, south, east, north [m] of boxes that make up the cells of a tile."""
    if cells.all():
        found = [(0, 0, TILE_CELLS, TILE_CELLS)]
    else:
        found = []
        open_since: dict[tuple[int, int], int] = {}
        for row in range(TILE_CELLS + 1):
            runs = set(_runs(cells[row])) if row < TILE_CELLS else set()
            for run in [run for run in open_since if run not in runs]:
                found.append((run[0], open_since.pop(run), run[1], row))
            for run in runs:
                open_since.setdefault(run, row)
    corner = np.array([*key, *key], dtype=np.float64) * TILE_CELLS
    boxes: Floats = (np.array(found, dtype=np.float64).reshape(-1, 4) + corner) * CELL_M
    return boxes


def _runs(row: Bools) -> list[tuple[int, int]]:
    """Return the first cell of each stretch of treated ones, and the one behind it."""
    edges = np.flatnonzero(np.diff(row.astype(np.int8), prepend=0, append=0)).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def moved(coverage: Coverage, source: LocalFrame, target: LocalFrame) -> Coverage:
    """Return a coverage of one flight's frame in another's: each cell by its centre.

    Frames of one field differ by a shift, a turn and nearly nothing else: within a tile the
    corners say it all.
    """
    here = (source.latitude_deg, source.longitude_deg)
    if here == (target.latitude_deg, target.longitude_deg) or not coverage.tiles:
        return coverage
    keys = _tiles_under(coverage, source, target)
    corners = np.array([(x + dx, y + dy) for x, y in keys for dy in (0, 1) for dx in (0, 1)])
    east, north = _carried(corners * TILE_M, target, source)
    share = (np.arange(TILE_CELLS) + 0.5) / TILE_CELLS
    along, up = np.meshgrid(share, share)
    weights = np.stack([(1 - along) * (1 - up), along * (1 - up), (1 - along) * up, along * up])
    tiles: dict[TileKey, bytes] = {}
    for number, key in enumerate(keys):
        own = slice(4 * number, 4 * number + 4)
        cells = coverage.covered_at(
            np.tensordot(east[own], weights, axes=1), np.tensordot(north[own], weights, axes=1)
        )
        if cells.any():
            tiles[key] = np.packbits(cells).tobytes()
    return Coverage(tiles=tiles, ahead_s=coverage.ahead_s)


def _tiles_under(coverage: Coverage, source: LocalFrame, target: LocalFrame) -> list[TileKey]:
    """Return the tiles of the target's frame that any tile of the coverage may lie on."""
    corners = np.array(
        [(x + dx, y + dy) for x, y in coverage.tiles for dy in (0, 1) for dx in (0, 1)]
    )
    east, north = _carried(corners * TILE_M, source, target)
    columns = np.floor(np.stack([east, north], axis=1).reshape(-1, 4, 2) / TILE_M).astype(np.int64)
    found: set[TileKey] = set()
    for low, high in zip(columns.min(axis=1).tolist(), columns.max(axis=1).tolist(), strict=True):
        found.update((x, y) for x in range(low[0], high[0] + 1) for y in range(low[1], high[1] + 1))
    return sorted(found)


def _carried(places: Floats, source: LocalFrame, target: LocalFrame) -> tuple[Floats, Floats]:
    latitude, longitude = source.to_geographic_all(places[:, 0].tolist(), places[:, 1].tolist())
    return target.to_local_all(latitude, longitude)


_Kind = Literal["before", "flight"]
# A number of a tile that is no damage: 655 ha are some 250 tiles across.
_NUMBER_MAX = 2**24


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
        found: tuple[str] | None = connection.execute(sql, (COVERAGE_AHEAD_KEY,)).fetchone()
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
