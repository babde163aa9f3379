"""How a copter leans, and what its accelerometer feels, as it truly moves.

A copter pushes straight up along its own axis. So it leans into its acceleration and against the
air, and its accelerometer feels that push and the drag, but never gravity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

GRAVITY_M_S2 = 9.80665
# The air's drag: 5 m/s are 0.7 m/s2, which a copter leans against by 4 degrees.
DRAG_1_S = 0.14
# What is felt is a mean of about so long: of ArduPilot's filter of 20 Hz.
MEAN_S = 0.02


class Moves(Protocol):
    """The true motion at one time."""

    @property
    def velocity_east_m_s(self) -> float:
        """Return the velocity to the east."""

    @property
    def velocity_north_m_s(self) -> float:
        """Return the velocity to the north."""

    @property
    def heading_deg(self) -> float:
        """Return where the nose points."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Leaning:
    """Roll, pitch and yaw, and what is felt along the body: forward, right, down."""

    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    felt_m_s2: tuple[float, float, float]


def leaning(before: Moves, now: Moves, dt_s: float) -> Leaning:
    """Return how it leans between two moments `dt_s` apart."""
    yaw = math.radians(now.heading_deg)
    sin, cos = math.sin(yaw), math.cos(yaw)
    east = (now.velocity_east_m_s - before.velocity_east_m_s) / dt_s
    north = (now.velocity_north_m_s - before.velocity_north_m_s) / dt_s
    ahead, aside = east * sin + north * cos, east * cos - north * sin
    speed_ahead = now.velocity_east_m_s * sin + now.velocity_north_m_s * cos
    speed_aside = now.velocity_east_m_s * cos - now.velocity_north_m_s * sin
    push_ahead, push_aside = ahead + DRAG_1_S * speed_ahead, aside + DRAG_1_S * speed_aside
    pitch = -math.atan2(push_ahead, GRAVITY_M_S2)
    roll = math.atan2(push_aside, math.hypot(GRAVITY_M_S2, push_ahead))
    # What is felt has no gravity in it: level and at rest, 9.8 m/s2 upwards.
    forward = ahead * math.cos(pitch) + GRAVITY_M_S2 * math.sin(pitch)
    below = ahead * math.sin(pitch) - GRAVITY_M_S2 * math.cos(pitch)
    right = aside * math.cos(roll) + below * math.sin(roll)
    down = below * math.cos(roll) - aside * math.sin(roll)
    return Leaning(roll_rad=roll, pitch_rad=pitch, yaw_rad=yaw, felt_m_s2=(forward, right, down))
