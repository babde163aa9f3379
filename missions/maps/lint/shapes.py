"""The shapes of the zones: overlaps, parts too small to spray, gaps and holes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from shapely import Geometry

from companion.wording import counted
from missions.maps.lint.survey import PLACES_MAX, Objects, Survey, area_text, some
from missions.maps.model import Problem
from missions.maps.overlaps import OVERLAP_MAX_M2, PAIRS_MAX, Overlap, overlaps

SMALL_M2 = 1.0
# Mean width of a strip, 2 area / perimeter, that no boom can follow.
SLIVER_WIDTH_M = 0.1
# Zones closer than this are neighbours; ground between them belongs to none by mistake.
GAP_WIDTH_M = 1.0
GAP_MIN_M2 = 1.0
_POLICIES = {
    "max": "the larger rate holds there",
    "min": "the smaller rate holds there",
    "mean": "the mean of their rates holds there",
    "last": "the one later in the file holds there",
}


def overlap_problems(survey: Survey, policy: str) -> list[Problem]:
    """Return how much ground zones with a rate share, whose, and what holds there."""
    if survey.cells is not None:
        return []
    joined = survey.rated_joined
    if joined is not None and joined[1] <= OVERLAP_MAX_M2:
        return []
    rated = np.flatnonzero(survey.rated).tolist()
    found = overlaps([survey.local[index] for index in rated])
    if not found:
        return []

    def pair(overlap: Overlap) -> str:
        first, second = rated[overlap.first], rated[overlap.second]
        shared = shapely.intersection(survey.local[first], survey.local[second])
        names = f"{survey.zone_name(first)} and {survey.zone_name(second)}"
        return f"{names}: {overlap.area_m2:.1f} m2 at {survey.spot(shared)}"

    total_m2 = sum(overlap.area_m2 for overlap in found)
    pairs = (
        "1 pair of zones overlaps" if len(found) == 1 else f"{len(found)} pairs of zones overlap"
    )
    extent = f"by {area_text(total_m2)} in all"
    if len(found) > PAIRS_MAX:
        pairs = f"at least {pairs}"
        extent = f"by at least {area_text(total_m2)} (the search ends after {PAIRS_MAX} pairs)"
    then = _POLICIES.get(policy, "no rule is set, and the map is refused")
    return [
        Problem(
            severity="error" if policy == "error" else "warning",
            code="overlap",
            text=f"{pairs}, {extent}; prescription.overlap is {policy!r}: {then}",
            where=some([pair(overlap) for overlap in found[:PLACES_MAX]], len(found)),
            fix="correct the map, or set prescription.overlap to max, min, mean or last",
        )
    ]


def shape_problems(survey: Survey) -> list[Problem]:
    """Return parts too small to be sprayed, and ground between the zones that is in none."""
    if survey.cells is not None:
        return _cell_holes(survey)
    if not survey.is_simple:
        return [
            *_small_problems(survey),
            Problem(
                severity="warning",
                code="not-checked",
                text="the map has too many polygons or vertices to look for gaps, holes, ground "
                "without a zone and short zones",
                where="the whole map",
                fix="simplify the map, or cut it to one field",
            ),
        ]
    return [*_small_problems(survey), *_between_problems(survey)]


def _small_problems(survey: Survey) -> list[Problem]:
    parts, owner = shapely.get_parts(survey.local, return_index=True)
    area_m2 = shapely.area(parts)
    small = area_m2 < SMALL_M2
    narrow = ~small & (2.0 * area_m2 < SLIVER_WIDTH_M * shapely.length(parts))

    def where(chosen: Sequence[int]) -> str:
        named = [
            f"{survey.zone_name(owner[i])} at {survey.spot(parts[i])} ({area_m2[i]:.2f} m2)"
            for i in chosen[:PLACES_MAX]
        ]
        return some(named, len(chosen))

    return [
        Problem(
            severity="warning",
            code=code,
            text=f"{counted(int(mask.sum()), 'part')} of zones {text}, "
            f"{area_text(float(area_m2[mask].sum()))} in all: too little to be sprayed",
            where=where(np.flatnonzero(mask).tolist()),
            fix="merge them into their neighbours",
        )
        for code, mask, text in (
            ("small-part", small, f"smaller than {SMALL_M2:.0f} m2"),
            ("sliver", narrow, f"narrower than {SLIVER_WIDTH_M * 100:.0f} cm"),
        )
        if mask.any()
    ]


def _between_problems(survey: Survey) -> list[Problem]:
    """Return gaps, by closing the outline of all zones over them, and holes that stay open."""
    covered = survey.covered
    grown = shapely.buffer(covered, GAP_WIDTH_M / 2, join_style="mitre")
    closed = shapely.buffer(grown, -GAP_WIDTH_M / 2, join_style="mitre")
    gaps = _large(shapely.get_parts(shapely.difference(closed, covered)))
    problems = []
    if len(gaps):
        gaps_m2 = float(shapely.area(gaps).sum())
        problems.append(
            Problem(
                severity="warning",
                code="gap",
                text=f"{counted(len(gaps), 'gap')} narrower than {GAP_WIDTH_M:.0f} m between "
                f"zones, {area_text(gaps_m2)} in all; the valves close over them",
                where=survey.spots(gaps.tolist()),
                fix="draw the zones up to each other",
            )
        )
    holes = _holes(survey, closed)
    if len(holes):
        problems.append(
            _hole(
                f"{counted(len(holes), 'hole')} in the map",
                float(shapely.area(holes).sum()),
                survey.spots(holes.tolist()),
            )
        )
    return problems


def _holes(survey: Survey, closed: Geometry) -> Objects:
    """Return the ground that zones enclose and none has; what lies outside the field is none."""
    shells = shapely.get_exterior_ring(shapely.get_parts(closed))
    holes = shapely.difference(shapely.union_all(shapely.polygons(shells)), closed)
    if survey.boundary is not None:
        holes = shapely.intersection(holes, survey.boundary)
    return _large(shapely.get_parts(holes))


def _large(parts: Objects) -> Objects:
    """Return the parts of some size, the largest first."""
    area_m2 = shapely.area(parts)
    order = np.argsort(-area_m2, kind="stable")
    found: Objects = parts[order][area_m2[order] >= GAP_MIN_M2]
    return found


def _hole(what: str, area_m2: float, where: str) -> Problem:
    return Problem(
        severity="warning",
        code="hole",
        text=f"{what}, {area_text(area_m2)} in all, without a zone; the valves close there",
        where=where,
        fix="leave them where they are obstacles, else draw a zone there",
    )


def _cell_holes(survey: Survey) -> list[Problem]:
    """Return cells without a rate that have cells with one on all four sides."""
    rated = survey.rated
    closed_in = ~rated & survey.cells_inside
    for axis in (0, 1):
        before = np.logical_or.accumulate(rated, axis=axis)
        after = np.flip(np.logical_or.accumulate(np.flip(rated, axis), axis=axis), axis)
        closed_in &= before & after
    area_m2 = float(survey.area_m2[closed_in].sum())
    if not area_m2 >= GAP_MIN_M2:
        return []
    what = f"{counted(int(closed_in.sum()), 'cell')} with others on all sides"
    return [_hole(what, area_m2, survey.cell_spots(closed_in))]
