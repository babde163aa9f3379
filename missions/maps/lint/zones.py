"""The shapes of the zones: overlaps, parts too small to spray, gaps and holes.

Zones that are over before the sprayer has settled on their rate, and narrower than a strip.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely
from shapely import Geometry, MultiPolygon, STRtree

from companion.core.frame import LocalFrame
from companion.wording import counted
from missions.maps.cells import to_degrees
from missions.maps.lint.survey import (
    PLACES_MAX,
    Floats,
    Ints,
    Objects,
    Survey,
    area_text,
    some,
)
from missions.maps.model import MapCells, Problem
from missions.maps.overlaps import OVERLAP_MAX_M2, PAIRS_MAX, Overlap, overlaps

SMALL_M2 = 1.0
# Mean width of a strip, 2 area / perimeter, that no boom can follow.
SLIVER_WIDTH_M = 0.1
# Zones closer than this are neighbours; ground between them belongs to none by mistake.
GAP_WIDTH_M = 1.0
GAP_MIN_M2 = 1.0
_POLICIES = {
    "max": "the larger rate applies there",
    "min": "the smaller rate applies there",
    "mean": "the mean of their rates applies there",
    "last": "the one later in the file applies there",
}


def overlap_problems(survey: Survey, policy: str) -> list[Problem]:
    """Return how much ground zones with a rate share, whose, and what holds there."""
    if survey.cells is not None:
        return []
    joined = survey.rated_joined
    if joined is not None and joined[1] <= OVERLAP_MAX_M2:
        return []
    rated = np.flatnonzero(survey.rated).tolist()
    found = overlaps([survey.local[index] for index in rated], tried=True)
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


# Runs of one rate in a map of cells, along the axis that is nearer to the passes.


class Runs(NamedTuple):
    """For every cell how many of its rate follow each other; a cell's size along and across."""

    length: Ints
    step_m: float
    width_m: float


def cell_steps(cells: MapCells, frame: LocalFrame) -> tuple[Floats, Floats]:
    """Return the steps (east, north) to the next cell of the row and of the column, mid-map."""
    rows, columns = cells.rates_l_ha.shape
    longitude, latitude = to_degrees(
        cells,
        np.array([0.0, 1.0, 0.0]) + columns // 2,
        np.array([0.0, 0.0, 1.0]) + rows // 2,
    )
    east, north = frame.to_local_all(latitude.tolist(), longitude.tolist())
    steps = np.column_stack([east, north])
    return steps[1] - steps[0], steps[2] - steps[0]


def runs_along(survey: Survey, direction: Floats) -> Runs:
    """Return the runs in rows or in columns, whichever is nearer to a direction (east, north)."""
    if survey.cells is None:
        raise ValueError("a map of zones has no runs of cells")
    along_row, along_column = cell_steps(survey.cells, survey.frame)
    row_m, column_m = float(np.hypot(*along_row)), float(np.hypot(*along_column))
    if abs(along_row @ direction) / row_m >= abs(along_column @ direction) / column_m:
        return Runs(run_lengths(survey.rates), row_m, column_m)
    return Runs(run_lengths(survey.rates.T).T, column_m, row_m)


def run_lengths(rates: Floats) -> Ints:
    """Return for every cell how many cells of its rate follow each other in its row.

    >>> run_lengths(np.array([[1.0, 1.0, 2.0], [1.0, np.nan, np.nan]])).tolist()
    [[2, 2, 1], [1, 2, 2]]
    """
    starts = np.ones(rates.shape, dtype=np.bool_)
    none = np.isnan(rates)
    starts[:, 1:] = (rates[:, 1:] != rates[:, :-1]) & ~(none[:, 1:] & none[:, :-1])
    length = np.diff(np.flatnonzero(starts), append=rates.size)
    result: Ints = np.repeat(length, length).reshape(rates.shape)
    return result


