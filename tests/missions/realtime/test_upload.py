"""`vrspray upload`: by MAVSDK over a real socket to both personalities of the stub."""

from __future__ import annotations

import asyncio
import json
import math
import sys
import time
from collections.abc import AsyncGenerator, AsyncIterator, Iterable
from contextlib import aclosing, asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from companion.link.transport import parse_url
from missions.errors import UploadError
from missions.upload.cli import read_mission_file
from missions.upload.transfer import put
from sitl.stub.mission_items import MissionItem, read_mission
from sitl.stub.protocol import Speaker, dialect
from tests.companion.wire_peer import free_port
from tests.missions.realtime.upload_bench import sorties, stub_on_a_port

pytest.importorskip("mavsdk.asyncio")
pytestmark = pytest.mark.sitl
both = pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])


def without_yaw(items: Iterable[MissionItem]) -> list[MissionItem]:
    """The reader of the stub takes a yaw that is left open for 0."""
    return [replace(item, param4=0.0) for item in items]


async def upload(file: Path, url: str, **options: Any) -> Any:
    from missions.upload.mavsdk_vehicle import connected

    async with asyncio.timeout(60.0), connected(url, wait_s=20.0) as vehicle:
        return await put(
            vehicle, read_mission_file(file), progress=lambda _what, _share: None, **options
        )


@asynccontextmanager
async def companion_on(url: str) -> AsyncIterator[None]:
    """Tell a link of a companion on the vehicle, a hundred times a second."""
    place = parse_url(url)
    speaker = Speaker(1, 191)
    beat = dialect.MAVLink_heartbeat_message(
        dialect.MAV_TYPE_ONBOARD_CONTROLLER, dialect.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3
    )
    loop = asyncio.get_running_loop()
    transport, _ = await loop.create_datagram_endpoint(
        asyncio.DatagramProtocol, remote_addr=(place.place, place.number)
    )

    def say() -> None:
        nonlocal timer
        transport.sendto(speaker.frame(beat))
        timer = loop.call_later(0.01, say)

    timer = loop.call_soon(say)
    try:
        yield
    finally:
        timer.cancel()
        transport.close()


@both
async def test_a_companion_on_the_same_link_is_not_taken_for_the_autopilot(
    autopilot: str, tmp_path: Path
) -> None:
    file = sorties(tmp_path, 1)[0]
    async with stub_on_a_port(autopilot) as (server, url), companion_on(url):
        done = await upload(file, url)
        kept = server.autopilot
    assert done.firmware == autopilot
    items = read_mission(file)
    assert without_yaw(kept.flight.items[1:]) == without_yaw(items[1:])


@both
async def test_mission_and_fence_are_on_the_vehicle_as_the_file_has_them(
    autopilot: str, tmp_path: Path
) -> None:
    file = sorties(tmp_path, 1)[0]
    async with stub_on_a_port(autopilot) as (server, url):
        done = await upload(file, url)
        kept = server.autopilot
    items = read_mission(file)
    assert without_yaw(kept.flight.items[1:]) == without_yaw(items[1:])
    assert math.isnan(kept.flight.items[1].param4)
    assert (done.items, done.firmware, done.attempts) == (len(items) - 1, autopilot, 1)
    fence = json.loads(file.read_text())["geoFence"]
    corners = [(5001 if each["inclusion"] else 5002, len(each["polygon"]), *place)
               for each in fence["polygons"] for place in each["polygon"]]  # fmt: skip
    corners += [(5003 if each["inclusion"] else 5004, each["circle"]["radius"],
                 *each["circle"]["center"]) for each in fence["circles"]]  # fmt: skip
    assert {corner[0] for corner in corners} == {5001, 5002}
    assert [(i.command, i.param1, i.latitude_deg, i.longitude_deg) for i in kept.fence] == [
        pytest.approx(corner, abs=1e-7) for corner in corners
    ]
    assert done.fence_items == len(corners)


@both
async def test_a_mission_that_was_left_begins_anew(autopilot: str, tmp_path: Path) -> None:
    file = sorties(tmp_path, 1)[0]
    async with stub_on_a_port(autopilot) as (server, url):
        await upload(file, url)
        assert server.autopilot.flight.set_sequence(3, time.monotonic())
        await upload(file, url)
        # Home is no item of PX4's; ArduPilot begins with the first when it is armed anew.
        assert server.autopilot.flight.sequence == (1 if autopilot == "px4" else 0)


async def test_sorties_in_a_row_each_replace_the_one_before(tmp_path: Path) -> None:
    files = sorties(tmp_path, 5, suffix=".waypoints")
    assert len(files) == 5
    from missions.upload.mavsdk_vehicle import connected

    async with (
        stub_on_a_port("ardupilot") as (server, url),
        connected(url, wait_s=20.0) as vehicle,
    ):
        for file in files:
            shares: list[float] = []
            mission = read_mission_file(file)
            await put(vehicle, mission, progress=lambda _what, share: shares.append(share))  # noqa: B023
            assert server.autopilot.flight.items[1:] == read_mission(file)[1:]
            assert shares == sorted(shares)
            assert shares[-1] == 1.0


async def test_an_armed_vehicle_keeps_its_mission_unless_told(tmp_path: Path) -> None:
    file = sorties(tmp_path, 1)[0]
    async with stub_on_a_port("px4") as (server, url):
        before = server.autopilot.flight.items
        server.autopilot.flight.armed = True
        with pytest.raises(UploadError, match="--while-armed"):
            await upload(file, url)
        assert server.autopilot.flight.items == before
        assert server.autopilot.fence == ()
        done = await upload(file, url, while_armed=True, with_fence=False)
        assert done.items == len(server.autopilot.flight.items) - 1


