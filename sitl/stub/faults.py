"""Faults by the clock: what goes wrong from when to when, read from a scenario file."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, fields
from enum import StrEnum
from pathlib import Path
from typing import Any

from companion.errors import ConfigError


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
_WHEN = ("kind", "at_s", "duration_s", "since")
_KEYS: dict[FaultKind, tuple[str, ...]] = {
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One fault: `at_s` counts from the start of the stub, or from `since = "take-off"`.

    `fraction` is of the messages concerned; `delay_s` is of late acknowledgements, of the clock's
    jump, and between two requests of the other station; `factor` is of slow streams, `rate_hz` of
    the station's; `mode` is the number of an ArduCopter mode; `fix` a fix type; `command` the only
    one concerned, 0 is every command; `channel` and `pulse_us` are of the transmitter.
    """

    kind: FaultKind
    at_s: float = 0.0
    duration_s: float = 1e9
    since: str = "start"
    fraction: float = 1.0
    delay_s: float = 1.0
    factor: float = 4.0
    mode: int = 5
    fix: int = 1
    command: int = 0
    rate_hz: float = 2.0
    channel: int = 8
    pulse_us: int = 2000

    def __post_init__(self) -> None:
        if not (0.0 <= self.at_s < 1e9 and 0.0 < self.duration_s <= 1e9):
            raise ValueError(
                f"at_s and duration_s must be times, got {self.at_s}, {self.duration_s}"
            )
        if self.since not in ("start", "take-off"):
            raise ValueError(f"since must be 'start' or 'take-off', got {self.since!r}")
        if not 0.0 <= self.fraction <= 1.0:
            raise ValueError(f"fraction must lie in [0, 1], got {self.fraction}")
        if not (0.0 <= self.delay_s <= 3600.0 and 1.0 <= self.factor <= 100.0):
            raise ValueError(f"delay_s {self.delay_s} or factor {self.factor} is out of range")
        if not (0.0 <= self.rate_hz <= 400.0 and 0 <= self.command <= 65535):
            raise ValueError(f"rate_hz {self.rate_hz} or command {self.command} is out of range")
        if not (1 <= self.channel <= 18 and 800 <= self.pulse_us <= 2200):
            raise ValueError(f"channel {self.channel} or pulse_us {self.pulse_us} is out of range")


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


def read_scenario(path: Path) -> tuple[Fault, ...]:
    """Return the faults of a scenario file that holds nothing else."""
    table = read_table(path)
    others = sorted(set(table) - {"fault"})
    if others:
        raise ConfigError(f"{path}: {others[0]}: only [[fault]] has a meaning here")
    return read_faults(path, table)


def read_table(path: Path) -> dict[str, Any]:
    """Return what a scenario file holds."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as a scenario ({error})") from error


def read_faults(path: Path, table: dict[str, Any]) -> tuple[Fault, ...]:
    """Return the faults of a scenario."""
    return tuple(_fault(path, number, each) for number, each in tables_of(path, table, "fault"))


def tables_of(path: Path, table: dict[str, Any], name: str) -> Iterable[tuple[int, dict[str, Any]]]:
    """Return the numbered tables [[name]] of a scenario."""
    entries = table.get(name, [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ConfigError(f"{path}: {name}: write it as [[{name}]], one table each")
    return enumerate(entries)


def _fault(path: Path, number: int, entry: dict[str, Any]) -> Fault:
    kinds_of = {field.name: field.type for field in fields(Fault)}
    names = set(kinds_of)
    unknown = sorted(set(entry) - names)
    if unknown:
        raise ConfigError(
            f"{path}: fault[{number}].{unknown[0]}: unknown key; known: {sorted(names)}"
        )
    try:
        kind = FaultKind(entry.get("kind", ""))
        for name, value in entry.items():
            _check_type(name, value, str(kinds_of[name]))
        fault = Fault(**{**entry, "kind": kind})
    except (ValueError, TypeError) as error:
        kinds = ", ".join(FaultKind)
        raise ConfigError(f"{path}: fault[{number}]: {error}; kinds: {kinds}") from error
    idle = sorted(set(entry) - {*_WHEN, *_KEYS.get(kind, ())})
    if idle:
        raise ConfigError(f"{path}: fault[{number}].{idle[0]}: means nothing to kind '{kind}'")
    return fault


def _check_type(name: str, value: object, kind: str) -> None:
    """Refuse what is no number where a number is wanted; a truth value is none."""
    wanted: tuple[type, ...] = {"float": (int, float), "int": (int,)}.get(kind, (str,))
    if isinstance(value, bool) or not isinstance(value, wanted):
        raise ValueError(f"{name} must be of type {wanted[-1].__name__}, got {value!r}")


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
