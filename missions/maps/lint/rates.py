"""Rates and the ground they stand on: zero, none, outside; each is another thing in flight."""

from __future__ import annotations

import numpy as np
import shapely
from shapely import Geometry, Polygon

from missions.maps.cells import shares_inside, to_degrees
from missions.maps.lint.survey import Survey, area_text
from missions.maps.local import project
from missions.maps.model import MapCells, Problem

# Herbicides in water need some 400 L/ha at most, liquid fertiliser some 1 000.
RATE_HIGH_L_HA = 2_000.0
# Even ultra-low-volume spraying puts down more, as a rule 1 to 5 L/ha; NDVI lies below 1.
RATE_LOW_L_HA = 1.0
# A map drawn by hand never meets its boundary exactly: this share of the field is let pass.
SHARE_MIN = 0.002
AREA_MIN_M2 = 1.0


def rate_problems(survey: Survey, default_rate_l_ha: float | None) -> list[Problem]:
    """Return what the rates themselves give reason to ask."""
    rates = survey.rates[survey.rated]
    problems = []
    if not len(rates) or (survey.cells is None and not survey.rated.all()):
        problems.append(_null_rate(survey, default_rate_l_ha))
    if not len(rates):
        return problems
    zero_ha = survey.hectares(survey.rates == 0.0)
    most = float(rates.max())
    if not most > 0.0:
        problems.append(
            Problem(
                severity="warning",
                code="all-zero",
                text=f"every rate is 0, on {zero_ha:.3f} ha: nothing would be sprayed",
                where=f"{survey.map_file.rate_field}: {survey.rate_spots(0.0)}",
                fix="check the rate column (--rate-field)",
            )
        )
    elif zero_ha > 0.0 and survey.cells is None and not survey.rated.all():
        none_ha = survey.hectares(~survey.rated)
        problems.append(
            Problem(
                severity="warning",
                code="zero-and-none",
                text=f"{zero_ha:.3f} ha have the rate 0 and {none_ha:.3f} ha have none: both stay "
                "dry, but a default rate would fall on the second",
                where=f"rate 0: {survey.rate_spots(0.0)}",
                fix="write 0 where nothing may fall, and leave out the zones that mean nothing",
            )
        )
    if 0.0 < most < RATE_LOW_L_HA:
        problems.append(
            Problem(
                severity="warning",
                code="low-rate",
                text=f"the largest rate is {most:g} L/ha: values from 0 to 1 look like a "
                "vegetation index or a share, and not like litres",
                where=f"{survey.map_file.rate_field}: {survey.rate_spots(most)}",
                fix="check the rate column (--rate-field) and its unit (--unit); an index has to "
                "be turned into rates first",
            )
        )
    if not most <= RATE_HIGH_L_HA:
        problems.append(
            Problem(
                severity="warning",
                code="high-rate",
                text=f"the largest rate is {most:.0f} L/ha, more than any sprayer's use",
                where=f"{survey.map_file.rate_field}: {survey.rate_spots(most)}",
                fix="check the rate column (--rate-field) and its unit (--unit)",
            )
        )
    return problems


def _null_rate(survey: Survey, default_rate_l_ha: float | None) -> Problem:
    then = "the valves close there"
    if default_rate_l_ha is not None and survey.boundary is not None:
        then = f"inside the boundary the default rate of {default_rate_l_ha:g} L/ha falls there"
    if survey.cells is not None:
        what, where = "cells", survey.cell_spots(~survey.rated)
    else:
        what, where = "zones", survey.zone_spots(np.flatnonzero(~survey.rated).tolist())
    return Problem(
        severity="warning" if survey.rated.any() else "error",
        code="null-rate",
        text=f"{int((~survey.rated).sum())} of {survey.rates.size} {what} without a rate, "
        f"{survey.hectares(~survey.rated):.3f} ha in all{_bare_text(survey)}; {then}",
        where=where,
        fix="give them a rate, 0 for none",
    )


