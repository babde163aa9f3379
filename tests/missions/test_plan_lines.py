"""From the plan's file to the flight: read, refused, recorded, judged."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from analysis.border import off_target
from analysis.flight_record import FlightMeta, FlightRecord
from analysis.strips import strips_of
from analysis.track import PlannedLines
from companion.cli.app import execute
from companion.config import load
from companion.core.frame import LocalFrame
from companion.core.options.lines import Lines
from companion.errors import ConfigError, MapError
from companion.flight_map import JOB_KEY
from companion.journal.codec import field_names_of, setup_from_json, setup_to_json
from companion.journal.geopackage import Ground
from missions.maps.compiling import MapOrder, compile_map, compiled_setup, read_plan_lines
from tests.builders import setup

EXAMPLE = "examples/anyang/config.toml"
BOUNDARY = Path("examples/anyang/boundary.geojson")
FRAME = LocalFrame(36.0, 114.5)
Place = tuple[float, float]


def line(*places: Place, kind: str = "spray", sortie: int = 1) -> dict[str, Any]:
    points = [FRAME.to_geographic(*place) for place in places]
    shape = {"type": "LineString", "coordinates": [[lon, lat] for lat, lon in points]}
    return {"type": "Feature", "properties": {"kind": kind, "sortie": sortie}, "geometry": shape}


def written(tmp_path: Path, *features: dict[str, Any]) -> Path:
    path = tmp_path / "plan.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": list(features)}))
    return path


# --------------------------------------------------------------------------------------- the file


def test_only_spray_lines_are_read_and_those_that_go_on_are_joined(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        line((0, 0), (0, 50)), line((0.2, 50), (2, 80)), line((2, 80), (40, 80)),
        line((40, 80), (9, 9), kind="ferry"), line((9, 9), (9, 40), sortie=2),
        line((9, 40), (9, 60), sortie=3),
    )  # fmt: skip
    found = read_plan_lines(path, FRAME)
    assert [len(polyline) for polyline in found] == [3, 2, 2, 2]
    assert found[0][1] == pytest.approx((0.1, 50.0), abs=1e-3)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "not readable JSON"),
        ("[]", "not GeoJSON"),
        ('{"type": "FeatureCollection", "features": []}', "no LineString"),
        ("[" * 100_000, "not readable JSON"),
    ],
)
def test_what_is_no_plan_is_refused(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "plan.geojson"
    path.write_text(text)
    with pytest.raises(MapError, match=said):
        read_plan_lines(path, FRAME)


@pytest.mark.parametrize(
    "coordinates", [[[114.5, 36.0]], [[114.5, 36.0], [1, 91]], [[1, 2], ["a", 2]], [[1], [2]], None]
)
def test_what_is_no_line_is_refused(tmp_path: Path, coordinates: object) -> None:
    feature = line((0, 0), (0, 50))
    feature["geometry"]["coordinates"] = coordinates
    with pytest.raises(MapError, match=r"less than two points|not a longitude and latitude"):
        read_plan_lines(written(tmp_path, feature), FRAME)


# ---------------------------------------------------------------------------------- configuration


def test_lines_of_another_field_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    far = written(tmp_path, line((50_000, 0), (50_000, 90)))
    with pytest.raises(ConfigError, match=r"mission\.lines.*no line comes over the map"):
        compiled_setup(load(Path(EXAMPLE), overrides=[f'mission.lines="{far}"']))
    with pytest.raises(MapError, match=r"mission\.lines.*no such file"):
        compiled_setup(load(Path(EXAMPLE), overrides=['mission.lines="none.geojson"']))


def test_a_tolerance_as_wide_as_the_next_line_is_refused() -> None:
    said = r"mission\.lines_aside_m.*half a swath, 3"
    with pytest.raises(ConfigError, match=said):
        load(Path(EXAMPLE), overrides=['mission.lines="x"', "mission.lines_aside_m=3.1"])
    assert compiled_setup(load(Path(EXAMPLE))).lines is None


# ----------------------------------------------------------------------- plan, check, fly, replay


# ArduCopter cuts the corners, and is slow at both ends of each line.
@pytest.mark.parametrize(("corners", "litres"), [("stop", 0.005), ("ardupilot", 0.015)])
def test_the_papers_field_is_planned_and_flown_with_nothing_off_its_lines(
    corners: str,
    litres: float,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Not compared with a flight of perfect knowledge.
    monkeypatch.setattr("sitl.fly._perfect", lambda *_: None)
    out = tmp_path / "field.plan"
    # Passes keep the buffer of the border and the aircraft's wander: no valve stands at its edge.
    kept = ["--border-m", "0.3"]
    execute(
        ["plan", "--force", str(BOUNDARY), "--config", EXAMPLE, "--out", str(out), "--json", *kept]
    )
    planned = json.loads(capsys.readouterr().out)
    lines = tmp_path / "field.lines.geojson"
    assert planned["lines_file"] == str(lines)
    own = ["--set", f'mission.lines="{lines}"']
    # What to do with the lines is said where they are named: no warning that every first plan has.
    assert "mission.lines" not in str(planned["warnings"])
    execute(["plan", str(BOUNDARY), "--config", EXAMPLE, "--out", str(tmp_path / "b.plan"), *kept])
    told = capsys.readouterr()
    assert "as the litres count; without it up to" in told.out
    assert "mission.lines" not in told.err
    execute(["config", "check", EXAMPLE, "--json", *own])
    assert "mission.lines" not in str(json.loads(capsys.readouterr().out)["notes"])
    # The flight map, and with it every journal, names the plan's job; lines of before had none.
    order = MapOrder.of(load(Path(EXAMPLE), overrides=own[1:]))
    assert compile_map(order).as_object()["frozen"][JOB_KEY] == json.loads(lines.read_text())["job"]
    old = tmp_path / "old.geojson"
    old.write_text(lines.read_text().replace('"job"', '"jobs"'))
    frozen = compile_map(replace(order, lines=str(old))).frozen
    assert JOB_KEY not in frozen
    copied = tmp_path / "config.toml"
    for file in (*Path("examples/anyang").glob("prescription.*"), BOUNDARY):
        shutil.copy(file, tmp_path)
    text = Path(EXAMPLE).read_text()
    copied.write_text(text.replace("[mission]", '[mission]\nlines = "field.lines.geojson"'))
    fly = ["sitl", "fly", "--config", str(copied), "--mission", str(out), "--json"]
    execute([*fly, "--corners", corners])
    (flight,) = json.loads(capsys.readouterr().out)["flights"]
    assert flight["off_target_ml"] + flight["off_line_ml"] < 0.05
    assert flight["missed"] == 0
    assert flight["applied_ml"] / 1000.0 == pytest.approx(planned["volume_l"], rel=litres)


def test_the_set_up_of_a_journal_holds_the_lines() -> None:
    given = setup(lines=Lines(polylines=(((0.0, 3.0), (36.0, 3.1), (48.0, 3.0)),), aside_m=0.7))
    text = setup_to_json(given)
    assert field_names_of(text)["Lines"] == ["polylines", "aside_m", "course_deg"]
    zones = [(z.name, z.rate_l_ha, z.polygon) for z in given.prescription.zones]
    field = given.prescription.field
    again = setup_from_json(text, Ground(zones=zones, field=field, cells=None))
    assert again.lines == given.lines
    assert again.lines is not None
    assert given.lines is not None
    assert again.lines.pieces == given.lines.pieces


# ------------------------------------------------------------------------------------- the metrics


def record(places: list[Place], *, lines: Lines | None) -> FlightRecord:
    """Return a flight at 5 m/s through places, with 10 mL/s from every valve all the way."""
    way = shapely.LineString(places)
    time_s = np.arange(0.0, way.length / 5.0, 0.01)
    east_m, north_m = shapely.get_coordinates(way.interpolate(5.0 * time_s)).T
    given = setup()
    return FlightRecord(
        time_s=time_s, east_m=east_m, north_m=north_m, heading_deg=np.full(len(time_s), 90.0),
        volume_ml=np.outer(10.0 * time_s, np.ones(6)), boom=given.boom,
        prescription=given.prescription, pwm_period_s=1.0 / 11.0, orders=(), lines=lines,
        meta=FlightMeta(speed_m_s=5.0, method="", fidelity="averaged", output="servo", seed=1),
    )  # fmt: skip


LINES = Lines(polylines=(((10.0, 3.0), (40.0, 3.0)),))


def test_what_falls_off_the_lines_is_named_so_and_nothing_is_asked_there() -> None:
    whole, some = (record([(2.0, 3.0), (46.0, 3.0)], lines=lines) for lines in (None, LINES))
    assert off_target(strips_of(whole), whole.prescription) == pytest.approx((0.0, 0.0), abs=1e-6)
    # 14 m of the 44 m at 5 m/s, six valves of 10 mL/s
    beyond = off_target(strips_of(some), some.prescription)
    assert beyond.outside_ml == pytest.approx(0.0, abs=1e-6)
    assert beyond.off_line_ml == pytest.approx(14.0 / 5.0 * 60.0, rel=0.01)
    asked = [strips_of(each)[0].asked_ml[-1] for each in (whole, some)]
    metres = [10 * 20 + 12 * 25 + 12 * 15 + 10 * 20, 2 * 20 + 12 * 25 + 12 * 15 + 4 * 20]
    assert asked[1] / asked[0] == pytest.approx(metres[1] / metres[0], rel=0.01)


@pytest.mark.parametrize(
    ("places", "visits"),
    [
        ([(2.0, 3.0), (46.0, 3.0)], 1),
        ([(46.0, 3.5), (2.0, 3.5)], 1),
        ([(2.0, 4.5), (46.0, 4.5)], 0),
        ([(2.0, 1.2), (46.0, 4.8)], 0),  # drifts across it
        ([(25.0, 30.0), (25.0, -30.0)], 0),
        ([(7.0, 0.0), (12.0, 2.9), (38.5, 3.1), (43.0, 6.0)], 1),  # corners cut at both ends
        ([(43.0, 6.0), (38.5, 3.1), (12.0, 2.9), (7.0, 0.0)], 1),
        ([(30.0, 6.0), (18.0, 4.0), (10.0, 3.0), (4.0, 2.0)], 0),  # a ferry to the line's start
        ([(30.0, 9.0), (36.0, 3.5), (45.0, 2.0)], 0),  # joins just before the end
    ],
)
def test_a_visit_comes_and_goes_by_the_ends(places: list[Place], visits: int) -> None:
    flight = record(places, lines=LINES)
    assert len(PlannedLines(flight, LINES).visits) == visits


def test_a_flight_without_lines_is_judged_as_ever() -> None:
    flight = record([(2.0, 3.0), (46.0, 3.0)], lines=None)
    lined = replace(flight, lines=Lines(polylines=(((-50.0, 3.0), (90.0, 3.0)),)))
    for one, other in zip(strips_of(flight), strips_of(lined), strict=True):
        assert one.runs == other.runs
