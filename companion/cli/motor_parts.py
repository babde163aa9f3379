"""From the configuration to the outputs of the motors: pump first, then the atomisers."""

from __future__ import annotations

from dataclasses import dataclass

from companion.config import Config
from companion.output.autopilot_options import DriveOutput
from companion.output.hardware_pwm import PwmDrive


@dataclass(frozen=True, slots=True, kw_only=True)
class Motor:
    """An output of a motor, on the autopilot or on a PWM chip of this computer."""

    drive: DriveOutput
    chip: int | None = None


def motors(config: Config) -> tuple[Motor, ...]:
    """Return all motors in the order of a plan's drives; none in a dry run."""
    if config.output.kind == "none":
        return ()
    found = []
    if config.pump is not None:
        pump = config.pump
        drive = DriveOutput(channel=pump.channel, stop_us=pump.stop_us, max_us=pump.max_us)
        found.append(Motor(drive=drive, chip=pump.chip if pump.output == "pwm" else None))
    for table in config.atomiser:
        drive = DriveOutput(channel=table.channel, stop_us=table.stop_us, max_us=table.us[-1])
        found.append(Motor(drive=drive, chip=table.chip if table.output == "pwm" else None))
    return tuple(found)


def pwm_drives(config: Config) -> tuple[PwmDrive, ...]:
    """Return the motors on this computer's hardware PWM."""
    return tuple(
        PwmDrive(chip=motor.chip, drive=motor.drive)
        for motor in motors(config)
        if motor.chip is not None
    )


def drive_numbers(config: Config, *, is_pwm: bool) -> tuple[int, ...]:
    """Return which of a plan's drives hang on hardware PWM, or on the autopilot."""
    return tuple(
        number for number, motor in enumerate(motors(config)) if (motor.chip is not None) == is_pwm
    )


def motor_closer_arguments(config: Config) -> list[str]:
    """Return the closer's arguments that stop what pulses on after this process."""
    drives = pwm_drives(config)
    given = [f"{each.chip}:{each.drive.channel}:{each.drive.stop_us}" for each in drives]
    return ["--pwm", *given] if given else []
