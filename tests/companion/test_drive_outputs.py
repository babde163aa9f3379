"""Motors at the outputs: on the autopilot, on hardware PWM, beside valves that hang elsewhere."""

from __future__ import annotations

import asyncio
import os
from dataclasses import replace
from pathlib import Path

import pytest

from companion.core.types import DriveChange, DrivePlan, SprayPlan, TimedChange
from companion.errors import ActuatorError
from companion.output.autopilot_guard import findings
from companion.output.autopilot_options import DriveOutput, ServoOptions
from companion.output.composite import CompositeExecutor, Part
from companion.output.engine import closer
from companion.output.hardware_pwm import HardwarePwmExecutor, PwmDrive
from companion.output.servo import ServoExecutor
from companion.output.timed import DryRunExecutor
from tests.builders import now, plan

PUMP = DriveOutput(channel=5, stop_us=1100, max_us=1900)


def with_drives(made: SprayPlan, *fractions: float) -> SprayPlan:
    return replace(made, drives=tuple(DrivePlan(fraction=fraction) for fraction in fractions))


class Wire:
    """What was ordered, in its order."""

    def __init__(self, **options: object) -> None:
        self.told: list[tuple[int, int]] = []
        self.heard = asyncio.Event()
        given: dict[str, object] = {"channels": (9,), "drives": (PUMP,)}
        self.executor = ServoExecutor(ServoOptions(**(given | options)), self.order)  # type: ignore[arg-type]

    def order(self, channel: int, pulse_us: int) -> bool:
        self.told.append((channel, pulse_us))
        self.heard.set()
        return True

    def last(self, channel: int) -> int:
        return [pulse for number, pulse in self.told if number == channel][-1]


async def test_a_servo_output_carries_a_drive_between_its_own_ends() -> None:
    wire = Wire()
    await wire.executor.start()
    assert wire.told == [(5, 1100), (9, 1000)]
    soon = DriveChange(at_s=now() + 0.02, fraction=1.0)
    half = replace(plan(1, 1.0), drives=(DrivePlan(fraction=0.5, changes=(soon,)),))
    wire.executor.submit(half)
    assert wire.told[2:] == [(9, 2000), (5, 1500)]  # a way out first, then the pump
    await asyncio.sleep(0.05)
    assert wire.last(5) == 1900
    wire.executor.submit(plan(2, 0.0))
    assert wire.told[-2:] == [(5, 1100), (9, 1000)]  # and the pump ahead of the valve
    await wire.executor.stop()


async def test_the_end_of_the_lease_a_fault_and_the_end_stop_a_drive() -> None:
    wire = Wire()
    await wire.executor.start()
    wire.executor.submit(with_drives(plan(1, 1.0, lease_s=0.03), 0.5))
    await asyncio.sleep(0.08)
    assert (wire.last(5), wire.last(9)) == (1100, 1000)
    assert wire.executor.lease_end_count == 1
    wire.executor.submit(with_drives(plan(2, 1.0), 0.5))
    assert wire.last(5) == 1500
    wire.executor.acknowledge(4)
    assert wire.executor.fault is not None
    assert (wire.last(5), wire.last(9)) == (1100, 1000)
    await wire.executor.stop()
    assert wire.told[-2:] == [(5, 1100), (9, 1000)]


async def test_drives_need_no_valves_and_a_plan_must_know_them_all() -> None:
    wire = Wire(channels=(), dither_us=8)
    await wire.executor.start()
    wire.executor.submit(with_drives(plan(1), 0.25))
    assert wire.last(5) == 1300
    with pytest.raises(ValueError, match="drives"):
        wire.executor.submit(with_drives(plan(2), 0.25, 0.5))
    await asyncio.sleep(0.25)
    assert {pulse for _, pulse in wire.told} == {1100, 1300}  # motors are not dithered
    await wire.executor.stop()


async def test_a_drive_is_said_again_from_time_to_time() -> None:
    wire = Wire(refresh_s=0.05)
    await wire.executor.start()
    wire.executor.submit(with_drives(plan(1, 1.0), 0.5))
    before = len(wire.told)
    async with asyncio.timeout(10.0):
        while (5, 1500) not in wire.told[before:]:
            wire.heard.clear()
            await wire.heard.wait()
    await wire.executor.stop()


