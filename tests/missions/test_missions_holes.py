"""A hole of the outline may be a pond or a house: no way of a plan comes near it unasked."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import Point, Polygon, box

from companion.cli.app import execute
from missions.demand import Uniform
from missions.errors import PlanError
from missions.field import both_ways, build_field, frame_of
from missions.maps.compiling import read_plan_lines
from missions.plan import Settings
from missions.planner import plan_mission
from tests.bench.missions import FRAME, random_field, to_degrees
from tests.mission_judge import Plane
from tests.missions.test_missions_cli import written

pytestmark = pytest.mark.usefixtures("searched_briefly", "laid_out_once")

KEPT_M, DIGITS_M = 2.0, 0.01
POND, HOUSE = Point(60, 70).buffer(14.0), box(100, 120, 112, 132)
FIELD = box(0, 0, 160, 200).difference(shapely.union_all([POND, HOUSE]))


def planned(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[dict[str, Any], list[str]]:
    code = execute(["plan", "--force", *map(str, words)])
    out, err = capsys.readouterr()
    assert code == 0, err
    return json.loads(out) if "--json" in words else {}, out.splitlines()


def apart_m(outline: Path, plan: Path) -> float:
    """Return how near any leg of a plan comes to a hole, by shapely and the Earth's shape alone."""
    drawn = shapely.from_geojson(outline.read_text())
    west, south, east, north = drawn.bounds
    plane = Plane((west + east) / 2.0, (south + north) / 2.0)
    rings = [
        Polygon(plane.metres(shapely.get_coordinates(ring)))
        for part in shapely.get_parts(shapely.get_parts(drawn))
        for ring in part.interiors
    ]
    legs = [
        shapely.LineString(plane.metres(np.array(each["geometry"]["coordinates"]))[:, :2])
        for each in json.loads(plan.read_text())["features"]
        if each["geometry"]["type"] == "LineString"
    ]
    assert rings and legs
    return float(shapely.union_all(rings).distance(shapely.union_all(legs)))


@pytest.mark.parametrize(
    "words",
    [
        (),
        ("--run-in-m", "auto"),
        ("--depot", "DEPOT"),
        ("--tank-l", "12"),
        ("--ferry-height-m", "30", "--obstacle", "LOW", "--depot", "DEPOT", "--tank-l", "8"),
    ],
    ids=["plain", "run-in", "depot", "tank", "high"],
)
def test_every_leg_keeps_off_the_holes(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, words: tuple[str, ...]
) -> None:
    field, out = written(FIELD, tmp_path / "f.geojson"), tmp_path / "m.geojson"
    lon, lat = shapely.get_coordinates(to_degrees(Point(60, -40)))[0].tolist()
    low = tmp_path / "low.geojson"
    shape = json.loads(shapely.to_geojson(to_degrees(box(20, 20, 24, 24))))
    low.write_text(
        json.dumps({"type": "Feature", "properties": {"height_m": 3}, "geometry": shape})
    )
    told = {"DEPOT": f"{lat},{lon}", "LOW": str(low)}
    planned(capsys, field, "--out", out, *(told.get(word, word) for word in words))
    assert apart_m(field, out) >= KEPT_M - DIGITS_M


