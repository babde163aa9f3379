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


# Take-off, return and landing: what a sortie takes beside its way over ground.


@dataclass(frozen=True, slots=True, kw_only=True)
class Vertical:
    """How an autopilot climbs and lands, its parameters as they come.

    `ready_s` passes before the aircraft leaves the ground, `settled_s` at the last waypoint,
    `loiter_s` over home, `down_s` on the ground until it disarms. It returns at
    `return_height_m`, or its own height if that is more, climbs there at `rise_m_s`, and goes down
    slowly from `slow_m`. Less than `near_m` from home it does not climb.
    """

    ready_s: float
    climb_m_s: float
    rise_m_s: float
    descent_m_s: float
    acceleration_m_s2: float
    settled_s: float
    return_height_m: float
    loiter_s: float
    slow_m: float
    land_m_s: float
    down_s: float
    near_m: float = 0.0

    def climb_s(self, height_m: float) -> float:
        """Return the time from the order to take off until the way begins."""
        return self.ready_s + self._way_s(height_m, self.climb_m_s)

    def return_s(self, height_m: float, away_m: float = math.inf) -> float:
        """Return the time from the last waypoint until disarmed, but for the way home."""
        above_m = max(self.return_height_m - height_m, 0.0) if away_m >= self.near_m else 0.0
        top_m = height_m + above_m
        slow_m = min(self.slow_m, top_m)
        down_s = self._way_s(top_m - slow_m, self.descent_m_s) + slow_m / self.land_m_s
        up_s = self._way_s(above_m, self.rise_m_s)
        return self.settled_s + up_s + self.loiter_s + down_s + self.down_s

    def change_s(self, from_m: float, to_m: float) -> float:
        """Return the time from one height to another, standing over one place."""
        return self._way_s(
            abs(to_m - from_m), self.climb_m_s if to_m > from_m else self.descent_m_s
        )

    def _way_s(self, length_m: float, speed_m_s: float) -> float:
        """Return the time of a climb or descent from rest to rest."""
        if length_m < speed_m_s**2 / self.acceleration_m_s2:
            return 2.0 * math.sqrt(length_m / self.acceleration_m_s2)
        return length_m / speed_m_s + speed_m_s / self.acceleration_m_s2


# ArduCopter: WPNAV_SPEED_UP, WPNAV_SPEED_DN, WPNAV_ACCEL_Z, RTL_ALT, RTL_LOIT_TIME, LAND_ALT_LOW,
# LAND_SPEED; the rest as timed beside ArduCopter 4.7. PX4: MPC_TKO_SPEED, MPC_Z_V_AUTO_DN,
# MPC_ACC_DOWN_MAX, RTL_RETURN_ALT of its multicopters, RTL_MIN_DIST, MPC_LAND_SPEED; the rest as
# timed beside PX4 1.16, whose slowing down between MPC_LAND_ALT1 and MPC_LAND_ALT2 takes as long as
# from 8 m.
VERTICALS = {
    "ardupilot": Vertical(
        ready_s=4.0, climb_m_s=2.5, rise_m_s=2.5, descent_m_s=1.5, acceleration_m_s2=1.0,
        settled_s=0.0, return_height_m=15.0, loiter_s=5.0, slow_m=10.0, land_m_s=0.5, down_s=2.3,
    ),
    "px4": Vertical(
        ready_s=4.0, climb_m_s=1.5, rise_m_s=1.8, descent_m_s=1.5, acceleration_m_s2=3.0,
        settled_s=1.0, return_height_m=30.0, loiter_s=0.0, slow_m=8.0, land_m_s=0.7, down_s=8.0,
        near_m=10.0,
    ),
}  # fmt: skip