async def test_one_order_of_px4_carries_valves_and_drives() -> None:
    sent: list[dict[int, int]] = []
    staged: dict[int, int] = {}

    def flush() -> bool:
        sent.append(dict(staged))
        return True

    def order(channel: int, pulse_us: int) -> bool:
        staged[channel] = pulse_us
        return True

    options = ServoOptions(channels=(1,), drives=(replace(PUMP, channel=2),))
    executor = ServoExecutor(options, order, flush=flush)
    await executor.start()
    executor.met(is_px4=True)
    count = len(sent)
    executor.submit(with_drives(plan(1, 1.0), 0.5))
    assert sent[count:] == [{1: 2000, 2: 1500}]
    await executor.stop()


async def test_a_dry_run_leaves_drives_alone() -> None:
    executor = DryRunExecutor(1)
    await executor.start()
    executor.submit(with_drives(plan(1, 0.5), 0.5, 0.7))
    assert [change.valve for change in executor.changes] == [0, 0]
    await executor.stop()


def test_px4s_parameters_of_a_drive() -> None:
    options = ServoOptions(channels=(1,), drives=(DriveOutput(channel=2, stop_us=1100),))
    known: dict[str, float | None] = {
        "PWM_MAIN_FUNC1": 301.0, "PWM_MAIN_FUNC2": 302.0,
        "PWM_MAIN_MIN1": 1000.0, "PWM_MAIN_MAX1": 2000.0, "PWM_MAIN_DIS1": 1000.0,
        "PWM_MAIN_MIN2": 1000.0, "PWM_MAIN_MAX2": 2000.0, "PWM_MAIN_DIS2": 1100.0,
    }  # fmt: skip
    assert findings(options, known, is_px4=True) == []
    (found,) = findings(options, known | {"PWM_MAIN_DIS2": 1500.0}, is_px4=True)
    assert found.is_fault
    assert found.text == "PWM_MAIN_DIS2 is 1500: set it to 1100, else disarming opens"
    wide = replace(options, drives=(DriveOutput(channel=2, max_us=2100),))
    assert any("within 1000 to 2000" in f.text for f in findings(wide, known, is_px4=True))


@pytest.mark.parametrize(("stop_us", "max_us"), [(2000, 1000), (400, 2000), (1000, 2600)])
def test_ends_that_are_none_are_refused(stop_us: int, max_us: int) -> None:
    with pytest.raises(ValueError, match="stop_us"):
        DriveOutput(channel=1, stop_us=stop_us, max_us=max_us)


# --------------------------------------------------------------------------------- hardware PWM


def sysfs(root: Path, *, is_exported: bool = True) -> Path:
    """Make what the kernel shows of one output; return its folder."""
    chip = root / "pwmchip0"
    folder = chip / "pwm1"
    folder.mkdir(parents=True)
    (chip / "export").write_text("")
    if is_exported:
        make_files(folder)
    else:
        folder.rmdir()
    return folder


