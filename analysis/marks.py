"""What marks on the ground tell: how late the position is, where boom and map really lie.

A mark is where a change of rate really fell, measured from its boundary along the direction of
flight, + beyond it:

    mark = speed * time_error + body_offset * cos(heading - course) + datum . course + noise

A time error grows with the speed, a body offset is the same in all directions of flight, a shift
of the map against the ground changes its sign with the direction. Least squares on boundaries
flown to and fro at two speeds separate them; `marks_design` says what cannot be told apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from analysis.least_squares import Estimate, Floats, Solved, solve, worst_outlier
from analysis.marks_design import (
    SINGULAR_MIN,
    Mark,
    axis_deg,
    design_of,
    least_singular,
    missing_in,
)
from analysis.student import t_factor

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["Estimate", "Mark", "MarksFit", "fit_marks", "missing_in"]

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