# A zone as wide as a strip is not narrower because of a rounding in its coordinates.
STRIP_SHARE = 0.999
_ACROSS = {
    "centre": "the rate under its own centre",
    "mean": "the mean of the rates under it",
    "max": "the largest rate under it",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Pieces:
    """Connected ground of one rate: whose, mean extent along and across the passes, and area."""

    ground: Objects
    owner: Ints
    along_m: Floats
    across_m: Floats
    area_m2: Floats


def short_problems(survey: Survey, sprayer: Sprayer | None) -> list[Problem]:
    """Return what is too short along the passes, or too narrow across them, for this sprayer."""
    if sprayer is None or not survey.rated.any() or not survey.is_simple:
        return []
    direction = _direction(survey, sprayer.angle_deg)
    if survey.cells is not None:
        return _cell_problems(survey, sprayer, direction)
    pieces = _pieces(survey, sprayer, direction)
    problems = []
    short = pieces.along_m < sprayer.length_min_m
    if short.any():
        where = _where(survey, pieces, pieces.along_m, np.flatnonzero(short))
        least_m, area_m2 = float(pieces.along_m[short].min()), float(pieces.area_m2[short].sum())
        problems.append(_short(sprayer, int(short.sum()), area_m2, least_m, where))
    narrow = ~short & (pieces.across_m < sprayer.strip_m * STRIP_SHARE)
    if narrow.any():
        where = _where(survey, pieces, pieces.across_m, np.flatnonzero(narrow))
        count, area_m2 = int(narrow.sum()), float(pieces.area_m2[narrow].sum())
        text = f"{counted(count, 'place')} of one rate, {area_text(area_m2)} in all,"
        problems.append(_narrow(sprayer, text, where))
    return problems


def _short(sprayer: Sprayer, count: int, area_m2: float, least_m: float, where: str) -> Problem:
    # Cut down, so that the speed named is one that does.
    speed_m_s = math.floor(10.0 * least_m / sprayer.settle_s) / 10.0
    slower = f"fly at {speed_m_s:g} m/s or slower, or "
    return Problem(
        severity="warning",
        code="short-zone",
        text=f"{counted(count, 'place')} of one rate, {area_text(area_m2)} in all, shorter "
        f"along the passes than the {sprayer.length_min_m:.2f} m that a change of rate takes at "
        f"{sprayer.speed_m_s:g} m/s (lag {sprayer.lag_s:.3f} s and one PWM period of "
        f"{sprayer.period_s:.3f} s); the shortest is {least_m:.2f} m",
        where=where,
        fix=(slower if speed_m_s >= max(sprayer.speed_min_m_s, 0.1) else "")
        + "make them longer or merge them with their neighbours",
    )


def _narrow(sprayer: Sprayer, text: str, where: str) -> Problem:
    return Problem(
        severity="warning",
        code="narrow-zone",
        text=f"{text} narrower than the strip of one valve ({sprayer.strip_m:.2f} m); each valve "
        f"sprays {_ACROSS.get(sprayer.across, sprayer.across)} (prescription.across)",
        where=where,
        fix="make the map no finer than the strips, or choose prescription.across",
    )


def _direction(survey: Survey, angle_deg: float | None) -> Floats:
    """Return the direction (east, north) of the passes: as planned, else along the longer side."""
    if angle_deg is not None:
        angle = math.radians(angle_deg)
        return np.array([math.sin(angle), math.cos(angle)])
    if survey.cells is not None:
        rows, columns = survey.rates.shape
        along_row, along_column = cell_steps(survey.cells, survey.frame)
        row_m = columns * np.hypot(*along_row)
        return _unit(along_row if row_m >= rows * np.hypot(*along_column) else along_column)
    hull = shapely.convex_hull(shapely.multipoints(shapely.get_coordinates(survey.local)))
    corners = shapely.get_coordinates(shapely.oriented_envelope(hull))
    sides = np.diff(corners[:3], axis=0) if len(corners) >= 3 else np.array([[0.0, 1.0]])
    return _unit(sides[int(np.argmax(np.hypot(*sides.T)))])


def _unit(vector: Floats) -> Floats:
    length = float(np.hypot(*vector))
    return vector / length if length > 0.0 else np.array([0.0, 1.0])


def _pieces(survey: Survey, sprayer: Sprayer, direction: Floats) -> Pieces:
    """Return the ground of every rate that has anything small, joined where its zones touch.

    Ground joined of parts that are all long enough is never shorter than the shortest of them,
    so the other rates need not be joined. Slivers have a problem of their own.
    """
    alone = _measured(survey.local, direction)
    small = (alone.along_m < sprayer.length_min_m) | (
        alone.across_m < sprayer.strip_m * STRIP_SHARE
    )
    rates = np.unique(survey.rates[alone.owner[small]])
    chosen = np.flatnonzero(np.isin(survey.rates, rates))
    order = chosen[np.argsort(survey.rates[chosen], kind="stable")]
    starts = np.flatnonzero(np.diff(survey.rates[order], prepend=-1.0))
    groups = np.split(survey.local[order], starts[1:])
    united = [group[0] if len(group) == 1 else shapely.union_all(group) for group in groups]
    return _measured(np.array(united, dtype=object), direction)


def _measured(areas: Objects, direction: Floats) -> Pieces:
    """Return all parts of some size, with their mean length along the passes and across them.

    Mean length is area over the extent across; a strip that lies across the passes is as short
    as they find it, however long it is itself.
    """
    parts, owner = shapely.get_parts(areas, return_index=True)
    area_m2 = shapely.area(parts)
    kept = (area_m2 >= SMALL_M2) & (2.0 * area_m2 >= SLIVER_WIDTH_M * shapely.length(parts))
    parts, owner, area_m2 = parts[kept], owner[kept], area_m2[kept]
    points, part = shapely.get_coordinates(parts, return_index=True)
    first = np.flatnonzero(np.diff(part, prepend=-1))

    def extent_m(axis: Floats) -> Floats:
        if not len(first):
            return np.empty(0)
        along = points @ axis
        result: Floats = np.maximum.reduceat(along, first) - np.minimum.reduceat(along, first)
        return result

    return Pieces(
        ground=parts,
        owner=owner,
        along_m=area_m2 / extent_m(np.array([direction[1], -direction[0]])),
        across_m=area_m2 / extent_m(direction),
        area_m2=area_m2,
    )


def _where(survey: Survey, pieces: Pieces, size_m: Floats, which: Ints) -> str:
    """Return the smallest pieces: of which zone, where and how large."""
    ordered = which[np.argsort(size_m[which], kind="stable")]
    tree = STRtree(survey.local)
    named = []
    for index in ordered[:PLACES_MAX].tolist():
        inside = shapely.point_on_surface(pieces.ground[index])
        zones = [zone for zone in tree.query(inside, "intersects").tolist() if survey.rated[zone]]
        name = survey.zone_name(zones[0]) if zones else "a zone"
        named.append(f"{name} at {survey.spot(pieces.ground[index])} ({size_m[index]:.2f} m)")
    return some(named, len(ordered))


def _cell_problems(survey: Survey, sprayer: Sprayer, direction: Floats) -> list[Problem]:
    """Return the same for cells: runs of one rate along the axis that is nearer to the passes."""
    runs = runs_along(survey, direction)
    problems = []
    least = math.ceil(sprayer.length_min_m / runs.step_m * (1.0 - 1e-6))
    short = survey.rated & (runs.length < least)
    if short.any():
        shortest = int(runs.length[short].min())
        count = int(np.rint((1.0 / runs.length[short]).sum()))
        where = survey.cell_spots(short & (runs.length == shortest))
        area_m2 = float(survey.area_m2[short].sum())
        problems.append(_short(sprayer, count, area_m2, shortest * runs.step_m, where))
    if runs.width_m < sprayer.strip_m * STRIP_SHARE:
        text = f"the cells are {runs.width_m:.2f} m wide across the passes,"
        problems.append(_narrow(sprayer, text, survey.cell_spots(survey.rated)))
    return problems


# What is known about the flight for which a map is checked; all of it may be missing.


@dataclass(frozen=True, slots=True, kw_only=True)
class Sprayer:
    """What the sprayer needs of a zone, so that its rate is really there.

    Args:
        speed_m_s: planned, in the passes.
        lag_s: of the slowest kind of change, the output's delay included.
        period_s: of a PWM period, which a change may have to wait for.
        strip_m: width of the narrowest valve's strip.
        across: what a strip over several zones sprays, as `prescription.across`.
        angle_deg: of the passes, clockwise from north; None where the planner chooses.
        speed_min_m_s: below which nothing is sprayed.
    """

    speed_m_s: float
    lag_s: float
    period_s: float
    strip_m: float
    across: str = "centre"
    angle_deg: float | None = None
    speed_min_m_s: float = 0.0

    @property
    def settle_s(self) -> float:
        """Return how long a rate must last: the lag of a change and one PWM period."""
        return self.lag_s + self.period_s

    @property
    def length_min_m(self) -> float:
        """Return how long a zone must be along the passes."""
        return self.speed_m_s * self.settle_s


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Where the field and the home are, in longitude and latitude, and what flies there.

    `boundary` and `default_rate_l_ha` stand above the map's own; homes are (latitude, longitude).
    Nothing falls on `exclusions`.
    """

    boundary: MultiPolygon | None = None
    exclusions: tuple[MultiPolygon, ...] = ()
    buffers: tuple[MultiPolygon, ...] = ()  # those of the exclusions that the label asks for
    default_rate_l_ha: float | None = None
    homes: tuple[tuple[float, float], ...] = ()
    sprayer: Sprayer | None = None
