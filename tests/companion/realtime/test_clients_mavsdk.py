"""MAVSDK, written by others, has the companion and the autopilot on one link, and flies both."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from sitl.stub.protocol import dialect
from tests.companion.realtime.client_bench import (
    Bench,
    flying_bench,
    kept_parameters,
    passes,
    prescribed_l,
)
from tests.companion.realtime.other_clients import raw_items

mavsdk = pytest.importorskip("mavsdk.asyncio")
pytestmark = pytest.mark.sitl
both = pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])

COMPANION, RATE_OVERRIDE, REFILLED = 191, 31010, 31011
ACCEPTED, DENIED, UNSUPPORTED = 0, 2, 3


class Ground:
    """A ground station made of MAVSDK's parts, and all that it heard from the companion."""

    def __init__(self, system: Any) -> None:
        from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync

        self.system = system
        self.heard: list[tuple[str, dict[str, Any]]] = []
        self._direct = MavlinkDirectAsync(system)
        self._news = asyncio.Event()

    async def listen(self) -> None:
        """Keep what comes from component 191."""
        async for message in self._direct.subscribe_message(""):
            if message.component_id == COMPANION:
                self.heard.append((message.message_name, json.loads(message.fields_json)))
                self._news.set()

    def of(self, kind: str) -> list[dict[str, Any]]:
        return [fields for name, fields in self.heard if name == kind]

    def value(self, name: str) -> float | None:
        """Return the newest NAMED_VALUE_FLOAT of a name."""
        found = [one["value"] for one in self.of("NAMED_VALUE_FLOAT") if one["name"] == name]
        return float(found[-1]) if found else None

    def has_said(self, text: str) -> bool:
        return any(text in one["text"] for one in self.of("STATUSTEXT"))

    async def until(self, done: Callable[[], bool], *, within_s: float = 20.0) -> None:
        try:
            async with asyncio.timeout(within_s):
                while not done():
                    self._news.clear()
                    await self._news.wait()
        except TimeoutError:
            pytest.fail(f"did not happen; heard {self.heard[-20:]}")

    async def list_parameters(self) -> None:
        """Ask for all of the companion's parameters, and have each arrive once asked for.

        By messages: MAVSDK 4.1.0 takes the autopilot's PARAM_VALUE for one of this list, and the
        companion reads some of those just now.
        """
        from mavsdk.plugins.mavlink_direct import MavlinkMessage

        self.heard.clear()
        fields = json.dumps({"target_system": 1, "target_component": COMPANION})
        message = MavlinkMessage("PARAM_REQUEST_LIST", 0, 0, 1, COMPANION, fields)
        await self._direct.send_message(message)
        await self.until(
            lambda: any(
                {one["param_index"] for one in self.of("PARAM_VALUE")}
                == set(range(found["param_count"]))
                for found in self.of("PARAM_VALUE")
            )
        )
        names = {one["param_id"] for one in self.of("PARAM_VALUE")}
        assert names >= {"SPR_RATE_PCT", "SPR_VAL_HZ", "SPR_TANK_L", "SPR_LAG_ON", "SPR_LAG_POS"}

    async def command(self, command: int, *params: float) -> int:
        """Send a command to the companion and return its result."""
        from mavsdk.plugins.mavlink_direct import MavlinkMessage

        numbers = {f"param{n}": value for n, value in enumerate((*params, *[0.0] * 7), 1) if n < 8}
        fields = {
            "target_system": 1,
            "target_component": COMPANION,
            "command": command,
            "confirmation": 0,
            **numbers,
        }
        message = MavlinkMessage("COMMAND_LONG", 0, 0, 1, COMPANION, json.dumps(fields))
        answer = await self._direct.send_command(message)
        assert answer.component_id == COMPANION
        return int(json.loads(answer.fields_json)["result"])


def has_started(beat: dict[str, Any]) -> bool:
    return bool(beat["system_status"] != dialect.MAV_STATE_BOOT)


@asynccontextmanager
async def ground(bench: Bench) -> AsyncIterator[Ground]:
    """Connect MAVSDK to the link of the bench, with both components discovered."""
    kind = mavsdk.ComponentType.GROUND_STATION
    way, _, place = bench.url.partition(":")
    urls = {"tcp": f"tcpout://{place}", "udpout": f"udpout://{place}"}
    configuration = mavsdk.Configuration.create_with_component_type(kind)
    async with asyncio.timeout(90.0), mavsdk.Mavsdk(configuration) as client:
        await client.add_any_connection(urls[way])
        system = await client.first_autopilot(20.0)
        assert system is not None
        found = Ground(system)
        listening = asyncio.create_task(found.listen())
        try:
            # Where the companion calls the vehicle it is heard while it still reads its map.
            await found.until(lambda: any(map(has_started, found.of("HEARTBEAT"))))
            yield found
        finally:
            listening.cancel()
            await asyncio.gather(listening, return_exceptions=True)


