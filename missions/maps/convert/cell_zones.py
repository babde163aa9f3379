"""Cells of one rate joined into polygons, whose edges are the edges of the cells.

The rings are traced, not united: every side of a cell whose neighbour has another rate is an edge,
directed with its cell on the left, and knows its successor. The time grows with the number of such
edges, where uniting boxes takes minutes for a speckled raster.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import MultiPolygon

from companion.core.cells import NO_RATE
from missions.maps.build import frame_for
from missions.maps.cells import corner
from missions.maps.crs import to_longitude_latitude
from missions.maps.local import Area, as_area, polygons_of, project
from missions.maps.model import MapCells, MapFile, MapZone, map_error

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Objects = NDArray[np.object_]

# A map with more is a picture of a continuous quantity; as polygons no program opens it.
MAX_RATES = 20_000
MAX_CORNERS = 2_000_000
_FIX = "convert it to GeoTIFF (.tif), which keeps the cells, or round the rates (--round)"

# The sides of a cell, anticlockwise: from each, the neighbour beyond it (row, column), and the
# corner at which the side begins. Rows count upwards here, whatever they do on the ground.
_BEYOND_ROW, _BEYOND_COLUMN = np.array([-1, 0, 1, 0]), np.array([0, 1, 0, -1])
_BEGIN_ROW, _BEGIN_COLUMN = np.array([0, 0, 1, 1]), np.array([0, 1, 1, 0])
_EAST_SIDE, _WEST_SIDE = 1, 3


class _Edges(NamedTuple):
    """Sides of cells that are edges: those on one line stand one after the other."""

    side: Ints
    row: Ints
    column: Ints


@dataclass(frozen=True, slots=True)
class _Runs:
    """Straight runs of edges, the corner at which each begins, and which one follows."""

    first: Ints
    follower: Ints
    x: Ints
    y: Ints


def zones_of(cells: MapCells, *, path: Path | None = None) -> list[MapZone]:
    """Return one zone for each rate, in longitude and latitude; cells without a rate are none."""
    path = Path("map") if path is None else path
    rated = ~np.isnan(cells.rates_l_ha)
    rates, index = np.unique(cells.rates_l_ha[rated], return_inverse=True)
    if len(rates) > MAX_RATES:
        raise map_error(
            path,
            f"its cells have {len(rates)} different rates, too many for zones",
            fix=_FIX,
            code="too-large",
        )
    if not len(rates):
        return []
    kinds = np.full((rated.shape[0] + 2, rated.shape[1] + 2), NO_RATE, dtype=np.int32)
    kinds[1:-1, 1:-1][rated] = index
    polygons, kind = _polygons(kinds, cells, path)
    order = np.argsort(kind, kind="stable")
    native = _objects(shapely.multipolygons(polygons[order], indices=kind[order]))
    ground = to_longitude_latitude(native, cells.crs, path=path)
    return [
        MapZone(name=f"{rate:.10g} L/ha", geometry=area, rate_l_ha=rate)
        for rate, area in zip(rates.tolist(), ground, strict=True)
    ]


def _polygons(kinds: NDArray[np.int32], cells: MapCells, path: Path) -> tuple[Objects, Ints]:
    """Return the polygons of cells that hang together by their sides, and the kind of each."""
    edges = _edges(kinds)
    runs = _runs(edges, kinds)
    if len(runs.first) > MAX_CORNERS:
        raise map_error(
            path,
            f"its zones would have {len(runs.first)} corners, more than {MAX_CORNERS}",
            fix=_FIX,
            code="too-large",
        )
    order, ring = _rings(runs)
    ring_of_run = np.empty(len(order), dtype=np.int64)
    ring_of_run[order] = ring
    x, y = runs.x[order], runs.y[order]
    begin = np.flatnonzero(np.diff(ring, prepend=-1))
    # Twice the area with its sign: the ring's closing edge leads back to its first corner.
    after = np.arange(1, len(ring) + 1)
    after[np.append(begin[1:], len(ring)) - 1] = begin
    is_shell = np.add.reduceat(x * y[after] - x[after] * y, begin) > 0
    shell_of = _shells(edges, runs, ring_of_run, is_shell, columns=kinds.shape[1])
    # One row and one column of the padding lie before the first cell.
    column, row = (x - 1).astype(np.float64), (y - 1).astype(np.float64)
    place = np.column_stack(corner(cells.transform, column, row))
    lines = _objects(shapely.linearrings(place, indices=ring))
    # A shell and then its holes, polygon by polygon.
    owner = (np.cumsum(is_shell) - 1)[shell_of]
    grouped = np.lexsort((~is_shell, owner))
    polygons = _objects(shapely.polygons(lines[grouped], indices=owner[grouped]))
    edge = runs.first[order[begin[is_shell]]]
    return polygons, kinds[edges.row[edge], edges.column[edge]].astype(np.int64)


def _objects(made: object) -> Objects:
    """Return what shapely makes of several things, which its types allow to be one."""
    return np.asarray(made, dtype=object)


def _edges(kinds: NDArray[np.int32]) -> _Edges:
    """Return all edges, those of each side in the order in which its lines are walked."""
    found = []
    for side in range(4):
        beyond = np.roll(kinds, (-_BEYOND_ROW[side], -_BEYOND_COLUMN[side]), (0, 1))
        there = (kinds != NO_RATE) & (kinds != beyond)
        if side % 2:
            column, row = np.nonzero(there.T)
        else:
            row, column = np.nonzero(there)
        if side >= 2:
            row, column = row[::-1], column[::-1]
        found.append((np.full(len(row), side), row, column))
    return _Edges(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def _runs(edges: _Edges, kinds: NDArray[np.int32]) -> _Runs:
    """Return the straight runs: from an edge after a turn to the next turn.

    At each corner the way goes on round the same cell, else straight on, else to the right. So a
    ring keeps to cells that share sides, and leaves those that only touch it.
    """
    side, row, column = edges
    own = kinds[row, column]
    left = (side + 1) % 4
    ahead_row, ahead_column = row + _BEYOND_ROW[left], column + _BEYOND_COLUMN[left]
    turns_left = kinds[ahead_row, ahead_column] != own
    # Where it does not turn left, the cell ahead is of the same kind and never in the padding.
    right_row = np.where(turns_left, row, ahead_row + _BEYOND_ROW[side])
    right_column = np.where(turns_left, column, ahead_column + _BEYOND_COLUMN[side])
    turns_right = ~turns_left & (kinds[right_row, right_column] == own)
    turn = np.flatnonzero(turns_left | turns_right)
    next_side = np.where(turns_left, left, (side + 3) % 4)[turn]
    next_cell = (right_row * kinds.shape[1] + right_column)[turn]
    cell = row * kinds.shape[1] + column
    number = np.empty(kinds.size, dtype=np.int32)
    successor = np.empty(len(turn), dtype=np.int64)
    for wanted in range(4):
        here = np.flatnonzero(side == wanted)
        number[cell[here]] = here
        asked = next_side == wanted
        successor[asked] = number[next_cell[asked]]
    begins = np.zeros(len(side), dtype=np.bool_)
    begins[successor] = True
    run_of = np.cumsum(begins) - 1
    # Each run has one turn, at its end, and runs stand in the order of their edges.
    first = np.flatnonzero(begins)
    return _Runs(
        first=first,
        follower=run_of[successor],
        x=column[first] + _BEGIN_COLUMN[side[first]],
        y=row[first] + _BEGIN_ROW[side[first]],
    )


def _rings(runs: _Runs) -> tuple[Ints, Ints]:
    """Return the runs ring by ring, and the ring of each; no ring meets a corner twice.

    A ring that touches itself at a corner is cut there: polygons may not have such rings.
    """
    follower = runs.follower.tolist()
    node = (runs.y * (int(runs.x.max()) + 1) + runs.x).tolist()
    seen = bytearray(len(follower))
    order: list[int] = []
    lengths: list[int] = []
    for start in range(len(follower)):
        run = start
        open_runs: list[int] = []
        place: dict[int, int] = {}
        while not seen[run]:
            seen[run] = 1
            corner_here = node[run]
            if corner_here in place:
                _close(open_runs, place, place[corner_here], node, order, lengths)
            place[corner_here] = len(open_runs)
            open_runs.append(run)
            run = follower[run]
        if open_runs:
            order += open_runs
            lengths.append(len(open_runs))
    return np.array(order), np.repeat(np.arange(len(lengths)), lengths)


def _close(
    open_runs: list[int],
    place: dict[int, int],
    since: int,
    node: list[int],
    order: list[int],
    lengths: list[int],
) -> None:
    """Move the runs from `since` on, which lead back to their own corner, to the whole rings."""
    loop = open_runs[since:]
    del open_runs[since:]
    for run in loop:
        del place[node[run]]
    order += loop
    lengths.append(len(loop))


def _shells(
    edges: _Edges, runs: _Runs, ring_of_run: Ints, is_shell: Bools, *, columns: int
) -> Ints:
    """Return for every ring the shell around it; for a shell, itself.

    West of a hole's westernmost edge lies a cell of its polygon. From there west to the end of
    that row of cells: the edge there is of the same polygon, and further west than all of the hole.
    """
    run_of = np.repeat(np.arange(len(runs.first)), np.diff(np.append(runs.first, len(edges.side))))
    cell = edges.row * columns + edges.column
    west = np.flatnonzero(edges.side == _WEST_SIDE)
    west = west[np.argsort(cell[west])]
    parent = np.arange(len(is_shell))
    east = np.flatnonzero(edges.side[runs.first] == _EAST_SIDE)
    east = east[~is_shell[ring_of_run[east]]]
    # The last one written for each hole is the westernmost.
    east = east[np.argsort(-runs.x[east], kind="stable")]
    reached = west[np.searchsorted(cell[west], cell[runs.first[east]], side="right") - 1]
    parent[ring_of_run[east]] = ring_of_run[run_of[reached]]
    while not is_shell[parent].all():
        parent = parent[parent]
    return parent


# A map as zones alone, for formats that know neither cells nor a default rate nor an outline.

# Ground beyond the boundary that a zone may keep: less is a rounding along a shared edge.
BEYOND_MAX_M2 = 1.0
DEFAULT_NAME = "default"


def plain_zones(map_file: MapFile, *, clip: bool) -> list[MapZone]:
    """Return zones that say all that the map says, in its order.

    Cells become zones, and ground that has the map's default a zone of its own, the first. With
    `clip`, zones end at the map's boundary, because the file that is written cannot hold it.
    """
    zones = list(map_file.zones)
    if map_file.cells is not None:
        zones = zones_of(map_file.cells, path=map_file.path)
    if map_file.boundary is None:
        return zones
    default = _default_zone(map_file.boundary, zones, map_file.default_rate_l_ha)
    if clip:
        zones = _clipped(map_file, map_file.boundary, zones)
    return zones if default is None else [default, *zones]


def outline_of_rates(map_file: MapFile) -> MultiPolygon:
    """Return the ground of all that has a rate, for a format that wants an outline of the field."""
    cells = map_file.cells
    if cells is None:
        grounds = [zone.geometry for zone in map_file.rated]
    else:
        rated = np.where(np.isnan(cells.rates_l_ha), np.nan, 0.0)
        grounds = [zone.geometry for zone in zones_of(replace(cells, rates_l_ha=rated))]
    return MultiPolygon(polygons_of(shapely.union_all(np.array(grounds, dtype=object))))


def _default_zone(
    boundary: MultiPolygon, zones: list[MapZone], rate_l_ha: float | None
) -> MapZone | None:
    """Return the ground inside the boundary where no zone has a rate."""
    if rate_l_ha is None:
        return None
    rated = [zone.geometry for zone in zones if zone.rate_l_ha is not None]
    rest = boundary.difference(shapely.union_all(np.array(rated, dtype=object)))
    ground = as_area(polygons_of(rest))
    if ground is None:
        return None
    return MapZone(name=DEFAULT_NAME, geometry=ground, rate_l_ha=rate_l_ha)


def _clipped(map_file: MapFile, boundary: MultiPolygon, zones: list[MapZone]) -> list[MapZone]:
    frame = frame_for(map_file)
    shapely.prepare(boundary)
    kept = []
    for zone in zones:
        ground: Area | None = zone.geometry
        if not boundary.covers(zone.geometry):
            beyond = as_area(polygons_of(zone.geometry.difference(boundary)))
            if beyond is not None and project(beyond, frame).area > BEYOND_MAX_M2:
                ground = as_area(polygons_of(zone.geometry.intersection(boundary)))
        if ground is not None:
            kept.append(MapZone(name=zone.name, geometry=ground, rate_l_ha=zone.rate_l_ha))
    return kept
