"""The deposit across the track: how wide a swath it makes, and where wind has put it.

A pattern is straight lines between the samples and nothing beyond them. Passes side by side add up,
and the sum is made of straight lines again, so that its coefficient of variation is exact at every
lane spacing. One way all passes lie alike; to and fro every other one is mirrored. The layout of
ASABE S386 and ISO 23117-2: a line of samplers at right angles to the track, several passes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.student import t_factor

Floats = NDArray[np.float64]

# Samples that still hold so much of the peak at the end of the line: liquid fell beyond it.
CUT_OFF_SHARE = 0.1
# Lane spacings that are tried.
SPACING_STEP_M = 0.05
# With passes in winds that differ by less, drift is not told from the boom's own offset.
WIND_RANGE_MIN_M_S = 0.5
PASSES_FOR_WIND = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Pattern:
    """Deposit across one track, `right_m` rising, seen in the direction of flight.

    `wind_right_m_s` is the wind across the track, positive where it blows towards the right.
    """

    name: str
    right_m: tuple[float, ...]
    deposit: tuple[float, ...]
    wind_right_m_s: float | None = None

    def __post_init__(self) -> None:
        if len(self.right_m) < 3 or not np.all(np.diff(self.right_m) > 0.0):
            raise ValueError(f"pass {self.name}: at least three samples, at different places")
        if not (min(self.deposit) >= 0.0 and self.total > 0.0):
            raise ValueError(f"pass {self.name}: its samples hold no deposit")

    @property
    def total(self) -> float:
        """Return the deposit of the whole pass."""
        return float(np.trapezoid(self.deposit, self.right_m))

    @property
    def centre_m(self) -> float:
        """Return the centroid of the deposit, right of the track.

        >>> Pattern(name="1", right_m=(0, 1, 2), deposit=(0, 5, 0)).centre_m
        1.0
        """
        at, high = np.array(self.right_m, dtype=float), np.array(self.deposit, dtype=float)
        width = np.diff(at)
        # Of a straight line over one interval, exact.
        moment = width * (
            high[:-1] * (2.0 * at[:-1] + at[1:]) + high[1:] * (at[:-1] + 2.0 * at[1:])
        )
        return float(moment.sum()) / 6.0 / self.total

    @property
    def is_cut_off(self) -> bool:
        """Tell whether the line of samplers ends before the deposit does."""
        return max(self.deposit[0], self.deposit[-1]) > CUT_OFF_SHARE * max(self.deposit)


@dataclass(frozen=True, slots=True, kw_only=True)
class Interval:
    """A figure with its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Displacement:
    """Where the deposit's centroid lies: without wind, and for each m/s of wind across.

    `fall_s` is None where the passes cannot tell wind from the rest.
    """

    still_m: float
    fall_s: Interval | None
    scatter_m: float | None


def cv_percent(pattern: Pattern, spacing_m: float, *, to_and_fro: bool) -> float:
    """Return the coefficient of variation of passes side by side, exact for straight lines.

    Two triangles that meet at half their height give an even sum:

    >>> triangle = Pattern(name="1", right_m=(-4, 0, 4), deposit=(0, 1, 0))
    >>> abs(round(cv_percent(triangle, 4.0, to_and_fro=False), 6))
    0.0
    """
    edges, left, right = lanes(pattern, spacing_m, to_and_fro=to_and_fro)
    weight = np.diff(edges) / (edges[-1] - edges[0])
    middle = 0.5 * (left + right)
    mean = float(weight @ middle)
    square = float(weight @ (middle**2 + (right - left) ** 2 / 12.0))
    return 100.0 * math.sqrt(max(square - mean**2, 0.0)) / mean


def lanes(pattern: Pattern, spacing_m: float, *, to_and_fro: bool) -> tuple[Floats, Floats, Floats]:
    """Return one period of the sum of all passes: edges of pieces, deposit at both ends of each."""
    at, high = np.array(pattern.right_m), np.array(pattern.deposit)
    shapes = [(at, high)]
    if to_and_fro:
        shapes.append((spacing_m - at[::-1], high[::-1]))
    period_m = spacing_m * len(shapes)
    places = np.concatenate([shape[0] for shape in shapes])
    edges = np.unique(np.concatenate([[0.0, period_m], np.mod(places, period_m)]))
    edges = edges[np.append(np.diff(edges) > 1e-9, True)]
    edges[-1] = period_m
    width = np.diff(edges)
    # Inside of a piece all is straight; at its ends a pattern that is cut off may jump.
    quarter, three = edges[:-1] + 0.25 * width, edges[:-1] + 0.75 * width
    sums = []
    for point in (quarter, three):
        total = np.zeros_like(point)
        for x, y in shapes:
            first = math.floor((x[0] - period_m) / period_m)
            for lane in range(first, math.ceil(x[-1] / period_m) + 1):
                total += np.interp(point + lane * period_m, x, y, left=0.0, right=0.0)
        sums.append(total)
    slope = sums[1] - sums[0]
    return edges, sums[0] - 0.5 * slope, sums[1] + 0.5 * slope


