"""What the boom sweeps over the ground while its valves are open: few and straight pieces."""

from __future__ import annotations

import math
from bisect import bisect_right
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from companion.core.boom import Boom
from companion.core.coverage import Quad
from companion.core.frame import Place
from companion.core.swath_liquid import Toggle

# So far a tip of the boom may be off a straight piece: below the noise of an RTK position.
STRAIGHT_M = 0.03
NEAR_M = 1e-6
# Strips of neighbours that touch to this are one.
TOUCH_M = 0.01


class Front(NamedTuple):
    """Where the boom was, the liquid's offset by the wind in it."""

    time_s: float
    east_m: float
    north_m: float
    heading_deg: float


def swept(
    boom: Boom,
    fronts: tuple[Front, ...],
    is_open: tuple[bool, ...],
    toggles: tuple[Toggle, ...],
) -> list[Quad]:
    """Return the quadrilaterals swept on the way through `fronts`; `is_open` holds at the first."""
    way = _Way(boom, fronts)
    stays = _stays(is_open, toggles, fronts[0].time_s, fronts[-1].time_s)
    return [quad for strip in _strips(boom, stays) for quad in way.quads(*strip)]


# From when until when liquid comes out of one valve.
_Stays = tuple[tuple[float, float], ...]


def _stays(
    is_open: tuple[bool, ...], toggles: tuple[Toggle, ...], start_s: float, end_s: float
) -> list[_Stays]:
    """Return when each valve is open between two times."""
    found: list[_Stays] = []
    for valve, opens in enumerate(is_open):
        stays = []
        since_s = start_s
        for toggle in toggles:
            if toggle.valve != valve or toggle.at_s > end_s or toggle.opens is opens:
                continue
            if opens:
                stays.append((since_s, toggle.at_s))
            opens, since_s = toggle.opens, max(toggle.at_s, start_s)
        if opens:
            stays.append((since_s, end_s))
        found.append(tuple(stay for stay in stays if stay[1] > stay[0]))
    return found


# Left and right end, place ahead, and when it is open: of valves side by side that are so together.
_Strip = tuple[float, float, float, _Stays]


def _strips(boom: Boom, stays: list[_Stays]) -> list[_Strip]:
    found: list[_Strip] = []
    for right_m, forward_m, half_m, own in zip(
        boom.right_m.tolist(),
        boom.forward_m.tolist(),
        boom.half_width_m.tolist(),
        stays,
        strict=True,
    ):
        left_m = right_m - half_m
        if found and found[-1][2:] == (forward_m, own) and abs(found[-1][1] - left_m) <= TOUCH_M:
            left_m = found.pop()[0]
        found.append((left_m, right_m + half_m, forward_m, own))
    return found


class _Way:
    """The way of the boom through its fronts, in as few straight pieces as it allows.

    Plain numbers: for some ten fronts that is several times as fast as arrays are.
    """

    def __init__(self, boom: Boom, fronts: tuple[Front, ...]) -> None:
        self._fronts = fronts
        reach_m = float((np.abs(boom.right_m) + boom.half_width_m).max())
        tips = []
        for _, east_m, north_m, heading_deg in fronts:
            angle = math.radians(heading_deg)
            sin, cos = reach_m * math.sin(angle), reach_m * math.cos(angle)
            tips.append((east_m - cos, north_m + sin, east_m + cos, north_m - sin))
        self._knots_s = [fronts[bend].time_s for bend in _bends(tips, 0, len(tips) - 1)]

    def quads(self, left_m: float, right_m: float, forward_m: float, stays: _Stays) -> list[Quad]:
        """Return the quadrilaterals that a strip sweeps while it is open."""
        found: list[Quad] = []
        for begin_s, end_s in stays:
            inner = [knot_s for knot_s in self._knots_s if begin_s < knot_s < end_s]
            ends = [
                self._ends(at_s, left_m, right_m, forward_m) for at_s in (begin_s, *inner, end_s)
            ]
            found.extend(
                (left, right, next_right, next_left)
                for (left, right), (next_left, next_right) in pairwise(ends)
            )
        return found

    def _ends(
        self, at_s: float, left_m: float, right_m: float, forward_m: float
    ) -> tuple[Place, Place]:
        """Return where the ends of a strip are at a time."""
        number = bisect_right(self._fronts, at_s, key=_time) - 1
        number = min(max(number, 0), len(self._fronts) - 2)
        first, last = self._fronts[number : number + 2]
        share = min(max((at_s - first.time_s) / (last.time_s - first.time_s), 0.0), 1.0)
        turned_deg = (last.heading_deg - first.heading_deg + 180.0) % 360.0 - 180.0
        angle = math.radians(first.heading_deg + share * turned_deg)
        sin, cos = math.sin(angle), math.cos(angle)
        east_m = first.east_m + share * (last.east_m - first.east_m) + forward_m * sin
        north_m = first.north_m + share * (last.north_m - first.north_m) + forward_m * cos
        return (
            (east_m + left_m * cos, north_m - left_m * sin),
            (east_m + right_m * cos, north_m - right_m * sin),
        )


def _time(front: Front) -> float:
    return front.time_s


def _bends(tips: list[tuple[float, float, float, float]], first: int, last: int) -> list[int]:
    """Return the indices between which both tips go straight (as Douglas and Peucker have it)."""
    x0, y0, x1, y1 = tips[first]
    x2, y2, x3, y3 = tips[last]
    dx, dy, ex, ey = x2 - x0, y2 - y0, x3 - x1, y3 - y1
    left, right = math.hypot(dx, dy), math.hypot(ex, ey)
    worst, worst_m = 0, STRAIGHT_M
    for number in range(first + 1, last):
        xa, ya, xb, yb = tips[number]
        xa, ya, xb, yb = xa - x0, ya - y0, xb - x1, yb - y1
        off_m = max(
            abs(xa * dy - ya * dx) / left if left > NEAR_M else math.hypot(xa, ya),
            abs(xb * ey - yb * ex) / right if right > NEAR_M else math.hypot(xb, yb),
        )
        if off_m > worst_m:
            worst, worst_m = number, off_m
    if not worst:
        return []
    return [*_bends(tips, first, worst), worst, *_bends(tips, worst, last)]
