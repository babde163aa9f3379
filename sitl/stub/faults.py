"""Faults by the clock: what goes wrong from when to when, read from a scenario file."""

from __future__ import annotations

from enum import StrEnum
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError


class FaultKind(StrEnum):
    """Everything that can be made to go wrong."""

    ACK_LOST = "ack-lost"
    ACK_LATE = "ack-late"
    ACK_DOUBLED = "ack-doubled"
    SERVO_REFUSED = "servo-refused"
    NO_POSITION = "no-position"
    STALE_POSITION = "stale-position"
    ZERO_POSITION = "zero-position"
    EXTREME_POSITION = "extreme-position"
    HEADING_UNKNOWN = "heading-unknown"
    GPS_DROP = "gps-drop"
    CLOCK_WRAP = "clock-wrap"
    CLOCK_BACKWARDS = "clock-backwards"
    REBOOT = "reboot"
    GARBAGE = "garbage"
    CORRUPT = "corrupt"
    FOREIGN = "foreign"
    SLOW_STREAMS = "slow-streams"
    SILENCE = "silence"
    MODE = "mode"
    ACK_IN_PROGRESS = "ack-in-progress"
    COMMAND_BLOCKED = "command-blocked"
    EKF_LOST = "ekf-lost"
    TRUNCATED = "truncated"
    MAVLINK1 = "mavlink1"
    UNKNOWN_ID = "unknown-id"
    SIGNED = "signed"
    SECOND_COMPANION = "second-companion"
    SECOND_VEHICLE = "second-vehicle"
    STATION_RATES = "station-rates"
    PARAM_LOST = "param-lost"
    SAFETY_SWITCH = "safety-switch"
    RC = "rc"
    KILL = "kill"
    TERMINATE = "terminate"


# The keys that mean something to a kind, beside when it is; of the others a file may set none.
_WHEN = {"kind", "at_s", "duration_s", "since"}
KEYS: dict[FaultKind, tuple[str, ...]] = {
    FaultKind.ACK_LOST: ("fraction", "command"),
    FaultKind.ACK_LATE: ("fraction", "command", "delay_s"),
    FaultKind.ACK_DOUBLED: ("fraction", "command"),
    FaultKind.ACK_IN_PROGRESS: ("fraction", "command", "delay_s"),
    FaultKind.COMMAND_BLOCKED: ("fraction", "command"),
    FaultKind.GPS_DROP: ("fix",),
    FaultKind.CLOCK_WRAP: ("delay_s",),
    FaultKind.CLOCK_BACKWARDS: ("delay_s",),
    FaultKind.GARBAGE: ("fraction",),
    FaultKind.CORRUPT: ("fraction",),
    FaultKind.TRUNCATED: ("fraction",),
    FaultKind.MAVLINK1: ("fraction",),
    FaultKind.UNKNOWN_ID: ("fraction",),
    FaultKind.SIGNED: ("fraction",),
    FaultKind.PARAM_LOST: ("fraction",),
    FaultKind.SLOW_STREAMS: ("factor",),
    FaultKind.STATION_RATES: ("rate_hz", "delay_s"),
    FaultKind.MODE: ("mode",),
    FaultKind.RC: ("channel", "pulse_us"),
}


class Strict(BaseModel):
    """A table of a scenario file, read as those of the configuration are."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def contradiction(key: str, text: str) -> PydanticCustomError:
    """Return what refuses a table for one of its keys."""
    return PydanticCustomError("contradiction", "{text}", {"text": text, "all": [(key, text)]})


class Fault(Strict):
    """One fault: `at_s` counts from the start of the stub, or from `since = "take-off"`.

    `fraction` is of the messages concerned; `delay_s` is of late acknowledgements, of the clock's
    jump, and between two requests of the other station; `factor` is of slow streams, `rate_hz` of
    the station's; `mode` is the number of an ArduCopter mode; `fix` a fix type; `command` the only
    one concerned, 0 is every command; `channel` and `pulse_us` are of the transmitter.
    """

    kind: FaultKind = Field(strict=False)
    at_s: float = Field(default=0.0, ge=0.0, lt=1e9)
    duration_s: float = Field(default=1e9, gt=0.0, le=1e9)
    since: Literal["start", "take-off"] = "start"
    fraction: float = Field(default=1.0, ge=0.0, le=1.0)
    delay_s: float = Field(default=1.0, ge=0.0, le=3600.0)
    factor: float = Field(default=4.0, ge=1.0, le=100.0)
    mode: int = 5
    fix: int = 1
    command: int = Field(default=0, ge=0, le=65535)
    rate_hz: float = Field(default=2.0, ge=0.0, le=400.0)
    channel: int = Field(default=8, ge=1, le=18)
    pulse_us: int = Field(default=2000, ge=800, le=2200)

    @model_validator(mode="after")
    def _means_something(self) -> Self:
        idle = self.model_fields_set - _WHEN - {*KEYS.get(self.kind, ())}
        if idle:
            raise contradiction(min(idle), f"means nothing to kind '{self.kind}'")
        return self


class FaultClock:
    """Says which faults are in force; take-off is told once it has happened."""

    def __init__(self, faults: tuple[Fault, ...], *, start_s: float) -> None:
        self._faults = faults
        self._start_s = start_s
        self.take_off_s: float | None = None

    def active(self, kind: FaultKind, now_s: float, *, command: int = 0) -> Fault | None:
        """Return the fault of a kind that is in force, for one command if one is named."""
        for fault in self._faults:
            wanted = fault.kind is kind and fault.command in (0, command)
            if wanted and self._covers(fault, now_s):
                return fault
        return None

    def every(self, kind: FaultKind, now_s: float) -> list[Fault]:
        """Return all faults of a kind that are in force."""
        return [f for f in self._faults if f.kind is kind and self._covers(f, now_s)]

    def elapsed_s(self, fault: Fault, now_s: float) -> float:
        """Return for how long a fault has been in force."""
        since_s = self._start_s if fault.since == "start" else self.take_off_s
        return now_s - (now_s if since_s is None else since_s) - fault.at_s

    def _covers(self, fault: Fault, now_s: float) -> bool:
        since_s = self._start_s if fault.since == "start" else self.take_off_s
        if since_s is None:
            return False
        return fault.at_s <= now_s - since_s < fault.at_s + fault.duration_s


# The pilot's transmitter: sticks in the middle, switches low, unless a fault moves them.

RC_COUNT = 16
_STICKS = 4
_MIDDLE_US, _LOW_US = 1500, 1000


def rc_pulses_us(faults: FaultClock, now_s: float) -> tuple[int, ...]:
    """Return the position of each control."""
    pulses = [_MIDDLE_US] * _STICKS + [_LOW_US] * (RC_COUNT - _STICKS)
    for fault in faults.every(FaultKind.RC, now_s):
        if fault.channel <= RC_COUNT:
            pulses[fault.channel - 1] = fault.pulse_us
    return tuple(pulses)
