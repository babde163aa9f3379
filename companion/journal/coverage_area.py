"""Treated cells as areas, and from the frame of one flight into that of another."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from companion.core.frame import LocalFrame
from companion.core.options.coverage import CELL_M, TILE_CELLS, Coverage, TileKey

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
