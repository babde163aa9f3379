"""`vrspray sitl serve` as a process: it flies, writes the truth, and says what is wrong."""

from __future__ import annotations

import asyncio
import json
import signal
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.cli.app import execute
from sitl.stub.protocol import dialect
from tests.companion.wire_peer import free_port
from tests.sitl.realtime.test_stub_links import Client, udp_client

pytestmark = pytest.mark.sitl
Captured = pytest.CaptureFixture[str]

MISSION = (
    "QGC WPL 110\n"
    "0 1 0 16 0 0 0 0 36.0 114.5 60 1\n"
    "1 0 3 22 0 0 0 0 36.0 114.5 2.0 1\n"
    "2 0 3 16 0 0 0 0 36.0002 114.5 2.0 1\n"
)
SERVE = (sys.executable, "-c", "from sitl.cli import app; app()", "serve", "--json")


async def start(*options: str) -> asyncio.subprocess.Process:
    pipe = asyncio.subprocess.PIPE
    return await asyncio.create_subprocess_exec(*SERVE, *options, stdout=pipe, stderr=pipe)


async def ended(process: asyncio.subprocess.Process) -> tuple[int, str, str]:
    async with asyncio.timeout(60.0):
        out, err = await process.communicate()
    assert process.returncode is not None
    return process.returncode, out.decode(), err.decode()


def half_open_servos(client: Client) -> None:
    """Open every valve half, as ArduPilot wants it."""
    for channel in range(9, 15):
        client.command(dialect.MAV_CMD_DO_SET_SERVO, channel, 1500)


def half_open_actuators(client: Client) -> None:
    """Open every valve half, as PX4 wants it."""
    client.command(dialect.MAV_CMD_DO_SET_ACTUATOR, *(0.0,) * 6, 0)


