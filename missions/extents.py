"""Which valves are open where: the companion closes a strip that touches the border.

A strip here is the segment of the boom that one valve sprays. On a pass along the border the
outer one is closed all the way, and the plan counts no litres for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from missions.strips import Floats

Bools = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Extents:
    """Ground on which a strip may be open, and the part of it deep inside the whole boom."""

    ground: BaseGeometry
    deep: BaseGeometry

    def deep_inside(self, middle: Floats) -> Bools:
        """Return where the whole boom is far from any border."""
        found: Bools = shapely.contains_xy(self.deep, middle[:, 0], middle[:, 1])
        return found

    def is_open(self, middle: Floats, right: Floats, strip: tuple[float, float]) -> Bools:
        """Return where the strip (right_m, width_m) of a boom lies on the ground as a whole."""
        right_m, width_m = strip
        found = np.ones(len(middle), dtype=np.bool_)
        for across_m in (right_m - width_m / 2.0, right_m, right_m + width_m / 2.0):
            places = middle + right * across_m
            found &= shapely.contains_xy(self.ground, places[:, 0], places[:, 1])
        return found


def extents_of(limit: BaseGeometry, *, width_m: float, buffer_m: float) -> Extents:
    """Return the extents of a field whose border is kept off by `buffer_m`."""
    ground = limit.buffer(-buffer_m)
    deep = limit.buffer(-(buffer_m + width_m / 2.0))
    shapely.prepare(ground)
    shapely.prepare(deep)
    return Extents(ground=ground, deep=deep)
