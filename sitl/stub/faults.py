"""Faults by the clock: what goes wrong from when to when, read from a scenario file."""

from __future__ import annotations

import tomllib
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One fault: `at_s` counts from the start of the stub, or from `since = "take-off"`.

    `fraction` is of the messages concerned; `delay_s` is of late acknowledgements and of the
    clock's jump; `factor` is of slow streams; `mode` is the number of a mode; `fix` a fix type.
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


class FaultClock:
    """Says which faults are in force; take-off is told once it has happened."""

    def __init__(self, faults: tuple[Fault, ...], *, start_s: float) -> None:
        self._faults = faults
        self._start_s = start_s
        self.take_off_s: float | None = None

    def active(self, kind: FaultKind, now_s: float) -> Fault | None:
        """Return the fault of a kind that is in force."""
        for fault in self._faults:
            if fault.kind is kind and self._covers(fault, now_s):
                return fault
        return None

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
    """Return the faults of a scenario file; other tables are left to others."""
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as a scenario ({error})") from error
    entries = table.get("fault", [])
    if not isinstance(entries, list):
        raise ConfigError(f"{path}: fault: write it as [[fault]], one table each")
    return tuple(_fault(path, number, entry) for number, entry in enumerate(entries))


def _fault(path: Path, number: int, entry: dict[str, Any]) -> Fault:
    names = {field.name for field in fields(Fault)}
    unknown = sorted(set(entry) - names)
    if unknown:
        raise ConfigError(
            f"{path}: fault[{number}].{unknown[0]}: unknown key; known: {sorted(names)}"
        )
    try:
        return Fault(**{**entry, "kind": FaultKind(entry.get("kind", ""))})
    except (ValueError, TypeError) as error:
        kinds = ", ".join(FaultKind)
        raise ConfigError(f"{path}: fault[{number}]: {error}; kinds: {kinds}") from error
