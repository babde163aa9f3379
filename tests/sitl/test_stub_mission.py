"""Missions go in and out over the wire and from files without a change."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from companion.errors import ConfigError
from sitl.stub.mission_items import MissionItem, item_message, item_of, read_mission
from sitl.stub.protocol import dialect
from tests.sitl.stub_bench import Bench, Peer, mission

ITEMS = mission((0.0, 40.0), (6.0, 40.0))


def upload(bench: Bench, peer: Peer, items: tuple[MissionItem, ...]) -> Any:
    """Upload as a ground station does and return the acknowledgement."""
    peer.say(dialect.MAVLink_mission_count_message(1, 1, len(items)))
    while not peer.of("MISSION_ACK"):
        asked = peer.last("MISSION_REQUEST_INT").seq
        peer.say(item_message(items[asked], asked, current=asked == 0, to=(1, 1)))
    return peer.last("MISSION_ACK")


def download(peer: Peer) -> tuple[MissionItem, ...]:
    peer.say(dialect.MAVLink_mission_request_list_message(1, 1))
    count = peer.last("MISSION_COUNT").count
    items = []
    for number in range(count):
        peer.say(dialect.MAVLink_mission_request_int_message(1, 1, number))
        items.append(item_of(peer.last("MISSION_ITEM_INT")))
    peer.say(dialect.MAVLink_mission_ack_message(1, 1, 0))
    return tuple(items)


def test_a_mission_reads_back_as_it_was_written_but_for_home() -> None:
    bench = Bench()
    ground = bench.peer(255, 190)
    assert upload(bench, ground, ITEMS).type == dialect.MAV_MISSION_ACCEPTED
    back = download(ground)
    assert [(i.command, i.x_e7, i.y_e7, i.z_m) for i in back[1:]] == [
        (i.command, i.x_e7, i.y_e7, i.z_m) for i in ITEMS[1:]
    ]
    assert back[0].z_m == bench.autopilot.flight.home_altitude_m


def test_a_lost_item_is_asked_for_again() -> None:
    bench = Bench()
    bench.companion.say(dialect.MAVLink_mission_count_message(1, 1, 2))
    bench.run(1.5)
    assert [message.seq for message in bench.companion.of("MISSION_REQUEST_INT")] == [0, 0]


def test_an_upload_that_stops_is_given_up_and_the_old_mission_kept() -> None:
    bench = Bench(items=ITEMS)
    bench.companion.say(dialect.MAVLink_mission_count_message(1, 1, 2))
    bench.run(10.0)
    assert bench.companion.last("MISSION_ACK").type == dialect.MAV_MISSION_OPERATION_CANCELLED
    assert bench.autopilot.flight.items == ITEMS


def test_a_second_sender_is_turned_away_during_an_upload() -> None:
    bench = Bench()
    ground = bench.peer(255, 190)
    bench.companion.say(dialect.MAVLink_mission_count_message(1, 1, 2))
    ground.say(dialect.MAVLink_mission_count_message(1, 1, 2))
    assert ground.last("MISSION_ACK").type == dialect.MAV_MISSION_DENIED


@pytest.mark.parametrize(
    ("item", "answer"),
    [
        (MissionItem(command=dialect.MAV_CMD_DO_SET_ACTUATOR), dialect.MAV_MISSION_UNSUPPORTED),
        (
            MissionItem(command=dialect.MAV_CMD_NAV_WAYPOINT, frame=1),
            dialect.MAV_MISSION_UNSUPPORTED_FRAME,
        ),
    ],
)
def test_an_item_that_cannot_be_flown_ends_the_upload(item: MissionItem, answer: int) -> None:
    bench = Bench(items=ITEMS)
    assert upload(bench, bench.companion, (ITEMS[0], item)).type == answer
    assert bench.autopilot.flight.items == ITEMS


def test_clearing_forgets_the_mission() -> None:
    bench = Bench(items=ITEMS)
    bench.companion.say(dialect.MAVLink_mission_clear_all_message(1, 1))
    assert bench.companion.last("MISSION_ACK").type == dialect.MAV_MISSION_ACCEPTED
    assert download(bench.companion) == ()


FENCE, RALLY = dialect.MAV_MISSION_TYPE_FENCE, dialect.MAV_MISSION_TYPE_RALLY
CORNERS = tuple(
    MissionItem(command=5001, frame=0, param1=3.0, x_e7=one, y_e7=two)
    for one, two in ((1, 2), (3, 4), (5, 6))
)


def test_a_fence_is_kept_beside_the_mission_and_cleared_alone() -> None:
    bench = Bench(items=ITEMS)
    peer = bench.companion
    peer.say(dialect.MAVLink_mission_count_message(1, 1, len(CORNERS), FENCE))
    for number, item in enumerate(CORNERS):
        assert peer.last("MISSION_REQUEST_INT").mission_type == FENCE
        peer.say(item_message(item, number, current=False, to=(1, 1), kind=FENCE))
    assert (peer.last("MISSION_ACK").type, peer.last("MISSION_ACK").mission_type) == (0, FENCE)
    assert bench.autopilot.fence == CORNERS
    assert bench.autopilot.flight.items == ITEMS
    peer.say(dialect.MAVLink_mission_request_list_message(1, 1, FENCE))
    assert peer.last("MISSION_COUNT").count == len(CORNERS)
    peer.say(dialect.MAVLink_mission_request_int_message(1, 1, 2, FENCE))
    assert item_of(peer.last("MISSION_ITEM_INT")) == CORNERS[2]
    assert peer.last("MISSION_ITEM_INT").mission_type == FENCE
    peer.say(dialect.MAVLink_mission_clear_all_message(1, 1, FENCE))
    assert (bench.autopilot.fence, bench.autopilot.flight.items) == ((), ITEMS)


@pytest.mark.parametrize(
    ("kind", "count", "answer"),
    [
        (RALLY, 3, dialect.MAV_MISSION_UNSUPPORTED),
        (FENCE, 65, dialect.MAV_MISSION_NO_SPACE),
        (dialect.MAV_MISSION_TYPE_MISSION, 2001, dialect.MAV_MISSION_NO_SPACE),
    ],
)
def test_what_has_no_room_is_refused(kind: int, count: int, answer: int) -> None:
    bench = Bench()
    bench.companion.say(dialect.MAVLink_mission_count_message(1, 1, count, kind))
    found = bench.companion.last("MISSION_ACK")
    assert (found.type, found.mission_type) == (answer, kind)


def test_a_waypoint_is_no_part_of_a_fence() -> None:
    bench = Bench()
    bench.companion.say(dialect.MAVLink_mission_count_message(1, 1, 1, FENCE))
    bench.companion.say(item_message(ITEMS[1], 0, current=False, to=(1, 1), kind=FENCE))
    assert bench.companion.last("MISSION_ACK").type == dialect.MAV_MISSION_UNSUPPORTED
    assert bench.autopilot.fence == ()


def test_a_waypoint_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "field.waypoints"
    path.write_text(
        "QGC WPL 110\n"
        "0\t1\t0\t16\t0\t0\t0\t0\t36.0\t114.5\t60\t1\n"
        "1\t0\t3\t22\t0\t0\t0\t0\t0\t0\t3.5\t1\n"
        "2\t0\t3\t178\t0\t5\t0\t0\t0\t0\t0\t1\n"
        "3\t0\t3\t16\t0\t0\t0\t0\t36.0004\t114.5\t3.5\t1\n"
    )
    items = read_mission(path)
    assert [item.command for item in items] == [16, 22, 178, 16]
    assert items[3].x_e7 == 360_004_000
    assert items[2].param2 == 5.0


def test_a_plan_is_read_home_first_and_with_the_items_of_its_survey(tmp_path: Path) -> None:
    def simple(command: int, *params: float | None) -> dict[str, Any]:
        kind, auto = "SimpleItem", True
        return {
            "type": kind,
            "command": command,
            "frame": 3,
            "params": list(params),
            "autoContinue": auto,
        }

    turn = simple(16, 0, 0, 0, None, 36.0004, 114.5, 3.5)
    survey = {"type": "ComplexItem", "TransectStyleComplexItem": {"Items": [turn, turn]}}
    start = simple(22, 0, 0, 0, None, 36.0, 114.5, 3.5)
    plan = {"mission": {"plannedHomePosition": [36.0, 114.5, 60], "items": [start, survey]}}
    path = tmp_path / "field.plan"
    path.write_text(json.dumps(plan))
    items = read_mission(path)
    assert [item.command for item in items] == [16, 22, 16, 16]
    assert (items[0].x_e7, items[2].x_e7) == (360_000_000, 360_004_000)


def test_a_mission_that_is_not_there_is_said_to_be_missing(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="there is no such file; check the path"):
        read_mission(tmp_path / "none.plan")


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.waypoints", "nonsense", "QGC WPL 110"),
        ("a.waypoints", "QGC WPL 110\n0 1 0 16\n", "line 2: 12 columns"),
        ("a.waypoints", "QGC WPL 110\n0 1 0 x 0 0 0 0 0 0 0 1\n", "line 2"),
        ("a.waypoints", "QGC WPL 110\n", "no mission items"),
        ("a.waypoints", "QGC WPL 110\n1 0 3 22 0 0 0 0 48 11 3 1\n", "line 2: row 0, home"),
        ("a.waypoints", "QGC WPL 110\n0 1 3 22 0 0 0 0 48 11 3 1\n", "here it is command 22"),
        ("a.plan", "{", "not a QGroundControl plan"),
        ("a.plan", "{}", "mission"),
    ],
)
def test_a_broken_mission_file_is_refused_in_one_line(
    tmp_path: Path, name: str, text: str, said: str
) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(ConfigError, match=said) as caught:
        read_mission(path)
    assert "\n" not in str(caught.value)
    assert name in str(caught.value)
