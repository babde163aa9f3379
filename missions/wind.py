"""Buffers of areas that must not be sprayed, wider where the wind blows towards them.

At a place of the field whose way to the area has the unit vector u, with the wind blowing along
the vector w, the buffer is

    buffer = base + k * max(0, w . u)

the base (what the label asks for, at least) plus `k` metres for each m/s of the wind that blows
towards the area. Across the wind and downwind of the area the base holds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from missions.strips import Floats

# The reach around a point is drawn in steps of this angle, so much too wide that the corners'
# chords lie outside the curve: 1 / cos(1.5 degrees) and the curve's own bend over 3 degrees.
STEP_DEG, WIDER = 3.0, 1.0005 / math.cos(math.radians(1.5))
# Areas with more corners are simplified outwards first.
CORNERS_MAX, SIMPLER_M = 400, 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class WindBuffer:
    """Wind as it is reported, by where it comes from, and the metres for each m/s of it."""

    speed_m_s: float
    from_deg: float
    m_per_m_s: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.speed_m_s <= 100.0:
            raise ValueError(f"a wind of {self.speed_m_s} m/s does not exist")
        if not -360.0 <= self.from_deg <= 360.0:
            raise ValueError(f"{self.from_deg} is no direction of the wind")
        if not 0.0 <= self.m_per_m_s <= 1000.0:
            raise ValueError(f"{self.m_per_m_s} m for each m/s of wind is no buffer")

    @property
    def extra_m(self) -> float:
        """Return what the wind adds straight upwind of an area."""
        return self.speed_m_s * self.m_per_m_s

    def width_m(self, towards_deg: float, base_m: float) -> float:
        """Return the buffer where the area lies in this direction, clockwise from north.

        >>> west = WindBuffer(speed_m_s=4.0, from_deg=270.0, m_per_m_s=2.5)
        >>> [round(west.width_m(to, 5.0), 9) for to in (90.0, 150.0, 180.0, 270.0)]
        [15.0, 10.0, 5.0, 5.0]
        """
        off_deg = towards_deg - (self.from_deg + 180.0)
        return base_m + self.extra_m * max(0.0, math.cos(math.radians(off_deg)))

    def around(self, area: BaseGeometry, base_m: float) -> BaseGeometry:
        """Return the ground that is nearer to some place of an area than its buffer there."""
        plain: BaseGeometry = area.buffer(base_m)
        if not self.extra_m > 0.0 or area.is_empty:
            return plain
        fan = self._fan(base_m)
        edges = _edges(area)
        # A convex piece carried along a straight edge sweeps the hull of its two ends.
        start, end = edges[:, None, None, :2] + fan[None], edges[:, None, None, 2:] + fan[None]
        swept = np.concatenate([start, end], axis=2).reshape(-1, 6, 2)
        hulls = np.asarray(shapely.convex_hull(shapely.linestrings(swept)), dtype=object)
        found: BaseGeometry = shapely.union_all([plain, *hulls.tolist()])
        return found

    def _fan(self, base_m: float) -> Floats:
        """Return the reach upwind of a point as triangles from it, (triangles, 3, 2)."""
        count = round(180.0 / STEP_DEG)
        off = np.radians(np.linspace(-90.0, 90.0, count + 1))
        reach = (base_m + self.extra_m * np.cos(off)) * WIDER
        angle = np.radians(self.from_deg) + off
        tips = np.column_stack([reach * np.sin(angle), reach * np.cos(angle)])
        triangles: Floats = np.stack([np.zeros((count, 2)), tips[:-1], tips[1:]], axis=1)
        return triangles


def _edges(area: BaseGeometry) -> Floats:
    """Return all edges of an area as rows of start and end."""
    if len(shapely.get_coordinates(area)) > CORNERS_MAX:
        area = area.simplify(SIMPLER_M).buffer(SIMPLER_M, join_style="mitre")
    rings = shapely.get_rings(shapely.get_parts(area))
    points = [shapely.get_coordinates(ring) for ring in rings]
    found: Floats = np.concatenate([np.column_stack([one[:-1], one[1:]]) for one in points])
    return found
