"""What other planners fly over the same ground, written anew from their rules.

- Mission Planner's survey grid: parallel lines over the bounding box, one between each pair of
  crossings; next is always the nearest end.
- QGroundControl's survey: the same lines, each from its first to its last crossing, to and fro.
- Fields2Cover (Mier et al. 2023): a headland of one swath along every border, the rest by parallel
  swaths at the course that needs the fewest, cell by cell to and fro.

The first two know no holes: they fly over them and spray them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import LineString, Polygon
from shapely.affinity import rotate
from shapely.geometry.base import BaseGeometry

Floats = NDArray[np.float64]

PEERS = ("grid", "survey", "headland")
# Courses that are tried for the headland's rest, coarse and fine; its outline is simpler for that.
COARSE_DEG, FINE_DEG, SIMPLE_M = 6.0, 1.0, 1.0


def lines_of(peer: str, ground: BaseGeometry, width_m: float) -> Floats:
    """Return the lines of a peer in the order they are flown: x, y from, x, y to."""
    if peer == "headland":
        return headland(ground, width_m)
    filled = shapely.union_all([Polygon(part.exterior) for part in _polygons(ground)])
    in_pairs = peer == "grid"
    lines = grid_lines(filled, longest_edge_deg(filled), in_pairs=in_pairs, width_m=width_m)
    return nearest_order(lines) if in_pairs else to_and_fro(lines)


def _polygons(area: BaseGeometry) -> list[Polygon]:
    return [part for part in shapely.get_parts(area) if isinstance(part, Polygon) and part.area]


def grid_lines(ground: BaseGeometry, angle_deg: float, *, in_pairs: bool, width_m: float) -> Floats:
    """Return the lines of a grid, serpentine; in pairs of crossings, or from first to last."""
    turned = rotate(ground, angle_deg, origin=(0.0, 0.0))  # north is then along the lines
    shapely.prepare(turned)
    west, _, east, _ = turned.bounds
    count = math.ceil((east - west) / width_m)
    first = (west + east) / 2.0 - (count - 1) * width_m / 2.0
    rows = []
    for x, spans in _spans(turned, first + width_m * np.arange(count)):
        if not in_pairs:
            spans = [(spans[0][0], max(span[1] for span in spans))]
        rows += [(x, low, x, high) for low, high in spans]
    return _turned_back(rows, angle_deg)


def _spans(turned: BaseGeometry, at: Floats) -> list[tuple[float, list[tuple[float, float]]]]:
    """Return the places where lines to the north are inside."""
    _, south, _, north = turned.bounds
    found = []
    for x in at.tolist():
        cut = LineString([(x, south - 1.0), (x, north + 1.0)]).intersection(turned)
        spans = sorted(part.bounds[1::2] for part in shapely.get_parts(cut) if part.length > 0.0)
        if spans:
            found.append((x, spans))
    return found


def _turned_back(rows: Sequence[tuple[float, float, float, float]], angle_deg: float) -> Floats:
    lines = np.array(rows).reshape(-1, 4)
    back = math.radians(angle_deg)
    turn = np.array([[math.cos(back), -math.sin(back)], [math.sin(back), math.cos(back)]])
    return np.column_stack([lines[:, :2] @ turn, lines[:, 2:] @ turn])


def nearest_order(lines: Floats) -> Floats:
    """Return the lines in the order of the nearest next end, as Mission Planner flies them."""
    left = np.ones(len(lines), dtype=bool)
    rows = [lines[0]]
    left[0] = False
    for _ in range(len(lines) - 1):
        here = rows[-1][2:]
        to_start = np.where(left, np.hypot(*(lines[:, :2] - here).T), np.inf)
        to_end = np.where(left, np.hypot(*(lines[:, 2:] - here).T), np.inf)
        best = int(np.argmin(np.minimum(to_start, to_end)))
        row = lines[best]
        rows.append(row if to_start[best] <= to_end[best] else row[[2, 3, 0, 1]])
        left[best] = False
    return np.array(rows)


def to_and_fro(lines: Floats) -> Floats:
    """Return the lines, every other one from its end."""
    found = lines.copy()
    found[1::2] = lines[1::2][:, [2, 3, 0, 1]]
    return found


def longest_edge_deg(ground: BaseGeometry) -> float:
    """Return the course of the longest edge of the outline as it is drawn."""
    outline = max(_polygons(ground), key=lambda part: part.area).exterior.simplify(0.5)
    points = shapely.get_coordinates(outline)
    step = np.diff(points, axis=0)
    longest = step[int(np.argmax(np.hypot(*step.T)))]
    return math.degrees(math.atan2(longest[0], longest[1]))


def headland(ground: BaseGeometry, width_m: float) -> Floats:
    """Return a pass along every border, then the rest in cells, each to and fro."""
    rings = [
        ring
        for part in _polygons(ground.buffer(-width_m / 2.0, join_style="mitre"))
        for ring in (part.exterior, *part.interiors)
    ]
    rows = [
        (*a, *b)
        for ring in rings
        for a, b in pairwise(shapely.get_coordinates(ring.simplify(0.05)).tolist())
    ]
    found = [np.array(rows).reshape(-1, 4)]
    for cell in _polygons(ground.buffer(-width_m, join_style="mitre")):
        lines = _cell_lines(cell, _best_deg(cell, width_m), width_m)
        found.append(lines)
    return np.vstack(found)


def _best_deg(cell: Polygon, width_m: float) -> float:
    """Return the course that needs the fewest lines, and of those the shortest."""
    simple = cell.simplify(SIMPLE_M)

    def cost(angle_deg: float) -> tuple[int, float]:
        rows = _rows(simple, angle_deg, width_m)
        return sum(len(spans) for _, spans in rows), sum(
            high - low for _, spans in rows for low, high in spans
        )

    best = min(np.arange(0.0, 180.0, COARSE_DEG).tolist(), key=cost)
    near = np.arange(best - COARSE_DEG, best + COARSE_DEG + 0.5, FINE_DEG).tolist()
    return float(min(near, key=cost))


def _rows(
    cell: BaseGeometry, angle_deg: float, width_m: float
) -> list[tuple[float, list[tuple[float, float]]]]:
    turned = rotate(cell, angle_deg, origin=(0.0, 0.0))
    shapely.prepare(turned)
    west, _, east, _ = turned.bounds
    # The last one lies on the far border, and overlaps.
    count = max(1, math.ceil((east - west) / width_m))
    at = np.minimum(west + (np.arange(count) + 0.5) * width_m, max(east - 1e-3, west))
    return _spans(turned, at)


def _cell_lines(cell: Polygon, angle_deg: float, width_m: float) -> Floats:
    """Return the lines of a cell: each chain of spans that lie beside each other, to and fro."""
    chains: list[list[tuple[float, float, float, float]]] = []
    before: list[tuple[float, float, int]] = []
    for x, spans in _rows(cell, angle_deg, width_m):
        now = []
        for low, high in spans:
            beside = [each for each in before if each[0] < high and each[1] > low]
            others = [s for s in spans if beside and s[0] < beside[0][1] and s[1] > beside[0][0]]
            if len(beside) == 1 and len(others) == 1:
                chain = beside[0][2]
            else:
                chain = len(chains)
                chains.append([])
            chains[chain].append((x, low, x, high))
            now.append((low, high, chain))
        before = now
    ordered: list[Floats] = []
    left = [to_and_fro(np.array(chain)) for chain in chains]
    here = np.zeros(2)
    while left:
        ways = [each for chain in left for each in (chain, chain[::-1][:, [2, 3, 0, 1]])]
        best = int(np.argmin([np.hypot(*(each[0, :2] - here)) for each in ways]))
        ordered.append(ways[best])
        here = ways[best][-1, 2:]
        left.pop(best // 2)
    rows = [tuple(row) for chain in ordered for row in chain.tolist()]
    return _turned_back(rows, angle_deg)


# --- refills: home where tank or battery is empty, and on from there ----------------------------


def tanks(
    lines: Floats, home: Floats, *, tank_m: float, range_s: float, speed_m_s: float, stop_s: float
) -> list[Floats]:
    """Return the lines of each sortie: `tank_m` of spraying, `range_s` in the air, home included.

    A corner takes `stop_s` beyond its way over its speed.
    """
    sorties: list[list[tuple[float, float, float, float]]] = [[]]
    left_m, left_s, here = tank_m, range_s, home
    for row in lines:
        start, end = row[:2], row[2:]
        while True:
            to_s = math.dist(here, start) / speed_m_s + stop_s
            length_m = math.dist(start, end)
            fits_m = _fits_m(start, end, home, left_s - to_s - 2.0 * stop_s, speed_m_s)
            done_m = min(length_m, left_m, fits_m)
            if done_m > 1e-6:
                place = start + (end - start) * done_m / length_m
                sorties[-1].append((*start.tolist(), *place.tolist()))
                left_m -= done_m
                left_s -= to_s + done_m / speed_m_s + stop_s
                start = here = place
            if done_m >= length_m - 1e-6:
                break
            if not sorties[-1]:
                # Farther than a battery reaches: it is flown all the same.
                left_s = math.inf
                continue
            sorties.append([])
            left_m, left_s, here = tank_m, range_s, home
    return [np.array(each) for each in sorties if each]


def _fits_m(start: Floats, end: Floats, home: Floats, left_s: float, speed_m_s: float) -> float:
    """Return how far along a line the time lasts, with the way home from there."""
    length_m = math.dist(start, end)
    if not math.isfinite(left_s):
        return length_m

    def needs_s(share: float) -> float:
        place = start + (end - start) * share
        return (share * length_m + math.dist(place, home)) / speed_m_s

    if needs_s(1.0) <= left_s:
        return length_m
    low, high = 0.0, 1.0
    for _ in range(30):
        middle = (low + high) / 2.0
        low, high = (middle, high) if needs_s(middle) <= left_s else (low, middle)
    return low * length_m


def way_of_lines(lines: Floats, home: Floats) -> Floats:
    """Return the places of a sortie from home and back."""
    return np.vstack([home, lines.reshape(-1, 2), home])