async def play_companion(
    client: Client, half_open: Callable[[Client], None] = half_open_servos
) -> None:
    """Be heard, take the enable, open every valve half."""
    await client.hear("HEARTBEAT", within_s=20.0)
    client.say(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
    order = await client.hear("COMMAND_LONG", within_s=20.0)
    assert (order.command, order.param1, order.target_component) == (216, 1.0, 191)
    client.say(dialect.MAVLink_command_ack_message(order.command, 0, 0, 0, 255, 190))
    half_open(client)


async def test_a_flight_ends_with_the_truth_on_disk(tmp_path: Path) -> None:
    mission = tmp_path / "short.waypoints"
    mission.write_text(MISSION)
    port, out = free_port(), tmp_path / "truth"
    async with udp_client(local=port) as client:
        process = await start(
            *("--link", f"udpout:127.0.0.1:{port}"),
            *("--mission", str(mission), "--out", str(out), "--speed", "10", "--no-script"),
        )
        await play_companion(client)
        code, stdout, stderr = await ended(process)
    assert code == 0, stderr
    result = json.loads(stdout)
    assert result["state"] == "landed"
    assert result["enabled"] is True
    assert result["distance_m"] == pytest.approx(22.2, abs=1.5)
    assert "flying" in stderr
    summary = json.loads((out / "truth.json").read_text())
    assert summary["origin"]["latitude_deg"] == pytest.approx(36.0)
    check_truth(dict(np.load(out / "truth.npz")), result)


def check_truth(truth: dict[str, Any], result: dict[str, Any]) -> None:
    volume_ml = truth["volume_ml"]
    assert volume_ml.shape == (len(truth["time_s"]), 6)
    assert np.all(np.diff(volume_ml, axis=0) >= -1e-9)
    assert volume_ml[-1].sum() / 1000.0 == pytest.approx(result["volume_l"], rel=0.01)
    assert list(truth["order_pulse_us"]) == [1500] * 6
    assert list(truth["order_valve"]) == [0, 1, 2, 3, 4, 5]
    # Nothing flows before the first order, and something does within 0.25 s of it.
    first_s = truth["order_time_s"][0]
    assert not volume_ml[truth["time_s"] < first_s].any()
    assert volume_ml[truth["time_s"] < first_s + 0.25][-1].all()
    assert truth["north_m"].max() == pytest.approx(22.2, abs=0.5)


async def test_a_flight_on_px4_sprays_with_actuators(tmp_path: Path) -> None:
    mission = tmp_path / "short.waypoints"
    mission.write_text(MISSION)
    port, out = free_port(), tmp_path / "truth"
    async with udp_client(local=port) as client:
        process = await start(
            *("--link", f"udpout:127.0.0.1:{port}", "--autopilot", "px4"),
            *("--mission", str(mission), "--out", str(out), "--speed", "10"),
        )
        await play_companion(client, half_open_actuators)
        code, stdout, stderr = await ended(process)
    assert code == 0, stderr
    result = json.loads(stdout)
    assert (result["state"], result["enabled"]) == ("landed", True)
    assert result["volume_l"] > 0.0
    pulses_us = list(np.load(out / "truth.npz")["order_pulse_us"])
    # Disarmed from the start, open by the order, disarmed after the landing.
    assert pulses_us[:6] == [900] * 6
    assert pulses_us[-12:] == [1500] * 6 + [900] * 6


async def test_an_interrupt_ends_cleanly_with_the_truth_so_far(tmp_path: Path) -> None:
    port = free_port()
    async with udp_client(local=port) as client:
        process = await start("--link", f"udpout:127.0.0.1:{port}", "--out", str(tmp_path / "t"))
        await client.hear("HEARTBEAT", within_s=20.0)
        process.send_signal(signal.SIGINT)
        code, stdout, stderr = await ended(process)
    assert (code, json.loads(stdout)["state"]) == (0, "stopped")
    assert "Traceback" not in stderr
    assert (tmp_path / "t" / "truth.json").exists()


async def test_without_a_companion_it_gives_up_after_the_wait() -> None:
    process = await start("--link", f"udpout:127.0.0.1:{free_port()}", "--wait-s", "0.2")
    code, stdout, _ = await ended(process)
    assert (code, json.loads(stdout)["state"]) == (1, "no companion")


def options_refused(folder: Path) -> dict[str, tuple[tuple[str, ...], str]]:
    """Return what is wrong on the command line, and what has to be in the message."""
    (folder / "broken.waypoints").write_text("nonsense")
    (folder / "broken.toml").write_text("[[fault]]\nkind = 'gremlins'\n")
    (folder / "version.toml").write_text("[firmware]\nversion = '1.16.0'\n")
    servo = "3 0 2 183 9 1500 0 0 0 0 0 1\n"
    (folder / "servo.waypoints").write_text(MISSION + servo)
    (folder / "grounded.waypoints").write_text(MISSION.replace("1 0 3 22", "1 0 3 16"))
    return {
        "no take-off": (("--mission", str(folder / "grounded.waypoints")), "take-off"),
        "mission": (("--mission", str(folder / "broken.waypoints")), "QGC WPL 110"),
        "scenario": (("--scenario", str(folder / "broken.toml")), "gremlins"),
        "config": (("--field-config", str(folder / "none.toml")), "none.toml"),
        "profile": (("--profile", "none"), "none"),
        "link": (("--link", "carrier-pigeon"), "KIND:HOST:PORT"),
        "speed": (("--speed", "nan"), "--speed nan"),
        "autopilot": (("--autopilot", "betaflight"), "betaflight"),
        "version": (("--scenario", str(folder / "version.toml")), "known from 4.0.0 on"),
        "px4 mission": (
            ("--autopilot", "px4", "--mission", str(folder / "servo.waypoints")),
            "183",
        ),
    }


WRONG = (
    *("autopilot", "config", "link", "mission", "no take-off", "profile", "px4 mission"),
    *("scenario", "speed", "version"),
)


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_input_is_told_in_one_line(tmp_path: Path, wrong: str, capsys: Captured) -> None:
    options, said = options_refused(tmp_path)[wrong]
    refused(capsys, said, *options)


def test_a_port_in_use_is_told_in_one_line(capsys: Captured) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        refused(capsys, "in use", "--link", f"udpin:127.0.0.1:{taken.getsockname()[1]}")


def refused(capsys: Captured, said: str, *options: str) -> None:
    assert execute(["sitl", "serve", "--json", *options]) == 2
    told = capsys.readouterr()
    assert said in json.loads(told.out)["error"]
    assert len(told.err.strip().splitlines()) == 1
