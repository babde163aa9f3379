"""After a break: only what is left is planned."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shapely import Polygon, box

from missions.demand import Uniform, demands
from missions.errors import PlanError
from missions.remaining import Break, UntreatedRates, demands_once, read_lines, remaining
from missions.strips import lengths_m
from tests.bench.missions import FRAME
from tests.missions.test_missions_cli import run, written

pytestmark = pytest.mark.usefixtures("searched_briefly", "laid_out_once")

FIELD = box(0.0, 0.0, 120.0, 200.0)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plan of three lines in two sorties, each line in the file as the planner writes it."""
    legs = [
        (1, 1, "spray", (3, 0), (3, 120)), (1, 2, "spray", (3, 120), (3, 200)),
        (1, 3, "transit", (3, 200), (9, 200)), (1, 4, "spray", (9, 200), (9, 100)),
        (2, 1, "spray", (9, 100), (9, 0)), (2, 2, "transit", (9, 0), (15, 0)),
        (2, 3, "spray", (15, 0), (15, 200)),
    ]  # fmt: skip
    features = [
        {
            "type": "Feature",
            "properties": {"kind": kind, "sortie": sortie, "sequence": sequence},
            "geometry": {
                "type": "LineString",
                "coordinates": [FRAME.to_geographic(*place)[::-1] for place in places],
            },
        }
        for sortie, sequence, kind, *places in legs
    ]
    path = tmp_path_factory.mktemp("plan") / "plan.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features[::-1]}))
    return path


def left(path: Path, **since: Any) -> Any:
    return remaining(read_lines(path, FRAME), Break(**since), width_m=6.0, frame=FRAME)


def test_lines_are_read_in_their_order_and_those_that_go_on_are_one(whole: Path) -> None:
    rows = read_lines(whole, FRAME)
    assert [sortie for sortie, _ in rows] == [1, 1, 2, 2]
    assert rows[0][1] == pytest.approx([3, 0, 3, 200], abs=1e-3)


def test_the_stop_leaves_the_rest_of_its_line_and_all_after_it(whole: Path) -> None:
    found = left(whole, stop=(9.5, 150.0), overlap_m=3.0)
    assert found.lines == pytest.approx(
        np.array([[9, 153, 9, 100], [9, 100, 9, 0], [15, 0, 15, 200]]), abs=1e-3
    )
    assert lengths_m(found.done).sum() == pytest.approx(200.0 + 47.0, abs=1e-3)
    assert found.angle_deg == pytest.approx(0.0, abs=1e-3)


def test_treated_ground_is_left_out(whole: Path) -> None:
    found = left(whole, treated=box(0.0, 0.0, 20.0, 150.0))
    assert sorted(lengths_m(found.lines)) == pytest.approx([50.0, 50.0, 50.0], abs=1e-3)


def test_both_together_leave_what_neither_has_done(whole: Path) -> None:
    found = left(whole, stop=(9.0, 50.0), overlap_m=0.0, treated=box(12.0, 0.0, 20.0, 150.0))
    assert sorted(lengths_m(found.lines)) == pytest.approx([50.0, 50.0], abs=1e-3)


def test_a_stop_at_the_very_end_leaves_nothing(whole: Path) -> None:
    with pytest.raises(PlanError, match="nothing of the plan is left"):
        left(whole, stop=(15.0, 200.0), overlap_m=0.0)


@pytest.mark.parametrize(
    ("stop", "sortie", "says"), [((60.0, 50.0), None, "45 m"), ((3.0, 50.0), 2, "of sortie 2")]
)
def test_a_stop_off_the_lines_is_refused_with_the_distance(
    whole: Path, stop: tuple[float, float], sortie: int | None, says: str
) -> None:
    with pytest.raises(PlanError, match=says):
        left(whole, stop=stop, sortie=sortie)


@pytest.mark.parametrize("text", ["", "{}", '{"features": []}', '{"features": [{}]}'])
def test_what_is_no_plan_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "other.geojson"
    path.write_text(text)
    with pytest.raises(PlanError, match=r"other\.geojson: .*vrspray plan"):
        read_lines(path, FRAME)


