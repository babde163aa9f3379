"""No decision depends on what the clocks say: all times moved by a constant change nothing else.

The companion's clock counts from its computer's start and the vehicle's from its own. Whoever
compares a time with a fixed one, or counts periods from zero, decides otherwise after an hour.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from functools import cache
from operator import attrgetter
from typing import Any

from analysis.replay import FlownCore
from companion.core.setup import Setup
from companion.core.types import Decision, Input, TimedChange
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


def is_alike(here: Any, there: Any, ours_s: float) -> bool:
    """Whether a value is the other one at the first glance, but for times later by `ours_s`.

    What is not may still be: NaN, and large numbers that are rounded; `difference` says.
    """
    kind = type(here)
    if kind is not type(there):
        return False
    if kind is float:
        return bool(abs(here - there) <= ROUNDED)
    if kind is tuple:
        return len(here) == len(there) and all(
            is_alike(a, b, ours_s) for a, b in zip(here, there, strict=True)
        )
    names = _names(kind)
    if not names:
        return bool(here == there)
    for name in names:
        a, b = getattr(here, name), getattr(there, name)
        if name in OURS and type(a) is type(b) is float:
            b -= ours_s
        if not is_alike(a, b, ours_s):
            return False
    return True


@cache
def _names(kind: type[Any]) -> tuple[str, ...]:
    return tuple(one.name for one in fields(kind)) if is_dataclass(kind) else ()


def by_valve(decision: Decision) -> Decision:
    """Return a decision, its changes at one moment by valve: rounding says which comes first."""
    groups: list[list[TimedChange]] = []
    for change in decision.plan.changes:
        if groups and change.at_s - groups[-1][-1].at_s <= ROUNDED:
            groups[-1].append(change)
        else:
            groups.append([change])
    changes = tuple(
        replace(one, at_s=group[0].at_s)
        for group in groups
        for one in sorted(group, key=attrgetter("valve"))
    )
    return replace(decision, plan=replace(decision.plan, changes=changes))


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
        there = self._core.decide(decided.now_s + ours_s)
        if is_alike(decided, there, ours_s):
            return
        one, other = by_valve(decided), by_valve(back(there, ours_s))
        found = difference(one, other, is_tolerant=True, within=ROUNDED)
        if found is not None:
            self.found.append((decided.now_s, found))


# After a quarter of an hour, in whole bits, before the clock's start, after eleven days.
SHIFTS = ((1000.1, 777.216), (4096.0, 0.0), (-4000.3, 0.0), (1_000_000.7, 123_456.789))
