"""Borders with fewer corners that hold all that they held, within ground that is allowed.

`missions.fewer_corners` keeps as near to a border everywhere. A fence only has to keep near to the
field: inside of it, bays and corners beside a way may be closed as far as that saves corners.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Polygon
from shapely.geometry.base import BaseGeometry
from shapely.geometry.polygon import orient

from missions.strips import Floats

Ints = NDArray[np.int64]
# Smaller ground is rounding: it is not looked at whether that is allowed.
LEAST_M2 = 1e-9


def with_corners(border: Polygon, allowed: BaseGeometry, most: int) -> Polygon:
    """Return a border around all of another one with so many corners, or as few as it takes.

    Step by step a corner inwards is left out, or an edge whose neighbours then meet farther out,
    whichever adds least ground; what is added lies within `allowed`.
    """
    shapely.prepare(allowed)
    points = shapely.get_coordinates(orient(Polygon(border.exterior)).exterior)[:-1]
    while len(points) > max(most, 3):
        for fewer, added in _steps(points):
            if Polygon(fewer).is_valid and (added.area <= LEAST_M2 or allowed.covers(added)):
                points = fewer
                break
        else:
            break
    return Polygon(points)


def _steps(points: Floats) -> Iterator[tuple[Floats, Polygon]]:
    """Yield the borders with one corner less and the ground that each adds, the least first."""
    before, after = np.roll(points, 1, axis=0), np.roll(points, -1, axis=0)
    turn = _cross(points - before, after - points)
    inwards = np.flatnonzero(turn <= 0.0)
    edges, met = _meeting(points, turn)
    triangles = np.concatenate(
        [
            np.stack([before[inwards], points[inwards], after[inwards]], axis=1),
            np.stack([points[edges], met, after[edges]], axis=1),
        ]
    )
    grounds = np.asarray(shapely.polygons(triangles))
    for at in np.argsort(shapely.area(grounds), kind="stable").tolist():
        if at < len(inwards):
            yield np.delete(points, inwards[at], axis=0), grounds[at]
            continue
        edge = int(edges[at - len(inwards)])
        fewer = points.copy()
        fewer[edge] = met[at - len(inwards)]
        yield np.delete(fewer, (edge + 1) % len(points), axis=0), grounds[at]


def _meeting(points: Floats, turn: Floats) -> tuple[Ints, Floats]:
    """Return edges between two outward corners, and where the edges beside each meet beyond it."""
    edges = np.flatnonzero((turn > 0.0) & (np.roll(turn, -1) > 0.0))
    start, end = points[edges], np.roll(points, -1, axis=0)[edges]
    one = start - np.roll(points, 1, axis=0)[edges]
    other = end - np.roll(points, -2, axis=0)[edges]
    sine, across = _cross(one, other), end - start
    flat = np.abs(sine) < 1e-9 * np.hypot(*one.T) * np.hypot(*other.T)
    sine = np.where(flat, 1.0, sine)
    on_one, on_other = _cross(across, other) / sine, _cross(across, one) / sine
    meets = ~flat & (on_one > 0.0) & (on_other > 0.0)
    found: Floats = (start + one * on_one[:, None])[meets]
    return edges[meets], found


def _cross(one: Floats, other: Floats) -> Floats:
    found: Floats = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]
    return found
