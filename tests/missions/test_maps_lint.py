"""What the linter says of each kind of fault: its code, how bad it is, and where it is."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from shapely import MultiPolygon, Point, Polygon, box
from shapely.affinity import translate

from companion.errors import MapError
from missions.maps import overlaps as overlaps_module
from missions.maps.lint import Plan, check_map, summary
from missions.maps.lint import survey as survey_module
from missions.maps.model import MapFile, Problem
from missions.maps.overlaps import overlaps
from tests.missions.lint_maps import (
    CELL,
    HEIGHT_M,
    SOUTH,
    WEST,
    WIDTH_M,
    a_map,
    cell,
    cells_map,
    plan_with,
    sprayer,
)

NAN = math.nan
HOME = (SOUTH, WEST)


@dataclass(frozen=True, kw_only=True)
class Case:
    """A map with one fault; `says` and `place` are in the text and in where it is."""

    code: str
    given: MapFile
    says: str
    place: str
    severity: str = "warning"
    plan: Plan = field(default_factory=Plan)
    overlap: str = "error"


HOLED = cell(0, width=3, height=3).difference(cell(1, 1))
CASES = [
    Case(
        code="overlap",
        given=a_map((cell(0), 10.0), (cell(0.5), 20.0)),
        says=r"1 pair of zones overlaps, by 50\.0 m2 in all; .*'error'.* refused",
        place="zone0 and zone1: 50.0 m2 at 35.996",
        severity="error",
    ),
    Case(
        code="overlap",
        given=a_map((cell(0), 10.0), (cell(0.5), 20.0)),
        says="the larger rate applies there",
        place="zone0 and zone1",
        overlap="max",
    ),
    Case(
        code="null-rate",
        given=a_map((cell(0), 10.0), (cell(1), None)),
        says=r"1 of 2 zones without a rate, 0\.010 ha in all, 0\.010 ha of it under no zone",
        place="zone1 at 35.996050, 114.543150",
    ),
    Case(
        code="null-rate",
        given=a_map((cell(0), None)),
        says="1 of 1 zones without a rate",
        place="zone0 at 35.996050, 114.543050",
        severity="error",
    ),
    Case(
        code="null-rate",
        given=cells_map([[NAN, NAN]]),
        says="2 of 2 cells without a rate",
        place="row 1, column 2 at 35.996050, 114.543150",
        severity="error",
    ),
    Case(
        code="zero-and-none",
        given=a_map((cell(0), 10.0), (cell(1), None), (cell(2), 0.0)),
        says=r"0\.010 ha have the rate 0 and 0\.010 ha have none",
        place="zone2 at 35.996050, 114.543250",
    ),
    Case(
        code="all-zero",
        given=a_map((cell(0), 0.0)),
        says="nothing would be sprayed",
        place="rate: zone0 at 35.996050",
    ),
    Case(
        code="low-rate",
        given=a_map((cell(0), 0.31), (cell(1), 0.87)),
        says=r"the largest rate is 0\.87 L/ha: values from 0 to 1 look like a vegetation index",
        place="rate: zone1 at 35.996050",
    ),
    Case(
        code="high-rate",
        given=cells_map([[10.0, 5_000.0]]),
        says="5000 L/ha",
        place="row 1, column 2 at 35.996050, 114.543150",
    ),
    Case(
        code="small-part",
        given=a_map((cell(0), 1.0), (cell(3, width=5e-3, height=0.5), 1.0)),
        says=r"1 part of zones smaller than 1 m2, 0\.3 m2 in all",
        place="zone1 at 35.996025, 114.543300 (0.25 m2)",
    ),
    Case(
        code="sliver",
        given=a_map((cell(0), 1.0), (cell(3, width=1e-2, height=3), 1.0)),
        says="1 part of zones narrower than 10 cm",
        place="zone1 at 35.996150",
    ),
    Case(
        code="gap",
        given=a_map((cell(0), 1.0), (cell(1.05), 1.0)),
        says=r"1 gap narrower than 1 m between zones, 5\.0 m2 in all; the valves close",
        place="35.996050, 114.543103",
    ),
    Case(
        code="hole",
        given=a_map((HOLED, 1.0)),
        says=r"1 hole in the map, 100\.0 m2 in all",
        place="35.996150, 114.543150",
    ),
    Case(
        code="hole",
        given=cells_map([[1.0, 1.0, 1.0], [1.0, NAN, 1.0], [1.0, 1.0, 1.0]]),
        says=r"1 cell with others on all sides, 100\.0 m2 in all",
        place="row 2, column 2 at 35.996150, 114.543150",
    ),
    Case(
        code="uncovered",
        given=a_map((cell(0), 1.0), boundary=cell(0, width=2)),
        says=r"100\.0 m2 inside the field's boundary \(0\.020 ha\) in no zone; the valves close",
        place="the largest part at 35.996050, 114.543150",
    ),
    Case(
        code="uncovered",
        given=a_map((cell(0), 1.0), boundary=cell(0, width=2), default_rate_l_ha=100.0),
        says=r"the default rate of 100 L/ha falls there, 1\.0 L",
        place="35.996050, 114.543150",
    ),
    Case(
        code="uncovered",
        given=cells_map([[1.0, NAN]], boundary=cell(0, width=2)),
        says=r"100\.0 m2 .* in no cell with a rate",
        place="row 1, column 2 at 35.996050, 114.543150",
    ),
    Case(
        code="uncovered",
        given=cells_map([[1.0, NAN]], boundary=cell(0, width=1.4)),
        says=r"40\.0 m2 .* in no cell with a rate",
        place="row 1, column 2 at 35.996050, 114.543150",
    ),
    Case(
        code="uncovered",
        given=cells_map([[1.0]], boundary=cell(0, width=2)),
        says=r"100\.0 m2",
        place="the largest part at 35.996050, 114.543150",
    ),
    Case(
        code="outside-boundary",
        given=a_map((cell(0), 1.0), (cell(1), 2.0), boundary=cell(0)),
        says=r"100\.0 m2 with a rate outside",
        place="zone1 at 35.996050, 114.543150",
    ),
    Case(
        code="outside-boundary",
        given=cells_map([[1.0, 2.0]], boundary=cell(0)),
        says=r"100\.0 m2 with a rate outside",
        place="row 1, column 2 at 35.996050, 114.543150",
    ),
    Case(
        code="far-from-field",
        given=a_map((cell(0), 1.0)),
        says=r"8\.9 km away from the field's boundary",
        place="map at 35.996050, 114.543050, field at 35.996050, 114.642050",
        severity="error",
        plan=Plan(boundary=MultiPolygon([cell(990)])),
    ),
    Case(
        code="far-from-field",
        given=cells_map([[1.0]], boundary=cell(2)),
        says="beside the field's boundary",
        place="map at 35.996050, 114.543050",
        severity="error",
    ),
    Case(
        code="far-from-home",
        given=a_map((cell(0), 1.0)),
        says=r"5\.5 km away from the home point",
        place="home at 35.946000, 114.543000",
        plan=Plan(homes=((0.0, 0.0), (SOUTH - 0.05, WEST))),
    ),
    Case(
        code="far-from-home",
        given=cells_map([[1.0]]),
        says=r"55\.\d km away",
        place="home at 36.496000, 114.543000",
        severity="error",
        plan=Plan(homes=((SOUTH + 0.5, WEST),)),
    ),
    Case(
        code="swapped-axes",
        given=a_map((box(48.0, 9.0, 48.001, 9.001), 1.0)),
        says="with latitude and longitude exchanged it would be 0.0 km away",
        place="map at 9.000500, 48.000500, expected near 48.000000, 9.000000",
        severity="error",
        plan=Plan(homes=((48.0, 9.0),)),
    ),
    Case(
        code="swapped-axes",
        given=a_map((box(48.0, 9.0, 48.001, 9.001), 1.0)),
        says="exchanged",
        place="map at 9.000500, 48.000500",
        severity="error",
        plan=Plan(boundary=MultiPolygon([box(9.0, 48.0, 9.001, 48.001)])),
    ),
    Case(
        code="far-apart",
        given=a_map((cell(0), 1.0), (cell(1), 1.0), (cell(3000), 1.0)),
        says="27 km",
        place="zone2 at 35.99",
    ),
    Case(
        code="far-apart",
        given=cells_map([[1.0, 2.0, 3.0]], size_deg=0.1),
        says="27 km",
        place="from 35.9960, 114.5430",
    ),
    Case(
        code="odd-place",
        given=a_map((box(0.0, 0.0, CELL, CELL), 1.0)),
        says="in the sea off Africa",
        place="0.000050, 0.000050",
    ),
    Case(
        code="odd-place",
        given=a_map((box(36.0, 81.0, 36.0 + CELL, 81.0 + CELL), 1.0)),
        says="latitude 81.00, where nobody farms",
        place="81.000050, 36.000050",
    ),
    Case(
        code="short-zone",
        given=a_map((cell(0, height=0.05), 1.0), (cell(0, 0.05), 2.0)),
        says=r"1 place of one rate, 5\.0 m2 in all, shorter along the passes than the 1\.00 m .* "
        r"at 5 m/s \(lag 0\.100 s and one PWM period of 0\.100 s\); the shortest is 0\.55 m",
        place="zone0 at 35.996003, 114.543050 (0.55 m)",
        plan=plan_with(sprayer()),
    ),
    Case(
        code="short-zone",
        given=cells_map([[1.0], [2.0], [2.0], [1.0]], size_deg=CELL / 20),
        says=r"2 places of one rate, 0\.5 m2 .* the shortest is 0\.55 m",
        place="row 4, column 1 at 35.996003, 114.543003",
        plan=plan_with(sprayer()),
    ),
    Case(
        code="narrow-zone",
        given=a_map((cell(0, width=0.05), 1.0), (cell(0.05), 2.0)),
        says=r"1 place of one rate, 5\.0 m2 in all, narrower than the strip of one valve "
        r"\(1\.00 m\); each valve sprays the rate under its own centre",
        place="zone0 at 35.996050, 114.543003 (0.45 m)",
        plan=plan_with(sprayer()),
    ),
    Case(
        code="narrow-zone",
        given=cells_map([[1.0, 1.0]] * 8, size_deg=CELL / 20),
        says=r"the cells are 0\.45 m wide across the passes",
        place="row 5, column 1 at",
        plan=plan_with(sprayer()),
    ),
]


@pytest.mark.parametrize("case", CASES, ids=[f"{i}-{case.code}" for i, case in enumerate(CASES)])
def test_every_fault_is_told_with_its_place(case: Case) -> None:
    found = check_map(case.given, overlap=case.overlap, plan=case.plan)
    assert [problem.code for problem in found].count(case.code) == 1
    (problem,) = (problem for problem in found if problem.code == case.code)
    assert problem.severity == case.severity
    assert re.search(case.says, problem.text), problem.text
    assert case.place in problem.where
    assert problem.fix


@pytest.mark.parametrize(
    ("given_map", "fix"),
    [
        (a_map((cell(0), 1.0)), "export the map with the longitude first"),
        (
            replace(cells_map([[1.0]]), format="text-map"),
            "latitude stands first in this format: exchange the two columns",
        ),
        (replace(cells_map([[1.0]]), format="csv"), "exchange the names of the two columns"),
        (
            replace(a_map((cell(0), 1.0)), format="csv"),
            "export the map with the longitude first",
        ),
    ],
    ids=["geojson", "text-map", "csv of points", "csv of polygons"],
)
@pytest.mark.parametrize("known", ["home", "field"])
def test_exchanged_axes_are_put_right_as_the_format_has_them(
    given_map: MapFile, fix: str, known: str
) -> None:
    turned = [(x - 100.0, y) for x, y in cell(0).exterior.coords]
    placed = _moved_west(given_map)
    there = MultiPolygon([Polygon([(y, x) for x, y in turned])])
    plan = Plan(homes=((WEST - 100.0, SOUTH),)) if known == "home" else Plan(boundary=there)
    (problem,) = (one for one in check_map(placed, plan=plan) if one.code == "swapped-axes")
    assert problem.fix == fix


def _moved_west(given_map: MapFile) -> MapFile:
    """Return a map 100 degrees further west, where its longitude could be a latitude."""
    if given_map.cells is not None:
        a, b, c, d, e, f = given_map.cells.transform
        moved = replace(given_map.cells, transform=(a, b, c - 100.0, d, e, f))
        return replace(given_map, cells=moved)
    zones = [replace(zone, geometry=translate(zone.geometry, -100.0)) for zone in given_map.zones]
    return replace(given_map, zones=tuple(zones))


SOUND = [
    (a_map((HOLED, 10.0), (cell(1, 1), 20.0), (cell(3), 0.0)), Plan()),
    (a_map((cell(0), 10.0), (cell(1), 20.0), boundary=cell(0, width=2)), Plan(homes=(HOME,))),
    (a_map((cell(0), 10.0), (cell(1), 20.0)), plan_with(sprayer(angle_deg=None))),
    (cells_map([[1.0, 2.0], [0.0, 4.0]], boundary=cell(0, width=2, height=2)), Plan()),
    (cells_map([[NAN, 2.0], [0.0, 4.0]]), plan_with(sprayer())),
]


@pytest.mark.parametrize(("given_map", "plan"), SOUND)
def test_a_sound_map_has_no_problems(given_map: MapFile, plan: Plan) -> None:
    assert check_map(given_map, plan=plan) == ()


def test_errors_come_first_and_what_reading_found_is_there_with_a_place() -> None:
    noted = Problem(severity="warning", code="invalid-ring", text="repaired", where="zone1")
    found = check_map(a_map((cell(0), 10.0), (cell(0.5), 20.0), problems=[noted]))
    assert [(problem.severity, problem.code) for problem in found] == [
        ("error", "overlap"),
        ("warning", "invalid-ring"),
    ]
    assert found[1].where == "zone1 at 35.996050, 114.543100"


def test_a_grid_beside_its_own_field_is_told_once() -> None:
    noted = Problem(severity="error", code="grid-outside-field", text="beside", where="grid")
    beside = a_map((cell(0), 1.0), boundary=cell(5), problems=[noted])
    assert [problem.code for problem in check_map(beside)] == ["grid-outside-field"]
    other = Plan(boundary=MultiPolygon([cell(9)]))
    codes = [problem.code for problem in check_map(beside, plan=other)]
    assert codes == ["grid-outside-field", "far-from-field"]


def test_the_places_named_are_the_largest_and_the_rest_is_counted() -> None:
    pairs = [(cell(3.0 * i), 1.0) for i in range(5)]
    pairs += [(cell(3.0 * i + 0.9 - i / 10), 2.0) for i in range(5)]
    (problem,) = (p for p in check_map(a_map(*pairs)) if p.code == "overlap")
    assert "5 pairs of zones overlap" in problem.text
    assert problem.where.startswith("zone4 and zone9: 50.0 m2 at ")
    assert problem.where.endswith("and 2 more")
    spot = re.search(r"at ([\d.]+), ([\d.]+)", problem.where)
    assert spot is not None
    point = Point(float(spot[2]), float(spot[1]))
    assert cell(12).intersection(cell(12.5)).contains(point)


def test_a_border_zone_without_a_rate_leaves_no_ground_bare() -> None:
    found = check_map(a_map((cell(0), 1.0), (cell(1), 2.0), (cell(0, width=2), None)))
    (problem,) = (p for p in found if p.code == "null-rate")
    assert "0.000 ha of it under no zone with a rate" in problem.text


def test_a_default_rate_falls_on_zones_without_a_rate() -> None:
    plan = Plan(boundary=MultiPolygon([cell(0, width=2)]), default_rate_l_ha=7.5)
    (problem,) = (p for p in check_map(a_map((cell(0), 1.0), (cell(1), None)), plan=plan))
    assert "the default rate of 7.5 L/ha falls there" in problem.text


# ------------------------------------------------------------------------------------- short zones


def short(given_map: MapFile, **more: float | None) -> Problem | None:
    found = check_map(given_map, plan=plan_with(sprayer(**more)))  # type: ignore[arg-type]
    return next((problem for problem in found if problem.code == "short-zone"), None)


def test_at_the_speed_that_is_named_the_zone_is_long_enough() -> None:
    given_map = a_map((cell(0, height=0.05), 1.0), (cell(0, 0.05), 2.0))
    problem = short(given_map)
    assert problem is not None
    speed = re.search(r"fly at ([\d.]+) m/s or slower", problem.fix)
    assert speed is not None
    assert short(given_map, speed_m_s=float(speed[1])) is None
    assert short(given_map, speed_m_s=float(speed[1]) + 0.2) is not None


def test_no_speed_below_the_least_is_named() -> None:
    problem = short(a_map((cell(0, height=0.015), 1.0), (cell(0, 0.015), 2.0)))
    assert problem is not None
    assert problem.fix == "make them longer or merge them with their neighbours"


def test_short_is_measured_along_the_passes() -> None:
    strip = a_map((cell(0, height=0.05), 1.0), (cell(0, 0.05), 2.0))
    assert short(strip, angle_deg=0.0) is not None
    assert short(strip, angle_deg=90.0) is None
    grid = cells_map([[1.0, 1.0, 1.0], [2.0, 2.0, 2.0]], size_deg=CELL / 20)
    assert short(grid, angle_deg=0.0) is not None
    assert short(grid, angle_deg=-90.0) is None


def test_without_an_angle_the_passes_run_along_the_longer_side() -> None:
    along = [(cell(0, row / 20, width=9, height=1 / 20), 1.0 + row) for row in range(5)]
    across = [(cell(0, row / 20, width=1 / 4, height=1 / 20), 1.0 + row) for row in range(20)]
    assert short(a_map(*along), angle_deg=None) is None
    assert short(a_map(*across), angle_deg=None) is not None
    assert short(cells_map([[1.0] * 3, [2.0] * 3], size_deg=CELL / 20), angle_deg=None) is None


def test_small_zones_of_one_rate_side_by_side_are_one_place() -> None:
    pieces = [(cell(0, row / 20, height=1 / 20), 3.0) for row in range(20)]
    assert short(a_map(*pieces)) is None
    pieces[10] = (pieces[10][0], 4.0)
    problem = short(a_map(*pieces))
    assert problem is not None
    assert problem.text.startswith("1 place of one rate, 5.0 m2")
    assert problem.where.startswith("zone10 at ")


def test_a_stripe_aslant_is_as_short_as_the_passes_find_it() -> None:
    frame = survey_module.Survey(a_map((cell(0), 1.0))).frame
    corners = [(-40.0, -40.0), (40.0, 40.0), (40.0, 40.8), (-40.0, -39.2)]
    latitudes, longitudes = frame.to_geographic_all(*zip(*corners, strict=True))
    problem = short(a_map((Polygon(list(zip(longitudes, latitudes, strict=True))), 1.0)))
    assert problem is not None
    assert "the shortest is 0.80 m" in problem.text


# ----------------------------------------------------------------------------------------- summary


def test_the_summary_of_zones_adds_up() -> None:
    field = cell(0, width=8, height=3)
    found = summary(a_map((HOLED, 10.0), (cell(5), 0.0), (cell(7), None), boundary=field))
    one_ha = WIDTH_M * HEIGHT_M / 10_000
    assert (found["zones"], found["parts"], found["holes"]) == (3, 3, 1)
    assert found["area_ha"] == pytest.approx(9 * one_ha, rel=1e-3)
    assert found["zero_ha"] == pytest.approx(found["no_rate_ha"], rel=1e-5)
    assert found["zero_ha"] == pytest.approx(one_ha, rel=1e-3)
    assert found["litres"] == pytest.approx(80 * one_ha, rel=1e-3)
    assert found["mean_rate_l_ha"] == pytest.approx(80 / 9, rel=1e-3)
    assert (found["rows"], found["columns"], found["cell_m"]) == (None, None, None)
    assert found["bounds"] == pytest.approx([WEST, SOUTH, WEST + 8 * CELL, SOUTH + 3 * CELL])
    assert found["boundary_from"] == "map"
    assert found["boundary_ha"] == pytest.approx(24 * one_ha, rel=1e-3)
    assert found["map_area_ha"] == pytest.approx(found["area_ha"], rel=1e-5)


def test_the_summary_of_cells_counts_those_with_a_rate() -> None:
    found = summary(cells_map([[10.0, NAN, 0.0], [20.0, NAN, NAN]]))
    one_ha = WIDTH_M * HEIGHT_M / 10_000
    assert (found["zones"], found["rows"], found["columns"]) == (3, 2, 3)
    assert found["cell_m"] == pytest.approx([WIDTH_M, HEIGHT_M], abs=2e-3)
    assert found["area_ha"] == pytest.approx(3 * one_ha, rel=1e-3)
    assert found["litres"] == pytest.approx(30 * one_ha, rel=1e-3)
    assert found["rates_l_ha"] == [0.0, 10.0, 20.0]
    assert found["zero_ha"] == pytest.approx(one_ha, rel=1e-3)


def test_what_others_found_counts_for_the_verdict() -> None:
    more = [Problem(severity="error", code="above-label", text="too much")]
    found = summary(a_map((cell(0), 1.0)), more=more)
    assert found["ok"] is False
    assert found["problems"] == [
        {"severity": "error", "code": "above-label", "text": "too much", "where": "", "fix": ""}
    ]


squares = st.tuples(
    st.integers(0, 12), st.integers(0, 12), st.integers(1, 4), st.integers(1, 4),
    st.none() | st.sampled_from([0.0, 5.0, 12.5]),
)  # fmt: skip


@given(drawn=st.lists(squares, min_size=1, max_size=8), angle_deg=st.none() | st.floats(-180, 180))
def test_any_map_is_checked_and_adds_up(
    drawn: list[tuple[int, int, int, int, float | None]], angle_deg: float | None
) -> None:
    zones = [(cell(c, r, width=w, height=h), rate) for c, r, w, h, rate in drawn]
    plan = Plan(
        sprayer=sprayer(speed_m_s=60.0, angle_deg=angle_deg),
        boundary=MultiPolygon([cell(0, width=20, height=20)]),
        homes=(HOME,),
    )
    found = summary(a_map(*zones), plan=plan)
    rated = [(w * h, rate) for _, _, w, h, rate in drawn if rate is not None]
    one_ha = WIDTH_M * HEIGHT_M / 10_000
    assert found["area_ha"] == pytest.approx(sum(n for n, _ in rated) * one_ha, rel=2e-3)
    assert found["litres"] == pytest.approx(sum(n * r for n, r in rated) * one_ha, rel=2e-3)
    problems = found["problems"]
    assert isinstance(problems, list)
    severities = [problem["severity"] for problem in problems]
    assert severities == sorted(severities)
    assert found["ok"] is ("error" not in severities)


# ------------------------------------------------------------------------------------------ bounds


def comb(teeth: int) -> Polygon:
    """Return teeth of 1 m, 1 m apart, as long as all of them are wide."""
    points = [(0.0, 0.0)]
    for x in range(0, 2 * teeth, 2):
        points += [(x, 1), (x, 2 * teeth + 2), (x + 1, 2 * teeth + 2), (x + 1, 1)]
    return Polygon([*points, (2 * teeth, 1), (2 * teeth, 0)])


def test_combs_laid_across_each_other_are_refused_before_they_take_the_memory() -> None:
    one = comb(20_000)
    other = shapely.transform(one, lambda points: points[:, ::-1])
    with pytest.raises(MapError) as caught:
        overlaps([one, other])
    assert caught.value.code == "too-complicated"


def test_small_combs_are_measured() -> None:
    one = comb(30)
    other = shapely.transform(one, lambda points: points[:, ::-1])
    (found,) = overlaps([one, other])
    assert found.area_m2 == pytest.approx(one.intersection(other).area)


def test_neighbours_with_a_long_common_border_are_no_combs() -> None:
    x = np.linspace(0.0, 500.0, 40_000)
    border = np.column_stack([x, 10.0 + np.sin(x * 40)])
    below = Polygon([*border, (500.0, 0.0), (0.0, 0.0)])
    above = Polygon([*border, (500.0, 30.0), (0.0, 30.0)])
    assert overlaps([below, above]) == []


def test_more_pairs_of_boxes_than_anyone_waits_for_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stripes = [Polygon([(i, 0), (i + 0.5, 0), (i + 90.5, 90), (i + 90, 90)]) for i in range(60)]
    assert overlaps(stripes) == []
    # As where their edges alone do not show that none overlaps.
    monkeypatch.setattr(overlaps_module, "without_overlay", lambda _: None)
    assert overlaps(stripes) == []
    monkeypatch.setattr(overlaps_module, "CANDIDATES_MAX", 1_000)
    with pytest.raises(MapError, match="too many places"):
        overlaps(stripes)


def test_a_map_too_large_to_join_says_what_was_not_looked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(survey_module, "PARTS_MAX", 2)
    given_map = a_map(*((cell(2 * i), 1.0) for i in range(3)), boundary=cell(0, width=9))
    found = check_map(given_map, plan=plan_with(sprayer(speed_m_s=100.0)))
    assert [problem.code for problem in found] == ["not-checked"]


def test_pairs_that_are_not_all_counted_are_said_to_be_at_least_so_many(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(overlaps_module, "PAIRS_MAX", 3)
    monkeypatch.setattr("missions.maps.lint.zones.PAIRS_MAX", 3)
    stack = a_map(*((cell(0), float(rate)) for rate in range(2, 7)))
    (problem,) = (one for one in check_map(stack) if one.code == "overlap")
    assert problem.text.startswith("at least 10 pairs of zones overlap, by at least ")
    assert "(the search ends after 3 pairs)" in problem.text
