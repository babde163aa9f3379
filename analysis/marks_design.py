"""Whether a set of marks can tell time, body and map apart; the columns of the least squares."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Sequence

Floats = NDArray[np.float64]

MARKS_MIN = 6
# Degrees of freedom that must be left: with fewer an interval is mostly the t factor.
SPARE_MIN = 3
SPEED_RATIO_MIN = 1.3
# On each side of a contrast (slow and fast, to and fro): one mark alone cannot be checked.
SIDE_MIN = 2
SAME_WITHIN_DEG = 30.0
# Mean square of the courses across their main axis from which both components of a shift show.
TWO_AXES_FROM = 0.1
# Least singular value of the design for one mark, the mean speed as unit: two speeds 30 % apart
# give 0.09; speeds that go with the direction some hundredths, of gusts alone.
SINGULAR_MIN = 0.04


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """One mark; `line` is where it stands in its file. Without a heading the nose leads.

    `mark_m` is from the boundary to the mark along the direction of flight, + beyond it.
    """

    course_deg: float
    speed_m_s: float
    mark_m: float
    heading_deg: float | None = None
    kind: str | None = None
    line: int = 0

    @property
    def body_share(self) -> float:
        """Return how much of an offset towards the nose lies along the direction of flight."""
        if self.heading_deg is None:
            return 1.0
        return math.cos(math.radians(self.heading_deg - self.course_deg))


def missing_in(marks: Sequence[Mark], *, body_known: bool = False) -> list[str]:
    """Return what these marks lack before anything can be told from them; empty if nothing."""
    if not marks:
        return ["marks: there are none"]
    design = design_of(marks, body_known=body_known)
    least = max(MARKS_MIN, design.shape[1] + SPARE_MIN)
    missing = []
    if len(marks) < least:
        missing.append(f"marks: {len(marks)} of at least {least}")
    speeds = np.array([mark.speed_m_s for mark in marks])
    slow = int((speeds * SPEED_RATIO_MIN <= speeds.max()).sum())
    fast = int((speeds >= SPEED_RATIO_MIN * speeds.min()).sum())
    if min(slow, fast) < SIDE_MIN:
        missing.append(
            f"speeds: {speeds.min():g} to {speeds.max():g} m/s; at least {SIDE_MIN} marks each "
            f"are needed at two speeds that differ by {SPEED_RATIO_MIN - 1.0:.0%}"
        )
    if _to_and_fro(marks) < SIDE_MIN:
        missing.append(
            f"directions: at least {SIDE_MIN} marks each are needed of flights to and fro over "
            "the boundary"
        )
    if not missing and not least_singular(design) >= SINGULAR_MIN:
        missing.append(
            "combinations: speed, direction and heading go together; fly slow and fast in each "
            "direction, the nose ahead"
        )
    return missing


def design_of(marks: Sequence[Mark], *, body_known: bool = False) -> Floats:
    """Return the columns: speed, body share unless known, course along one axis or both."""
    columns = [np.array([mark.speed_m_s for mark in marks])]
    if not body_known:
        columns.append(np.array([mark.body_share for mark in marks]))
    east, north = _courses(marks)
    axis = axis_deg(marks)
    if axis is None:
        columns += [east, north]
    else:
        angle = math.radians(axis)
        columns.append(east * math.sin(angle) + north * math.cos(angle))
    return np.column_stack(columns)


def axis_deg(marks: Sequence[Mark]) -> float | None:
    """Return the line, 0 to 180, that all flights follow; None where they cross each other.

    >>> to_and_fro = [Mark(course_deg=deg, speed_m_s=5.0, mark_m=0.0) for deg in (12.0, 192.0)]
    >>> round(axis_deg(to_and_fro), 6)
    12.0
    """
    east, north = _courses(marks)
    # The mean of doubled angles: a course and its opposite are one line.
    angle = 0.5 * math.atan2(float((2.0 * east * north).sum()), float((north**2 - east**2).sum()))
    across = east * math.cos(angle) - north * math.sin(angle)
    if float((across**2).mean()) >= TWO_AXES_FROM:
        return None
    return math.degrees(angle) % 180.0


def least_singular(design: Floats) -> float:
    """Return the least singular value for one mark, the mean speed as unit of the first column."""
    scale = np.ones(design.shape[1])
    scale[0] = max(float(design[:, 0].mean()), 1e-9)
    values = np.linalg.svd(design / scale / math.sqrt(len(design)), compute_uv=False)
    return float(values[-1]) if len(design) >= design.shape[1] else 0.0


def _courses(marks: Sequence[Mark]) -> tuple[Floats, Floats]:
    """Return the directions of flight as unit vectors, east and north."""
    angles = np.radians([mark.course_deg for mark in marks])
    return np.sin(angles), np.cos(angles)


def _to_and_fro(marks: Sequence[Mark]) -> int:
    """Return how many marks the weaker side has of the best pair of opposite directions."""
    courses = np.array([mark.course_deg for mark in marks])
    turn_deg = np.abs((courses[:, None] - courses[None, :] + 180.0) % 360.0 - 180.0)
    same = (turn_deg <= SAME_WITHIN_DEG).sum(axis=1)
    opposite = (turn_deg >= 180.0 - SAME_WITHIN_DEG).sum(axis=1)
    return int(np.minimum(same, opposite).max())
