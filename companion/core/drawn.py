"""How fast an estimator is just drawing its place after GNSS, beside the velocity that it tells.

After each fix an autopilot draws the place that it tells within a quarter of a second to where its
estimator now has it (PX4: EKF2_TAU_POS, ArduPilot: EK3_TAU_OUTPUT), and not by its velocity. What
a valve gives on a metre of ground that is told so follows the speed of the place. What has begun
lately goes on for the 0.1 to 0.2 s that an order takes; what has gone on for long is the velocity's
own error, and a dose by it wavers more than it gains (docs/px4.md). So the one is taken less the
other: two means of how much faster the place goes than its velocity, a quick and a slow one.

The quick one is half rounding, 1 cm in 50 ms. So nothing is taken of it until place and velocity
have been seen to disagree by more than rounding makes them: PX4's do in simulation, ArduCopter's
do not.
"""

from __future__ import annotations

from typing import NamedTuple

from companion.core.arithmetic import exp

# Tried on recorded flights of PX4, positions at 20 Hz: half and twice as long serve nearly as well,
# and no linear filter that is fitted to other flights does better.
QUICK_TIME_S = 0.08
SLOW_TIME_S = 0.25
# How long a disagreement is remembered, and how large one is that says nothing. The slow mean
# (root of its mean square) was 0.08 to 0.18 m/s beside PX4, 0.02 m/s beside ArduCopter.
MEMORY_S = 10.0
AGREES_M_S = 0.04
# More is no drawing: a place that is set anew is not driven to. Places are rounded to 1 cm.
DRAWN_MAX_M_S, ROUNDED_M = 0.5, 0.03


class Drawn(NamedTuple):
    """Both means, in one direction, and the mean square of the slow one."""

    quick_m_s: float = 0.0
    slow_m_s: float = 0.0
    square_m2_s2: float = 0.0

    def after(self, dt_s: float) -> float:
        """Return how much faster than its velocity the place goes `dt_s` later, as far as new.

        >>> round(Drawn(0.25, 0.05, 0.016).after(0.0), 3)
        0.18
        >>> Drawn(0.25, 0.05, 0.001).after(0.0)
        0.0
        """
        if not self.square_m2_s2 > AGREES_M_S * AGREES_M_S:
            return 0.0
        share = 1.0 - AGREES_M_S * AGREES_M_S / self.square_m2_s2
        return share * (self.quick_m_s - self.slow_m_s) * exp(-max(dt_s, 0.0) / SLOW_TIME_S)


NOT_DRAWN = Drawn()


def followed(before: Drawn, dt_s: float, gone_m: float, told_m_s: float) -> Drawn:
    """Return the means after a message: the way since the one before, and the velocity over it."""
    outrun_m = gone_m - told_m_s * dt_s
    if not abs(outrun_m) <= DRAWN_MAX_M_S * dt_s + ROUNDED_M:
        # A jump, or no number.
        return Drawn(square_m2_s2=before.square_m2_s2)
    outrun_m_s = outrun_m / dt_s
    slow_m_s = _mean(before.slow_m_s, outrun_m_s, dt_s / SLOW_TIME_S)
    return Drawn(
        _mean(before.quick_m_s, outrun_m_s, dt_s / QUICK_TIME_S),
        slow_m_s,
        _mean(before.square_m2_s2, slow_m_s * slow_m_s, dt_s / MEMORY_S),
    )


def _mean(before: float, now: float, times: float) -> float:
    return before + (1.0 - exp(-times)) * (now - before)
