"""`vrspray doctor` with all its options beside a real ArduCopter that is ready to fly."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from tests.companion.realtime.doctor_bench import Guided, guided
from tests.firmware.fields import write_pass
from tests.firmware.firmware import vrspray
from tests.firmware.flights import COPTER, OPEN_US, PX4, Kind, both, ready
from tests.firmware.station import Station

pytestmark = [pytest.mark.firmware, pytest.mark.timeout(300)]


def checks(*options: str) -> tuple[int, dict[str, dict[str, Any]]]:
    """Run the doctor; return its exit code and its checks by name."""
    found = vrspray("doctor", *options, "--json")
    assert found.stdout, found.stderr
    return found.returncode, {one["name"]: one for one in json.loads(found.stdout)["checks"]}


@asynccontextmanager
async def logged(station: Station) -> AsyncIterator[None]:
    """Log what the vehicle sends while something else is waited for."""

    async def pump() -> None:
        while True:
            station.pump(0.0)
            await asyncio.sleep(0.005)

    pumping = asyncio.create_task(pump())
    try:
        yield
    finally:
        pumping.cancel()
        await asyncio.gather(pumping, return_exceptions=True)


ACTUATOR_TEST = 310
# As the firmwares are set up here; what has no meaning on one of them says so.
READY = ("link", "heartbeat", "streams", "vehicle-clock", "fix", "estimator", "output-parameters")
FURTHER = {
    "ardupilot": {"watchdog-script": "ok", "closed-order": "ok"},
    "px4": {"watchdog-script": "not-applicable", "closed-order": "not-applicable"},
}


@both
async def test_doctor_finds_a_ready_vehicle_ready(
    kind: Kind, firmwares: Path, tmp_path: Path, tell: Callable[[object], None]
) -> None:
    config = write_pass(tmp_path / "field", config=kind.config)
    chosen = ("--config", str(config), *kind.options)
    with ready(kind, tmp_path / "vehicle", firmwares) as vehicle:
        station = vehicle.station
        code, found = checks(*chosen, "--wait-s", "20")
        failed = [one for one in found.values() if one["status"] == "fail"]
        warned = [one["name"] for one in found.values() if one["status"] == "warn"]
        tell(f"nothing failed; to be seen to: {', '.join(warned)}")
        assert (code, failed) == (0, [])
        expected = {**dict.fromkeys(READY, "ok"), **FURTHER[kind.name]}
        assert {name: found[name]["status"] for name in expected} == expected

        code, found = checks(*chosen, "--no-link", "--set", "lag.on_s=0.11")
        assert code == 0
        assert found["heartbeat"]["status"] == "not-applicable"

        _, found = checks(*chosen, "--watchdogs")
        tell(found["script-closes"]["text"])
        assert found["script-closes"]["status"] == ("ok" if kind is COPTER else "not-applicable")

        refused = vrspray("doctor", *chosen, "--click", "--wet")
        assert refused.returncode == 2
        assert "needs a flow meter" in refused.stderr

        station.log.clear_flight()
        async with logged(station), guided(config, kind.port, "--click", *kind.options) as doctor:
            if kind is COPTER:
                await click_each(doctor)
                code, clicks = await doctor.ended()
                assert (code, [one["status"] for one in clicks["checks"][:6]]) == (0, ["ok"] * 6)
            else:
                await doctor.answer("valve 1 (1 of 6): Enter clicks", "\n")
                code, clicks = await doctor.ended()
                assert code == 1
                assert "only while it is armed (PX4)" in clicks["checks"][0]["text"]
        opened = [openings(station, output) for output in range(9, 15)]
        assert opened == [2 if kind is COPTER else 0] * 6
        assert not any(us > OPEN_US for us in station.log.pulses[-1].us[8:14])
        if kind is PX4:
            opens_by_its_own_test(station)


def opens_by_its_own_test(station: Station) -> None:
    """Have PX4 open a disarmed output for half a second, as docs/howto/ground-work.md says."""
    station.log.clear_flight()
    assert station.command(ACTUATOR_TEST, 1.0, 0.5, 0.0, 0.0, 1301.0) == 0
    station.for_s(1.5)
    assert [openings(station, output) for output in range(9, 15)] == [1, 0, 0, 0, 0, 0]
    assert not any(us > OPEN_US for us in station.log.pulses[-1].us[8:14])


async def click_each(doctor: Guided) -> None:
    """Have every valve clicked and heard."""
    for number in range(1, 7):
        await doctor.answer(f"valve {number} ({number} of 6): Enter clicks", "\n")
        await doctor.answer(f"did valve {number} click?", "y\n")


def openings(station: Station, output: int) -> int:
    """Return how often an output went from closed to open."""
    us = [one.us[output - 1] for one in station.log.pulses]
    return sum(before <= OPEN_US < after for before, after in pairwise([1000, *us]))
