"""Which way the passes run: along an edge, or what a coarse and then a fine search find.

What an angle costs is time: of the passes, of a turn at each, and of product sprayed twice.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import shapely
from shapely import Polygon
from shapely.geometry.base import BaseGeometry

from missions.maps.local import polygons_of
from missions.strips import Floats, lengths_m
from missions.swaths import inner_lines
from missions.turns import Motion

COARSE_DEG = 15.0
EDGES_MAX = 8
SMALL_SWATHS = 5.0
# Angles closer than this are the same edge, drawn twice.
SAME_DEG = 0.05
# Around the best, in two rounds: a tenth of a degree is a strip more or less on a long field.
FINE_DEG = (-1.0, -0.7, -0.5, -0.3, -0.2, -0.1, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0)
FINEST_DEG = (-0.06, -0.03, 0.03, 0.06)
# Ground sprayed twice also costs product: of a course a second of flight for a second of product,
# of the layouts drawn in full, which turn seldom where they overlap, half of one.
OVERLAP_WEIGHT, LAYOUT_WEIGHT = 1.0, 0.5


def edge_angles(ground: BaseGeometry) -> list[float]:
    """Return the courses of the longest edges of the ground and of its hull, 0 to 180."""
    found: dict[float, float] = {}
    for shape in (ground, ground.convex_hull):
        for part in shapely.get_parts(shape):
            points = shapely.get_coordinates(part.exterior)
            step = np.diff(points, axis=0)
            course = np.degrees(np.arctan2(step[:, 0], step[:, 1])) % 180.0
            for angle, length_m in zip(course.tolist(), np.hypot(*step.T).tolist(), strict=True):
                near = next((a for a in found if abs(a - angle) < SAME_DEG), angle)
                found[near] = found.get(near, 0.0) + length_m
    longest = sorted(found, key=lambda angle: -found[angle])
    return longest[:EDGES_MAX]


def main_course_deg(lines: Floats) -> float:
    """Return the course, 0 to 180, that most metres of lines are flown along, to a degree."""
    step = lines[:, 2:] - lines[:, :2]
    course = np.degrees(np.arctan2(step[:, 0], step[:, 1])) % 180.0
    off = np.abs((course[:, None] - course[None, :] + 90.0) % 180.0 - 90.0)
    return float(course[int(np.argmax((off < 1.0) @ lengths_m(lines)))])


def _without_small_holes(ground: BaseGeometry, width_m: float) -> BaseGeometry:
    """Return the ground with holes of a few swaths filled: no course is better for a tree."""
    least_m2 = (SMALL_SWATHS * width_m) ** 2
    filled: BaseGeometry = shapely.union_all(
        [
            Polygon(
                part.exterior,
                [ring for ring in part.interiors if Polygon(ring).area > least_m2],
            )
            for part in polygons_of(ground)
        ]
    )
    return filled


def cost_s(
    lines: Floats,
    motion: Motion,
    width_m: float,
    inner_m2: float,
    *,
    weight: float = OVERLAP_WEIGHT,
) -> float:
    """Return the time of these passes with a turn after each, plus that of what is doubled."""
    length_m = lengths_m(lines)
    flown_s = float(motion.legs_s(length_m).sum()) + len(lines) * motion.between_passes_s(width_m)
    doubled_m2 = max(float(length_m.sum()) * width_m - inner_m2, 0.0)
    return flown_s + weight * doubled_m2 / (width_m * motion.speed_m_s)


def ranked(
    inner: BaseGeometry, ground: BaseGeometry, *, width_m: float, motion: Motion
) -> list[tuple[float, float]]:
    """Return (cost in seconds, angle) of all angles that were tried, the best first."""
    inner = _without_small_holes(inner, width_m)
    if inner.is_empty:
        return [(0.0, angle) for angle in edge_angles(ground)[:1]]
    tried: dict[float, float] = {}

    def attempt(angles: Iterator[float]) -> None:
        for angle in angles:
            key = round(angle % 180.0, 4)
            if key not in tried:
                lines = inner_lines(inner, width_m, key)
                tried[key] = cost_s(lines, motion, width_m, inner.area)

    attempt(iter(np.arange(0.0, 180.0, COARSE_DEG).tolist()))
    attempt(iter(edge_angles(ground)))
    for changes in (FINE_DEG, FINEST_DEG):
        best = min(tried, key=lambda angle: (tried[angle], angle))
        attempt(best + change for change in changes)
    return sorted((cost, angle) for angle, cost in tried.items())
