"""Parallel lines from border to border, and passes along the border only where they are needed.

Where an edge runs along the lines or square to them, they fit it by themselves; a pass along it
would only be sprayed twice at its corners and cost its turns. Slanted edges leave triangles at
the ends of the lines: there the pass along the border is flown.
"""

from __future__ import annotations

import heapq
import math

import numpy as np
import shapely
from shapely import Polygon
from shapely.geometry.base import BaseGeometry

from missions.boom import SLACK_M
from missions.corners import Motion
from missions.coverage import reachable
from missions.strips import (
    LINE_MIN_M,
    Floats,
    Objects,
    axes,
    count_across,
    directions,
    joined,
    lengths_m,
    no_lines,
    rectangles,
    united,
)

Ints = np.ndarray[tuple[int, ...], np.dtype[np.int64]]

# So much of the reachable ground may be left for patches.
LEFT_SHARE = 0.0005
# Ground to be covered is looked at in parts of so many corners, or this wide.
TILE_CORNERS, TILE_MIN_M = 100, 1.0
# The companion is on a line within a metre of it: nearer ones would be taken for each other, and an
# aircraft that turns back between them is on the next before it has turned.
APART_M = 2.0
# A pass that covers less is none.
LEAST_M2 = 1e-3


def open_lines(
    ground: BaseGeometry, width_m: float, angle_deg: float, *, packed: bool = False
) -> Floats:
    """Return lines each as long as its strip stays on the ground, evenly spaced or packed."""
    turned_by = axes(angle_deg)
    turned = shapely.transform(ground, lambda points: points @ turned_by.T)
    of_part = _packed if packed else _of_part
    lines = joined([of_part(part, width_m) for part in shapely.get_parts(turned)])
    return np.column_stack([lines[:, :2] @ turned_by, lines[:, 2:] @ turned_by])


def _of_part(part: Polygon, width_m: float) -> Floats:
    _, low, _, high = part.bounds
    return across_part(part, evenly(low, high, width_m), width_m)


def _packed(part: Polygon, width_m: float) -> Floats:
    """Return lines side by side; only the first or the last two overlap, where that is less.

    Where valves close over treated ground, less than one valve's width is sprayed twice so, and not
    that much between any two lines.
    """
    _, low, _, high = part.bounds
    even = evenly(low, high, width_m)
    left_m = float(even[-1] - even[0]) - width_m * (len(even) - 2)
    if len(even) < 3 or left_m < APART_M:
        return across_part(part, even, width_m)
    aside = width_m * np.arange(len(even))
    at_end = np.minimum(even[0] + aside, even[-1])
    at_start = np.maximum(even[-1] - aside, even[0])[::-1]
    tried = [across_part(part, middles, width_m) for middles in (at_end, at_start)]
    return min(tried, key=lambda lines: float(lengths_m(lines).sum()))


def evenly(low: float, high: float, width_m: float) -> Floats:
    """Return the middles of strips that cover from `low` to `high`, as few as do.

    >>> evenly(0.0, 17.0, 6.0).tolist()
    [3.0, 8.5, 14.0]
    """
    count = count_across(high - low, width_m)
    if count == 1:
        return np.array([(low + high) / 2.0])
    return np.linspace(low + width_m / 2.0, high - width_m / 2.0, count)


def across_part(part: BaseGeometry, middles: Floats, width_m: float) -> Floats:
    """Return lines along the first axis at these places, where their strips lie on the part."""
    west, _, east, _ = part.bounds
    count = len(middles)
    half_m = width_m / 2.0 - SLACK_M
    ends = np.full(count, west - 1.0), np.full(count, east + 1.0)
    across = np.column_stack([ends[0], middles, ends[1], middles])
    bands = rectangles(across, 2.0 * half_m)
    outside, band_of = shapely.get_parts(shapely.difference(bands, part), return_index=True)
    bounds = shapely.bounds(outside)
    rows = [
        (start, middle, end, middle)
        for number, middle in enumerate(middles.tolist())
        for start, end in _gaps(bounds[band_of == number][:, [0, 2]].tolist())
    ]
    return np.array(rows) if rows else no_lines()


def _gaps(spans: list[list[float]]) -> list[tuple[float, float]]:
    """Return what lies between spans, where it is long enough for a line.

    >>> _gaps([[-1.0, 0.0], [4.0, 5.0], [3.0, 4.5], [9.0, 10.0]])
    [(0.0, 3.0), (5.0, 9.0)]
    """
    gaps, reached = [], math.inf
    for start, end in sorted(spans):
        if start - reached > LINE_MIN_M:
            gaps.append((reached, start))
        reached = end if math.isinf(reached) else max(reached, end)
    return gaps


