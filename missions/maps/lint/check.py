"""All checks of a map, one after the other, and what `map check` prints of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import shapely
from shapely import Geometry, Polygon
from shapely.errors import ShapelyError

from companion.cli.answer import problem_object
from companion.core.frame import WGS84
from missions.maps.cells import shares_inside, to_degrees
from missions.maps.lint.survey import Floats, Ints, Survey, area_text, latitude_longitude
from missions.maps.lint.zones import Plan, overlap_problems, shape_problems, short_problems
from missions.maps.local import project
from missions.maps.model import MapCells, MapFile, Problem, Severity, map_error
from missions.maps.outlines import INSIDE_SHARE, SAME_SHARE
from missions.maps.overlaps import check_outline
from missions.maps.totals import Totals, totals


def check_map(
    map_file: MapFile, *, overlap: str = "error", plan: Plan | None = None
) -> tuple[Problem, ...]:
    """Return everything that reading found, and what a look at the whole map adds; errors first.

    Overlaps are an error only where the overlap policy refuses them.
    """
    plan = plan or Plan()
    return _checked(_survey(map_file, plan), map_file.rule(overlap), plan)


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
    plan, overlap = plan or Plan(), map_file.rule(overlap)
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
        "problems": [problem_object(problem) for problem in problems],
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


# Rates and the ground they stand on: zero, none, outside; each is another thing in flight.

# Herbicides in water need some 400 L/ha at most, liquid fertiliser some 1 000.
RATE_HIGH_L_HA = 2_000.0
# Even ultra-low-volume spraying puts down more, as a rule 1 to 5 L/ha; NDVI lies below 1.
RATE_LOW_L_HA = 1.0
# The rates of a map lie within a few times of each other; codes like 254 or 999 do not.
RATE_APART_TIMES = 8.0
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
    return [*problems, *_sizes(survey, rates, most)]


def _sizes(survey: Survey, rates: Floats, most: float) -> list[Problem]:
    """Return rates that are too small or too large for any, or for the others of this map."""
    problems, column = [], survey.map_file.rate_field
    others = rates[rates < most]
    if 0.0 < most < RATE_LOW_L_HA:
        problems.append(
            Problem(
                severity="warning",
                code="low-rate",
                text=f"the largest rate is {most:g} L/ha: values from 0 to 1 look like a "
                "vegetation index or a share, and not like litres",
                where=f"{column}: {survey.rate_spots(most)}",
                fix="check the rate column (--rate-field) and its unit (--unit); an index has to "
                "be turned into rates first",
            )
        )
    if not most <= RATE_HIGH_L_HA:
        problems.append(
            Problem(
                severity="warning",
                code="high-rate",
                text=f"the largest rate is {most:.0f} L/ha, more than any sprayer applies",
                where=f"{column}: {survey.rate_spots(most)}",
                fix="check the rate column (--rate-field) and its unit (--unit)",
            )
        )
    if others.size and 0.0 < others.max() * RATE_APART_TIMES < most <= RATE_HIGH_L_HA:
        problems.append(
            Problem(
                severity="warning",
                code="rate-apart",
                text=f"the largest rate is {most:g} L/ha, and all others at most "
                f"{others.max():g}: it may be a code for no data, or a slip",
                where=f"{column}: {survey.rate_spots(most)}",
                fix="correct it where the map is made, if nobody meant it",
            )
        )
    return problems


def _null_rate(survey: Survey, default_rate_l_ha: float | None) -> Problem:
    then = "the valves close there"
    if default_rate_l_ha is not None and survey.boundary is not None:
        then = f"inside the boundary the default rate of {default_rate_l_ha:g} L/ha falls there"
    severity: Severity = "warning" if survey.rated.any() else "error"
    fix = "give them a rate, 0 for none"
    if survey.cells is not None:
        what, where = "cells", survey.cell_spots(~survey.rated)
    else:
        what, where = "zones", survey.zone_spots(np.flatnonzero(~survey.rated).tolist())
        under = _under(survey) if survey.is_simple else np.array([], dtype=np.int64)
        if under.size:
            # An island or a pond as a record of its own, of which a program knows no rate.
            severity, fix = "error", "draw them as holes of the zone around them"
            then = f"{under.size} of them lie in a zone with a rate, which falls there too"
            where = survey.zone_spots(under.tolist())
    return Problem(
        severity=severity,
        code="null-rate",
        text=f"{int((~survey.rated).sum())} of {survey.rates.size} {what} without a rate, "
        f"{survey.hectares(~survey.rated):.3f} ha in all{_bare_text(survey)}; {then}",
        where=where,
        fix=fix,
    )


def _under(survey: Survey) -> Ints:
    """Return the zones without a rate that lie, but for a border, in a larger one with a rate."""
    none, rated = survey.local[~survey.rated], survey.local[survey.rated]
    inner, outer = shapely.STRtree(rated).query(none, predicate="intersects")
    shared = shapely.area(shapely.intersection(none[inner], rated[outer]))
    size = shapely.area(none)[inner]
    inside = (shared >= INSIDE_SHARE * size) & (size < SAME_SHARE * shapely.area(rated)[outer])
    found: Ints = np.flatnonzero(~survey.rated)[np.unique(inner[inside])]
    return found


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
    share_m2 = survey.area_m2
    if survey.boundary_deg is not None:
        share_m2 = shares_inside(cells, survey.boundary_deg) * survey.area_m2
    # Along a slanted edge a cell whose centre lies outside holds ground of the field, too.
    cut_m2 = float(share_m2[~survey.rated].sum())
    cut = survey.cell_spots(~survey.rated & (share_m2 > 0.0))
    where = survey.cell_spots(bare) or (_largest(survey, beyond) if beyond.area > cut_m2 else cut)
    empty_m2 = beyond.area + cut_m2
    sprayed = survey.rated & (survey.rates > 0.0)
    outside_m2 = float((survey.area_m2 - share_m2)[sprayed].sum())
    return (empty_m2, where), (outside_m2, survey.cell_spots(outside))


def _largest(survey: Survey, ground: Geometry) -> str:
    parts = shapely.get_parts(ground)
    parts = parts[~shapely.is_empty(parts)]  # an empty polygon is a part of itself
    if not len(parts):
        return ""
    largest = parts[int(np.argmax(shapely.area(parts)))]
    return f"the largest part at {survey.spot(largest)}"


# Where the map lies on earth, against the field and the home that are known.

Bounds = tuple[float, float, float, float]

# A map over more than this holds a zone of another field.
FAR_APART_M = 20_000.0
# Nobody farms beyond the northern end of Norway's fields; there the two axes are exchanged.
LATITUDE_MAX_DEG = 66.0
# A sprayer that is carried to the field stands beside it; beyond the second, something is wrong.
HOME_NEAR_M = 2_000.0
HOME_FAR_M = 20_000.0


def place_problems(survey: Survey, homes: Sequence[tuple[float, float]]) -> list[Problem]:
    """Return where the map lies in an odd place, or far from the field or from home."""
    return [*_field(survey), *_home(survey, homes), *_apart(survey), *_odd(survey)]


def gap_m(one: Bounds, two: Bounds) -> float:
    """Return the distance between two boxes of west, south, east, north; 0 where they meet.

    >>> gap_m((0.0, 0.0, 1.0, 1.0), (0.5, 0.5, 2.0, 2.0))
    0.0
    >>> round(gap_m((0.0, 0.0, 1.0, 0.0), (2.0, 0.0, 3.0, 0.0)))
    111319
    """
    west, south = max(one[0], two[0]), max(one[1], two[1])
    east, north = min(one[2], two[2]), min(one[3], two[3])
    longitudes = (east, west) if west > east else (west, west)
    latitudes = (north, south) if south > north else (south, south)
    return float(WGS84.inv(longitudes[0], latitudes[0], longitudes[1], latitudes[1])[2])


def _field(survey: Survey) -> list[Problem]:
    if survey.boundary_deg is None or survey.meets_boundary or not survey.rated.any():
        return []
    bounds = _bounds(survey.boundary_deg)
    away_m = gap_m(survey.bounds_deg, bounds)
    exchanged = _exchanged(survey, bounds, away_m)
    if exchanged is not None:
        return [exchanged]
    far = f"{away_m / 1000:.1f} km away from" if away_m > 50.0 else "beside"
    return [
        Problem(
            severity="error",
            code="far-from-field",
            text=f"the map lies {far} the field's boundary and has no ground in common with it: "
            "nothing would be sprayed",
            where=f"map at {_middle(survey.bounds_deg)}, field at {_middle(bounds)}",
            fix="give map and boundary (prescription.boundary) of the same field, or correct the "
            "CRS with --crs",
        )
    ]


def _home(survey: Survey, homes: Sequence[tuple[float, float]]) -> list[Problem]:
    if not homes:
        return []
    boxes = [(longitude, latitude, longitude, latitude) for latitude, longitude in homes]
    away_m = [gap_m(survey.bounds_deg, box) for box in boxes]
    nearest = int(np.argmin(away_m))
    if away_m[nearest] <= HOME_NEAR_M:
        return []
    exchanged = _exchanged(survey, boxes[nearest], away_m[nearest])
    if exchanged is not None:
        return [exchanged]
    return [
        Problem(
            severity="error" if away_m[nearest] > HOME_FAR_M else "warning",
            code="far-from-home",
            text=f"the map lies {away_m[nearest] / 1000:.1f} km away from the home point",
            where=f"map at {_middle(survey.bounds_deg)}, "
            f"home at {latitude_longitude(*homes[nearest])}",
            fix="check that the map is of this field, its CRS (--crs), and the home point (--home, "
            "mission.depots)",
        )
    ]


def _exchanged(survey: Survey, known: Bounds, away_m: float) -> Problem | None:
    """Return the problem of a map that would be in place with its axes the other way round."""
    west, south, east, north = survey.bounds_deg
    turned = (south, west, north, east)
    if max(abs(west), abs(east)) > 90.0 or away_m <= HOME_FAR_M:
        return None
    turned_m = gap_m(turned, known)
    if turned_m > HOME_FAR_M:
        return None
    return Problem(
        severity="error",
        code="swapped-axes",
        text=f"the map lies {away_m / 1000:.0f} km away; with latitude and longitude exchanged it "
        f"would be {turned_m / 1000:.1f} km away: its file has them the wrong way round",
        where=f"map at {_middle(survey.bounds_deg)}, expected near {_middle(known)}",
        fix=_put_right(survey),
    )


def _put_right(survey: Survey) -> str:
    """Return how to exchange the axes in the format of the map."""
    if survey.map_file.format == "text-map":
        return "latitude stands first in this format: exchange the two columns"
    if survey.map_file.format == "csv" and survey.cells is not None:
        return "exchange the names of the two columns"
    return "export the map with the longitude first"


def _apart(survey: Survey) -> list[Problem]:
    west, south, east, north = survey.bounds_deg
    reach_m = max(
        gap_m((west, south, west, south), (east, south, east, south)),
        gap_m((west, south, west, south), (west, north, west, north)),
    )
    if reach_m <= FAR_APART_M:
        return []
    where = f"from {south:.4f}, {west:.4f} to {north:.4f}, {east:.4f}"
    if survey.cells is None:
        centres = shapely.get_coordinates(shapely.centroid(survey.local))
        middle = np.median(centres, axis=0)
        where = survey.zone_spots([int(np.argmax(np.hypot(*(centres - middle).T)))])
    return [
        Problem(
            severity="warning",
            code="far-apart",
            text=f"the map reaches over {reach_m / 1000:.0f} km, more than a field",
            where=where,
            fix="check the zone that lies far from the others, and the CRS (--crs)",
        )
    ]


def _odd(survey: Survey) -> list[Problem]:
    latitude, longitude = survey.frame.latitude_deg, survey.frame.longitude_deg
    if abs(latitude) < 1.0 and abs(longitude) < 1.0:
        text = "the map lies in the sea off Africa, where latitude and longitude are 0"
        fix = "check the CRS: metres may have been written as degrees"
    elif not abs(latitude) <= LATITUDE_MAX_DEG:
        text = f"the map lies at latitude {latitude:.2f}, where nobody farms"
        fix = "check whether latitude and longitude are exchanged, and the CRS"
    else:
        return []
    return [
        Problem(
            severity="warning",
            code="odd-place",
            text=text,
            where=latitude_longitude(latitude, longitude),
            fix=fix,
        )
    ]


def _bounds(area: shapely.Geometry) -> Bounds:
    west, south, east, north = shapely.bounds(area).tolist()
    return west, south, east, north


def _middle(bounds: Bounds) -> str:
    west, south, east, north = bounds
    return latitude_longitude((south + north) / 2, (west + east) / 2)
