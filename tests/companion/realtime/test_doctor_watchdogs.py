"""`vrspray doctor --watchdogs` beside a disarmed autopilot, with the script and without it."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from sitl.stub.autopilot import Autopilot
from sitl.stub.outputs import ServoOrder
from sitl.stub.server import StubOptions, StubServer, build_autopilot
from tests.companion.realtime.doctor_bench import guided
from tests.companion.realtime.ground_bench import example
from tests.companion.wire_peer import free_port
from tests.lua_bindings import FakeAutopilot
from tests.sitl.stub_bench import HOME

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(90)]


@asynccontextmanager
async def standing(
    port: int, autopilot: str = "ardupilot"
) -> AsyncIterator[tuple[Autopilot, list[ServoOrder]]]:
    """Have a vehicle stand on the ground, disarmed; yield it and the orders at its pins."""
    orders: list[ServoOrder] = []
    options = StubOptions(home=HOME, autopilot=autopilot)
    stub = build_autopilot(options, start_s=time.monotonic(), written=orders.append)
    async with StubServer(stub, [f"udpout:127.0.0.1:{port}"]):
        yield stub, orders


async def checks_of(config: Path, port: int, *, skips: int = 0) -> dict[str, Any]:
    async with guided(config, port, "--watchdogs", "--wait-s", "8") as doctor:
        for _ in range(skips):
            await doctor.answer("[y/n, s skips]", "s\n")
        _, result = await doctor.ended()
        assert b"Traceback" not in doctor.told, doctor.told.decode()
    return {check["name"]: check for check in result["checks"]}


async def test_the_script_closes_when_the_sign_of_life_stops(tmp_path: Path) -> None:
    port = free_port()
    async with standing(port) as (stub, orders):
        stub.script = FakeAutopilot(
            set_output=stub.set_output,
            parameters={"SPRW_FIRST": 9, "SPRW_LAST": 14},
            boot_ms=round(time.monotonic() * 1000),
        )
        checks = await checks_of(example(tmp_path), port)
    assert checks["script-closes"]["status"] == "ok", checks["script-closes"]
    # Nothing came near to opening a valve, and all is closed at the end.
    assert {order.pulse_us for order in orders} <= {0, 1000, 1004}
    assert {order.channel for order in orders if order.pulse_us == 1004} == {9}
    assert [order.pulse_us for order in orders if order.channel == 9][-1] == 1000
    assert checks["engine-lease"]["status"] == "not-applicable"


async def test_without_the_script_the_output_stays_and_is_said(tmp_path: Path) -> None:
    port = free_port()
    async with standing(port) as (_, orders):
        checks = await checks_of(example(tmp_path), port)
    assert checks["script-closes"]["status"] == "fail"
    assert "stays as ordered" in checks["script-closes"]["text"]
    assert [order.pulse_us for order in orders if order.channel == 9][-1] == 1000


async def test_an_armed_vehicle_is_left_alone(tmp_path: Path) -> None:
    port = free_port()
    async with standing(port) as (stub, orders):
        assert stub.flight.arm(time.monotonic())
        checks = await checks_of(example(tmp_path), port)
    assert checks["script-closes"]["status"] == "fail"
    assert "not tried: the vehicle is armed" in checks["script-closes"]["text"]
    assert not orders


async def test_px4_has_no_script(tmp_path: Path) -> None:
    port = free_port()
    config = example(tmp_path).with_name("px4.toml")
    async with standing(port, "px4"):
        checks = await checks_of(config, port, skips=1)
    assert checks["script-closes"]["status"] == "not-applicable"
    assert checks["board-dither"]["text"] == "not answered"


async def test_px4_lets_no_valve_click_and_says_why(tmp_path: Path) -> None:
    port = free_port()
    config = example(tmp_path).with_name("px4.toml")
    async with standing(port, "px4") as (_, orders), guided(config, port, "--click") as doctor:
        await doctor.answer("valve 1 (1 of 6): Enter clicks", "\n")
        code, result = await doctor.ended()
    assert code == 1
    assert {order.pulse_us for order in orders} <= {0, 900}
    first = result["checks"][0]
    assert first["text"].startswith("nothing was opened: servo outputs of this autopilot follow")
    assert first["fix"] == 'use valves on GPIO (output.kind = "gpio")'


async def test_what_only_a_person_sees_is_asked(tmp_path: Path) -> None:
    config, port = example(tmp_path), free_port()
    fitted = ("--no-link", "--set", "safety.pump_cutoff=true", "--set", "output.dither_us=8")
    async with guided(config, port, "--watchdogs", *fitted) as doctor:
        await doctor.answer("did it close within half a second?", "what\n")
        await doctor.answer("[y/n, s skips]", "y\n")
        await doctor.answer("did it stop?", "n\n")
        code, result = await doctor.ended()
    assert code == 1
    status = {check["name"]: check["status"] for check in result["checks"]}
    assert (status["board-dither"], status["pump-cutoff-works"]) == ("ok", "fail")
    assert (status["dead-man"], status["estop-works"]) == ("not-applicable",) * 2
    assert status["script-closes"] == "not-applicable"
