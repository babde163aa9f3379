"""How long a leg takes: laws of a multirotor that accelerates and brakes evenly."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from missions.strips import Floats

Turn = Literal["stop", "strafe", "rounded"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """How the aircraft flies; `turn` is what it does between passes."""

    speed_m_s: float
    acceleration_m_s2: float
    turn: Turn = "stop"

    def legs_s(self, length_m: Floats) -> Floats:
        """Return the time of straight legs that begin and end at rest.

        t = 2 sqrt(d / a) below v^2 / a, else d / v + v / a.

        >>> motion = Motion(speed_m_s=6.0, acceleration_m_s2=2.5)
        >>> motion.legs_s(np.array([7.0, 60.0])).round(2).tolist()
        [3.35, 12.4]
        """
        speed, acceleration = self.speed_m_s, self.acceleration_m_s2
        long_s = length_m / speed + speed / acceleration
        short_s = 2.0 * np.sqrt(np.maximum(length_m, 0.0) / acceleration)
        taken: Floats = np.where(length_m < speed**2 / acceleration, short_s, long_s)
        return taken

    def leg_s(self, length_m: float) -> float:
        """Return the time of one leg, from rest to rest."""
        return float(self.legs_s(np.array([length_m]))[0])

    def between_passes_s(self, aside_m: float) -> float:
        """Return the time from the end of one pass to the start of the next beside it.

        A stop and a strafe are a leg from rest to rest. Rounded is half a circle, at the speed
        whose centripetal acceleration is that of the vehicle; the passes' own braking to rest,
        which `legs_s` counts, is then less, too.

        >>> Motion(speed_m_s=6.0, acceleration_m_s2=2.5).between_passes_s(7.0) > 3.3
        True
        """
        if self.turn != "rounded":
            return self.leg_s(aside_m)
        around_m_s = min(self.speed_m_s, math.sqrt(self.acceleration_m_s2 * aside_m / 2.0))
        arc_s = math.pi * aside_m / 2.0 / max(around_m_s, 0.1)
        # Each pass saves half of the time between the turn's speed and rest.
        return min(arc_s - around_m_s / self.acceleration_m_s2, self.leg_s(aside_m))
