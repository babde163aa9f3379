"""Watt-hours of a flight: power by what the aircraft does and how much it carries, times time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from missions.turns import Turn

if TYPE_CHECKING:
    from missions.plan import Leg, Sortie
    from missions.verticals import Vertical

# Spray liquid is water, but for a few per cent.
KG_L = 1.0
J_WH = 3600.0
# A change of course below this is flown through: the nose turns on the way.
STRAIGHT_DEG = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Battery:
    """What the aircraft draws with an empty tank, each kilogram more of liquid, and what it has.

    `capacity_wh` is None where only the use is wanted. `cruise_w` holds at constant speed,
    `hover_w` for everything else: speeding up, braking, turning, climbing and descending.
    """

    hover_w: float
    cruise_w: float
    per_kg_w: float = 0.0
    capacity_wh: float | None = None
    reserve_percent: float = 20.0

    def __post_init__(self) -> None:
        for name in ("hover_w", "cruise_w"):
            if not 0.0 < getattr(self, name) < 1e6:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if not 0.0 <= self.per_kg_w < 1e5 or not 0.0 <= self.reserve_percent < 100.0:
            raise ValueError("power per kg and reserve must not be negative, a reserve below 100")
        if self.capacity_wh is not None and not 0.0 < self.capacity_wh < 1e7:
            raise ValueError(f"capacity_wh must be positive, got {self.capacity_wh}")

    @property
    def usable_wh(self) -> float:
        """Return what may be drawn in one sortie; without a battery given, as much as it takes."""
        if self.capacity_wh is None:
            return math.inf
        return self.capacity_wh * (1.0 - self.reserve_percent / 100.0)

    def wh(self, *, cruise_s: float, other_s: float, litres: float) -> float:
        """Return the use with so much liquid on board.

        >>> Battery(hover_w=3600.0, cruise_w=1800.0, per_kg_w=36.0).wh(
        ...     cruise_s=10.0, other_s=2.0, litres=10.0)
        8.2
        """
        drawn = cruise_s * self.cruise_w + other_s * self.hover_w
        return (drawn + (cruise_s + other_s) * litres * KG_L * self.per_kg_w) / J_WH


def nose_s(legs: Sequence[Leg], *, turn: Turn, rate_deg_s: float | None) -> float:
    """Return how long the aircraft stands and turns its nose, at every corner of its way.

    Only one that stops and flies nose first does so, and only where the rate is given.
    """
    if rate_deg_s is None or turn != "stop":
        return 0.0
    points = [point for leg in legs for point in leg.points]
    courses = [
        math.degrees(math.atan2(b[0] - a[0], b[1] - a[1]))
        for a, b in pairwise(points)
        if math.dist(a, b) > 1e-3
    ]
    bends = [abs((b - a + 180.0) % 360.0 - 180.0) for a, b in pairwise(courses)]
    return sum(bend for bend in bends if bend >= STRAIGHT_DEG) / rate_deg_s


def sortie_wh(
    sortie: Sortie,
    battery: Battery,
    *,
    vertical: Vertical,
    height_m: float,
    reserve_l: float,
    nose_turn_s: float,
) -> float:
    """Return the use of a sortie: the tank empties line by line, down to its reserve.

    Turning the nose is counted with half of the sortie's litres on board.
    """
    left_l = sortie.volume_l + reserve_l
    first_m, last_m = sortie.end_heights_m(height_m)
    used = battery.wh(cruise_s=0.0, other_s=vertical.climb_s(first_m), litres=left_l)
    used += battery.wh(
        cruise_s=0.0, other_s=vertical.return_s(last_m, sortie.home_m), litres=reserve_l
    )
    middle_l = reserve_l + sortie.volume_l / 2.0
    used += battery.wh(cruise_s=0.0, other_s=nose_turn_s, litres=middle_l)
    for leg in sortie.legs:
        cruise_s = min(leg.length_m / leg.speed_m_s, leg.seconds)
        used += battery.wh(
            cruise_s=cruise_s, other_s=leg.seconds - cruise_s, litres=left_l - leg.volume_l / 2.0
        )
        left_l -= leg.volume_l
    return used
