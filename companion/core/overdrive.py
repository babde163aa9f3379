"""A slow flow is driven past its target for a moment, so that it stands there sooner.

A flow that follows its order as an exponential needs four time constants to stand. Ordered as far
as the pump goes, it reaches the target after `time ln((u - a) / (u - b))`; ordered to the target
then, it stays. All flows in L/min, from `a` to `b`, driven by `u`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

# A drive that is over sooner than this is none: the order's own jitter would be as large.
DRIVE_MIN_S = 0.03
# Not quite as far as the pump goes: what an ageing pump no longer reaches would come late.
DRIVE_SHARE = 0.9


class Drive(NamedTuple):
    """Order `duty` for `for_s`; the volume-equivalent step comes sooner by `saved_s`."""

    duty: float
    for_s: float
    saved_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Overdrive:
    """The flow's time constants, 0 where it is not slow, and how far the duty may go."""

    up_time_s: float
    down_time_s: float
    duty_min: float
    duty_max: float
    flow_for: Callable[[float], float]

    def between(self, before: float, after: float) -> Drive | None:
        """Return how to go from one duty to another; None for an order as it is.

        >>> law = Overdrive(up_time_s=1.0, down_time_s=1.0, duty_min=0.0, duty_max=1.0,
        ...                 flow_for=lambda duty: 10.0 * duty)
        >>> drive = law.between(0.4, 0.5)
        >>> round(drive.duty, 3), round(drive.for_s, 3), round(drive.saved_s, 3)
        (0.95, 0.201, 0.903)
        """
        time_s = self.up_time_s if after > before else self.down_time_s
        if not (time_s > 0.0 and before > 0.0 and after > 0.0):
            return None
        end = self.duty_max if after > before else self.duty_min
        duty = after + DRIVE_SHARE * (end - after)
        a, b, u = self.flow_for(before), self.flow_for(after), self.flow_for(duty)
        if not ((u - b) * (b - a) > 0.0):
            return None
        for_s = time_s * math.log((u - a) / (u - b))
        if not for_s >= DRIVE_MIN_S:
            return None
        return Drive(duty, for_s, (u - b) * for_s / (b - a))
