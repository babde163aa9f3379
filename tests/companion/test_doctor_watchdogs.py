"""The watchdogs' checks: what was tried and what the operator said, and what it means."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import pytest

from companion.cli.doctor_watchdogs import (
    ScriptTrial,
    Systemd,
    asked_check,
    engine_checks,
    questions,
    script_check,
    seconds_of,
    systemd_checks,
    try_script,
)
from companion.core.types import HeartbeatReport, Input, LandedReport, PwmLimits, SprayPlan
from companion.doctor import gpio
from companion.doctor.check import Check, Status, is_ready
from companion.doctor.gpio import EngineTrial, try_engine
from companion.ground.work import GroundSetup
from companion.output.autopilot_options import ServoOptions
from companion.output.engine.wire import EngineSetup, Wiring
from companion.output.gpio import GpioExecutor

PWM = PwmLimits(frequency_hz=11.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01)
WELL = EngineTrial(lease_s=0.01, killed_s=0.02, alive_changes=8)
UNIT = {
    "LoadState": "loaded",
    "ActiveState": "active",
    "WatchdogUSec": "2s",
    "WatchdogTimestampMonotonic": "99500000",
}
FED = Systemd(runtime_watchdog="15s", unit=UNIT, now_s=100.0, has_closer=True)


def statuses(found: Sequence[Check]) -> dict[str, Status]:
    return {check.name: check.status for check in found}


@pytest.mark.parametrize(
    ("found", "name", "status"),
    [
        (WELL, "engine-lease", Status.OK),
        (replace(WELL, lease_s=None), "engine-lease", Status.FAIL),
        (replace(WELL, lease_s=0.4), "engine-lease", Status.FAIL),
        (replace(WELL, lease_s=float("nan")), "engine-lease", Status.FAIL),
        (WELL, "engine-killed", Status.OK),
        (replace(WELL, killed_s=None), "engine-killed", Status.FAIL),
        (WELL, "engine-alive", Status.OK),
        (replace(WELL, alive_changes=None), "engine-alive", Status.NOT_APPLICABLE),
        (replace(WELL, alive_changes=1), "engine-alive", Status.FAIL),
        (replace(WELL, is_alive_after=True), "engine-alive", Status.FAIL),
        (EngineTrial(problem="no"), "engine-lease", Status.FAIL),
        (EngineTrial(problem="no"), "engine-killed", Status.NOT_APPLICABLE),
        (None, "engine-lease", Status.NOT_APPLICABLE),
    ],
)
def test_the_engine_is_judged_by_when_it_closed(
    found: EngineTrial | None, name: str, status: Status
) -> None:
    assert statuses([*engine_checks(found, lease_s=0.3)])[name] is status


async def test_the_engine_closes_without_plans_and_when_it_is_killed() -> None:
    wiring = Wiring(valves=(3, 4, 5), return_line=7, alive_line=9, normally_open=True)
    found = await try_engine(EngineSetup(wiring=wiring, pwm=PWM, realtime=False), lease_s=0.3)
    assert found.problem is None
    assert found.lease_s is not None
    assert found.killed_s is not None
    assert found.alive_changes is not None
    assert found.alive_changes >= 2
    assert not found.is_alive_after


class Deaf(GpioExecutor):
    """An executor whose plans go nowhere; those that were made are kept."""

    made: ClassVar[list[Deaf]] = []

    async def start(self) -> None:
        self.made.append(self)
        await super().start()

    def submit(self, plan: SprayPlan) -> None:
        pass


async def test_an_engine_that_opens_nothing_is_said_and_is_stopped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(gpio, "GpioExecutor", Deaf)
    wiring = Wiring(valves=(3, 4))
    found = await try_engine(EngineSetup(wiring=wiring, pwm=PWM, realtime=False), lease_s=0.3)
    assert found.problem == "the engine opened nothing"
    assert [executor.engine_pid for executor in Deaf.made] == [None]


class BrokenLink:
    """A link beside a disarmed ArduPilot that fails once an output was moved."""

    def __init__(self) -> None:
        self.orders: list[int] = []
        self.is_closed = False
        self.rival = None
        self._listener: Any = None

    def follow_outputs(self, listener: object) -> None:
        self._listener = listener

    async def open(self, wake: object) -> None:
        self._listener.met(is_px4=False)

    def receive(self) -> list[Input]:
        if self.orders:
            raise OSError("gone")
        now_s = time.monotonic()
        heartbeat = HeartbeatReport(
            received_s=now_s, autopilot="ardupilot", armed=False, mode="LOITER"
        )
        return [heartbeat, LandedReport(received_s=now_s, in_air=False, on_ground=True)]

    def tell(self, decision: object, now_s: float) -> None:
        pass

    def order(self, channel: int, pulse_us: int) -> bool:
        self.orders.append(pulse_us)
        return True

    def flush_orders(self) -> bool:
        return True

    async def close(self) -> None:
        self.is_closed = True


async def test_a_moved_output_is_ordered_closed_whatever_happens() -> None:
    link = BrokenLink()
    with pytest.raises(OSError, match="gone"):
        await try_script(
            link,  # type: ignore[arg-type]
            ServoOptions(channels=(9,)),
            wait_s=5.0,
            setup=GroundSetup(has_servo_outputs=True),
        )
    assert link.orders == [1004, 1000]
    assert link.is_closed


def test_the_page_that_a_failed_trial_names_says_what_to_set() -> None:
    fix = script_check(ScriptTrial(open_s=0.36, closed_s=0.5)).fix or ""
    page = Path(__file__).parents[2] / fix.rpartition(": ")[2]
    assert "SPRW_TIMEOUT_MS" in fix
    assert "`SPRW_TIMEOUT_MS`" in page.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("found", "status"),
    [
        (ScriptTrial(open_s=0.2, closed_s=0.3), Status.OK),
        (ScriptTrial(open_s=0.36, closed_s=0.5), Status.FAIL),
        (ScriptTrial(open_s=float("nan"), closed_s=0.5), Status.FAIL),
        (ScriptTrial(open_s=1.9), Status.FAIL),
        (ScriptTrial(problem="nothing tells"), Status.FAIL),
        (ScriptTrial(reasons=frozenset({"armed"})), Status.FAIL),
        (ScriptTrial(is_px4=True), Status.NOT_APPLICABLE),
        (None, Status.NOT_APPLICABLE),
    ],
)
def test_the_script_is_judged_by_the_last_report_that_was_not_closed(
    found: ScriptTrial | None, status: Status
) -> None:
    assert script_check(found, why="left out", words="armed; disarm it").status is status


@pytest.mark.parametrize(
    ("found", "name", "status"),
    [
        (FED, "system-watchdog", Status.OK),
        (replace(FED, runtime_watchdog="0"), "system-watchdog", Status.WARN),
        (replace(FED, runtime_watchdog="infinity"), "system-watchdog", Status.WARN),
        (replace(FED, runtime_watchdog="1min"), "system-watchdog", Status.WARN),
        (replace(FED, runtime_watchdog=None), "system-watchdog", Status.NOT_APPLICABLE),
        (FED, "watchdog-feed", Status.OK),
        (replace(FED, now_s=102.0), "watchdog-feed", Status.FAIL),
        (replace(FED, now_s=float("nan")), "watchdog-feed", Status.FAIL),
        (
            replace(FED, unit={**UNIT, "WatchdogTimestampMonotonic": "0"}),
            "watchdog-feed",
            Status.FAIL,
        ),
        (replace(FED, unit={**UNIT, "WatchdogUSec": "0"}), "watchdog-feed", Status.WARN),
        (
            replace(FED, unit={**UNIT, "ActiveState": "inactive"}),
            "watchdog-feed",
            Status.NOT_APPLICABLE,
        ),
        (replace(FED, unit=None), "watchdog-feed", Status.NOT_APPLICABLE),
        (
            replace(FED, unit={**UNIT, "LoadState": "not-found"}),
            "service-closer",
            Status.NOT_APPLICABLE,
        ),
        (FED, "service-closer", Status.OK),
        (replace(FED, has_closer=False), "service-closer", Status.WARN),
    ],
)
def test_what_systemd_says_is_judged(found: Systemd, name: str, status: Status) -> None:
    assert statuses([*systemd_checks(found)])[name] is status


@pytest.mark.parametrize("text", ["", "soon", "5 parsecs", "infinity", "1.2.3s"])
def test_a_time_that_is_none_is_none(text: str) -> None:
    assert seconds_of(text) is None


def test_only_what_is_fitted_is_asked_for() -> None:
    everything = questions(
        has_dither=True, is_servo=True, has_cutoff=True, has_alive=True, has_estop=True
    )
    nothing = questions(
        has_dither=False, is_servo=False, has_cutoff=False, has_alive=False, has_estop=False
    )
    assert all(question.applies for question in everything)
    assert {asked_check(question, True).status for question in nothing} == {Status.NOT_APPLICABLE}
    assert {asked_check(question, True).status for question in everything} == {Status.OK}
    assert {asked_check(question, False).status for question in everything} == {Status.FAIL}
    for question in everything:
        unasked = asked_check(question, None, why="is asked at a terminal only")
        assert unasked.status is Status.WARN
        assert not is_ready([unasked]), "what nobody has seen is not ready"
    assert is_ready([asked_check(question, True) for question in everything])
    assert is_ready([asked_check(question, None) for question in nothing])
