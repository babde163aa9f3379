"""`vrspray doctor --click` beside a vehicle on the ground: by ear, and by the meter."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from itertools import pairwise
from pathlib import Path

import pytest

from tests.companion.realtime.doctor_bench import guided
from tests.companion.realtime.ground_bench import example, standing
from tests.companion.wire_peer import WirePeer, free_port, over_udp

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(120)]


async def test_each_valve_clicks_twice_and_the_operator_says_what_was_heard(
    tmp_path: Path,
) -> None:
    peer, port = standing(), free_port()
    async with over_udp(peer, port), guided(example(tmp_path), port, "--click") as doctor:
        await doctor.answer("valve 1 (1 of 6): Enter clicks", "\n")
        await doctor.answer("did valve 1 click?", "again\n")
        await doctor.answer("did valve 1 click?", "what\n")
        await doctor.answer("did valve 1 click?", "y\n")
        await doctor.answer("valve 2 (2 of 6)", "\n")
        await doctor.answer("did valve 2 click?", "n\n")
        await doctor.answer("valve 3 (3 of 6)", "\n")
        await doctor.answer("did valve 3 click?", "5\n")
        await doctor.answer("valve 4 (4 of 6)", "q\n")
        code, result = await doctor.ended()
        assert code == 1, doctor.told.decode()
        assert peer.is_all_closed
    checks = {check["name"]: check for check in result["checks"]}
    assert [check["status"] for check in result["checks"]] == ["ok", "fail", "fail"] + [
        "not-applicable"
    ] * 3
    assert checks["click-2"]["text"] == "did not click"
    assert "output 10" in checks["click-2"]["fix"]
    assert checks["click-3"]["text"] == "valve 5 clicked in its place"
    # Twice for each click; the first valve was asked for again.
    assert [openings(peer, channel) for channel in range(9, 15)] == [4, 2, 2, 0, 0, 0]


def openings(peer: WirePeer, channel: int) -> int:
    """Return how often an output went from closed to open; an order may be said again."""
    pulses_us = [order.pulse_us for order in peer.orders if order.channel == channel]
    return sum(before <= 1000 < after for before, after in pairwise([1000, *pulses_us]))


async def test_an_armed_vehicle_is_refused_and_nothing_opens(tmp_path: Path) -> None:
    peer, port = standing(), free_port()
    peer.armed = True
    async with over_udp(peer, port), guided(example(tmp_path), port, "--click") as doctor:
        await doctor.answer("valve 1 (1 of 6)", "\n")
        code, result = await doctor.ended()
    assert code == 1
    first, *rest = result["checks"]
    assert (first["status"], first["fix"]) == ("fail", "disarm it")
    assert "the vehicle is armed" in first["text"]
    assert {check["status"] for check in rest} == {"not-applicable"}
    assert not [order for order in peer.orders if order.pulse_us > 1000]


async def test_ctrl_c_between_the_valves_ends_it(tmp_path: Path) -> None:
    peer, port = standing(), free_port()
    async with over_udp(peer, port), guided(example(tmp_path), port, "--click") as doctor:
        await doctor.until_told("valve 1 (1 of 6)")
        doctor.process.send_signal(signal.SIGINT)
        code, _ = await doctor.ended()
        assert code == 130
        assert b"Traceback" not in doctor.told


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--click",), "stdin is not a terminal"),
        (("--click", "--set", "output.kind=none"), "there are no valves to click"),
        (("--click", "--wet"), "needs a flow meter"),
    ],
)
def test_what_cannot_be_done_is_refused_in_one_line(
    tmp_path: Path, arguments: tuple[str, ...], said: str
) -> None:
    command = (sys.executable, "-m", "companion", "doctor", "--config", str(example(tmp_path)))
    done = subprocess.run(
        (*command, *arguments),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert said in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


@asynccontextmanager
async def simulated(port: int, scenario: Path) -> AsyncIterator[None]:
    """Have a vehicle with a sprayer stand on the ground."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "companion", "sitl", "serve", "--ground", "--seed", "3"),
        *("--link", f"udpout:127.0.0.1:{port}", "--scenario", str(scenario)),
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.DEVNULL,
    )
    try:
        yield
    finally:
        process.terminate()
        await process.wait()


async def test_the_meter_tells_a_clogged_and_a_dead_valve(tmp_path: Path) -> None:
    port, scenario = free_port(), tmp_path / "faults.toml"
    scenario.write_text(
        "[sensors]\nmeter_battery = 1\n"
        '[[liquid]]\nkind = "clog"\nshare = 0.4\nvalve = 2\n'
        '[[liquid]]\nkind = "stuck-closed"\nvalve = 4\n'
    )
    source = ("--set", "flow_meter.source=autopilot")
    async with (
        simulated(port, scenario),
        guided(example(tmp_path), port, "--click", "--wet", *source) as doctor,
    ):
        for valve in range(1, 7):
            await doctor.answer(f"valve {valve} ({valve} of 6): Enter", "\n")
            await doctor.hold_until(f"valve {valve + 1} (")
        code, result = await doctor.ended()
        assert code == 1, doctor.told.decode()
    checks = {check["name"]: check for check in result["checks"]}
    status = [checks[f"click-{valve}"]["status"] for valve in range(1, 7)]
    assert status == ["ok", "fail", "ok", "fail", "ok", "ok"], checks
    assert "clogged" in checks["click-2"]["text"]
    assert "delivers nothing" in checks["click-4"]["text"]
    assert checks["click-flow"]["status"] == "ok"
