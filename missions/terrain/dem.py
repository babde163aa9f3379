"""An elevation model: heights of the ground in rows and columns, read between its posts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pyproj import CRS, Transformer

from companion.core.frame import LocalFrame
from missions.strips import Floats

# Heights of the ground on land, Dead Sea and Everest with room; other numbers are fills.
LOWEST_M, HIGHEST_M = -500.0, 9000.0
# Rounding must not put a place on the last post outside the model.
EDGE_CELLS = 1e-6
WGS84_CRS = CRS.from_epsg(4326)


@dataclass(frozen=True)
class Dem:
    """Heights in metres, NaN where there are none, at posts (the middles of cells).

    `transform` leads from column and row of a post to x and y of `crs`, as (a, b, c, d, e, f):
    x = a column + b row + c, y = d column + e row + f. Only differences of heights are used, so
    that it does not matter above which surface they count, as long as it is one.
    """

    name: str
    heights_m: Floats
    transform: tuple[float, float, float, float, float, float]
    crs: CRS

    def __post_init__(self) -> None:
        if self.heights_m.ndim != 2 or min(self.heights_m.shape) < 2:
            raise ValueError(f"{self.name}: heights in two rows and columns or more are needed")

    @cached_property
    def _inverse(self) -> Floats:
        a, b, _, d, e, _ = self.transform
        found: Floats = np.linalg.inv(np.array([[a, b], [d, e]]))
        return found

    @cached_property
    def _to_crs(self) -> Transformer:
        return Transformer.from_crs(WGS84_CRS, self.crs, always_xy=True)

    def at(self, latitude_deg: Floats, longitude_deg: Floats) -> Floats:
        """Return the heights at places, NaN outside and beside missing posts (bilinear)."""
        x, y = self._to_crs.transform(longitude_deg, latitude_deg)
        c, f = self.transform[2], self.transform[5]
        column, row = self._inverse @ np.stack([np.asarray(x) - c, np.asarray(y) - f])
        rows, columns = self.heights_m.shape
        inside = (column >= -EDGE_CELLS) & (column <= columns - 1 + EDGE_CELLS)
        inside &= (row >= -EDGE_CELLS) & (row <= rows - 1 + EDGE_CELLS)
        column, row = np.where(inside, column, 0.0), np.where(inside, row, 0.0)
        left = np.clip(np.floor(column), 0, columns - 2).astype(np.int64)
        top = np.clip(np.floor(row), 0, rows - 2).astype(np.int64)
        right_share = np.clip(column - left, 0.0, 1.0)
        down_share = np.clip(row - top, 0.0, 1.0)
        found = np.zeros_like(right_share)
        for down in (0, 1):
            for right in (0, 1):
                share = right_share if right else 1.0 - right_share
                share = share * (down_share if down else 1.0 - down_share)
                height = self.heights_m[top + down, left + right]
                # A missing post beside a place on a row or column of posts has no share in it.
                found = found + np.where(share > 0.0, share * height, 0.0)
        usable = inside & (found >= LOWEST_M) & (found <= HIGHEST_M)
        result: Floats = np.where(usable, found, np.nan)
        return result

    def under(self, frame: LocalFrame, places: Floats) -> Floats:
        """Return the heights at rows of east and north in a frame."""
        latitude_deg, longitude_deg = frame.to_geographic_all(
            places[:, 0].tolist(), places[:, 1].tolist()
        )
        return self.at(np.array(latitude_deg), np.array(longitude_deg))

    def step_m(self, frame: LocalFrame) -> float:
        """Return how closely a way over it is looked at: half a cell, from 1 m to 15 m."""
        a, b, _, d, e, _ = self.transform
        cells = min(float(np.hypot(a, d)), float(np.hypot(b, e)))
        if self.crs.is_geographic:
            shrunk = float(np.cos(np.radians(frame.latitude_deg)))
            cells *= 111_000.0 * max(shrunk, 0.05)
        else:
            cells *= self.crs.axis_info[0].unit_conversion_factor or 1.0
        return min(max(cells / 2.0, 1.0), 15.0)
