"""How long ways take: laws of a multirotor that speeds up and brakes within its jerk."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from missions.corners import CornerRule, Course, parts_s
from missions.strips import Floats

Turn = Literal["stop", "strafe", "rounded"]

# Passes so long, in accelerations, reach their speed; ways aside between them are tabled so far.
LONG, ASIDE_KNOTS_M = 10.0, np.geomspace(0.05, 20_000.0, 160)
SQUARE_DEG = 90.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """How the aircraft flies: `turn` is what its nose does between passes, `corners` whose rule.

    Without a jerk the acceleration changes at once.
    """

    speed_m_s: float
    acceleration_m_s2: float
    jerk_m_s3: float | None = None
    turn: Turn = "stop"
    corners: CornerRule = "stop"

    def legs_s(self, length_m: Floats) -> Floats:
        """Return the time of straight legs that begin and end at rest.

        Without a jerk t = 2 sqrt(d / a) below v^2 / a, else d / v + v / a.

        >>> motion = Motion(speed_m_s=6.0, acceleration_m_s2=2.5)
        >>> motion.legs_s(np.array([7.0, 60.0])).round(2).tolist()
        [3.35, 12.4]
        """
        speed, short = self.speed_m_s, _short_legs(self)
        taken: Floats = length_m / speed + short.reaching_s
        is_short = length_m < speed * short.reaching_s
        root_m = np.sqrt(np.maximum(length_m[is_short], 0.0))
        taken[is_short] = np.interp(root_m, short.root_m, short.seconds)
        return taken

    def leg_s(self, length_m: float) -> float:
        """Return the time of one leg, from rest to rest."""
        return float(self.legs_s(np.array([length_m]))[0])

    def between_passes_s(self, aside_m: float) -> float:
        """Return what the way from the end of one pass to the start of the next beside it adds.

        The passes themselves count from rest to rest. Below zero, where the corners are flown
        faster than that spares.

        >>> Motion(speed_m_s=6.0, acceleration_m_s2=2.5).between_passes_s(7.0) > 3.3
        True
        """
        return float(self.ways_s(np.array([aside_m]))[0])

    def ways_s(self, length_m: Floats) -> Floats:
        """Return what ways between two long passes add, with a square corner at both ends."""
        if self.corners == "stop":
            return self.legs_s(length_m)
        added: Floats = self.legs_s(length_m) - np.interp(
            length_m, ASIDE_KNOTS_M, _spared_at_corners_s(self)
        )
        return added

    def spared_straight_s(self, one_m: Floats, other_m: Floats) -> Floats:
        """Return what two legs take less than from rest to rest, where one goes on in the other.

        Legs of a row never spare more than they take.
        """
        one_s, other_s = self.legs_s(one_m), self.legs_s(other_m)
        if self.corners == "ardupilot":
            halves_s = np.minimum(one_s, other_s) / 2.0
            spared: Floats = np.minimum(halves_s, _short_legs(self).reaching_s)
            return spared
        stopping_s = one_s - one_m / self.speed_m_s + other_s - other_m / self.speed_m_s
        halved: Floats = stopping_s / 2.0
        return halved

    def at(self, speed_m_s: float) -> Course:
        """Return the course rules of a way at another speed."""
        return Course(
            speed_m_s=speed_m_s,
            acceleration_m_s2=self.acceleration_m_s2,
            jerk_m_s3=self.jerk_m_s3,
        )


@dataclass(frozen=True, slots=True)
class _ShortLegs:
    """Times of legs too short for the speed, by the root of their length."""

    reaching_s: float
    root_m: Floats
    seconds: Floats


@lru_cache(maxsize=64)
def _short_legs(motion: Motion) -> _ShortLegs:
    speeds = motion.speed_m_s * np.linspace(0.0, 1.0, 400) ** 2
    reaching_s = np.array([motion.at(max(v, 1e-9)).reaching_s for v in speeds.tolist()])
    return _ShortLegs(
        reaching_s=float(reaching_s[-1]),
        root_m=np.sqrt(speeds * reaching_s),
        seconds=np.concatenate([[0.0], 2.0 * reaching_s[1:]]),
    )


@lru_cache(maxsize=64)
def _spared_at_corners_s(motion: Motion) -> Floats:
    """Return what the two corners of ways aside spare, at the knots."""
    long_m = LONG * motion.speed_m_s * _short_legs(motion).reaching_s
    course = motion.at(motion.speed_m_s)
    spared = []
    for aside_m in ASIDE_KNOTS_M.tolist():
        # The third pass and the way to it: what the first takes more, from rest, counts once.
        parts_m = (long_m, aside_m, long_m, aside_m, long_m)
        bends_deg = (SQUARE_DEG, SQUARE_DEG, -SQUARE_DEG, -SQUARE_DEG)
        found_s = parts_s(parts_m, bends_deg, (course,) * 5, motion.corners)
        spared.append(float(motion.legs_s(np.array(parts_m[3:])).sum()) - sum(found_s[3:]))
    return np.array(spared)