def test_a_plan_says_what_its_holes_leave_bare(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field, out = written(FIELD, tmp_path / "f.geojson"), tmp_path / "m.geojson"
    found, _ = planned(capsys, field, "--out", out, "--json")
    ring_m2 = shapely.union_all([POND, HOUSE]).buffer(KEPT_M, quad_segs=64).area
    ring_m2 -= POND.area + HOUSE.area
    assert found["holes"]["count"] == 2 and found["holes"]["kept_m"] == KEPT_M
    assert found["holes"]["bare_m2"] == pytest.approx(ring_m2, rel=0.01)
    # What stays bare is no part of what the passes reach.
    assert 1e4 * found["area_ha"] == pytest.approx(FIELD.area - ring_m2, rel=1e-3)
    # But it is ground of the field, and a grower finds it bare.
    assert found["bare_m2"] > 0.95 * ring_m2
    rated_m2 = found["bare_m2"] / (1.0 - found["treated_percent"] / 100.0)
    assert rated_m2 == pytest.approx(FIELD.area, rel=2e-3)
    _, lines = planned(capsys, field, "--out", out)
    (said,) = [line for line in lines if line.startswith("holes")]
    assert f"{found['holes']['bare_m2']:.0f} m2" in said and "--holes over" in said


def test_over_holes_a_plan_leaves_nothing_for_them(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field, out = written(FIELD, tmp_path / "f.geojson"), tmp_path / "m.geojson"
    found, _ = planned(capsys, field, "--out", out, "--json", "--holes", "over")
    assert found["holes"] == {"count": 2, "kept_m": 0.0, "bare_m2": 0.0}
    assert 1e4 * found["area_ha"] == pytest.approx(FIELD.area, rel=1e-3)
    assert apart_m(field, out) < KEPT_M
    _, lines = planned(capsys, field, "--out", out, "--holes", "over")
    assert not [line for line in lines if line.startswith("holes")]


def test_holes_are_kept_by_the_fence_too(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field, out = written(FIELD, tmp_path / "f.geojson"), tmp_path / "m.plan"
    planned(capsys, field, "--out", out)
    fence = json.loads(out.read_text())["geoFence"]
    drawn = shapely.from_geojson(field.read_text())
    rings = [Polygon(ring) for part in shapely.get_parts(shapely.get_parts(drawn))
             for ring in part.interiors]  # fmt: skip
    kept = [Polygon([(lon, lat) for lat, lon in each["polygon"]])
            for each in fence["polygons"] if not each["inclusion"]]  # fmt: skip
    assert len(rings) == 2
    for ring in rings:
        assert max(part.intersection(ring).area for part in kept) > 0.99 * ring.area


@pytest.mark.parametrize("name", ["x_holes0", "x_vertices"])
def test_no_leg_over_a_real_field_comes_near_its_holes(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, samples: Path, name: str
) -> None:
    field, out = samples / "fields" / f"{name}.geojson", tmp_path / "m.geojson"
    planned(capsys, field, "--out", out, "--swath-m", "6")
    assert apart_m(field, out) >= KEPT_M - DIGITS_M


@given(seed=st.integers(0, 5_000), kept_m=st.sampled_from([0.5, 2.0, 5.0]))
@settings(max_examples=6)
def test_no_leg_of_any_field_comes_nearer_than_is_kept(seed: int, kept_m: float) -> None:
    outline = random_field(seed)[1]
    middle = outline.representative_point()
    pond = middle.buffer(min(8.0, 0.4 * outline.boundary.distance(middle)))
    ground = outline.difference(pond)
    holes = [Polygon(ring) for part in shapely.get_parts(ground) for ring in part.interiors]
    try:
        field = build_field(
            to_degrees(ground), swath_width_m=6.0, frame=FRAME, obstacle_buffer_m=kept_m
        )
        plan = plan_mission(
            field, Settings(swath_width_m=6.0, speed_m_s=6.0, moves=0, tank_l=8.0),
            Uniform(rate_l_ha=20.0),
        )  # fmt: skip
    except PlanError:
        return
    ways = [
        shapely.LineString(leg.points) for sortie in plan.sorties for leg in sortie.legs
        if len(leg.points) > 1
    ]  # fmt: skip
    assert shapely.union_all(ways).distance(shapely.union_all(holes)) >= kept_m - DIGITS_M


def test_the_lines_that_a_flight_reads_go_on_over_no_hole(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field = written(FIELD, tmp_path / "f.geojson")
    found, _ = planned(capsys, field, "--out", tmp_path / "m.plan", "--json")
    frame = frame_of(shapely.from_geojson(field.read_text()))
    lines = read_plan_lines(Path(found["lines_file"]), frame)
    # Lines are joined where one goes on in the next: never across what is kept off.
    read_m = sum(shapely.LineString(line).length for line in lines)
    assert read_m == pytest.approx(found["spray_m"], rel=0.01)
    drawn = shapely.get_parts(both_ways(shapely.from_geojson(field.read_text()), frame))
    holes = [Polygon(ring) for part in drawn for ring in part.interiors]
    assert len(holes) == 2
    for line in lines:
        assert shapely.LineString(line).distance(shapely.union_all(holes)) > KEPT_M - DIGITS_M