def needed_passes(
    lines: Floats,
    passes: Floats,
    ground: BaseGeometry,
    width_m: float,
    *,
    left_share: float = LEFT_SHARE,
    covered: BaseGeometry | None = None,
) -> Floats:
    """Return the parts of passes along the border that cover what the lines leave out."""
    target = reachable(ground, width_m)
    covered = united(lines, width_m) if covered is None else covered
    missing = _in_tiles(shapely.get_parts(target.difference(covered)))
    allowed_m2 = left_share * target.area
    left_m2 = float(shapely.area(missing).sum())
    strips = rectangles(passes, width_m)
    one, patch, common = _common(strips, missing)
    over = np.split(patch, np.searchsorted(one, np.arange(1, len(passes))))
    gain_m2 = np.bincount(one, weights=shapely.area(common), minlength=len(passes))
    # A pass never gains more than it did before others were chosen: the best of those that are
    # looked at anew is the best of all.
    waiting = [(-float(gain), at) for at, gain in enumerate(gain_m2) if gain > LEAST_M2]
    heapq.heapify(waiting)
    chosen = []
    while waiting and left_m2 > allowed_m2:
        _, at = heapq.heappop(waiting)
        own = missing[over[at]]
        common = shapely.intersection(own, strips[at])
        gain = float(shapely.area(common).sum())
        if waiting and gain < -waiting[0][0] - LEAST_M2:
            if gain > LEAST_M2:
                heapq.heappush(waiting, (-gain, at))
            continue
        if gain <= LEAST_M2:
            break
        new = _trimmed(passes[at], shapely.get_coordinates(common))
        chosen.append(new)
        left = shapely.difference(own, rectangles(new, width_m)[0])
        left_m2 += float(shapely.area(left).sum() - shapely.area(own).sum())
        missing[over[at]] = left
    return joined(chosen)


def likely_passes(passes: Floats, bare: BaseGeometry, width_m: float) -> Floats:
    """Return the parts of passes that have bare ground in their strips, whatever others cover.

    Those needed are fewer, but which layout needs less of them is seen by these, in no time.
    """
    missing = _in_tiles(shapely.get_parts(bare))
    one, _, common = _common(rectangles(passes, width_m), missing)
    some = shapely.area(common) > LEAST_M2
    points, row = shapely.get_coordinates(common[some], return_index=True)
    at = one[some][row]
    along_m = ((points - passes[at, :2]) * directions(passes)[at]).sum(axis=1)
    start_m, end_m = np.full(len(passes), np.inf), np.full(len(passes), -np.inf)
    np.minimum.at(start_m, at, along_m)
    np.maximum.at(end_m, at, along_m)
    found = end_m > start_m
    way, begin = directions(passes)[found], passes[found, :2]
    start_m, end_m = start_m[found, None], end_m[found, None]
    return np.column_stack([begin + way * start_m, begin + way * end_m])


def _common(strips: Objects, missing: Objects) -> tuple[Ints, Ints, Objects]:
    """Return which strip lies over which missing ground, by strip, and what both share."""
    one, patch = shapely.STRtree(missing).query(strips, predicate="intersects")
    return one, patch, np.asarray(shapely.intersection(strips[one], missing[patch]), dtype=object)


def _in_tiles(parts: Objects) -> Objects:
    """Return the ground in parts with few corners each: those of many are cut in two.

    What a strip shares with a part takes as long as the part has corners.
    """
    done: list[Objects] = []
    while len(parts):
        west, south, east, north = shapely.bounds(parts).reshape(-1, 4).T
        is_small = shapely.get_num_coordinates(parts) <= TILE_CORNERS
        is_small |= np.maximum(east - west, north - south) <= TILE_MIN_M
        done.append(parts[is_small])
        west, south, east, north = (each[~is_small] for each in (west, south, east, north))
        x, y = (west + east) / 2.0, (south + north) / 2.0
        is_wide = east - west > north - south
        ones = shapely.box(west, south, np.where(is_wide, x, east), np.where(is_wide, north, y))
        others = shapely.box(np.where(is_wide, x, west), np.where(is_wide, south, y), east, north)
        large = parts[~is_small]
        parts = shapely.get_parts(
            np.concatenate([shapely.intersection(large, half) for half in (ones, others)])
        )
        # Edges along a cut are no ground.
        parts = parts[shapely.get_dimensions(parts) == 2]
    return np.concatenate([np.empty(0, dtype=object), *done])


def _trimmed(line: Floats, points: Floats) -> Floats:
    """Return the part of a pass along points of what is missing."""
    row = line[None, :]
    along = directions(row)[0]
    length_m = float(np.hypot(*(line[2:] - line[:2])))
    where = (points - line[:2]) @ along
    start, end = max(float(where.min()), 0.0), min(float(where.max()), length_m)
    lack_m = max(LINE_MIN_M - (end - start), 0.0)
    start, end = max(start - lack_m, 0.0), min(end + lack_m, length_m)
    return np.array([[*(line[:2] + along * start), *(line[:2] + along * end)]])


# Parallel lines from border to border, with a spacing that fits each part of the field.
#
# Teeth of a comb are seldom whole swaths wide. Where edges run along the lines, the lines may begin
# anew at any of them; at which, is a shortest path over the edges: evenly spaced lines from one
# chosen edge to the next cost their time, and what they leave out costs a pass of its own.

