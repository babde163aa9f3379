"""Which ground has been treated: a sparse raster of bits in the flight's frame, never changed.

Every change makes a new `Coverage` that shares all tiles it did not touch with the one before. So
a snapshot costs nothing, and whoever keeps one writes only the tiles that are not the same object.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from companion.core.frame import Bools, Floats, Ints, Place

# Number of a tile eastwards and northwards.
TileKey = tuple[int, int]
# Eight cells in each.
Octets = NDArray[np.uint8]
# Corners in turn, either way round.
Quad = tuple[Place, Place, Place, Place]

# A fifth of the narrowest strips in use (1 m), so that a percentage of one means something, and
# several times the noise of an RTK position (0.03 m); 10 ha are 0.3 MB.
CELL_M = 0.2
TILE_CELLS = 64
TILE_BYTES = TILE_CELLS * TILE_CELLS // 8
_BARE = bytes(TILE_BYTES)
# 655 ha, 20 MB: more than any tank; whatever makes more is no flight.
TILES_MAX = 40_000
# A swath of one second at 100 m/s with the widest boom; a larger one is a jump of the position.
QUAD_MAX_M = 150.0
# A look-up over so many tiles or fewer lays them side by side.
WINDOW_TILES = 64
_NUMBER_MAX = 2**31
PLACE_MAX_M = 1e8
# A centre on a side lies inside: so neighbours leave none out.
TOUCH_M2 = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage:
    """Treated cells of `CELL_M`: tiles of 64 x 64 bits, rows northwards, each cell by its centre.

    `ahead_s` is how far a coverage was carried beyond what had happened: see `swath.expected`.
    """

    tiles: Mapping[TileKey, bytes] = field(default_factory=dict)
    ahead_s: float = 0.0

    @property
    def cell_count(self) -> int:
        """Return the number of treated cells."""
        return sum(int.from_bytes(tile, "little").bit_count() for tile in self.tiles.values())

    @property
    def area_m2(self) -> float:
        """Return the treated ground."""
        return self.cell_count * CELL_M * CELL_M

    def stamped(self, quads: Iterable[Quad]) -> Coverage:
        """Return the coverage with the ground of quadrilaterals added.

        One that crosses itself counts as the two
        triangles at its first corner. A cell is treated where its centre is.
        """
        drafts: dict[TileKey, Octets] = {}
        for quad in quads:
            for first_row, first_column, inside in _insides(quad):
                self._add(drafts, first_row, first_column, inside)
        if not drafts:
            return self
        return self._with(drafts)

    def covered_at(self, east_m: Floats, north_m: Floats) -> Bools:
        """Return, for each place, whether it has been treated; False for what is no place."""
        places = np.floor(np.stack([np.asarray(east_m), np.asarray(north_m)]) / CELL_M)
        sound: Bools = np.all(np.abs(places) < _NUMBER_MAX, axis=0)
        if not (self.tiles and sound.any()):
            return np.zeros(sound.shape, dtype=np.bool_)
        columns, rows = np.where(sound, places, 0.0).astype(np.int64)
        if not sound.all():
            columns[~sound], rows[~sound] = columns[sound].flat[0], rows[sound].flat[0]
        west, east = int(columns.min()) // TILE_CELLS, int(columns.max()) // TILE_CELLS
        south, north = int(rows.min()) // TILE_CELLS, int(rows.max()) // TILE_CELLS
        if (east - west + 1) * (north - south + 1) > WINDOW_TILES:
            return sound & self._each(columns, rows)
        window = self._window(west, south, east, north)
        found: Bools = window[rows - south * TILE_CELLS, columns - west * TILE_CELLS]
        return sound & found

    def is_bare(self, west_m: float, south_m: float, east_m: float, north_m: float) -> bool:
        """Return whether no tile that meets a box holds anything; True for a box of no place."""
        if not self.tiles:
            return True
        tile_m = CELL_M * TILE_CELLS
        box = [side_m / tile_m for side_m in (west_m, south_m, east_m, north_m)]
        if not all(abs(side) < _NUMBER_MAX for side in box):
            return True
        west, south, east, north = (math.floor(side) for side in box)
        if (east - west + 1) * (north - south + 1) > len(self.tiles):
            return not any(west <= x <= east and south <= y <= north for x, y in self.tiles)
        return not any(
            (x, y) in self.tiles for x in range(west, east + 1) for y in range(south, north + 1)
        )

    def joined(self, other: Coverage) -> Coverage:
        """Return the ground that either has treated."""
        tiles = dict(self.tiles)
        for key, tile in other.tiles.items():
            mine = tiles.get(key)
            both = tile if mine is None else _either(mine, tile)
            if mine is None or both != mine:
                tiles[key] = both
        return Coverage(tiles=tiles, ahead_s=max(self.ahead_s, other.ahead_s))

    def unpacked(self) -> Iterator[tuple[TileKey, Bools]]:
        """Yield each tile, from the south-west on, as rows (northwards) of cells (eastwards)."""
        for key in sorted(self.tiles):
            yield key, _unpacked(self.tiles[key])

    def _window(self, west: int, south: int, east: int, north: int) -> Bools:
        size = TILE_CELLS
        shape = ((north - south + 1) * size, (east - west + 1) * size)
        window = np.zeros(shape, dtype=np.bool_)
        for x in range(west, east + 1):
            for y in range(south, north + 1):
                tile = self.tiles.get((x, y))
                if tile is not None:
                    row, column = (y - south) * size, (x - west) * size
                    window[row : row + size, column : column + size] = _unpacked(tile)
        return window

    def _each(self, columns: Ints, rows: Ints) -> Bools:
        found = np.zeros(columns.shape, dtype=np.bool_)
        x, y = columns // TILE_CELLS, rows // TILE_CELLS
        flat = np.stack([x.ravel(), y.ravel()], axis=1)
        keys, which = np.unique(flat, axis=0, return_inverse=True)
        which = which.reshape(columns.shape)
        for number, (key_x, key_y) in enumerate(keys.tolist()):
            tile = self.tiles.get((key_x, key_y))
            if tile is not None:
                here = which == number
                cells = rows[here] - key_y * TILE_CELLS, columns[here] - key_x * TILE_CELLS
                found[here] = _unpacked(tile)[cells]
        return found

    def _add(
        self, drafts: dict[TileKey, Octets], first_row: int, first_column: int, inside: Bools
    ) -> None:
        """Set cells in the drafts of the tiles that they lie in, eight at once."""
        size = TILE_CELLS
        row_count, column_count = inside.shape
        # From the first column of a byte on, as the tiles have them.
        shift = first_column % 8
        wide = np.zeros((row_count, shift + column_count), dtype=np.bool_)
        wide[:, shift:] = inside
        octets = np.packbits(wide, axis=1)
        first_octet, octet_count = (first_column - shift) // 8, octets.shape[1]
        across = size // 8
        for y in range(first_row // size, (first_row + row_count - 1) // size + 1):
            low, high = max(first_row, y * size), min(first_row + row_count, (y + 1) * size)
            of_rows = octets[low - first_row : high - first_row]
            for x in range(first_octet // across, (first_octet + octet_count - 1) // across + 1):
                left = max(first_octet, x * across)
                right = min(first_octet + octet_count, (x + 1) * across)
                part = of_rows[:, left - first_octet : right - first_octet]
                draft = drafts.get((x, y))
                if draft is None:
                    if not part.any():
                        continue
                    draft = drafts[x, y] = np.array(self._octets(x, y))
                draft[low - y * size : high - y * size, left - x * across : right - x * across] |= (
                    part
                )

    def _octets(self, x: int, y: int) -> Octets:
        """Return a tile as rows of bytes."""
        tile = self.tiles.get((x, y), _BARE)
        return np.frombuffer(tile, dtype=np.uint8).reshape(TILE_CELLS, TILE_CELLS // 8)

    def _with(self, drafts: dict[TileKey, Octets]) -> Coverage:
        tiles = dict(self.tiles)
        for key, draft in drafts.items():
            packed = draft.tobytes()
            if tiles.get(key) == packed or (key not in tiles and len(tiles) >= TILES_MAX):
                continue
            tiles[key] = packed
        return Coverage(tiles=tiles)


def _unpacked(tile: bytes) -> Bools:
    bits = np.unpackbits(np.frombuffer(tile, dtype=np.uint8))
    return bits.view(np.bool_).reshape(TILE_CELLS, TILE_CELLS)


def _either(one: bytes, other: bytes) -> bytes:
    both = int.from_bytes(one, "little") | int.from_bytes(other, "little")
    return both.to_bytes(TILE_BYTES, "little")


def _insides(quad: Quad) -> Iterator[tuple[int, int, Bools]]:
    """Yield the first row and column of a block of cells, and which of them lie inside."""
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = quad
    wide_m = max(x0, x1, x2, x3) - min(x0, x1, x2, x3)
    high_m = max(y0, y1, y2, y3) - min(y0, y1, y2, y3)
    # Written so that what is no number is left out.
    if not all(abs(side) < PLACE_MAX_M for place in quad for side in place):
        return
    if not (wide_m <= QUAD_MAX_M and high_m <= QUAD_MAX_M):
        return
    for part in _convex(quad):
        east, north = zip(*part, strict=True)
        # The first centre that is not below, to the last that is not above.
        first_column, first_row = (math.ceil(min(x) / CELL_M - 0.5) for x in (east, north))
        columns = math.floor(max(east) / CELL_M - 0.5) - first_column + 1
        rows = math.floor(max(north) / CELL_M - 0.5) - first_row + 1
        if columns < 1 or rows < 1:
            continue
        x = (np.arange(columns) + (first_column + 0.5)) * CELL_M
        y = (np.arange(rows) + (first_row + 0.5)) * CELL_M
        # All sides at once: each call of numpy costs more than the cells that it looks at.
        level, across, along = [], [], []
        for (x0, y0), (x1, y1) in zip(part, (*part[1:], part[0]), strict=True):
            dx, dy = x1 - x0, y1 - y0
            level.append(TOUCH_M2 - dx * y0 + dy * x0)
            across.append(dx)
            along.append(dy)
        sides = np.array([across, level, along])[:, :, None]
        bound, reached = sides[0] * y + sides[1], sides[2] * x
        inside = np.logical_and.reduce(bound[:, :, None] >= reached[:, None, :], axis=0)
        yield first_row, first_column, inside


def _convex(corners: Quad) -> list[Sequence[Place]]:
    """Return a quadrilateral, or the triangles at its first corner, each turning left."""
    turns = [_turn(corners[i - 2], corners[i - 1], corners[i]) for i in range(len(corners))]
    if all(turn >= 0.0 for turn in turns) and any(turns):
        return [corners]
    if all(turn <= 0.0 for turn in turns) and any(turns):
        return [corners[::-1]]
    found: list[Sequence[Place]] = []
    for part in (corners[:3], (corners[0], *corners[2:])):
        turn = _turn(*part)
        if turn != 0.0:
            found.append(part if turn > 0.0 else part[::-1])
    return found


def _turn(a: Place, b: Place, c: Place) -> float:
    """Return twice the area of a triangle, positive where it turns left."""
    return (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0])
