"""What of a harvester's or sensor's points is no measurement of the ground they stand on.

The steps are those that yield editors have in common: speed, ends of passes, overlap and local
outliers (Sudduth and Drummond 2007, Agronomy Journal 99:1471; Vega et al. 2019, Precision
Agriculture 20:1). Each step sees what the ones before it have left.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from missions.strips import Floats

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Step = Literal["speed", "ends", "overlap", "outliers"]
STEPS: tuple[Step, ...] = ("speed", "ends", "overlap", "outliers")

# Speeds outside of half to one and a half of the median belong to turns, stops and jumps.
SPEED_SHARES = (0.5, 1.5)
# A pass ends where the next point is so many steps away, or the course has turned so far.
GAP_STEPS, TURN_DEG = 4.0, 45.0
# Of a median absolute deviation, so many are an outlier; that of a normal distribution is 0.6745.
OUTLIER_MADS, MAD = 3.0, 1.4826
NEIGHBOURS = 21
# Where all neighbours agree, a value this share away from them is still none of noise.
AGREE_SHARE = 0.05
# Distances in a grid differ by less than this; so many points say whether they are one.
GRID_SHARE, GRID_OF = 0.01, 5_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """Points in the order in which they were recorded, in metres; `speed_m_s` where there is one.

    `width_m` is what one point stands for across the track, `ends_m` how far after the start and
    before the end of a pass the machine is filling and emptying.
    """

    points: Floats
    values: Floats
    speed_m_s: Floats | None = None
    width_m: float = 6.0
    ends_m: float = 10.0


@dataclass(frozen=True, slots=True)
class Cleaned:
    """Which points are kept, and how many each step has removed."""

    kept: Bools
    removed: dict[str, int]


def cleaned(track: Track, steps: tuple[Step, ...] = STEPS) -> Cleaned:
    """Return which points measure the ground they stand on."""
    kept = np.isfinite(track.values) & np.isfinite(track.points).all(axis=1)
    removed = {"no value": int(np.count_nonzero(~kept))}
    passes = _passes(track.points)
    for step in steps:
        here = np.flatnonzero(kept)
        if not len(here):
            break
        if step == "speed":
            wrong = _odd_speeds(track, here, passes)
        elif step == "ends":
            wrong = _ends(track, here, passes)
        elif step == "overlap":
            wrong = _overlapping(track, here, passes)
        else:
            wrong = _outliers(track, here)
        kept[here[wrong]] = False
        removed[step] = int(np.count_nonzero(wrong))
    return Cleaned(kept, removed)


def is_track(points: Floats) -> bool:
    """Tell whether points follow each other, as a machine records them, and are no samples.

    Points of a square grid follow each other too, row by row; they are estimates for their places.
    """
    if len(points) < 100 or _is_grid(points):
        return False
    step_m = np.hypot(*np.diff(points, axis=0).T)
    typical = float(np.median(step_m))
    return bool(np.quantile(step_m, 0.9) <= 3.0 * typical)


def _is_grid(points: Floats) -> bool:
    """Tell whether most points have four neighbours at one distance."""
    from scipy.spatial import cKDTree

    some = points[np.isfinite(points).all(axis=1)][:GRID_OF]
    away = cKDTree(some).query(some, k=5)[0]
    even = away[:, 4] <= (1.0 + GRID_SHARE) * away[:, 1]
    return bool(np.mean(even & (away[:, 1] > 0.0)) > 0.5)


def _passes(points: Floats) -> Ints:
    """Return the number of the pass of each point."""
    if len(points) < 3:
        return np.zeros(len(points), dtype=np.int64)
    way = np.diff(points, axis=0)
    step_m = np.hypot(*way.T)
    course = np.degrees(np.arctan2(way[:, 0], way[:, 1]))
    turned = np.abs((np.diff(course, prepend=course[:1]) + 180.0) % 360.0 - 180.0)
    breaks = (step_m > GAP_STEPS * np.median(step_m)) | (turned > TURN_DEG)
    return np.concatenate([[0], np.cumsum(breaks)])


def _odd_speeds(track: Track, here: Ints, passes: Ints) -> Bools:
    if track.speed_m_s is not None:
        speed = track.speed_m_s[here]
    else:
        # Recorders log at a fixed rate: the step is the speed but for a factor.
        step_m = np.hypot(*np.diff(track.points, axis=0, prepend=track.points[:1]).T)
        first = np.diff(passes, prepend=-1) != 0
        step_m[first] = np.nan
        speed = step_m[here]
    known = np.isfinite(speed)
    if not known.any():
        return np.zeros(len(here), dtype=np.bool_)
    low, high = (share * float(np.median(speed[known])) for share in SPEED_SHARES)
    return known & ~((speed >= low) & (speed <= high))


def _ends(track: Track, here: Ints, passes: Ints) -> Bools:
    """Return the points near the start and the end of their pass, along the track."""
    step_m = np.hypot(*np.diff(track.points, axis=0, prepend=track.points[:1]).T)
    first = np.flatnonzero(np.diff(passes, prepend=-1))
    step_m[first] = 0.0
    along = np.cumsum(step_m)
    begin = along[first][passes]
    end = along[np.append(first[1:], len(passes)) - 1][passes]
    near: Bools = (along - begin < track.ends_m) | (end - along < track.ends_m)
    return near[here]


def _overlapping(track: Track, here: Ints, passes: Ints) -> Bools:
    """Return the points whose ground an earlier pass has covered by half."""
    from scipy.spatial import cKDTree

    pairs = cKDTree(track.points[here]).query_pairs(track.width_m / 2.0, output_type="ndarray")
    wrong = np.zeros(len(here), dtype=np.bool_)
    if len(pairs):
        one, two = passes[here[pairs[:, 0]]], passes[here[pairs[:, 1]]]
        wrong[np.where(one < two, pairs[:, 1], pairs[:, 0])[one != two]] = True
    return wrong


def _outliers(track: Track, here: Ints) -> Bools:
    """Return the points far from the median of their neighbours, by how much these differ."""
    from scipy.spatial import cKDTree

    values = track.values[here]
    count = min(NEIGHBOURS, len(here))
    if count < 4:
        return np.zeros(len(here), dtype=np.bool_)
    wrong = np.zeros(len(here), dtype=np.bool_)
    tree = cKDTree(track.points[here])
    for first in range(0, len(here), 100_000):
        part = slice(first, first + 100_000)
        around = values[tree.query(track.points[here[part]], k=count)[1]]
        middle = np.median(around, axis=1)
        spread = MAD * np.median(np.abs(around - middle[:, None]), axis=1)
        least = np.maximum(OUTLIER_MADS * spread, AGREE_SHARE * np.abs(middle))
        wrong[part] = np.abs(values[part] - middle) > least
    return wrong


def pass_width_m(points: Floats) -> float:
    """Return how far passes lie from each other: the median distance to the nearest other one.

    For points that are no track, how far they lie from their nearest neighbour.
    """
    from scipy.spatial import cKDTree

    if len(points) < 3:
        return WIDTH_M
    tree = cKDTree(points)
    draw = np.random.default_rng(1)
    some = np.sort(draw.choice(len(points), min(len(points), 5_000), replace=False))
    passes = _passes(points) if is_track(points) else np.arange(len(points))
    away, which = tree.query(points[some], k=min(100, len(points)))
    apart = np.where(passes[which] != passes[some][:, None], away, np.inf).min(axis=1)
    apart = apart[np.isfinite(apart) & (apart > 0.0)]
    return float(np.median(apart)) if len(apart) else WIDTH_M


# Of a machine whose passes do not tell.
WIDTH_M = 6.0
