"""What a plan says of treated, bare and twice treated ground is what its flight leaves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import shapely

from companion.config import load
from missions.demand import Uniform
from missions.field import build_field
from missions.plan import Settings
from missions.planner import plan_mission
from missions.reading import Asked, read_task
from missions.sheet import filled_of
from missions.treated import thirsty_warnings, treated_by, treated_lines
from tests.bench.plan_treated import of_field, write
from tests.mission_fields import degrees

TUTORIAL = ((15, 35.9960, 35.9963), (25, 35.9963, 35.9966))
WEST_DEG, EAST_DEG = 114.54400, 114.54419


def tutorial(folder: Path, *, overrun: bool = False) -> None:
    features = []
    for rate, low, high in TUTORIAL:
        ring = [[WEST_DEG, low], [EAST_DEG, low], [EAST_DEG, high], [WEST_DEG, high]]
        shape = {"type": "Polygon", "coordinates": [[*ring, ring[0]]]}
        features.append({"type": "Feature", "properties": {"rate": rate}, "geometry": shape})
    write(folder, features, overrun=overrun)


def settings(**changes: object) -> Settings:
    valves = tuple((-2.5 + number, 1.0) for number in range(6))
    return Settings(
        swath_width_m=6.0, speed_m_s=5.0, valves=valves, angle_deg=0.0, border_buffer_m=0.1,
        flow_l_min=(1.5, 6.0), speeds_m_s=(1.0, 0.0), switch_off_percent=100.0, **changes,
    )  # type: ignore[arg-type]  # fmt: skip


def figures(*, kept_m: float, wide_m: float = 30.0, rate: float = 20.0) -> dict[str, float]:
    ground = build_field(
        degrees(shapely.box(0.0, 0.0, wide_m, 100.0)), swath_width_m=6.0, kept_m=kept_m
    )  # type: ignore[arg-type]
    rates = Uniform(rate_l_ha=rate)
    return treated_by(plan_mission(ground, settings(), rates), rates).summary()


@pytest.mark.parametrize("overrun", [False, True], ids=["inside", "overrun"])
def test_the_tutorials_flight_leaves_what_its_plan_says(tmp_path: Path, overrun: bool) -> None:
    tutorial(tmp_path, overrun=overrun)
    found = of_field(tmp_path, "--angle-deg", "0", "--depot", "35.9959,114.5440")
    for what in ("bare", "twice"):
        assert found[f"{what}_percent"] == pytest.approx(found[f"flown_{what}_percent"], abs=1.0)
    # What is put out follows from it, which the passes' own litres do not.
    assert found["litres"] == pytest.approx(found["flown_litres"], rel=0.03)
    assert found["outside_ml"] == 0.0
    if overrun:
        assert found["flown_bare_percent"] < 5.0


def test_outer_valves_stay_open_on_passes_along_the_border(tmp_path: Path) -> None:
    tutorial(tmp_path)
    field = tmp_path / "field.geojson"
    config = load(tmp_path / "config.toml")
    said = []
    for border_m in (0.0, None):
        asked = Asked(field=field, prescription=field, border_m=border_m)
        task = read_task(asked, config, {"angle_deg": 0.0})
        plan = plan_mission(task.field, task.settings, task.rates)
        said.append(treated_by(plan, task.rates).summary()["treated_percent"])
    # Two valves of a metre on a field of seventeen.
    assert said[1] > said[0] + 5.0


def test_passes_on_the_border_keep_their_outer_valves_closed() -> None:
    # 30 m are five swaths: with the border's distance and the sway both outer valves are shut.
    assert figures(kept_m=0.0)["bare_m2"] > figures(kept_m=0.2)["bare_m2"] + 100.0


def test_flow_below_what_valves_give_leaves_ground_bare() -> None:
    assert figures(kept_m=0.2, rate=2.0)["treated_percent"] == 0.0
    assert figures(kept_m=0.2, rate=8.0)["bare_m2"] > figures(kept_m=0.2)["bare_m2"]


def test_ground_under_two_passes_is_treated_once_where_whole_valves_close() -> None:
    # Three swaths on 14 m: 4 m lie under two passes, and four valves close there.
    assert figures(kept_m=0.2, wide_m=14.45)["twice_m2"] < 10.0
    # Of 0.8 m no whole valve closes.
    assert 60.0 < figures(kept_m=0.0, wide_m=17.2)["twice_m2"] < 80.0


def test_the_answer_says_what_stays_bare_and_what_ways_outside_would_spare() -> None:
    ground = build_field(degrees(shapely.box(0.0, 0.0, 30.0, 60.0)), swath_width_m=6.0, kept_m=0.2)
    rates = Uniform(rate_l_ha=20.0)
    plan = plan_mission(ground, settings(), rates)
    assert treated_lines(plan, rates, has_runs=False) == []
    plan = replace(plan, treated=treated_by(plan, rates))
    said, price = treated_lines(plan, rates, has_runs=False)
    assert said.startswith("treated   ")
    assert "m2 stay bare" in said
    assert 'mission.overrun = "allowed"' in price
    assert treated_lines(plan, rates, has_runs=True) == [said]


def test_tanks_are_filled_for_what_falls_where_nozzles_give_more_than_is_asked() -> None:
    # 14 m are too short for the speed, and below it nozzles give their least.
    ground = build_field(degrees(shapely.box(0.0, 0.0, 30.0, 14.0)), swath_width_m=6.0)
    rates = Uniform(rate_l_ha=9.0)
    plan = plan_mission(ground, settings(), rates)
    plan = replace(plan, treated=treated_by(plan, rates))
    (sortie,) = plan.sorties
    falls_l = plan.needs_l(sortie)
    assert falls_l > sortie.volume_l
    assert filled_of(plan)[1]["fill_l"] == pytest.approx(falls_l + plan.settings.reserve_l)
    assert thirsty_warnings(plan) == ()
    tight = replace(plan.settings, tank_l=sortie.volume_l + plan.settings.reserve_l)
    plan = replace(plan, settings=tight)
    assert filled_of(plan)[1]["fill_l"] == pytest.approx(tight.tank_l)
    (said,) = thirsty_warnings(plan)
    assert said.startswith(f"sortie 1 puts out {falls_l:.2f} L")
