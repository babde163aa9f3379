"""No decision depends on what the clocks say: all times moved by a constant change nothing else.

The companion's clock counts from its computer's start and the vehicle's from its own. Whoever
compares a time with a fixed one, or counts periods from zero, decides otherwise after an hour.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from functools import cache
from typing import Any

from analysis.replay import FlownCore
from companion.core.setup import Setup
from companion.core.types import Decision, Input
from tests.golden.checking import Beside, difference

OURS = {
    "received_s", "now_s", "time_s", "position_received_s", "heartbeat_received_s",
    "wind_received_s", "issued_s", "lease_until_s", "at_s",
}  # fmt: skip
LENGTHS = {"gap_s", "round_trip_s", "acceleration_fade_s"}
UTC = {"utc_s", "observed_s"}
# After eleven days a clock's last bit is 0.1 ns.
ROUNDED = 1e-6


def is_time(name: str) -> bool:
    return name.endswith("_s") and not name.endswith(("m_s", "deg_s"))


def moved(item: Input, ours_s: float, vehicles_s: float) -> Input:
    """Return an input as it would be had the clocks begun sooner."""
    by = {"received_s": ours_s, "boot_s": vehicles_s, "offset_s": ours_s - vehicles_s}
    changes: dict[str, Any] = {}
    for one in fields(item):
        value = getattr(item, one.name)
        if one.name in by and value is not None:
            changes[one.name] = value + by[one.name]
    return replace(item, **changes)


def back(value: Any, ours_s: float) -> Any:
    """Return a decision with all its times moved back."""
    if isinstance(value, float | int | str | None):
        return value
    if isinstance(value, tuple):
        changed = tuple(back(one, ours_s) for one in value)
        return value if all(a is b for a, b in zip(changed, value, strict=True)) else changed
    if not is_dataclass(value) or isinstance(value, type):
        return value
    changes = {}
    for name in _names(type(value)):
        found = getattr(value, name)
        is_ours = name in OURS and isinstance(found, float)
        changed = found - ours_s if is_ours else back(found, ours_s)
        if changed is not found:
            changes[name] = changed
    return replace(value, **changes) if changes else value


@cache
def _names(kind: type[Any]) -> tuple[str, ...]:
    return tuple(one.name for one in fields(kind))


class OtherClocks(Beside):
    """The core, told other times than the one that it flies beside; `found` is what differs."""

    def __init__(self, ours_s: float, vehicles_s: float) -> None:
        self._by_s = ours_s, vehicles_s
        self.found: list[tuple[float, str]] = []

    def begin(self, given: Setup) -> None:
        self._core = FlownCore(given)

    def observe(self, item: Input) -> None:
        self._core.observe(moved(item, *self._by_s))

    def compare(self, decided: Decision) -> None:
        ours_s, _ = self._by_s
        here = back(self._core.decide(decided.now_s + ours_s), ours_s)
        found = difference(decided, here, is_tolerant=True, within=ROUNDED)
        if found is not None:
            self.found.append((decided.now_s, found))


# After a quarter of an hour, in whole bits, before the clock's start, after eleven days.
SHIFTS = ((1000.1, 777.216), (4096.0, 0.0), (-4000.3, 0.0), (1_000_000.7, 123_456.789))
