"""The picture of a plan: what is drawn of it, and what is refused."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import shapely
from shapely import LineString, Point, Polygon, box

from companion.cli.app import execute
from missions.demand import Uniform
from missions.field import build_field
from missions.picture import KINDS, colour_of, draw_plan
from missions.plan import Settings
from missions.planner import plan_mission
from missions.reading_outline import Obstacle
from missions.strips import rectangles, sprayed_twice
from tests.mission_fields import degrees
from tests.missions.test_missions_cli import written

pytestmark = pytest.mark.usefixtures("searched_briefly")

pytest.importorskip("matplotlib")


def test_ground_under_two_strips_is_sprayed_twice() -> None:
    lines = np.array([[0, 0, 0, 50], [4, 0, 4, 50], [20, 0, 20, 50], [26, 0, 26, 50]], dtype=float)
    assert sprayed_twice(rectangles(lines, 6.0)).area == pytest.approx(2.0 * 50.0)


def test_sorties_side_by_side_differ_in_colour() -> None:
    colours = [np.array(colour_of(number)) for number in range(1, 21)]
    for one, other in pairwise(colours):
        assert float(np.abs(one - other).max()) > 0.2


def test_a_plan_is_drawn_with_all_of_its_sorties(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    hole = [(30.0, 30.0), (50.0, 30.0), (50.0, 60.0), (30.0, 60.0)]
    ground = Polygon([(0, 0), (120, 0), (120, 100), (0, 100)], [hole])
    field = written(ground, tmp_path / "f.geojson")
    words = [
        "plan",
        "--force",
        field,
        "--rate-l-ha",
        "20",
        "--tank-l",
        "9",
        "--holes",
        "over",
        "--out",
        tmp_path / "m.geojson",
    ]
    assert execute([*map(str, words), "--png", str(tmp_path / "m.svg"), "--json"]) == 0
    sorties = len(json.loads(capsys.readouterr().out)["sorties"])
    assert sorties > 2
    text = (tmp_path / "m.svg").read_text()
    for words_shown in (f"sortie {sorties} ", "sprayed twice", "not to be sprayed", "depot"):
        assert f"<!-- {words_shown}" in text
    # Where passes end, the aircraft turns.
    assert "<!-- left unsprayed" in text


def test_each_kind_of_ground_that_is_not_sprayed_has_a_sign_of_its_own(tmp_path: Path) -> None:
    ground = Polygon([(0, 0), (160, 0), (160, 90), (0, 90)], [[(20, 20), (34, 20), (34, 40)]])
    obstacles = [
        Obstacle(geometry=degrees(Point(60.0, 40.0)), beyond_m=3.0),
        Obstacle(geometry=degrees(LineString([(90.0, -5.0), (95.0, 95.0)])), beyond_m=4.0),
        Obstacle(geometry=degrees(box(120.0, 30.0, 130.0, 40.0))),
    ]
    field = build_field(
        degrees(ground), obstacles=obstacles, no_spray=[degrees(box(140.0, 60.0, 150.0, 70.0))],
        swath_width_m=6.0,
    )  # fmt: skip
    plan = plan_mission(
        field, Settings(swath_width_m=6.0, speed_m_s=6.0, moves=0), Uniform(rate_l_ha=20.0),
        depots=(field.frame.to_geographic(-75.0, 0.0),),
    )  # fmt: skip
    draw_plan(plan, tmp_path / "m.svg", title="field")
    text = (tmp_path / "m.svg").read_text()
    signs = {f"<!-- {words} -->" for kind, (_, _, words) in KINDS.items() if kind is not None}
    assert len(signs) == 5 and all(each in text for each in signs)
    assert f"<!-- {KINDS[None][2]} -->" not in text


def test_ground_on_which_valves_close_is_not_drawn_as_sprayed_twice(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    anyang = Path(__file__).parents[2] / "examples" / "anyang"
    words = ["plan", anyang / "boundary.geojson", "--config", anyang / "config.toml",
             "--out", tmp_path / "m.plan", "--png", tmp_path / "m.svg"]  # fmt: skip
    assert execute([*map(str, words)]) == 0
    assert " % under two passes, " in capsys.readouterr().out
    text = (tmp_path / "m.svg").read_text()
    # A fifth of the field is under two passes; valves close over nearly all of it.
    assert "<!-- under two passes" not in text
    assert "<!-- left unsprayed" in text


def test_wind_speed_heights_and_both_ends_of_every_sortie_are_shown(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field = written(shapely.box(0, 0, 120, 100), tmp_path / "f.geojson")
    words = ["plan", "--force", field, "--rate-l-ha", "20", "--tank-l", "9",
             "--out", tmp_path / "m.geojson",
             "--wind", "3.5,250", "--ferry-height-m", "18"]  # fmt: skip
    assert execute([*map(str, words), "--png", str(tmp_path / "m.svg"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    text = (tmp_path / "m.svg").read_text()
    for shown in (
        "wind 3.5 m/s", "from 250°", "passes at 6 m/s, 3.5 m high    ferries 18 m high",
        "ferry or transit 18 m high", "last pass ends", "first pass begins",
    ):  # fmt: skip
        assert f"<!-- {shown}" in text
    first = found["sorties"][0]
    minutes = f"{first['airborne_s'] / 60:.1f} min"
    assert f"<!-- sortie 1    fill {first['fill_l']:.1f} L    {minutes}" in text
    for row in found["sorties"]:
        assert f"<!-- {row['number']} -->" in text


def test_without_a_wind_none_is_drawn(tmp_path: Path) -> None:
    field = written(shapely.box(0, 0, 50, 50), tmp_path / "f.geojson")
    words = [str(field), "--out", str(tmp_path / "m.kml"), "--png", str(tmp_path / "m.svg")]
    assert execute(["plan", "--force", *words]) == 0
    assert "<!-- wind" not in (tmp_path / "m.svg").read_text()


def test_the_same_plan_makes_the_same_bytes(tmp_path: Path) -> None:
    from tests.missions.test_missions_files import plan as made

    plan = made.__wrapped__()  # type: ignore[attr-defined]
    one, two = tmp_path / "one.png", tmp_path / "two.png"
    draw_plan(plan, one, title="field")
    draw_plan(plan, two, title="field")
    assert one.read_bytes() == two.read_bytes()
    assert one.read_bytes().startswith(b"\x89PNG")


def test_a_picture_in_no_known_format_is_refused_before_any_work(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field = written(shapely.box(0, 0, 50, 50), tmp_path / "f.geojson")
    words = [str(field), "--out", str(tmp_path / "m.plan"), "--png", str(tmp_path / "m.bmp")]
    assert execute(["plan", "--force", *words]) == 2
    assert "pictures are written as .png, .svg, .pdf" in capsys.readouterr().err
    assert not (tmp_path / "m.plan").exists()


def test_a_corner_that_no_strip_reaches_is_red(tmp_path: Path) -> None:
    field = written(Polygon([(0, 0), (100, 0), (0, 40)]), tmp_path / "f.geojson")
    words = [str(field), "--rate-l-ha", "9", "--out", str(tmp_path / "m.kml")]
    assert execute(["plan", "--force", *words, "--png", str(tmp_path / "m.svg")]) == 0
    assert "<!-- left unsprayed" in (tmp_path / "m.svg").read_text()
