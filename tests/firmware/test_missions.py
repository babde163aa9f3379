"""Missions beside the real firmwares: what they refuse, and that they take every example."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.firmware.fields import HOME, HOME_DEG, file_items
from tests.firmware.firmware import ROOT, arducopter, px4, vrspray
from tests.firmware.mission_facts import COMMANDS, FRAMES, NUMBERED, NUMBERS, PLACED
from tests.firmware.station import MissionItem, Station

pytestmark = [pytest.mark.firmware, pytest.mark.timeout(300)]

# The firmwares' second link: the station has the first.
LINKS = {"ardupilot": "udpin:127.0.0.1:14550", "px4": "udpin:127.0.0.1:14540"}
PLACE = (HOME_DEG[0] + 0.0005, HOME_DEG[1])
MISSION_FRAME = 2
ACCEPTED = 0
LISTENS_WITHIN_S = 40.0
both = pytest.mark.parametrize("firmware", ["ardupilot", "px4"])


@contextmanager
def on_the_ground(firmware: str, where: Path, folder: Path) -> Iterator[Station]:
    """Have a vehicle that is heard."""
    place = (*map(str, HOME_DEG), "60")
    started = (
        arducopter(where, folder, HOME, has_watchdog=False)
        if firmware == "ardupilot"
        else px4(where, folder, *place)
    )
    with started as station:
        station.until(lambda: station.heard("HEARTBEAT") is not None, "heartbeat", LISTENS_WITHIN_S)
        # ArduCopter has no room for a mission in its first moments.
        way = around(firmware, MissionItem(16, *PLACE, 3.5))
        station.until(lambda: station.try_upload(way)[0] == ACCEPTED, "room", LISTENS_WITHIN_S)
        yield station


def around(firmware: str, item: MissionItem) -> list[MissionItem]:
    """Return a mission with an item between its waypoints."""
    home = [MissionItem(16, *HOME_DEG, 0.0, 0)] if firmware == "ardupilot" else []
    way = MissionItem(16, *PLACE, 3.5)
    return [*home, MissionItem(22, *HOME_DEG, 3.5), way, item, way]


def of_command(command: int, frame: int) -> MissionItem:
    """Return an item with good numbers."""
    has_place = command in PLACED and frame != MISSION_FRAME
    place = PLACE if has_place else (0.0, 0.0)
    values = NUMBERS.get(command, (0.0, 0.0, 0.0, 0.0))
    return MissionItem(command, *place, 3.5 * has_place, frame, values)


@both
def test_every_command_in_every_frame_is_answered_as_recorded(
    firmware: str, firmwares: Path, tmp_path: Path
) -> None:
    found: dict[tuple[int, object], tuple[int, int]] = {}
    wrong: list[tuple[int, int, int]] = []
    with on_the_ground(firmware, firmwares, tmp_path / firmware) as station:
        for command, answers in COMMANDS.items():
            for frame, digit in zip(FRAMES, getattr(answers, firmware), strict=True):
                items = around(firmware, of_command(command, frame))
                result, last = station.try_upload(items)
                found[command, frame] = (result, int(digit))
                if result and last != len(items) - 2:
                    wrong.append((command, frame, last))
        for name, fact in NUMBERED.items():
            item = MissionItem(
                fact.command, fact.latitude_deg, fact.longitude_deg, fact.height_m, fact.frame,
                fact.params,
            )  # fmt: skip
            result, _ = station.try_upload(around(firmware, item))
            found[fact.command, name] = (result, getattr(fact, firmware))
    assert {what: pair for what, pair in found.items() if pair[0] != pair[1]} == {}
    assert wrong == []  # the item that ends an upload is the one that was asked for last


@both
def test_every_mission_of_the_examples_is_uploaded_and_there(
    firmware: str, firmwares: Path, tmp_path: Path
) -> None:
    paths = sorted((ROOT / "examples").glob("*/mission.*"))
    assert len(paths) == 6
    with on_the_ground(firmware, firmwares, tmp_path / firmware) as station:
        for path in paths:
            done = vrspray("upload", str(path), "--link", LINKS[firmware], "--json")
            assert done.returncode == 0, (path, done.stdout, done.stderr)
            there = station.mission()
            sent = file_items(path.with_suffix(".waypoints"))[1:]
            assert json.loads(done.stdout)["items"] == len(sent)
            kept = there[1:] if firmware == "ardupilot" else there
            assert [item.command for item in kept] == [item.command for item in sent]
            for one, other in zip(sent, kept, strict=True):
                assert one.latitude_deg == pytest.approx(other.latitude_deg, abs=3e-7)
                assert one.longitude_deg == pytest.approx(other.longitude_deg, abs=3e-7)
                assert one.height_m == pytest.approx(other.height_m, abs=0.02)


@both
def test_the_plan_of_a_real_field_is_taken_with_its_fence(
    firmware: str, firmwares: Path, samples: Path, tmp_path: Path
) -> None:
    field, file = samples / "fields" / "r_us_ca_scm.geojson", tmp_path / "field.plan"
    planned = vrspray("plan", str(field), "--autopilot", firmware, "--out", str(file))
    assert planned.returncode == 0, planned.stderr
    content = json.loads(file.read_text())
    corners = sum(len(each["polygon"]) for each in content["geoFence"]["polygons"])
    assert corners > 40
    with on_the_ground(firmware, firmwares, tmp_path / firmware) as station:
        done = vrspray("upload", str(file), "--link", LINKS[firmware], "--json")
        assert done.returncode == 0, (done.stdout, done.stderr)
        found = json.loads(done.stdout)
        assert found["fence_items"] == corners + len(content["geoFence"]["circles"])
        kept = station.mission()[firmware == "ardupilot" :]
        sent = content["mission"]["items"]
        assert [item.command for item in kept] == [item["command"] for item in sent]


def test_px4_begins_a_mission_anew_that_it_left(firmwares: Path, tmp_path: Path) -> None:
    file = str(ROOT / "examples" / "anyang" / "mission.plan")
    with on_the_ground("px4", firmwares, tmp_path / "px4") as station:
        assert vrspray("upload", file, "--link", LINKS["px4"]).returncode == 0
        station.go_on_with(3)
        assert vrspray("upload", file, "--link", LINKS["px4"]).returncode == 0
        station.until(lambda: station.heard("MISSION_CURRENT").seq == 0, "first item", 5.0)


def test_an_item_that_px4_refuses_is_named(firmwares: Path, tmp_path: Path) -> None:
    content = json.loads((ROOT / "examples" / "anyang" / "mission.plan").read_text())
    strange = {"command": 42, "frame": 2, "params": [0, 0, 0, 0, 0, 0, 0]}
    content["mission"]["items"][3] = {**content["mission"]["items"][1], **strange}
    file = tmp_path / "strange.plan"
    file.write_text(json.dumps(content))
    with on_the_ground("px4", firmwares, tmp_path / "px4"):
        done = vrspray("upload", str(file), "--link", LINKS["px4"])
    assert done.returncode == 2
    assert "item 4 (command 42 in frame 2" in done.stderr