def _bare_text(survey: Survey) -> str:
    """Return how much of the ground without a rate no zone with one covers."""
    if survey.cells is not None or not survey.rated.any() or not survey.is_simple:
        return ""
    rated = shapely.union_all(survey.local[survey.rated])
    bare = shapely.difference(shapely.union_all(survey.local[~survey.rated]), rated)
    return f", {bare.area / 10_000:.3f} ha of it under no zone with a rate"


def ground_problems(survey: Survey, default_rate_l_ha: float | None) -> list[Problem]:
    """Return where map and boundary do not cover the same ground."""
    boundary = survey.boundary
    if boundary is None or not (survey.meets_boundary and survey.is_simple):
        return []
    found = (
        _of_zones(survey, boundary)
        if survey.cells is None
        else _of_cells(survey, survey.cells, boundary)
    )
    (empty_m2, empty_where), (outside_m2, outside_where) = found
    least_m2 = max(AREA_MIN_M2, SHARE_MIN * boundary.area)
    problems = []
    if empty_m2 >= least_m2:
        then = "the valves close there"
        nowhere = "in no zone" if survey.cells is None else "in no cell with a rate"
        if default_rate_l_ha is not None:
            litres = default_rate_l_ha * empty_m2 / 10_000.0
            then = f"the default rate of {default_rate_l_ha:g} L/ha falls there, {litres:.1f} L"
        problems.append(
            Problem(
                severity="warning",
                code="uncovered",
                text=f"{area_text(empty_m2)} inside the field's boundary "
                f"({boundary.area / 10_000:.3f} ha) {nowhere}; {then}",
                where=empty_where,
                fix="draw the map up to the boundary, or check that both are of the same field",
            )
        )
    if outside_m2 >= least_m2:
        problems.append(
            Problem(
                severity="warning",
                code="outside-boundary",
                text=f"{area_text(outside_m2)} with a rate outside the field's boundary; they are "
                "not sprayed",
                where=outside_where,
                fix="correct the boundary, or check that map and boundary are of the same field",
            )
        )
    return problems


Ground = tuple[tuple[float, str], tuple[float, str]]


def _of_zones(survey: Survey, boundary: Geometry) -> Ground:
    """Return the ground of the boundary without a zone, and of zones outside it; with places."""
    empty = shapely.difference(boundary, survey.covered)
    shapely.prepare(boundary)
    out = survey.rated & (survey.rates > 0.0) & ~shapely.contains_properly(boundary, survey.local)
    outside = shapely.difference(survey.local[out], boundary)
    area_m2 = shapely.area(outside)
    where = ""
    if len(area_m2):
        worst = int(np.argmax(area_m2))
        name = survey.zone_name(int(np.flatnonzero(out)[worst]))
        where = f"{name} at {survey.spot(outside[worst])}"
    return (empty.area, _largest(survey, empty)), (float(area_m2.sum()), where)


def _of_cells(survey: Survey, cells: MapCells, boundary: Geometry) -> Ground:
    """Return the same for cells, and for ground beyond the rows and columns."""
    rows, columns = survey.rates.shape
    longitude, latitude = to_degrees(
        cells, np.array([0.0, columns, columns, 0.0]), np.array([0.0, 0.0, rows, rows])
    )
    grid = project(Polygon(np.column_stack([longitude, latitude])), survey.frame)
    beyond = shapely.difference(boundary, grid)
    bare = survey.cells_inside & ~survey.rated
    outside = ~survey.cells_inside & survey.rated & (survey.rates > 0.0)
    where = survey.cell_spots(bare) or _largest(survey, beyond)
    share_m2 = survey.area_m2
    if survey.boundary_deg is not None:
        share_m2 = shares_inside(cells, survey.boundary_deg) * survey.area_m2
    empty_m2 = beyond.area + float(share_m2[~survey.rated].sum())
    sprayed = survey.rated & (survey.rates > 0.0)
    outside_m2 = float((survey.area_m2 - share_m2)[sprayed].sum())
    return (empty_m2, where), (outside_m2, survey.cell_spots(outside))


def _largest(survey: Survey, ground: Geometry) -> str:
    parts = shapely.get_parts(ground)
    if not len(parts):
        return ""
    largest = parts[int(np.argmax(shapely.area(parts)))]
    return f"the largest part at {survey.spot(largest)}"
