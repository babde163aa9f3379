"""All checks of a map, one after the other, and what `map check` prints of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import shapely
from shapely.errors import ShapelyError

from missions.maps.lint.place import place_problems
from missions.maps.lint.plan import Plan
from missions.maps.lint.rates import ground_problems, rate_problems
from missions.maps.lint.shapes import overlap_problems, shape_problems
from missions.maps.lint.short import short_problems
from missions.maps.lint.survey import Survey
from missions.maps.model import MapFile, Problem, map_error
from missions.maps.overlaps import check_outline
from missions.maps.totals import Totals, totals


def check_map(
    map_file: MapFile, *, overlap: str = "error", plan: Plan | None = None
) -> tuple[Problem, ...]:
    """Return everything that reading found, and what a look at the whole map adds; errors first.

    Overlaps are an error only where the overlap policy refuses them.
    """
    plan = plan or Plan()
    return _checked(_survey(map_file, plan), overlap, plan)


def summary(
    map_file: MapFile,
    *,
    overlap: str = "error",
    plan: Plan | None = None,
    more: Sequence[Problem] = (),
) -> dict[str, object]:
    """Return what `map check --json` prints; `more` are problems that others found.

    `area_ha` is the ground that has a rate and may be sprayed, and `litres` what it takes, both as
    `totals` has them; `map_area_ha` is the ground of the file's own zones or cells with a rate,
    inside the boundary and outside.
    """
    plan = plan or Plan()
    survey = _survey(map_file, plan)
    problems = _worst_first([*_checked(survey, overlap, plan), *_placed(survey, more)])
    parts = shapely.get_parts(np.array([zone.geometry for zone in map_file.zones], dtype=object))
    found = _totals(survey, overlap, plan)
    return {
        "ok": not any(problem.severity == "error" for problem in problems),
        "path": str(map_file.path),
        "format": map_file.format,
        "crs": map_file.crs,
        "unit": map_file.unit,
        "rate_field": map_file.rate_field,
        "zones": len(map_file.zones) if map_file.cells is None else int(survey.rated.sum()),
        "parts": len(parts),
        "holes": int(shapely.get_num_interior_rings(parts).sum()),
        **_shape(survey),
        "area_ha": found.area_ha,
        "map_area_ha": float(survey.area_m2[survey.rated].sum()) / 10_000.0,
        "zero_ha": float(found.areas_ha[found.rates_l_ha == 0.0].sum()),
        "no_rate_ha": survey.hectares(~survey.rated) if map_file.cells is None else None,
        "boundary_ha": None if survey.boundary is None else survey.boundary.area / 10_000.0,
        "boundary_from": _boundary_from(map_file, plan),
        "default_rate_l_ha": _default(survey, plan),
        "litres": found.all_litres,
        "mean_rate_l_ha": found.all_litres / found.area_ha if found.area_ha > 0.0 else None,
        "rates_l_ha": list(map_file.rates_l_ha),
        "bounds": list(survey.bounds_deg),
        "sha256": map_file.sha256,
        "problems": [
            {
                "severity": problem.severity,
                "code": problem.code,
                "text": problem.text,
                "where": problem.where,
                "fix": problem.fix,
            }
            for problem in problems
        ],
    }


def _survey(map_file: MapFile, plan: Plan) -> Survey:
    return Survey(map_file, boundary=plan.boundary, exclusions=plan.exclusions)


def _totals(survey: Survey, overlap: str, plan: Plan) -> Totals:
    try:
        return totals(
            survey.map_file,
            boundary=plan.boundary,
            default_rate_l_ha=plan.default_rate_l_ha,
            exclusions=plan.exclusions,
            overlap=overlap,
            frame=survey.frame,
            areas_m2=survey.inside_m2,
        )
    except ShapelyError as error:
        raise _unusable(survey.map_file, error) from None


def _checked(survey: Survey, overlap: str, plan: Plan) -> tuple[Problem, ...]:
    """Return all problems; overlaps are looked for first, they refuse what none could join."""
    try:
        overlapping = overlap_problems(survey, overlap)
        if survey.boundary is None and survey.cells is None and survey.is_simple:
            check_outline(survey.rated_ground, survey.map_file.path)
        default = _default(survey, plan)
        found = [
            *place_problems(survey, plan.homes),
            *rate_problems(survey, default),
            *ground_problems(survey, default),
            *overlapping,
            *shape_problems(survey),
            *short_problems(survey, plan.sprayer),
        ]
    except ShapelyError as error:
        raise _unusable(survey.map_file, error) from None
    read = survey.map_file.problems
    if plan.boundary is None and any(problem.code == "grid-outside-field" for problem in read):
        said = ("far-from-field", "outside-boundary")
        found = [problem for problem in found if problem.code not in said]
    return _worst_first([*_placed(survey, read), *found])


def _default(survey: Survey, plan: Plan) -> float | None:
    """Return the rate inside the boundary where there is no zone, as the flight takes it."""
    if plan.default_rate_l_ha is not None or survey.map_file.boundary is None:
        return plan.default_rate_l_ha
    return survey.map_file.default_rate_l_ha


def _worst_first(problems: Sequence[Problem]) -> tuple[Problem, ...]:
    return tuple(sorted(problems, key=lambda problem: problem.severity != "error"))


def _placed(survey: Survey, problems: Sequence[Problem]) -> list[Problem]:
    """Return problems that name a zone, or a rate's problem that names none, with a place."""
    if survey.cells is not None or not problems:
        return list(problems)
    by_name = {zone.name: index for index, zone in enumerate(survey.zones)}
    return [
        replace(problem, where=survey.zone_spots([by_name[problem.where]]))
        if problem.where in by_name
        else problem
        for problem in problems
    ]


def _shape(survey: Survey) -> dict[str, object]:
    """Return rows, columns and the size of a cell; none for a map of zones."""
    size = survey.cell_size_m
    rows, columns = survey.rates.shape if size is not None else (None, None)
    return {
        "rows": rows,
        "columns": columns,
        "cell_m": None if size is None else [float(np.round(side, 4)) for side in size],
    }


def _boundary_from(map_file: MapFile, plan: Plan) -> str | None:
    if plan.boundary is not None:
        return "configuration"
    return None if map_file.boundary is None else "map"


def _unusable(map_file: MapFile, error: ShapelyError) -> Exception:
    return map_error(
        map_file.path,
        f"its polygons cannot be used ({str(error)[:120]})",
        fix="export the map again",
        code="broken-geometry",
    )
