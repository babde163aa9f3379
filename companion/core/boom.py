"""The sprayer's geometry on the aircraft: where each valve's strip lies on the ground.

Course is not heading: the lag is along the course, the boom lies across the heading. A copter
that flies a zig-zag backwards keeps its boom, and its left valve stays on its left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from companion.core.frame import Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class Valve:
    """One valve and the strip of ground that its nozzles cover, in the body frame.

    `right_m` and `forward_m` are from the autopilot's position reference to the strip's centre.
    """

    name: str
    right_m: float
    forward_m: float
    width_m: float
    channel: int = 0

    def __post_init__(self) -> None:
        if not 0.0 < self.width_m < 1000.0:
            raise ValueError(f"width of valve {self.name} must be positive, got {self.width_m}")
        if not (abs(self.right_m) < 1000.0 and abs(self.forward_m) < 1000.0):
            raise ValueError(f"offset of valve {self.name} is no length")


@dataclass(frozen=True, slots=True, kw_only=True)
class Boom:
    """All valves, left to right, and the effective width B of every flow law."""

    width_m: float
    valves: tuple[Valve, ...]
    height_m: float = 3.5
    right_m: Floats = field(init=False, repr=False, compare=False)
    forward_m: Floats = field(init=False, repr=False, compare=False)
    half_width_m: Floats = field(init=False, repr=False, compare=False)
    reach_m: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.width_m < 1000.0:
            raise ValueError(f"boom width must be positive, got {self.width_m}")
        if not self.valves:
            raise ValueError("a boom needs at least one valve")
        for name, values in (
            ("right_m", [valve.right_m for valve in self.valves]),
            ("forward_m", [valve.forward_m for valve in self.valves]),
            ("half_width_m", [valve.width_m / 2 for valve in self.valves]),
        ):
            object.__setattr__(self, name, np.array(values, dtype=np.float64))
        far = np.hypot(np.abs(self.right_m) + self.half_width_m, self.forward_m)
        object.__setattr__(self, "reach_m", float(far.max()))


def body_axes(heading_deg: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the unit vectors (east, north) of forward and of right.

    >>> forward, right = body_axes(90.0)
    >>> round(forward[0], 12), round(right[1], 12)
    (1.0, -1.0)
    """
    heading_rad = math.radians(heading_deg)
    sin, cos = math.sin(heading_rad), math.cos(heading_rad)
    return (sin, cos), (cos, -sin)


def width_across_course_m(width_m: float, *, heading_deg: float, course_deg: float) -> float:
    """Return the width of a strip measured across the motion: width |cos(heading - course)|.

    >>> round(width_across_course_m(6.0, heading_deg=60.0, course_deg=0.0), 6)
    3.0
    """
    return width_m * abs(math.cos(math.radians(heading_deg - course_deg)))
