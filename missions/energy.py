"""Watt-hours of a flight: power by what the aircraft does and how much it carries, times time."""

from __future__ import annotations

import math
from dataclasses import dataclass

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
