"""Lines with an end of the boom beyond the border, where the valves of that end are closed.

Ground that is no whole number of swaths wide is then covered by whole swaths all the same: what is
too much lies outside, not on what was sprayed before.
"""

from __future__ import annotations

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from companion.wording import counted
from missions.boom import Boom
from missions.strips import Floats, directions, joined, lengths_m, rectangles, whole
from missions.swaths import axes, count_across

# What may be missing to a whole valve is a gap that nobody can see.
ROUND_M = 0.01
# What margins and rounding leave beyond the border.
BEYOND_M2 = 0.1


def over_warnings(lines: Floats, ground: BaseGeometry, boom: Boom) -> tuple[str, ...]:
    """Return what whole booms would spray off the ground, where ends are beyond its border."""
    if not boom.closes:
        return ()
    strips = rectangles(lines, boom.width_m)
    beyond_m2 = shapely.area(shapely.difference(strips, ground))
    count = int(np.count_nonzero(beyond_m2 > BEYOND_M2))
    if not count:
        return ()
    off_m2 = float(whole(strips).difference(ground).area)
    return (
        f"{counted(count, 'line')} with an end of the boom beyond the border: to be flown "
        f'with the companion and border = "inside" alone; whole booms would spray {off_m2:.0f} m2 '
        "off the field",
    )


def lines_over(ground: BaseGeometry, boom: Boom, angle_deg: float) -> Floats:
    """Return lines side by side, with ends of the boom beyond the border on both sides."""
    turned_by = axes(angle_deg)
    turned = shapely.transform(ground, lambda points: points @ turned_by.T)
    rows = []
    for part in shapely.get_parts(turned):
        west, low, east, high = part.bounds
        rows += [
            [west - 1.0, middle, east + 1.0, middle] for middle in side_by_side(low, high, boom)
        ]
    lines = np.array(rows)
    return boom.where_open(np.column_stack([lines[:, :2] @ turned_by, lines[:, 2:] @ turned_by]))


def side_by_side(low: float, high: float, boom: Boom) -> list[float]:
    """Return the middles of strips that cover from `low` to `high`, with ends beyond both.

    What whole valves beyond the edges do not take up falls twice, in one place.
    """
    width_m = boom.width_m
    count = count_across(high - low, width_m)
    if count == 1:
        return [(low + high) / 2.0]
    spare_m = count * width_m - (high - low)
    pairs = [(a, b) for a in boom.over_m for b in boom.over_m if a + b <= spare_m + ROUND_M]
    first_m, last_m = max(pairs, key=lambda pair: (sum(pair), -abs(pair[0] - pair[1])))
    first, last = low + width_m / 2.0 - first_m, high - width_m / 2.0 + last_m
    return [min(first + width_m * number, last) for number in range(count)]


def passes_over(ground: BaseGeometry, boom: Boom) -> Floats:
    """Return lines along every long edge, with whole valves of the boom beyond it."""
    half_m, found = boom.width_m / 2.0, []
    for part in shapely.get_parts(shapely.orient_polygons(ground)):
        for ring in (part.exterior, *part.interiors):
            points = shapely.get_coordinates(ring)
            edges = np.column_stack([points[:-1], points[1:]])
            edges = edges[lengths_m(edges) > boom.width_m]
            if not len(edges):
                continue
            along = directions(edges)
            inwards = np.column_stack([-along[:, 1], along[:, 0]])
            for over_m in boom.over_m[1:]:
                aside, longer = inwards * (half_m - over_m), along * boom.width_m
                found.append(
                    np.column_stack([edges[:, :2] + aside - longer, edges[:, 2:] + aside + longer])
                )
    return boom.where_open(joined(found))
