"""Several aircraft: shares that cover the field, and sorties that never meet."""

from __future__ import annotations

import json
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import shapely
from shapely import Polygon, box
from shapely.affinity import rotate

from missions.errors import PlanError
from missions.files.write import write_fleet
from missions.plan import Plan
from missions.sheet import separation_m, sheet, sortie_lines, way_of
from missions.strips import rectangles
from tests.bench.missions import comb, outside_m2, transit_outside_m
from tests.missions.test_missions_plan import WIDTH_M, plan_of

pytestmark = pytest.mark.usefixtures("searched_briefly", "laid_out_once")

FIELD = box(0.0, 0.0, 240.0, 200.0)


def fleet(ground: Polygon = FIELD, aircraft: int = 2, **changes: float) -> Plan:
    return plan_of(ground, aircraft=aircraft, **{"tank_l": 20.0, **changes})


def strips_of(plan: Plan, aircraft: int) -> shapely.Geometry:
    rows = [
        [*leg.points[0], *leg.points[-1]]
        for sortie in plan.sorties if sortie.aircraft == aircraft
        for leg in sortie.legs if leg.kind == "spray"
    ]  # fmt: skip
    return shapely.union_all(rectangles(np.array(rows), WIDTH_M))


def together(plan: Plan) -> list[tuple[int, int]]:
    """Return the pairs of sorties that `after` lets be in the air at the same time.

    A sortie ends before all later ones of its aircraft begin, and before those that wait for it.
    """
    before: dict[int, set[int]] = {}
    last: dict[int, int] = {}
    for sortie in sorted(plan.sorties, key=lambda each: each.start_s):
        known = [*sortie.after, *([last[sortie.aircraft]] if sortie.aircraft in last else [])]
        before[sortie.number] = set(known).union(*(before[number] for number in known))
        last[sortie.aircraft] = sortie.number
    return [
        (a, b) for a, b in combinations(sorted(before), 2)
        if a not in before[b] and b not in before[a]
    ]  # fmt: skip


@pytest.mark.parametrize("aircraft", [2, 3])
@pytest.mark.parametrize("ground", [FIELD, comb(), rotate(FIELD, 33.0)])
def test_shares_cover_the_field_and_sorties_in_the_air_keep_apart(
    ground: Polygon, aircraft: int
) -> None:
    plan = fleet(ground, aircraft)
    assert {sortie.aircraft for sortie in plan.sorties} == set(range(1, aircraft + 1))
    assert plan.coverage.reachable_percent > 99.9
    assert outside_m2(plan, ground) == pytest.approx(0.0, abs=1e-6)
    assert transit_outside_m(plan) == pytest.approx(0.0, abs=1e-6)
    shares = [strips_of(plan, number) for number in range(1, aircraft + 1)]
    both = sum(shapely.intersection(a, b).area for a, b in combinations(shares, 2))
    whole = shapely.union_all(shares)
    assert whole.area > 0.998 * plan.field.area_m2
    # Lines of a share end where the next begins; only what is sprayed twice anyway is in both.
    assert both <= plan.coverage.overlap_percent / 100.0 * ground.area + 1.0
    ways = {sortie.number: way_of(sortie) for sortie in plan.sorties}
    of = {sortie.number: sortie.aircraft for sortie in plan.sorties}
    for one, other in together(plan):
        if of[one] != of[other]:
            assert ways[one].distance(ways[other]) >= plan.settings.aircraft_gap_m
    assert (separation_m(plan) or 0.0) >= plan.settings.aircraft_gap_m


def test_two_aircraft_are_much_quicker_than_one_with_the_same_litres() -> None:
    one, two = fleet(aircraft=1), fleet(aircraft=2)
    assert two.volume_l == pytest.approx(one.volume_l, rel=1e-6)
    assert two.total_s < 0.7 * one.total_s


def test_each_aircraft_has_its_own_depot_where_as_many_are_given() -> None:
    east, west = (240.0, 100.0), (0.0, 100.0)
    plan = fleet(depots=(east, west), angle_deg=0.0)  # type: ignore[arg-type]
    used = {sortie.aircraft: plan.depots[sortie.depot] for sortie in plan.sorties}
    middle = {number: strips_of(plan, number).centroid.x for number in (1, 2)}
    assert set(used.values()) == set(plan.depots)
    assert (used[1][0] < used[2][0]) == (middle[1] < middle[2])


def test_aircraft_that_share_a_depot_are_planned_too() -> None:
    plan = fleet(depots=((120.0, 0.0),))  # type: ignore[arg-type]
    assert {sortie.depot for sortie in plan.sorties} == {0}
    assert {sortie.aircraft for sortie in plan.sorties} == {1, 2}


def test_a_wider_gap_is_kept_too() -> None:
    assert (separation_m(fleet(aircraft_gap_m=60.0)) or 0.0) >= 60.0


def test_each_aircraft_gets_its_files_and_its_lines(tmp_path: Path) -> None:
    plan = fleet(tank_l=40.0)
    files, lines = write_fleet(plan, tmp_path / "m.plan")
    assert len(files) == len(plan.sorties)
    assert {"m-a1.plan", "m-a2.plan"} <= {path.name for path in files}
    assert len(lines) == 2
    assert all(path.exists() for path in (*files, *lines))


def test_all_sorties_of_a_plan_have_one_job_and_another_plan_another(tmp_path: Path) -> None:
    files, lines = write_fleet(fleet(tank_l=40.0), tmp_path / "m.plan")
    documents = [json.loads(path.read_text()) for path in (*files, *lines)]
    jobs = {each.get("job") or each["vrspray"]["job"] for each in documents}
    assert len(documents) > 3
    assert len(jobs) == 1
    _, (other,) = write_fleet(fleet(aircraft=1, tank_l=40.0), tmp_path / "n.plan")
    assert json.loads(other.read_text())["job"] not in jobs


def test_the_sheet_says_who_waits_for_whom() -> None:
    plan = fleet()
    found = sheet(plan)
    assert [row["number"] for row in found["aircraft"]] == [1, 2]
    assert sum(row["volume_l"] for row in found["aircraft"]) == pytest.approx(plan.volume_l)
    waiting = [sortie for sortie in plan.sorties if sortie.after]
    texts = [text for text in sortie_lines(plan, found) if "has landed" in text]
    assert waiting
    assert len(texts) == len(waiting)
    assert found["total_s"] == pytest.approx(max(row["end_s"] for row in found["aircraft"]))


def test_more_aircraft_than_lines_are_refused() -> None:
    with pytest.raises(PlanError, match="5 aircraft need at least as many lines"):
        fleet(box(0.0, 0.0, 12.0, 200.0), 5)
