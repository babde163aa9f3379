"""`[[liquid]]` of a scenario: what goes wrong with the liquid, and from which moment on."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from companion.errors import ConfigError
from sitl.liquid_faults import LiquidFault, LiquidFaultKind

START, TAKE_OFF, SPRAYING = "start", "take-off", "spraying"
MOMENTS = (START, TAKE_OFF, SPRAYING)
# Which share may be given, and whether a valve, by kind.
_WITH_SHARE = (LiquidFaultKind.CLOG, LiquidFaultKind.LEAK, LiquidFaultKind.SUPPLY)
_WITH_VALVE = (LiquidFaultKind.STUCK_CLOSED, LiquidFaultKind.STUCK_OPEN)


@dataclass(frozen=True, slots=True, kw_only=True)
class LiquidEntry:
    """One `[[liquid]]`: a fault from `at_s` after a moment on; `valve` counts from 1 at the left.

    Nothing of the liquid mends itself in flight, so there is no end.
    """

    kind: LiquidFaultKind
    at_s: float = 0.0
    since: str = START
    share: float = 0.0
    valve: int | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.at_s < 1e9:
            raise ValueError(f"at_s must be a time, got {self.at_s}")
        if self.since not in MOMENTS:
            raise ValueError(f"since must be one of {', '.join(MOMENTS)}, got {self.since!r}")
        if self.kind in _WITH_SHARE and not 0.0 < self.share <= 1.0:
            raise ValueError(f"share = {self.share}: give more than 0, up to 1")
        if self.kind not in _WITH_SHARE and self.share != 0.0:
            raise ValueError(f"share means nothing to kind '{self.kind}'")
        if self.kind in _WITH_VALVE and self.valve is None:
            raise ValueError("valve is missing: 1 is the leftmost")
        if self.valve is not None and self.kind not in (*_WITH_VALVE, LiquidFaultKind.CLOG):
            raise ValueError(f"valve means nothing to kind '{self.kind}'")
        if self.valve is not None and not self.valve >= 1:
            raise ValueError(f"valve = {self.valve}: 1 is the leftmost")

    def fault(self, moment_s: float) -> LiquidFault:
        """Return the fault once the moment that it counts from has come."""
        valve = None if self.valve is None else self.valve - 1
        return LiquidFault(
            kind=self.kind, from_s=moment_s + self.at_s, share=self.share, valve=valve
        )


def read_liquid(path: Path, table: dict[str, Any]) -> tuple[LiquidEntry, ...]:
    """Return the faults of the liquid of a scenario."""
    entries = table.get("liquid", [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ConfigError(f"{path}: liquid: write it as [[liquid]], one table each")
    return tuple(_entry(path, number, entry) for number, entry in enumerate(entries))


def _entry(path: Path, number: int, entry: dict[str, Any]) -> LiquidEntry:
    where, names = f"{path}: liquid[{number}]", [field.name for field in fields(LiquidEntry)]
    unknown = sorted(set(entry) - set(names))
    if unknown:
        raise ConfigError(f"{where}.{unknown[0]}: unknown key; known: {', '.join(names)}")
    kinds = ", ".join(LiquidFaultKind)
    if entry.get("kind") not in list(LiquidFaultKind):
        raise ConfigError(f"{where}.kind = {entry.get('kind')!r}: known kinds: {kinds}")
    for name, wanted in (("at_s", (int, float)), ("share", (int, float)), ("valve", (int,))):
        value = entry.get(name, 0)
        if isinstance(value, bool) or not isinstance(value, wanted):
            raise ConfigError(f"{where}.{name} = {value!r}: give a number")
    try:
        return LiquidEntry(**{**entry, "kind": LiquidFaultKind(entry["kind"])})
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from error