@both
async def test_mavsdk_finds_both_and_each_parameter_and_command_is_answered(
    autopilot: str, tmp_path: Path
) -> None:
    async with flying_bench(autopilot, tmp_path) as bench, ground(bench) as station:
        assert set(await station.system.component_ids()) >= {1, COMPANION}
        beat = station.of("HEARTBEAT")[0]
        assert (beat["type"], beat["autopilot"]) == (18, 8)
        await set_parameters(bench, station)
        await give_commands(station)
        assert not bench.stub.flight.armed
    assert kept_parameters(tmp_path) == {"SPR_LAG_ON": 0.12}


async def set_parameters(bench: Bench, station: Ground) -> None:
    from mavsdk.asyncio.plugins.param import ParamAsync
    from mavsdk.plugins.param import ParamError, ProtocolVersion

    own = ParamAsync(station.system)
    # MAVSDK 4.1.0 selects the component, and reports UNKNOWN where it means success.
    with contextlib.suppress(ParamError):
        await own.select_component(COMPANION, ProtocolVersion.V1)
    assert await own.get_param_float("SPR_RATE_PCT") == 100.0
    await own.set_param_float("SPR_RATE_PCT", 95.0)
    await own.set_param_float("SPR_LAG_ON", 0.12)
    assert await own.get_param_float("SPR_LAG_ON") == pytest.approx(0.12)
    await station.list_parameters()
    # The autopilot's own are still within reach.
    of_vehicle = ParamAsync(station.system)
    name = "SERVO9_FUNCTION" if bench.name == "ardupilot" else "PWM_MAIN_FUNC9"
    assert await of_vehicle.get_param_int(name) == bench.stub.parameters[name]


async def give_commands(station: Ground) -> None:
    assert await station.command(dialect.MAV_CMD_DO_SPRAYER, 1.0) == ACCEPTED
    await station.until(lambda: station.value("SPR_STATE") == 1.0)
    await station.until(lambda: station.has_said("not armed"))
    assert await station.command(dialect.MAV_CMD_DO_SPRAYER, 0.5) == DENIED
    assert await station.command(dialect.MAV_CMD_DO_SPRAYER, 0.0) == ACCEPTED
    await station.until(lambda: station.value("SPR_STATE") == 2.0)
    assert await station.command(RATE_OVERRIDE, 90.0) == ACCEPTED
    await station.until(lambda: station.value("SPR_PCT") == 90.0)
    assert await station.command(RATE_OVERRIDE, 120.0) == DENIED
    assert await station.command(REFILLED, 12.0) == ACCEPTED
    await station.until(lambda: station.value("SPR_TANK") == 12.0)
    assert await station.command(dialect.MAV_CMD_REQUEST_MESSAGE, 148.0) == ACCEPTED
    await station.until(lambda: bool(station.of("AUTOPILOT_VERSION")))
    assert await station.command(dialect.MAV_CMD_NAV_LAND) == UNSUPPORTED


async def fly(bench: Bench, station: Ground) -> None:
    """Upload the mission, arm, start it, enable in the air, and wait for its end."""
    from mavsdk.asyncio.plugins.action import ActionAsync
    from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync

    missions, action = MissionRawAsync(station.system), ActionAsync(station.system)
    await missions.upload_mission(raw_items(passes(bench.name)))
    await action.arm()
    await missions.start_mission()
    await bench.until(lambda: bench.is_in_the_air)
    assert await station.command(dialect.MAV_CMD_DO_SPRAYER, 1.0) == ACCEPTED
    await bench.until(lambda: bench.has_flown, within_s=40.0)


@both
async def test_the_companion_sprays_the_map_while_mavsdk_flies_its_mission(
    autopilot: str, tmp_path: Path
) -> None:
    async with flying_bench(autopilot, tmp_path) as bench, ground(bench) as station:
        assert await station.command(RATE_OVERRIDE, 90.0) == ACCEPTED
        await fly(bench, station)
        assert station.has_said("ready")
        flows = [one for one in station.of("NAMED_VALUE_FLOAT") if one["name"] == "SPR_FLOW"]
        assert max(one["value"] for one in flows) > 1.0
        found = bench.judged(tmp_path / "truth")
    assert found["missed"] == 0
    # An order to close that a busy computer sends late puts some drops beyond the border.
    assert found["off_target_ml"] <= 0.01 * 1000.0 * found["volume_l"]
    assert found["volume_l"] == pytest.approx(0.9 * prescribed_l(), rel=0.1)
