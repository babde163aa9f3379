"""Parallel lines from border to border, with a spacing that fits each part of the field.

Teeth of a comb are seldom whole swaths wide. Where edges run along the lines, the lines may begin
anew at any of them; at which, is a shortest path over the edges: evenly spaced lines from one
chosen edge to the next cost their time, and what they leave out costs a pass of its own.
"""

from __future__ import annotations

import numpy as np
import shapely
from shapely import Polygon
from shapely.geometry.base import BaseGeometry

from missions.open_lines import across_part, evenly
from missions.strips import Floats, joined, lengths_m, united
from missions.swaths import axes
from missions.turns import Motion

# An edge off the course by more across than this is not along the lines.
ALONG_M = 0.02
EDGES_MAX = 12
# Less than this left out is no pass, but crumbs for the patches.
CRUMB_M2 = 1.0


def fitted_lines(ground: BaseGeometry, width_m: float, angle_deg: float, motion: Motion) -> Floats:
    """Return lines that begin anew at the edges where that is quickest."""
    turned_by = axes(angle_deg)
    turned = shapely.transform(ground, lambda points: points @ turned_by.T)
    lines = joined([_of_part(part, width_m, motion) for part in shapely.get_parts(turned)])
    return np.column_stack([lines[:, :2] @ turned_by, lines[:, 2:] @ turned_by])


def has_edges_along(ground: BaseGeometry, width_m: float, angle_deg: float) -> bool:
    """Return whether there is any edge at which the lines could begin anew."""
    turned_by = axes(angle_deg)
    turned = shapely.transform(ground, lambda points: points @ turned_by.T)
    return any(len(edges_along(part, width_m)) > 2 for part in shapely.get_parts(turned))


def edges_along(part: Polygon, width_m: float) -> Floats:
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
        if apart and len(places) < EDGES_MAX:
            places.append(place)
    return np.array([low, *sorted(places), high])


def _of_part(part: Polygon, width_m: float, motion: Motion) -> Floats:
    edges = edges_along(part, width_m)
    last = len(edges) - 1
    best = [0.0] + [np.inf] * last
    lines: list[Floats] = [np.empty((0, 4))] * (last + 1)
    for end in range(1, last + 1):
        for start in range(end):
            some = across_part(part, evenly(edges[start], edges[end], width_m), width_m)
            band = shapely.box(part.bounds[0], edges[start], part.bounds[2], edges[end])
            cost = best[start] + _cost_s(some, part.intersection(band), width_m, motion)
            if cost < best[end]:
                best[end], lines[end] = cost, joined([lines[start], some])
    return lines[last]


def _cost_s(lines: Floats, ground: BaseGeometry, width_m: float, motion: Motion) -> float:
    """Return the time of lines with a turn after each, and of passes over what they leave out."""
    turn_s = motion.between_passes_s(width_m)
    left = shapely.get_parts(ground.difference(united(lines, width_m)))
    left = left[shapely.area(left) > CRUMB_M2]
    bounds = shapely.bounds(left).reshape(-1, 4)
    passes_m = np.maximum(bounds[:, 2] - bounds[:, 0], bounds[:, 3] - bounds[:, 1])
    whole_m = np.concatenate([lengths_m(lines), passes_m])
    return float(motion.legs_s(whole_m).sum()) + len(whole_m) * turn_s
