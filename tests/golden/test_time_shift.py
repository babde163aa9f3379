"""No decision depends on what the clocks say: all times moved by a constant change nothing else.

The companion's clock counts from its computer's start and the vehicle's from its own. Whoever
compares a time with a fixed one, or counts periods from zero, decides otherwise after an hour.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from functools import cache
from itertools import cycle
from typing import Any, get_args

import pytest

from analysis.journals.content import read_journal
from analysis.replay import FlownCore
from companion.core.types import Decision, Input
from tests.golden.checking import difference, names, unpacked

OURS = {
    "received_s", "now_s", "time_s", "position_received_s", "heartbeat_received_s",
    "wind_received_s", "issued_s", "lease_until_s", "at_s",
}  # fmt: skip
LENGTHS = {"gap_s", "round_trip_s", "acceleration_fade_s"}
UTC = {"utc_s", "observed_s"}
# After eleven days a clock's last bit is 0.1 ns.
ROUNDED = 1e-6
# A limit that is met to the last bit, as by reports exactly two seconds apart, may be judged met
# one step later.
AT_A_LIMIT = 3
BRIEF_S = 0.06


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


def differences(name: str, ours_s: float, vehicles_s: float) -> Iterator[tuple[float, str]]:
    """Yield when a recorded flight is decided otherwise with other clocks, and what."""
    with unpacked(name) as path:
        content = read_journal(path)
        core = FlownCore(content.setup)
        for item in content.items():
            if not isinstance(item, Decision):
                core.observe(moved(item, ours_s, vehicles_s))
                continue
            decided = back(core.decide(item.now_s + ours_s), ours_s)
            found = difference(item, decided, is_tolerant=True, within=ROUNDED)
            if found is not None:
                yield item.now_s, found


# After a quarter of an hour, in whole bits, before the clock's start, after eleven days.
SHIFTS = ((1000.1, 777.216), (4096.0, 0.0), (-4000.3, 0.0), (1_000_000.7, 123_456.789))


@pytest.mark.parametrize(("name", "shift"), list(zip(names(), cycle(SHIFTS), strict=False)))
def test_a_flight_is_decided_alike_whatever_the_clocks_say(
    name: str, shift: tuple[float, float]
) -> None:
    ours_s, vehicles_s = shift
    found = list(differences(name, ours_s, vehicles_s))
    assert len(found) <= AT_A_LIMIT, found[:5]
    if found:
        assert found[-1][0] - found[0][0] <= BRIEF_S, found
        assert all("inhibits" in what or "plan" in what for _, what in found), found


def test_every_time_of_an_input_is_known_here() -> None:
    known = OURS | LENGTHS | UTC | {"boot_s", "offset_s"}
    times = {one.name for kind in get_args(Input) for one in fields(kind) if is_time(one.name)}
    assert times <= known, times - known


def test_a_core_that_looks_at_the_clock_itself_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    decide = FlownCore.decide

    def by_the_clock(self: FlownCore, now_s: float) -> Decision:
        made = decide(self, now_s)
        return replace(made, late_count=made.late_count + (now_s > 5500.0))

    monkeypatch.setattr(FlownCore, "decide", by_the_clock)
    assert len(list(differences("ardupilot-cut", 1000.1, 0.0))) > AT_A_LIMIT