# An edge off the course by more across than this is not along the lines.
ALONG_M = 0.02
EDGES_MAX = 12
# Lines from each edge to each other are laid over ground of so many corners in all; fewer edges
# are looked at where there are more, the longest.
EDGES_MIN, EDGE_CORNERS = 4, 8_000
# Less than this left out is no pass, but crumbs for the patches.
CRUMB_M2 = 1.0


def fitted_lines(ground: BaseGeometry, width_m: float, angle_deg: float, motion: Motion) -> Floats:
    """Return lines that begin anew at the edges where that is quickest."""
    turned_by = axes(angle_deg)
    turned = shapely.transform(ground, lambda points: points @ turned_by.T)
    lines = joined([_fitted_in_part(part, width_m, motion) for part in shapely.get_parts(turned)])
    return np.column_stack([lines[:, :2] @ turned_by, lines[:, 2:] @ turned_by])


def has_edges_along(ground: BaseGeometry, width_m: float, angle_deg: float) -> bool:
    """Return whether there is any edge at which the lines could begin anew."""
    turned_by = axes(angle_deg)
    turned = shapely.transform(ground, lambda points: points @ turned_by.T)
    return any(len(edges_along(part, width_m)) > 2 for part in shapely.get_parts(turned))


def edges_along(part: Polygon, width_m: float, *, most: int = EDGES_MAX) -> Floats:
    """Return where edges run along the lines, lowest and highest place of the part among them."""
    low, high = part.bounds[1], part.bounds[3]
    found: list[tuple[float, float]] = []
    for ring in (part.exterior, *part.interiors):
        points = shapely.get_coordinates(ring)
        step = np.abs(np.diff(points, axis=0))
        some = (step[:, 1] < ALONG_M) & (step[:, 0] > width_m)
        middle = (points[:-1, 1] + points[1:, 1]) / 2.0
        found += zip(step[some, 0].tolist(), middle[some].tolist(), strict=True)
    places: list[float] = []
    for _, place in sorted(found, reverse=True):
        apart = all(abs(place - other) > ALONG_M for other in (*places, low, high))
        if apart and len(places) < most:
            places.append(place)
    return np.array([low, *sorted(places), high])


def _fitted_in_part(part: Polygon, width_m: float, motion: Motion) -> Floats:
    corners = int(shapely.get_num_coordinates(part))
    most = min(max(EDGE_CORNERS // corners, EDGES_MIN), EDGES_MAX)
    edges = edges_along(part, width_m, most=most)
    last = len(edges) - 1
    best = [0.0] + [np.inf] * last
    lines: list[Floats] = [np.empty((0, 4))] * (last + 1)
    west, _, east, _ = part.bounds
    for end in range(1, last + 1):
        tried = []
        for start in range(end):
            ground = part.intersection(shapely.box(west, edges[start], east, edges[end]))
            some = across_part(ground, evenly(edges[start], edges[end], width_m), width_m)
            # The time of the lines alone: what they leave out only adds to it.
            least_s = best[start] + _legs_s(lengths_m(some), width_m, motion)
            tried.append((least_s, start, ground, some))
        for least_s, start, ground, some in sorted(tried, key=lambda each: each[:2]):
            if least_s >= best[end]:
                break
            cost = best[start] + _cost_s(some, ground, width_m, motion)
            if cost < best[end]:
                best[end], lines[end] = cost, joined([lines[start], some])
    return lines[last]


def _cost_s(lines: Floats, ground: BaseGeometry, width_m: float, motion: Motion) -> float:
    """Return the time of lines with a turn after each, and of passes over what they leave out."""
    left = shapely.get_parts(_beside(lines, ground, width_m))
    left = left[shapely.area(left) > CRUMB_M2]
    bounds = shapely.bounds(left).reshape(-1, 4)
    passes_m = np.maximum(bounds[:, 2] - bounds[:, 0], bounds[:, 3] - bounds[:, 1])
    whole_m = np.concatenate([lengths_m(lines), passes_m])
    return _legs_s(whole_m, width_m, motion)


def _beside(lines: Floats, ground: BaseGeometry, width_m: float) -> BaseGeometry:
    """Return the ground that strips of evenly spaced lines leave.

    Strips of every other line lie apart: as they are they are one area, with nothing to put
    together, which takes ten times as long.
    """
    strips, row = rectangles(lines, width_m), np.unique(lines[:, 1], return_inverse=True)[1]
    left = ground
    for odd in (0, 1):
        left = shapely.difference(left, shapely.multipolygons(strips[row % 2 == odd]))
    return left


def _legs_s(length_m: Floats, width_m: float, motion: Motion) -> float:
    """Return the time of lines with a turn after each."""
    return float(motion.legs_s(length_m).sum()) + len(length_m) * motion.between_passes_s(width_m)
