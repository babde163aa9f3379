"""What marks on the ground tell: how late the position is, where boom and map really lie.

A mark is where a change of rate really fell, measured from its boundary along the direction of
flight, + beyond it:

    mark = speed * time_error + body_offset * cos(heading - course) + datum . course + noise

A time error grows with the speed, a body offset is the same in all directions of flight, a shift
of the map against the ground changes its sign with the direction. Least squares on boundaries
flown to and fro at two speeds separate them; `least_singular` says what cannot be told apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.student import t_factor, t_inside

if TYPE_CHECKING:
    from collections.abc import Sequence


__all__ = ["Estimate", "Mark", "MarksFit", "fit_marks", "missing_in"]


# Whether a set of marks can tell time, body and map apart; the columns of the least squares.

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


# Least squares with intervals, and the one measurement that does not fit.

Floats = NDArray[np.float64]

# A clean set loses its worst measurement in one of a hundred cases.
OUTLIER_PROBABILITY = 0.01
NORMAL = NormalDist()


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """A value and its 95 % interval."""

    value: float
    low: float
    high: float

    def turned(self, factor: float, added: float = 0.0) -> Estimate:
        """Return `factor` times this, plus `added`."""
        low, high = sorted((self.low * factor + added, self.high * factor + added))
        return Estimate(value=self.value * factor + added, low=low, high=high)


@dataclass(frozen=True, slots=True, kw_only=True)
class Solved:
    """A least squares solution; `sd_m` is what its intervals rest on."""

    values: Floats
    covariance: Floats
    residual_m: Floats
    leverage: Floats
    residual_sd_m: float
    sd_m: float
    factor: float
    spare: int

    def estimate(self, index: int) -> Estimate:
        """Return one of the values with its interval."""
        value = float(self.values[index])
        half = self.factor * math.sqrt(float(self.covariance[index, index]))
        return Estimate(value=value, low=value - half, high=value + half)


def solve(design: Floats, measured_m: Floats, sd_m: float | None) -> Solved:
    """Solve; a stated deviation is kept unless the residuals are far beyond it."""
    spare = len(design) - design.shape[1]
    inverse = np.linalg.inv(design.T @ design)
    solution = inverse @ design.T @ measured_m
    residual_m = measured_m - design @ solution
    found_m = math.sqrt(float(residual_m @ residual_m) / spare)
    stated = sd_m is not None and found_m <= sd_m * _excess(spare)
    used_m = sd_m if stated and sd_m is not None else found_m
    return Solved(
        values=solution,
        covariance=np.asarray(inverse * used_m**2, dtype=np.float64),
        residual_m=residual_m,
        leverage=np.einsum("ij,jk,ik->i", design, inverse, design),
        residual_sd_m=found_m,
        sd_m=used_m,
        factor=NORMAL.inv_cdf(0.975) if stated else t_factor(spare),
        spare=spare,
    )


def _excess(spare: int) -> float:
    """Return the ratio of found to true deviation that is exceeded in 1 % (Wilson, Hilferty)."""
    part = 2.0 / (9.0 * spare)
    cube_root = 1.0 - part + NORMAL.inv_cdf(0.99) * math.sqrt(part)
    return math.sqrt(cube_root**3)


def worst_outlier(solved: Solved, sd_m: float | None) -> int | None:
    """Return the one that is too far from what the others tell; None where none is.

    Judged by the stated deviation where the others agree with it, else by the others' own: the
    worst one would hide in a deviation that it is part of.
    """
    free = np.maximum(1.0 - solved.leverage, 1e-9)
    share = solved.residual_m**2 / free
    worst = int(np.argmax(share))
    spare = solved.spare - 1
    if spare < 1 or not solved.residual_sd_m > 1e-9:
        return None
    others_2 = max(solved.residual_sd_m**2 * solved.spare - float(share[worst]), 0.0) / spare
    if sd_m is not None and math.sqrt(others_2) <= sd_m * _excess(spare):
        chance = 2.0 * NORMAL.cdf(-math.sqrt(float(share[worst])) / sd_m)
    else:
        chance = 1.0 - t_inside(math.sqrt(float(share[worst]) / max(others_2, 1e-18)), spare)
    return worst if chance * len(free) < OUTLIER_PROBABILITY else None


# Time errors of two kinds of change are different when this probability says so.
DIFFERENT_FROM = 0.99
# Tape and eye do better than this; what scatters more has another reason.
SCATTER_M = 0.15
# An interval of the time error wider than this says little: 0.1 m at 5 m/s.
WIDE_S = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class MarksFit:
    """What the marks tell; `axis_deg` is given where the map's shift is known along it only.

    `body_offset_m` is None where it was said to be known. `residual_m` has a value for each mark,
    the outlier's too. `time_by_group_s` has the time errors by kind of change, or by direction of
    flight where no kinds are given; empty where they cannot be told apart.
    """

    time_error_s: Estimate
    body_offset_m: Estimate | None
    datum_east_m: Estimate
    datum_north_m: Estimate
    axis_deg: float | None
    sd_m: float
    spare: int
    residual_m: tuple[float, ...]
    outlier: int | None
    time_by_group_s: dict[str, Estimate]
    warnings: tuple[str, ...]


def fit_marks(
    marks: Sequence[Mark], *, sd_m: float | None = None, body_known: bool = False
) -> MarksFit:
    """Return the errors behind these marks with 95 % intervals; one outlier is left out.

    `sd_m` is the marks' standard deviation where it is known; else the residuals tell it.

    Raises:
        ValueError: where `missing_in` has something to say.
    """
    missing = missing_in(marks, body_known=body_known)
    if missing:
        raise ValueError("; ".join(missing))
    design = design_of(marks, body_known=body_known)
    mark_m = np.array([mark.mark_m for mark in marks])
    used, warnings = _without_outlier(marks, design, mark_m, sd_m, body_known=body_known)
    solved = solve(design[used], mark_m[used], sd_m)
    residual_m = mark_m - design @ solved.values
    outlier = None if used.all() else int(np.argmin(used))
    if outlier is not None:
        warnings.append(f"{_name(marks, outlier)} is left out: {residual_m[outlier]:+.2f} m off")
    warnings += _doubts(solved, sd_m)
    kept = [mark for mark, use in zip(marks, used.tolist(), strict=True) if use]
    groups, different = _by_group(kept, design[used], mark_m[used], sd_m)
    axis = axis_deg(marks)
    shift = solved.estimate(design.shape[1] - 1)
    if axis is None:
        east, north = solved.estimate(design.shape[1] - 2), shift
    else:
        angle = math.radians(axis)
        east, north = shift.turned(math.sin(angle)), shift.turned(math.cos(angle))
    return MarksFit(
        time_error_s=solved.estimate(0),
        body_offset_m=None if body_known else solved.estimate(1),
        datum_east_m=east,
        datum_north_m=north,
        axis_deg=axis,
        sd_m=solved.sd_m,
        spare=solved.spare,
        residual_m=tuple(residual_m.tolist()),
        outlier=outlier,
        time_by_group_s=groups,
        warnings=(*warnings, *different),
    )


def _without_outlier(
    marks: Sequence[Mark],
    design: Floats,
    mark_m: Floats,
    sd_m: float | None,
    *,
    body_known: bool,
) -> tuple[np.ndarray[tuple[int], np.dtype[np.bool_]], list[str]]:
    """Return which marks are used, all or all but one, and what is to be said about it."""
    used = np.ones(len(marks), dtype=np.bool_)
    worst = worst_outlier(solve(design, mark_m, sd_m), sd_m)
    if worst is None:
        return used, []
    rest = [mark for index, mark in enumerate(marks) if index != worst]
    used[worst] = False
    if missing_in(rest, body_known=body_known) or not least_singular(design[used]) >= SINGULAR_MIN:
        used[worst] = True
        return used, [f"{_name(marks, worst)} does not fit, and without it too little is left"]
    if worst_outlier(solve(design[used], mark_m[used], sd_m), sd_m) is not None:
        return used, ["more than one mark does not fit: look at the residuals and measure again"]
    return used, []


def _doubts(solved: Solved, sd_m: float | None) -> list[str]:
    """Return what speaks against the result as a whole."""
    doubts = []
    if sd_m is not None and solved.sd_m != sd_m:
        doubts.append(
            f"the marks scatter by {solved.residual_sd_m:.3f} m, more than the {sd_m:g} m stated; "
            "the intervals rest on what was found"
        )
    if solved.residual_sd_m > SCATTER_M:
        doubts.append(
            f"the marks scatter by {solved.residual_sd_m:.2f} m: gusts, wrong boundaries, or "
            "different valves"
        )
    time = solved.estimate(0)
    if time.high - time.low > 2.0 * WIDE_S:
        doubts.append(
            f"the time error is known to {500.0 * (time.high - time.low):.0f} ms only: more marks, "
            "or speeds farther apart"
        )
    return doubts


def _by_group(
    marks: Sequence[Mark], design: Floats, mark_m: Floats, sd_m: float | None
) -> tuple[dict[str, Estimate], list[str]]:
    """Return the time error of each kind or direction, and which of them are different."""
    names = _groups(marks)
    found = sorted(set(names))
    speed = design[:, 0]
    columns = [np.where(np.array(names) == name, speed, 0.0) for name in found]
    split = np.column_stack([*columns, design[:, 1:]])
    if len(found) < 2 or len(split) - split.shape[1] < 2:
        return {}, []
    scaled = np.column_stack([split[:, : len(found)] / speed.mean(), split[:, len(found) :]])
    values = np.linalg.svd(scaled / math.sqrt(len(scaled)), compute_uv=False)
    if not values[-1] >= SINGULAR_MIN:
        return {}, []
    solved = solve(split, mark_m, sd_m)
    different = []
    for i, j in combinations(range(len(found)), 2):
        difference_s = float(solved.values[i] - solved.values[j])
        cov = solved.covariance
        error_s = math.sqrt(float(cov[i, i] + cov[j, j] - 2.0 * cov[i, j]))
        if abs(difference_s) > t_factor(solved.spare, DIFFERENT_FROM) * error_s:
            different.append(
                f"the time errors of {found[i]} and {found[j]} differ by "
                f"{1000.0 * abs(difference_s):.0f} ms: a lag of one kind is wrong, or the wind "
                "turned; identify the lags first (vrspray calibrate lag)"
            )
    return {name: solved.estimate(i) for i, name in enumerate(found)}, different


def _groups(marks: Sequence[Mark]) -> list[str]:
    """Return the kind of each mark, or its direction where kinds are missing."""
    if all(mark.kind for mark in marks):
        return [str(mark.kind) for mark in marks]
    axis = axis_deg(marks)
    if axis is None:
        return ["all"] * len(marks)
    ends = (f"course {axis % 360.0:.0f}", f"course {(axis + 180.0) % 360.0:.0f}")
    return [
        ends[0] if math.cos(math.radians(mark.course_deg - axis)) > 0.0 else ends[1]
        for mark in marks
    ]


def _name(marks: Sequence[Mark], index: int) -> str:
    line = marks[index].line
    return f"line {line}" if line else f"mark {index + 1}"