async def test_a_fence_beyond_the_vehicles_room_leaves_its_mission_alone(tmp_path: Path) -> None:
    file = sorties(tmp_path, 1)[0]
    content = json.loads(file.read_text())
    home = content["mission"]["plannedHomePosition"]
    ring = [
        [home[0] + 0.01 * math.cos(corner), home[1] + 0.01 * math.sin(corner)]
        for corner in (math.tau * number / 65 for number in range(65))
    ]
    content["geoFence"] |= {
        "polygons": [{"inclusion": True, "polygon": ring, "version": 1}], "circles": [],
    }  # fmt: skip
    file.write_text(json.dumps(content))
    async with stub_on_a_port("ardupilot") as (server, url):
        before = server.autopilot.flight.items
        with pytest.raises(UploadError, match=r"no room for 65 items.*--no-fence"):
            await upload(file, url)
        assert server.autopilot.flight.items == before


@both
async def test_the_item_that_the_vehicle_refuses_is_named(autopilot: str, tmp_path: Path) -> None:
    file = sorties(tmp_path, 1)[0]
    content = json.loads(file.read_text())
    content["mission"]["items"][4] |= {"command": 2000, "frame": 2}  # which the stub does not fly
    file.write_text(json.dumps(content))
    async with stub_on_a_port(autopilot) as (server, url):
        before = server.autopilot.flight.items
        with pytest.raises(UploadError, match=r"item 5 \(command 2000 in frame 2, .*this item"):
            await upload(file, url, with_fence=False)
        assert server.autopilot.flight.items == before


async def test_a_mission_with_too_many_items_is_refused_by_the_vehicle(tmp_path: Path) -> None:
    file = tmp_path / "m.waypoints"
    row = "{}\t0\t3\t16\t0\t0\t0\t0\t48.0\t11.0\t3.5\t1"
    file.write_text("\n".join(["QGC WPL 110", *(row.format(n) for n in range(1, 2002))]) + "\n")
    async with stub_on_a_port("px4") as (_, url):
        with pytest.raises(UploadError, match="no room for 2001 items"):
            await upload(file, url)


async def test_every_result_of_mavsdk_has_words() -> None:
    from mavsdk.plugins.mission_raw import MissionRawResult

    from missions.upload.mavsdk_vehicle import PASSING, REASONS

    of_plans = {each.name for each in MissionRawResult if "PLAN" in each.name}
    untold = {"UNKNOWN", "SUCCESS", "NEXT", "NO_MISSION_AVAILABLE"} | of_plans
    assert {each.name for each in MissionRawResult} - untold == {*PASSING, *REASONS}


async def typed(*words: str) -> tuple[int, str, str]:
    """Run `vrspray upload` in a process of its own."""
    pipe = asyncio.subprocess.PIPE
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "companion", "upload", *words, stdout=pipe, stderr=pipe
    )
    out, err = await process.communicate()
    return process.returncode or 0, out.decode(), err.decode()


async def test_the_command_prints_one_object_and_its_progress_apart(tmp_path: Path) -> None:
    file = sorties(tmp_path, 1)[0]
    async with stub_on_a_port("px4") as (_, url):
        code, out, err = await typed(str(file), "--link", url, "--json")
    found = json.loads(out)
    assert (code, found["ok"], found["firmware"]) == (0, True, "px4")
    assert found["items"] == len(read_mission(file)) - 1
    assert err.splitlines()[0] == "fence: 100 % sent"
    assert err.splitlines()[-1] == "mission: 100 % sent"


async def test_a_link_without_a_vehicle_is_one_line(tmp_path: Path) -> None:
    file = sorties(tmp_path, 1)[0]
    link = f"udpin:127.0.0.1:{free_port()}"
    code, out, err = await typed(str(file), "--link", link, "--wait-s", "1")
    assert (code, out) == (2, "")
    assert err.startswith(f"error: --link {link}: no vehicle within 1 s")
    assert len(err.splitlines()) == 1


@both
async def test_the_next_sortie_follows_when_the_one_before_is_flown_and_landed(
    autopilot: str, tmp_path: Path
) -> None:
    from missions.upload.mavsdk_vehicle import connected
    from missions.upload.transfer import Seen, each_when_flown

    files = [(path, len(read_mission(path))) for path in sorties(tmp_path, 3)[:2]]
    counts = [count - (autopilot == "px4") - 1 for _, count in files]
    loaded: list[int] = []
    async with stub_on_a_port(autopilot) as (server, url), asyncio.timeout(60.0):
        flight = server.autopilot.flight
        async with connected(url, wait_s=20.0) as vehicle:

            class Flown:
                """Flies at every second heartbeat, the first time not to the end."""

                beats = 0

                async def watch(self) -> AsyncGenerator[Seen, None]:
                    async with aclosing(vehicle.watch()) as seen:
                        async for each in seen:
                            self.beats += 1
                            on_air = 2 <= self.beats % 6 < 5
                            flight.armed = on_air
                            last = len(flight.items) - 1
                            if on_air:
                                flight.set_sequence(3 if self.beats < 6 else last, time.monotonic())
                            yield each

            async def upload_one(path: Path) -> None:
                await put(vehicle, read_mission_file(path), progress=lambda _what, _share: None)
                loaded.append(len(flight.items))

            said: list[str] = []
            lasts = [(path, last) for (path, _), last in zip(files, counts, strict=True)]
            await each_when_flown(Flown(), lasts, upload_one, say=said.append)
        assert not flight.armed
        assert without_yaw(flight.items[1:]) == without_yaw(read_mission(files[1][0])[1:])
    assert loaded == [count for _, count in files]
    assert any("is not flown to its end" in text for text in said)
