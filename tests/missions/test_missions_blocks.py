"""Sorties are blocks from side to side: a day that ends early leaves a sprayed half, no stripes."""

from __future__ import annotations

from pathlib import Path

import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import Polygon, box
from shapely.geometry.base import BaseGeometry

from missions.demand import Uniform
from missions.errors import PlanError
from missions.field import build_field
from missions.maps.registry import read_area
from missions.plan import Plan, Settings, Sortie
from missions.planner import plan_mission
from tests.bench.missions import random_field, to_degrees
from tests.missions.test_missions_cli import written
from tests.missions.test_missions_holes import planned

pytestmark = pytest.mark.usefixtures("searched_briefly", "laid_out_once")

WIDTH_M = 6.0
DRAWN = {
    "long": box(0, 0, 160, 250),
    "triangle": Polygon([(0, 0), (300, 30), (120, 260)]),
    "bent": box(0, 0, 260, 90).union(box(0, 0, 90, 240)),
}


def plan_of(area: BaseGeometry, tank_l: float, *, stripes: bool = False) -> Plan:
    asked = Settings(
        swath_width_m=WIDTH_M, speed_m_s=6.0, tank_l=tank_l, reserve_l=1.0, stripes=stripes
    )
    field = build_field(area, swath_width_m=WIDTH_M)
    return plan_mission(field, asked, Uniform(rate_l_ha=20.0))


def ground_of(sorties: tuple[Sortie, ...]) -> BaseGeometry:
    """Return the ground within half a swath of the passes."""
    passes = [
        shapely.LineString(leg.points).buffer(WIDTH_M / 2.0 + 0.05)
        for sortie in sorties
        for leg in sortie.legs
        if leg.kind == "spray"
    ]
    return shapely.union_all(passes)


def apart_share(ground: BaseGeometry) -> float:
    """Return the share of some ground that lies apart from its largest piece."""
    return 1.0 - float(max(shapely.area(shapely.get_parts(ground)))) / ground.area


@pytest.mark.parametrize("name", DRAWN)
def test_every_sortie_and_all_until_then_are_one_piece(name: str) -> None:
    plan = plan_of(to_degrees(DRAWN[name]), 14.0)
    assert len(plan.sorties) > 3
    for number, sortie in enumerate(plan.sorties, start=1):
        assert apart_share(ground_of((sortie,))) < 1e-9
        assert apart_share(ground_of(plan.sorties[:number])) < 1e-9
    # A half is sprayed, without gaps between its passes.
    half = ground_of(plan.sorties[: len(plan.sorties) // 2])
    closed = half.buffer(WIDTH_M * 0.7).buffer(-WIDTH_M * 0.7)
    assert closed.area < 1.05 * half.area


@pytest.mark.parametrize(
    ("name", "tank_l"), [("r_ie", 16.0), ("r_us_ca_scm", 20.0), ("x_vertices", 40.0)]
)
def test_the_first_sortie_over_a_real_field_is_one_piece(
    samples: Path, name: str, tank_l: float
) -> None:
    plan = plan_of(read_area(samples / "fields" / f"{name}.geojson"), tank_l)
    assert apart_share(ground_of(plan.sorties[:1])) < 1e-9


def test_stripes_are_a_choice_with_its_minutes(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field, out = written(DRAWN["triangle"], tmp_path / "f.geojson"), tmp_path / "m.geojson"
    words = [field, "--out", out, "--tank-l", "15", "--choices"]
    _, lines = planned(capsys, *words)
    (said,) = [line for line in lines if "with --stripes" in line]
    found, _ = planned(capsys, *words, "--json")
    (price,) = [each for each in found["prices"] if each["option"] == "with --stripes"]
    less_s = found["flight_s"] - price["flight_s"]
    assert less_s > 0.0 and f"{less_s / 60.0:.1f} min less" in said
    striped, _ = planned(capsys, *words, "--stripes", "--json")
    assert striped["flight_s"] == pytest.approx(price["flight_s"])
    assert any(each["option"] == "without --stripes" for each in striped["prices"])


@given(seed=st.integers(0, 5_000), tank_l=st.floats(6.0, 20.0))
@settings(max_examples=6)
def test_no_more_of_any_field_lies_apart_than_with_stripes(seed: int, tank_l: float) -> None:
    area = to_degrees(random_field(seed)[1])
    try:
        blocks, stripes = (plan_of(area, tank_l, stripes=each) for each in (False, True))
    except PlanError:
        return
    assert blocks.coverage.percent == pytest.approx(stripes.coverage.percent, abs=0.2)
    assert blocks.volume_l == pytest.approx(stripes.volume_l, rel=0.01)
    mean = [
        sum(apart_share(ground_of((each,))) for each in plan.sorties) / len(plan.sorties)
        for plan in (blocks, stripes)
    ]
    assert mean[0] <= mean[1] + 1e-9
