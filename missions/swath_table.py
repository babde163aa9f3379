"""The measured swath by height and speed: bilinear inside the table, nothing outside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from missions.errors import PlanError


@dataclass(frozen=True, slots=True, kw_only=True)
class SwathPoint:
    """One measurement: the width that was wet evenly at a height and a speed."""

    height_m: float
    speed_m_s: float
    width_m: float


def swath_width_m(points: Sequence[SwathPoint], *, height_m: float, speed_m_s: float) -> float:
    """Return the swath at a height and a speed.

    >>> table = [SwathPoint(height_m=h, speed_m_s=v, width_m=w)
    ...          for h, v, w in ((2, 4, 5.0), (2, 8, 6.0), (4, 4, 6.0), (4, 8, 8.0))]
    >>> swath_width_m(table, height_m=3.0, speed_m_s=6.0)
    6.25

    Raises:
        PlanError: for a table with holes, and outside of it.
    """
    widths = {(point.height_m, point.speed_m_s): point.width_m for point in points}
    if len(widths) < len(points):
        raise PlanError("mission.swath has two widths for one height and speed; keep one")
    heights = sorted({height for height, _ in widths})
    speeds = sorted({speed for _, speed in widths})
    for height in heights:
        for speed in speeds:
            if (height, speed) not in widths:
                raise PlanError(
                    f"mission.swath has no width at {height:g} m and {speed:g} m/s; measure every "
                    "speed at every height"
                )
    for value, known, name, unit in (
        (height_m, heights, "height_m", "m"), (speed_m_s, speeds, "speed_m_s", "m/s")
    ):  # fmt: skip
        if not known[0] <= value <= known[-1]:
            raise PlanError(
                f"mission.{name} = {value:g} lies outside mission.swath, which was measured from "
                f"{known[0]:g} to {known[-1]:g} {unit}; measure it there, or fly within"
            )
    by_speed = [
        float(np.interp(height_m, heights, [widths[height, speed] for height in heights]))
        for speed in speeds
    ]
    return float(np.interp(speed_m_s, speeds, by_speed))
