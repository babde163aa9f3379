"""The stub refuses the mission items that the real firmwares refuse, with the same result."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Literal

import pytest

from companion.errors import ConfigError
from missions.files.items import plan_problems
from sitl.earth import Earth
from sitl.serve_mission import mission_items
from sitl.stub.flight import plan_flight
from sitl.stub.mission_items import FLOWN, MissionItem, item_message, read_mission
from sitl.stub.protocol import dialect
from tests.firmware.mission_facts import COMMANDS, FRAMES, NUMBERED, NUMBERS, PLACED
from tests.sitl.stub_bench import HOME, Bench, of_firmware, place

Personality = Literal["ardupilot", "px4"]
EXAMPLES = Path(__file__).parents[2] / "examples"
MISSIONS = sorted([*EXAMPLES.glob("*/*.plan"), *EXAMPLES.glob("*/*.waypoints")])
both = pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
START = (
    place(dialect.MAV_CMD_NAV_WAYPOINT, 0.0, 0.0, 0.0),
    place(dialect.MAV_CMD_NAV_TAKEOFF, 0.0, 0.0),
)


def answer(bench: Bench, items: tuple[MissionItem, ...]) -> int:
    """Upload, and return what the vehicle says of it."""
    peer = bench.companion
    seen = len(peer.of("MISSION_ACK"))
    peer.say(dialect.MAVLink_mission_count_message(1, 1, len(items)))
    for number, item in enumerate(items):
        peer.say(item_message(item, number, current=number == 0, to=(1, 1)))
        if len(peer.of("MISSION_ACK")) > seen:
            break
    return int(peer.last("MISSION_ACK").type)


def of_command(command: int, frame: int) -> MissionItem:
    one, two, three, four = NUMBERS.get(command, (0.0, 0.0, 0.0, 0.0))
    has_place = command in PLACED and frame != dialect.MAV_FRAME_MISSION
    latitude_deg, longitude_deg = HOME.to_geographic(0.0, 60.0) if has_place else (0.0, 0.0)
    return MissionItem(
        command=command, frame=frame, param1=one, param2=two, param3=three, param4=four,
        x_e7=round(latitude_deg * 1e7), y_e7=round(longitude_deg * 1e7), z_m=3.5 * has_place,
    )  # fmt: skip


@both
def test_every_command_in_every_frame_is_answered_as_the_firmware_answers(
    autopilot: Personality,
) -> None:
    bench = Bench(autopilot=autopilot)
    start = of_firmware(autopilot, START)
    for command, answers in COMMANDS.items():
        for frame, digit in zip(FRAMES, getattr(answers, autopilot), strict=True):
            found = answer(bench, (*start, of_command(command, frame)))
            real, which = int(digit), f"command {command} in frame {frame}"
            if command in FLOWN and frame not in (10, 11):  # the stub has no terrain
                assert found == real, which
            else:  # it flies less than they do, and never takes more
                assert found or not real, which


@both
@pytest.mark.parametrize("name", NUMBERED)
def test_numbers_are_answered_as_the_firmware_answers(autopilot: Personality, name: str) -> None:
    fact = NUMBERED[name]
    one, two, three, four = fact.params
    item = MissionItem(
        command=fact.command, frame=fact.frame, param1=one, param2=two, param3=three, param4=four,
        x_e7=round(fact.latitude_deg * 1e7), y_e7=round(fact.longitude_deg * 1e7),
        z_m=fact.height_m,
    )  # fmt: skip
    found = answer(Bench(autopilot=autopilot), (*of_firmware(autopilot, START), item))
    assert found == getattr(fact, autopilot)


def test_a_landing_at_zero_is_here_to_ardupilot_and_far_away_to_px4() -> None:
    items = (
        *START,
        place(dialect.MAV_CMD_NAV_WAYPOINT, 0.0, 40.0),
        MissionItem(command=dialect.MAV_CMD_NAV_LAND, frame=dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT),
    )

    def ends(*, zero_is_a_place: bool) -> list[tuple[float, float]]:
        plan = plan_flight(
            items, HOME, first_sequence=1, speed_m_s=5.0, home_altitude_m=0.0,
            zero_is_a_place=zero_is_a_place,
        )  # fmt: skip
        return [(leg.east_m, leg.north_m) for leg in plan.legs]

    assert ends(zero_is_a_place=False) == [pytest.approx((0.0, 40.0), abs=0.01)]
    east_m, north_m = ends(zero_is_a_place=True)[-1]
    assert math.hypot(east_m, north_m) > 50_000.0
    # The shortest way from 36 N 114.5 E begins towards the west.
    assert east_m < 0.0


@both
@pytest.mark.parametrize("path", MISSIONS, ids=lambda path: f"{path.parent.name}-{path.suffix[1:]}")
def test_every_example_is_taken_and_stays_near_its_home(autopilot: Personality, path: Path) -> None:
    items = read_mission(path)
    assert answer(Bench(autopilot=autopilot), of_firmware(autopilot, items)) == 0
    home = Earth(items[0].latitude_deg, items[0].longitude_deg)
    placed = [item for item in items[1:] if item.frame != dialect.MAV_FRAME_MISSION]
    assert placed
    for item in placed:
        assert math.hypot(*home.to_local(item.latitude_deg, item.longitude_deg)) < 1000.0


@pytest.mark.parametrize("path", [path for path in MISSIONS if path.suffix == ".plan"])
def test_every_example_plan_loads_and_leaves_the_yaw_open(path: Path) -> None:
    content = json.loads(path.read_text(encoding="utf-8"))
    assert plan_problems(content) == []
    for item in content["mission"]["items"]:
        if item["command"] in (16, 21, 22):
            assert item["params"][3] is None  # 0 turns the nose of a PX4 to the north


def test_a_file_that_would_send_px4_to_the_atlantic_is_not_served(tmp_path: Path) -> None:
    path = tmp_path / "away.waypoints"
    path.write_text(
        "QGC WPL 110\n"
        "0\t1\t0\t16\t0\t0\t0\t0\t36.0\t114.5\t60\t1\n"
        "1\t0\t3\t22\t0\t0\t0\t0\t36.0\t114.5\t3.5\t1\n"
        "2\t0\t3\t21\t0\t0\t0\t0\t0\t0\t0\t1\n"
    )
    px4, ardupilot = (Bench(autopilot=name).autopilot.firmware for name in ("px4", "ardupilot"))
    with pytest.raises(ConfigError, match="item 2: px4 would fly to latitude 0, longitude 0"):
        mission_items(path, 5.0, px4)
    assert len(mission_items(path, 5.0, ardupilot)) == 3