def spacings(pattern: Pattern) -> Floats:
    """Return the lane spacings to try: up to as wide as the whole line of samplers."""
    reach_m = pattern.right_m[-1] - pattern.right_m[0]
    count = max(round(reach_m / SPACING_STEP_M), 1)
    return np.arange(1, count + 1, dtype=np.float64) * np.float64(SPACING_STEP_M)


def effective_m(spacing_m: Floats, cv: Floats, cv_max: float) -> float | None:
    """Return the widest spacing with a CV within the limit; None where there is none.

    Spacings much narrower than the pattern are even whatever it looks like. They count, so that a
    pattern with two humps has the widest of all, and not the first that is left.
    """
    within = np.flatnonzero(cv <= cv_max)
    return float(spacing_m[within[-1]]) if len(within) else None


def displacement(passes: Sequence[Pattern]) -> Displacement:
    """Return how far wind and the boom itself put the deposit aside."""
    centre = np.array([one.centre_m for one in passes])
    wind = [one.wind_right_m_s for one in passes]
    scatter = float(centre.std(ddof=1)) if len(centre) > 1 else None
    plain = Displacement(still_m=float(centre.mean()), fall_s=None, scatter_m=scatter)
    if len(passes) < PASSES_FOR_WIND or any(one is None for one in wind):
        return plain
    blown = np.array(wind, dtype=float)
    if np.ptp(blown) < WIND_RANGE_MIN_M_S:
        return plain
    off = blown - blown.mean()
    slope = float(off @ centre / (off @ off))
    still = float(centre.mean() - slope * blown.mean())
    rest = centre - still - slope * blown
    dof = len(passes) - 2
    variance = float(rest @ rest) / dof
    half = t_factor(dof) * math.sqrt(variance / float(off @ off))
    return Displacement(
        still_m=still,
        fall_s=Interval(value=slope, low=slope - half, high=slope + half),
        scatter_m=math.sqrt(variance),
    )


def joint(passes: Sequence[Pattern], still_m: float) -> Pattern:
    """Return the mean pattern, each pass moved to where it lies without wind.

    Passes that wind or the pilot have put aside are not averaged as they lie: that would smear
    the pattern, and a smeared one seems to allow a wider swath.
    """
    moved = [np.array(one.right_m) - one.centre_m + still_m for one in passes]
    places = np.unique(np.round(np.concatenate(moved), 6))
    mean = np.mean(
        [
            np.interp(places, at, one.deposit, left=0.0, right=0.0)
            for at, one in zip(moved, passes, strict=True)
        ],
        axis=0,
    )
    return Pattern(name="mean of all", right_m=tuple(places.tolist()), deposit=tuple(mean.tolist()))


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """What the samples say: the mean pattern, and the swath of all passes and of each."""

    passes: tuple[Pattern, ...]
    mean: Pattern
    spacing_m: Floats
    cv: dict[str, Floats]
    swath_m: dict[str, float | None]
    by_pass_m: tuple[float | None, ...]
    displacement: Displacement
    cv_max: float


def evaluate(passes: Sequence[Pattern], cv_max: float) -> Found:
    """Return the swath of all passes together and of each."""
    aside = displacement(passes)
    mean = joint(passes, aside.still_m)
    tried = spacings(mean)
    cv = {
        name: np.array([cv_percent(mean, float(one), to_and_fro=fro) for one in tried])
        for name, fro in (("one_way", False), ("to_and_fro", True))
    }
    by_pass = []
    for one in passes:
        moved = joint([one], aside.still_m)
        own = spacings(moved)
        values = [cv_percent(moved, float(each), to_and_fro=True) for each in own]
        by_pass.append(effective_m(own, np.array(values), cv_max))
    return Found(
        passes=tuple(passes),
        mean=mean,
        spacing_m=tried,
        cv=cv,
        swath_m={name: effective_m(tried, values, cv_max) for name, values in cv.items()},
        by_pass_m=tuple(by_pass),
        displacement=aside,
        cv_max=cv_max,
    )
