"""What spray lines do to a field: covered, covered twice, and outside."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from companion.core.frame import LocalFrame
from missions.demand import Rates, Uniform
from missions.strips import (
    LINE_MIN_M,
    NARROWER_M,
    Floats,
    Objects,
    joined,
    lengths_m,
    no_lines,
    rectangles,
    stretched,
    united,
    whole,
)

# From so much ground on that is narrower than the swath a pilot is told.
NARROW_PERCENT = 2.0
# What is twice as broad is no crumb.
BROAD_M = 0.25
# Less than this is not a ground but the last digits of large numbers.
NOISE_M2 = 1e-6
# Of the cells in which rates are looked at.
CELL_M, CELLS_MAX = 0.5, 200_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage:
    """`reachable_percent` is of what a strip of that width can reach: the ground opened by it.

    `percent` is of the ground that has a rate, `without_rate_m2` what has none.
    """

    percent: float
    reachable_percent: float
    overlap_percent: float
    outside_m2: float
    largest_skip_m2: float
    largest_skip_at: tuple[float, float] | None = None
    without_rate_m2: float = 0.0


# Layouts, what they leave and what is told of a plan are about the same ground.
@lru_cache(maxsize=8)
def reachable(ground: BaseGeometry, width_m: float) -> BaseGeometry:
    """Return the ground that a disc of half the width can touch without leaving it."""
    return ground.buffer(-width_m / 2.0).buffer(width_m / 2.0 * (1.0 - 1e-9))


def measure(
    lines: Floats, ground: BaseGeometry, width_m: float, *, strips: Objects | None = None
) -> Coverage:
    """Return what all lines cover of the ground: their whole strips, or those that are given."""
    strips = rectangles(lines, width_m) if strips is None else strips
    covered = whole(strips)
    area_m2 = ground.area
    if not area_m2 > 0.0:
        raise ValueError("there is no ground to cover")
    possible = reachable(ground, width_m)
    inside = shapely.intersection(covered, ground)
    outside_m2 = covered.area - inside.area
    skipped = shapely.difference(ground, covered)
    patches = shapely.get_parts(skipped)
    # Nothing skipped is an empty part, which lies nowhere.
    patches = patches[~shapely.is_empty(patches)]
    areas_m2 = shapely.area(patches)
    largest = _in_the_midst(patches[areas_m2.argmax()]) if len(patches) else None
    reached = shapely.intersection(covered, possible).area
    return Coverage(
        percent=100.0 * inside.area / area_m2,
        reachable_percent=100.0 * reached / possible.area if possible.area > 0.0 else 100.0,
        overlap_percent=100.0
        * max(float(shapely.area(strips).sum()) - covered.area, 0.0)
        / area_m2,
        outside_m2=outside_m2 if outside_m2 > NOISE_M2 else 0.0,
        largest_skip_m2=float(areas_m2.max(initial=0.0)),
        largest_skip_at=None if largest is None else (largest.x, largest.y),
    )


def _in_the_midst(patch: BaseGeometry) -> shapely.Point:
    """Return a place where a patch is broad: a crumb along a border may hang on to it."""
    broad = shapely.get_parts(patch.buffer(-BROAD_M))
    if not len(broad) or broad[0].is_empty:
        return patch.representative_point()
    place: shapely.Point = broad[shapely.area(broad).argmax()].representative_point()
    return place


def narrow_warnings(found: Coverage, frame: LocalFrame, width_m: float) -> tuple[str, ...]:
    """Return how much of a field no whole swath fits on, where that is much, and where."""
    narrow_percent = 100.0 * (1.0 - found.percent / max(found.reachable_percent, 1e-9))
    if found.largest_skip_at is None or found.largest_skip_m2 < width_m**2:
        return ()
    if narrow_percent < NARROW_PERCENT:
        return ()
    latitude_deg, longitude_deg = frame.to_geographic(*found.largest_skip_at)
    return (
        f"{narrow_percent:.0f} % of the field is narrower than the swath of {width_m:g} m and is "
        f"not sprayed, {found.largest_skip_m2:.0f} m2 of it near {latitude_deg:.6f}, "
        f"{longitude_deg:.6f}; spray it by hand, or plan for a narrower boom "
        "(mission.swath_width_m)",
    )


def of_rated_ground(
    found: Coverage, flown: Objects, ground: BaseGeometry, *, rates: Rates
) -> Coverage:
    """Return the coverage of the ground that has a rate, by the strips that are flown for it.

    The rates are looked at in the middles of cells, so many that none is wider than a boom's valve
    on most fields.
    """
    if isinstance(rates, Uniform):
        return found
    west, south, east, north = ground.bounds
    cell_m = max(CELL_M, math.sqrt((east - west) * (north - south) / CELLS_MAX))
    steps = [np.arange(a + cell_m / 2.0, b, cell_m) for a, b in ((west, east), (south, north))]
    east_m, north_m = (axis.ravel() for axis in np.meshgrid(*steps))
    shapely.prepare(ground)
    inside = shapely.contains_xy(ground, east_m, north_m)
    east_m, north_m = east_m[inside], north_m[inside]
    rated = rates.rates_at(east_m, north_m) > 0.0
    if rated.all() or not rated.any():
        return found
    covered = whole(flown)
    shapely.prepare(covered)
    treated = shapely.contains_xy(covered, east_m[rated], north_m[rated])
    return replace(
        found,
        percent=100.0 * float(treated.mean()),
        without_rate_m2=ground.area * float((~rated).mean()),
    )


# What passes and inner lines leave out: sharp corners, and places no wider than a swath.

# So much may stay uncovered of what can be reached: half of what the plan as a whole may miss.
LEFT_SHARE = 0.0005
PATCH_MIN_M2 = 0.02
# What margins take of a place that is too narrow for them; at corners it is less than this.
PLACE_M2 = 2.0
# A pass there is worth its time where so much of its strip is such ground; what others leave out
# comes to so much of all ground at most.
PATCH_WORTH, SLIVERS_SHARE = 0.1, 0.00015
ROUNDS = 4
PATCHES_MAX = 200
ANGLES, ASIDE = 12, 7
# A line grows to both sides from a seed of this half length.
SEED_M = 0.05


def patches(
    lines: Floats,
    ground: BaseGeometry,
    width_m: float,
    *,
    left_share: float = LEFT_SHARE,
    target: BaseGeometry | None = None,
    covered: BaseGeometry | None = None,
) -> Floats:
    """Return more lines, for ground that the others miss though a strip could reach it.

    That ground is the `target`, where it is given.
    """
    if target is None:
        target = reachable(ground, width_m)
    if covered is None:
        covered = united(lines, width_m)
    allowed_m2 = left_share * target.area
    tight = ground.buffer(NARROWER_M)
    shapely.prepare(tight)
    added = no_lines()
    for _ in range(ROUNDS):
        missing = shapely.get_parts(target.difference(covered))
        area_m2 = shapely.area(missing)
        order = np.argsort(-area_m2, kind="stable")
        # No more of them than have to be covered.
        still_m2 = area_m2.sum() - np.concatenate([[0.0], np.cumsum(area_m2[order])[:-1]])
        largest = missing[order[still_m2 > allowed_m2]][:PATCHES_MAX]
        if not len(largest):
            break
        new = joined([_over(patch, tight, width_m) for patch in largest])
        if not len(new):
            break
        added = joined([added, new])
        covered = whole(np.array([covered, *rectangles(new, width_m)]))
    return added


def narrow_patches(
    lines: Floats, ground: BaseGeometry, limit: BaseGeometry, width_m: float
) -> Floats:
    """Return more lines for places of the limit that margins make narrower than a swath.

    A ditch that is a swath wide to the centimetre is flown across there, stroke by stroke.
    """
    whole = reachable(limit, width_m).intersection(ground)
    lost = shapely.get_parts(whole.difference(reachable(ground, width_m)))
    places = lost[shapely.area(lost) > PLACE_M2]
    if not len(places):
        return no_lines()
    target = shapely.union_all(places)
    found = patches(lines, ground, width_m, target=target)
    # Slivers along a border are such places, too, and no pass of its own pays for them.
    bare = target.difference(united(lines, width_m))
    gain_m2 = shapely.area(shapely.intersection(rectangles(found, width_m), bare))
    order = np.argsort(gain_m2, kind="stable")
    spare = np.cumsum(gain_m2[order]) < SLIVERS_SHARE * whole.area
    poor = gain_m2[order] < PATCH_WORTH * width_m * np.maximum(lengths_m(found), width_m)[order]
    return found[np.sort(order[~(spare & poor)])]


# Most layouts of a field leave the same nooks.
@lru_cache(maxsize=PATCHES_MAX)
def _over(patch: BaseGeometry, ground: BaseGeometry, width_m: float) -> Floats:
    """Return the line whose strip covers most of a patch and nothing outside; none for crumbs."""
    if not patch.area > PATCH_MIN_M2:
        return no_lines()
    lines = _candidates(patch, ground, width_m)
    if not len(lines):
        return no_lines()
    strips = rectangles(lines, width_m)
    inside = shapely.covers(ground, rectangles(lines, width_m - 2.0 * NARROWER_M))
    gain = np.where(inside, shapely.area(shapely.intersection(strips, patch)), 0.0)
    best = int(np.argmax(gain))
    if not gain[best] > PATCH_MIN_M2:
        return no_lines()
    return lines[[best]]


def _candidates(patch: BaseGeometry, ground: BaseGeometry, width_m: float) -> Floats:
    """Return lines over the patch in many directions, moved aside from it by parts of a swath."""
    near = patch.buffer(2.0 * width_m).intersection(ground)
    points = shapely.get_coordinates(near)
    step = np.diff(points, axis=0)
    long = step[np.argsort(-np.hypot(*step.T), kind="stable")[:ANGLES]]
    courses = np.concatenate(
        [np.arctan2(long[:, 1], long[:, 0]), np.arange(ANGLES) * np.pi / ANGLES]
    )
    courses = np.concatenate([courses, courses + np.pi / 2.0])
    corners = shapely.get_coordinates(patch)
    middle = shapely.get_coordinates(patch.representative_point())[0]
    along = np.column_stack([np.cos(courses), np.sin(courses)])
    right = np.column_stack([along[:, 1], -along[:, 0]])
    s, t, here = corners @ along.T, corners @ right.T, along @ middle
    half_m = width_m / 2.0
    aside = np.linspace(t.max(axis=0) - half_m, t.min(axis=0) + half_m, ASIDE)
    places = (along * here[:, None])[None, :, :] + right * aside[:, :, None]
    seeds = np.concatenate([places - along * SEED_M, places + along * SEED_M], axis=2)
    seeds = seeds.reshape(-1, 4)
    before_m, after_m = np.tile(here - s.min(axis=0), ASIDE), np.tile(s.max(axis=0) - here, ASIDE)
    inside = shapely.covers(ground, rectangles(seeds, width_m - 2.0 * NARROWER_M))
    wanted = np.maximum(np.stack([before_m, after_m])[:, inside], LINE_MIN_M / 2.0)
    return stretched(seeds[inside], wanted[0], wanted[1], ground, width_m)
