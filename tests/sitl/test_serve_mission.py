"""The simulated autopilot that waits for a mission: what it waits for, says and judges by."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from companion.errors import ConfigError, VrsprayError
from sitl.anyang import anyang_items
from sitl.serve import Operator, ServeOptions, Step, _Run
from sitl.serve_mission import home_of_file
from sitl.stub.mission_items import MissionItem
from sitl.stub.protocol import dialect
from tests.sitl.stub_bench import Bench, mission

EXAMPLE = Path(__file__).parents[2] / "examples" / "anyang"


class Waiting:
    """A vehicle without a mission, its operator, and a companion that may beat."""

    def __init__(self) -> None:
        self.bench = Bench()
        self.there = False
        self.operator = Operator(self.bench.autopilot, mission_is_there=lambda: self.there)

    def run(self, duration_s: float) -> None:
        end_s = self.bench.now_s + duration_s
        while self.bench.now_s < end_s:
            self.bench.run(0.02)
            self.operator.tick(self.bench.now_s)

    def beat(self) -> None:
        self.bench.companion.say(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))

    def upload(self) -> None:
        self.bench.autopilot.flight.set_items(mission((0.0, 60.0)), self.bench.now_s)
        self.there = True


def test_a_companion_alone_is_not_flown() -> None:
    waiting = Waiting()
    waiting.beat()
    waiting.run(10.0)
    assert waiting.operator.step is Step.NO_MISSION
    assert not waiting.bench.autopilot.flight.armed


def test_a_mission_alone_is_not_flown_nor_with_a_companion_that_was_there_before() -> None:
    waiting = Waiting()
    waiting.beat()
    waiting.run(1.0)
    waiting.upload()
    waiting.run(10.0)
    assert waiting.operator.step is Step.WAITING
    assert not waiting.bench.autopilot.flight.armed


def test_a_companion_after_the_mission_is_flown() -> None:
    waiting = Waiting()
    waiting.run(1.0)
    waiting.upload()
    waiting.run(1.0)
    waiting.beat()
    waiting.run(3.5)
    assert waiting.operator.step is Step.FLYING
    assert waiting.bench.autopilot.flight.armed


class Served:
    """`serve` without a socket, and what it has said."""

    def __init__(self, **options: Any) -> None:
        self.said: list[str] = []
        self.run = _Run(ServeOptions(wait_mission=True, **options), self.said.append)

    def upload(self, items: tuple[MissionItem, ...]) -> None:
        self.run.autopilot.flight.set_items(items, self.run._start_s)
        self.run.tick(self.run._start_s)


def test_it_waits_for_a_mission_where_the_examples_flight_begins() -> None:
    served = Served()
    home, example = served.run.autopilot.flight.frame, anyang_items(5.0)[0]
    assert served.run.operator.step is Step.NO_MISSION
    assert served.run.autopilot.flight.items == ()
    assert (home.latitude_deg, home.longitude_deg) == (example.latitude_deg, example.longitude_deg)


def test_it_stands_where_it_is_told_else_near_the_map_of_the_configuration() -> None:
    told = Served(place_deg=(36.0, 114.5)).run.autopilot.flight.frame
    assert (told.latitude_deg, told.longitude_deg) == (36.0, 114.5)
    near = Served(field_config=EXAMPLE / "config.toml").run.autopilot.flight.frame
    assert near.latitude_deg == pytest.approx(35.9961, abs=2e-3)
    assert near.longitude_deg == pytest.approx(114.5435, abs=2e-3)


def test_the_home_of_a_mission_file_is_where_it_may_stand(tmp_path: Path) -> None:
    items = anyang_items(5.0)
    latitude_deg, longitude_deg = items[0].latitude_deg, items[0].longitude_deg
    found = home_of_file(str(EXAMPLE / "mission.plan"))
    assert found == pytest.approx((latitude_deg, longitude_deg), abs=1e-5)
    assert home_of_file("36.0,114.5") is None
    with pytest.raises(ConfigError, match=r"none\.plan"):
        home_of_file(str(tmp_path / "none.plan"))


def test_an_uploaded_mission_is_said_and_its_speed_is_the_flights() -> None:
    served = Served()
    served.upload(anyang_items(4.0))
    assert served.run.operator.step is Step.WAITING
    assert served.said == ["mission: 10 items uploaded", "waiting for a companion"]
    result = served.run.result(cancelled=True)
    assert (result["uploaded_items"], result["speed_m_s"]) == (10, 4.0)


def test_a_mission_of_another_field_or_without_a_take_off_is_said() -> None:
    served = Served(place_deg=(36.5, 114.5))
    items = anyang_items(5.0)
    served.upload((items[0], *items[2:]))
    assert "does not begin with a take-off" in served.said[1]
    assert "56 km from the vehicle; stand there with --home" in served.said[2]
    served.upload(())
    assert served.said[-1] == "mission: cleared"


def test_without_a_mission_it_gives_up_after_the_wait() -> None:
    served = Served(wait_s=2.0)
    served.run.tick(served.run._start_s + 1.9)
    assert not served.run._done.is_set()
    served.run.tick(served.run._start_s + 2.1)
    assert served.run._done.is_set()
    assert served.run.result(cancelled=False)["state"] == "no mission"


def test_the_wait_begins_again_for_the_companion() -> None:
    served = Served(wait_s=2.0)
    start_s = served.run._start_s
    served.run.tick(start_s + 1.9)
    served.run.autopilot.flight.set_items(anyang_items(5.0), start_s + 1.9)
    served.run.tick(start_s + 1.95)
    served.run.tick(start_s + 3.9)
    assert not served.run._done.is_set()
    served.run.tick(start_s + 4.0)
    assert served.run.result(cancelled=False)["state"] == "no companion"


def write_lines(path: Path, longitude_deg: float) -> Path:
    line = {
        "type": "Feature",
        "properties": {"kind": "spray", "sortie": 1},
        "geometry": {
            "type": "LineString",
            "coordinates": [[longitude_deg, 35.9959], [longitude_deg, 35.9965]],
        },
    }
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [line]}))
    return path


def test_the_lines_given_are_those_that_the_flight_is_judged_by(tmp_path: Path) -> None:
    served = Served(lines=write_lines(tmp_path / "field.lines.geojson", 114.5435))
    setup = served.run._setup
    assert setup is not None
    assert setup.lines is not None
    assert len(setup.lines.polylines) == 1


def test_lines_of_another_field_are_refused_before_the_flight(tmp_path: Path) -> None:
    with pytest.raises(VrsprayError, match="no line comes over the map"):
        Served(lines=write_lines(tmp_path / "field.lines.geojson", 114.6))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"wait_mission": True, "mission": Path("m.plan")}, "exclude each other"),
        ({"place_deg": (36.0, 114.5)}, "--home is for --wait-mission"),
    ],
)
def test_options_that_do_not_go_together_are_one_line(options: Any, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        _Run(ServeOptions(**options), lambda _text: None)