def planned(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, *words: object, out: str = "m.geojson"
) -> tuple[int, dict[str, Any]]:
    field = written(FIELD, tmp_path / "f.geojson")
    code, found, _ = run(capsys, field, "--tank-l", "10", *words, "--out", tmp_path / out)
    return code, found


def test_a_flight_goes_on_where_it_stopped(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    _, before = planned(capsys, tmp_path)
    lines = read_lines(tmp_path / "m.geojson", FRAME)
    sortie, row = lines[len(lines) // 2]
    middle = FRAME.to_geographic(*((row[:2] + row[2:]) / 2.0).tolist())
    code, after = planned(
        capsys, tmp_path, "--resume", tmp_path / "m.geojson", "--sortie", sortie,
        "--from", f"{middle[0]:.8f},{middle[1]:.8f}", out="rest.plan",
    )  # fmt: skip
    assert code == 0
    flown_m = sum(lengths_m(np.array([each]))[0] for _, each in lines[: len(lines) // 2])
    left_m = before["spray_m"] - flown_m - lengths_m(row[None, :])[0] / 2.0 + 3.0
    assert after["spray_m"] == pytest.approx(left_m, abs=0.05)
    assert after["volume_l"] == pytest.approx(left_m * 6.0 * 20.0 / 10_000.0, rel=1e-3)
    assert after["coverage_percent"] == pytest.approx(before["coverage_percent"], abs=0.01)


def test_treated_ground_is_not_sprayed_again(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    done = box(-5.0, -5.0, 60.0, 205.0)
    path = written(done, tmp_path / "done.geojson")
    code, found = planned(capsys, tmp_path, "--done", path)
    assert code == 0
    assert found["area_ha"] == pytest.approx(1.2, rel=1e-3)
    assert found["coverage_percent"] > 99.9
    for _, row in read_lines(tmp_path / "m.geojson", FRAME):
        assert min(row[0], row[2]) > 63.0 - 0.05


def test_a_field_that_is_all_treated_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = written(Polygon(FIELD.buffer(5.0)), tmp_path / "done.geojson")
    code, found = planned(capsys, tmp_path, "--done", path, out="none.plan")
    assert code == 2
    assert "leaves nothing of the field" in found["error"]
    assert not (tmp_path / "none.plan").exists()


@pytest.mark.parametrize(
    ("words", "says"),
    [(["--from", "48,11"], "need --resume"), (["--resume", "x.geojson"], "needs --from")],
)
def test_half_a_break_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, words: list[str], says: str
) -> None:
    code, found = planned(capsys, tmp_path, *words)
    assert code == 2
    assert says in found["error"]


def test_the_litres_are_what_a_guard_leaves_to_spray(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Half of the field is treated: the whole lines over it need half of what they did.
    code, before = planned(capsys, tmp_path)
    assert code == 0
    done = written(box(-5.0, -5.0, 60.0, 205.0), tmp_path / "done.geojson")
    code, found = planned(capsys, tmp_path, "--done", done)
    assert code == 0
    assert found["volume_l"] == pytest.approx(0.5 * before["volume_l"], rel=0.06)


def test_ground_under_two_lines_is_counted_once() -> None:
    field = box(0.0, 0.0, 100.0, 100.0)
    rates = UntreatedRates(rates=Uniform(rate_l_ha=10.0), treated=box(50, 0, 100, 100), limit=field)
    lines = np.array([[0.0, 50.0, 100.0, 50.0], [0.0, 53.0, 100.0, 53.0]])
    valves = tuple((k - 2.5, 1.0) for k in range(6))
    found = demands_once(lines, rates, width_m=6.0, valves=valves)
    assert [need.total_l for need in found] == pytest.approx([0.3, 0.15], rel=0.02)
    both = demands(lines, rates, width_m=6.0, valves=valves)
    assert [need.total_l for need in both] == pytest.approx([0.3, 0.3], rel=0.02)
