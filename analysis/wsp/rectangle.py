"""The smallest rectangle around points, and which pixels lie in one: the shape of a card."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Rectangle:
    """A rectangle in pixels of a sheet, x to the right and y down; `long` lies at `angle_deg`.

    `angle_deg` is that of the long side against the picture's right, clockwise, -90 to 90.
    """

    x: float
    y: float
    long: float
    short: float
    angle_deg: float

    @property
    def corners(self) -> Floats:
        """Return the four corners, (4, 2), in order around the rectangle."""
        along, across = self._axes()
        a, b = along * self.long / 2.0, across * self.short / 2.0
        middle = np.array([self.x, self.y])
        return np.asarray(middle + np.array([-a - b, a - b, a + b, -a + b]))

    def _axes(self) -> tuple[Floats, Floats]:
        angle = np.deg2rad(self.angle_deg)
        along = np.array([np.cos(angle), np.sin(angle)])
        return along, np.array([-along[1], along[0]])

    def scaled(self, factor: float) -> Rectangle:
        """Return the same rectangle on a sheet with `factor` times the pixels."""
        return Rectangle(
            x=self.x * factor,
            y=self.y * factor,
            long=self.long * factor,
            short=self.short * factor,
            angle_deg=self.angle_deg,
        )

    def inset(self, margin: float) -> Rectangle:
        """Return the rectangle less `margin` on each side; ValueError where nothing is left."""
        if not self.short > 2.0 * margin:
            raise ValueError(f"a margin of {margin} leaves nothing of {self.short}")
        return Rectangle(
            x=self.x,
            y=self.y,
            long=self.long - 2.0 * margin,
            short=self.short - 2.0 * margin,
            angle_deg=self.angle_deg,
        )

    def box(self, width: int, height: int) -> tuple[int, int, int, int]:
        """Return left, top, right, bottom [px] of what lies on a sheet of this size."""
        low, high = np.floor(self.corners.min(axis=0)), np.ceil(self.corners.max(axis=0))
        left, top = max(int(low[0]), 0), max(int(low[1]), 0)
        return left, top, min(int(high[0]), width), min(int(high[1]), height)

    def mask(self, box: tuple[int, int, int, int]) -> Mask:
        """Return which pixels of a box have their centres inside."""
        left, top, right, bottom = box
        # Single precision: 1e-3 of a pixel on a sheet of 14 000, at half the time.
        dx = (np.arange(left, right) + 0.5 - self.x).astype(np.float32)
        dy = (np.arange(top, bottom) + 0.5 - self.y).astype(np.float32)[:, None]
        along, across = (axis.astype(np.float32) for axis in self._axes())
        inside = np.abs(dx * along[0] + dy * along[1]) <= self.long / 2.0
        inside &= np.abs(dx * across[0] + dy * across[1]) <= self.short / 2.0
        return np.asarray(inside)


def around(x: Floats, y: Floats) -> Rectangle | None:
    """Return the smallest rectangle around points; None where they lie in a line.

    One of its sides lies along a side of the convex hull, so those are tried.
    """
    hull = _hull(x, y)
    if len(hull) < 3:
        return None
    sides = np.roll(hull, -1, axis=0) - hull
    angles = np.arctan2(sides[:, 1], sides[:, 0])
    cos, sin = np.cos(angles)[:, None], np.sin(angles)[:, None]
    u, v = hull[:, 0] * cos + hull[:, 1] * sin, hull[:, 1] * cos - hull[:, 0] * sin
    width, height = np.ptp(u, axis=1), np.ptp(v, axis=1)
    best = int(np.argmin(width * height))
    middle_u = (u[best].max() + u[best].min()) / 2.0
    middle_v = (v[best].max() + v[best].min()) / 2.0
    c, s = float(cos[best, 0]), float(sin[best, 0])
    is_long = width[best] >= height[best]
    angle_deg = float(np.rad2deg(angles[best])) + (0.0 if is_long else 90.0)
    return Rectangle(
        x=float(middle_u * c - middle_v * s),
        y=float(middle_u * s + middle_v * c),
        long=float(max(width[best], height[best])),
        short=float(min(width[best], height[best])),
        angle_deg=(angle_deg + 90.0) % 180.0 - 90.0,
    )


def _hull(x: Floats, y: Floats) -> Floats:
    """Return the corners of the convex hull in order, (n, 2); fewer than three of a line."""
    order = np.lexsort((x, y))
    x, y = x[order], y[order]
    # Only the first and the last point of a row can be corners.
    is_first = np.diff(y, prepend=np.nan) != 0.0
    is_end = is_first | np.roll(is_first, -1)
    points = list(zip(x[is_end].tolist(), y[is_end].tolist(), strict=True))
    return np.array(_chain(points)[:-1] + _chain(points[::-1])[:-1]).reshape(-1, 2)


def _chain(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the hull on one side of points in order (Andrew's monotone chain)."""
    chain: list[tuple[float, float]] = []
    for point in points:
        while len(chain) > 1 and _bend(chain[-2], chain[-1], point) <= 0.0:
            chain.pop()
        if not chain or point != chain[-1]:
            chain.append(point)
    return chain


def _bend(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