def make_files(folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    for name in ("period", "duty_cycle", "enable"):
        (folder / name).write_text("0")


def read(folder: Path) -> tuple[int, int, int]:
    period, duty, enable = (
        int((folder / name).read_text()) for name in ("period", "duty_cycle", "enable")
    )
    return period, duty, enable


def hardware(root: Path) -> HardwarePwmExecutor:
    drive = PwmDrive(chip=0, drive=replace(PUMP, channel=1))
    return HardwarePwmExecutor((drive,), root=root)


async def test_hardware_pwm_pulses_at_stop_follows_and_is_switched_off(tmp_path: Path) -> None:
    folder, executor = sysfs(tmp_path), hardware(tmp_path)
    await executor.start()
    assert read(folder) == (20_000_000, 1_100_000, 1)
    executor.submit(with_drives(plan(1, lease_s=0.05), 0.5))
    assert read(folder) == (20_000_000, 1_500_000, 1)
    await asyncio.sleep(0.1)
    assert read(folder) == (20_000_000, 1_100_000, 1)  # the lease has ended
    executor.submit(with_drives(plan(2), 1.0))
    assert read(folder)[1] == 1_900_000
    await executor.stop()
    assert read(folder) == (20_000_000, 1_100_000, 0)
    await executor.stop()


async def test_an_output_is_exported_and_awaited(tmp_path: Path) -> None:
    folder, executor = sysfs(tmp_path, is_exported=False), hardware(tmp_path)
    asyncio.get_running_loop().call_later(0.05, make_files, folder)
    await executor.start()
    assert (tmp_path / "pwmchip0" / "export").read_text() == "1"
    assert read(folder)[2] == 1
    await executor.stop()


async def test_an_output_that_is_not_there_refuses_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.output.hardware_pwm.EXPORT_MAX_S", 0.03)
    with pytest.raises(ActuatorError, match=r"pwmchip0/pwm1: No such file.*overlay"):
        await hardware(tmp_path).start()


async def test_what_cannot_be_written_is_a_fault_and_stays_one(tmp_path: Path) -> None:
    folder, executor = sysfs(tmp_path), hardware(tmp_path)
    await executor.start()
    (folder / "duty_cycle").unlink()
    (folder / "duty_cycle").mkdir()
    executor.submit(with_drives(plan(1), 0.5))
    assert executor.fault == "hardware PWM pwm1: Is a directory"
    os.rmdir(folder / "duty_cycle")  # noqa: PTH106
    executor.submit(with_drives(plan(2), 0.5))
    assert (folder / "duty_cycle").read_text() == "1100000"  # it is stopped, whatever is asked
    await executor.stop()


def test_the_closer_stops_a_motor_that_pulses_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = sysfs(tmp_path)
    (folder / "duty_cycle").write_text("1800000")
    (folder / "enable").write_text("1")
    root = ["--pwm-root", str(tmp_path)]
    assert closer.main([*root, "--pwm", "0:1:1100", "0:7:1000"]) == 0
    assert read(folder)[1:] == (1_100_000, 0)
    (folder / "enable").unlink()
    (folder / "enable").mkdir()
    assert closer.main([*root, "--pwm", "0:1:1100"]) == 1
    assert "closer: --pwm 0:1:1100" in capsys.readouterr().err
    assert closer.main([*root, "--pwm", "nonsense"]) == 1


# ------------------------------------------------------------------------------------ composite


async def test_each_part_gets_what_is_its(tmp_path: Path) -> None:
    folder = sysfs(tmp_path)
    valves, atomisers = DryRunExecutor(2), Wire(channels=(), drives=(PUMP,))
    whole = CompositeExecutor(
        [
            Part(executor=valves, has_valves=True),
            Part(executor=hardware(tmp_path), drives=(0,)),
            Part(executor=atomisers.executor, drives=(1,)),
        ]
    )
    await whole.start()
    change = TimedChange(at_s=now() + 0.02, valve=1, duty=1.0)
    whole.submit(with_drives(plan(1, 1.0, 0.0, changes=(change,)), 0.25, 0.5))
    assert read(folder)[1] == 1_300_000
    assert atomisers.last(5) == 1500
    await asyncio.sleep(0.05)
    assert [(c.valve, c.duty) for c in valves.changes][-2:] == [(0, 1.0), (1, 1.0)]
    await whole.stop()
    assert (read(folder)[1:], atomisers.last(5)) == ((1_100_000, 0), 1100)
    assert [(c.valve, c.duty) for c in valves.changes][-2:] == [(0, 0.0), (1, 0.0)]


async def test_a_fault_of_one_stops_all() -> None:
    valves, motors = DryRunExecutor(1), Wire(channels=())
    whole = CompositeExecutor(
        [Part(executor=valves, has_valves=True), Part(executor=motors.executor, drives=(0,))]
    )
    await whole.start()
    whole.submit(with_drives(plan(1, 1.0), 0.5))
    motors.executor.acknowledge(4)
    assert whole.fault == motors.executor.fault
    whole.submit(with_drives(plan(2, 1.0), 0.5))
    assert valves.changes[-1].duty == 0.0
    assert motors.last(5) == 1100
    await whole.stop()


async def test_valves_that_cannot_be_had_let_the_drives_go(tmp_path: Path) -> None:
    class Refuses(DryRunExecutor):
        async def start(self) -> None:
            raise ActuatorError("busy")

    folder = sysfs(tmp_path)
    whole = CompositeExecutor(
        [
            Part(executor=Refuses(1), has_valves=True),
            Part(executor=hardware(tmp_path), drives=(0,)),
        ]
    )
    with pytest.raises(ActuatorError, match="busy"):
        await whole.start()
    assert read(folder)[2] == 0


def test_a_composite_has_parts_and_the_valves_once() -> None:
    twice = [Part(executor=DryRunExecutor(1), has_valves=True)] * 2
    for parts in ([], twice):
        with pytest.raises(ValueError, match="parts"):
            CompositeExecutor(parts)
