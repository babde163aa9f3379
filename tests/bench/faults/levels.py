"""From what was written to lines and outputs to when each valve was open. Pure.

What happens to lines whose owner is gone stands here: they fall back to their pull, which is
closed (normally closed valves, a kernel that lets go as mainline's does).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from tests.bench.faults.chip import Act, Row
from tests.bench.faults.record import Opening

MONOSTABLE_S = 0.3


class Level(NamedTuple):
    """The levels of all lines from a time on, and whether the owner wrote them."""

    at_s: float
    levels: int
    is_ordered: bool


class Pulse(NamedTuple):
    """What an output of the autopilot carries from a time on, and whether it was ordered."""

    at_s: float
    valve: int
    share: float
    is_ordered: bool


def levels_of(rows: Iterable[Row], deaths: Mapping[int, float]) -> list[Level]:
    """Return the levels over time; `deaths` says which process ended when."""
    events: list[tuple[float, int, Row | int]] = [(row.at_s, 1, row) for row in rows]
    events += [(at_s, 0, pid) for pid, at_s in deaths.items()]
    events.sort(key=lambda event: event[:2])
    found, owner = [], -1
    for at_s, _, what in events:
        if isinstance(what, int):
            if what == owner:
                found.append(Level(at_s, 0, False))
                owner = -1
        elif what.act is Act.RELEASED:
            found.append(Level(at_s, 0, True))
            owner = -1
        else:
            # Who takes the lines has closed what the last owner left, whoever noticed its end.
            found.append(Level(at_s, what.levels, what.act is Act.WRITTEN))
            owner = what.pid
    return found


def openings_of(levels: Sequence[Level], valves: int, until_s: float) -> list[Opening]:
    """Return when each line was at the level that opens; those open at the end end there."""
    found: list[Opening] = []
    since: dict[int, float] = {}
    for at_s, value, is_ordered in levels:
        for valve in range(valves):
            if value >> valve & 1:
                since.setdefault(valve, at_s)
            elif valve in since:
                found.append(Opening(valve, since.pop(valve), at_s, 1.0, is_ordered))
    found += [Opening(valve, at_s, until_s, 1.0, False) for valve, at_s in since.items()]
    return sorted(found, key=lambda one: one.from_s)


def behind_monostable(
    openings: Iterable[Opening], levels: Sequence[Level], alive: int
) -> list[Opening]:
    """Return the openings as far as the ALIVE line has changed within the last 0.3 s."""
    gates: list[list[float]] = []
    before = 0
    for at_s, value, _ in levels:
        bit = value >> alive & 1
        if bit != before:
            if gates and at_s <= gates[-1][1]:
                gates[-1][1] = at_s + MONOSTABLE_S
            else:
                gates.append([at_s, at_s + MONOSTABLE_S])
        before = bit
    found = []
    for one in openings:
        for begin_s, end_s in gates:
            from_s, to_s = max(one.from_s, begin_s), min(one.to_s, end_s)
            if from_s < to_s:
                is_ordered = one.is_ordered and to_s == one.to_s
                found.append(one._replace(from_s=from_s, to_s=to_s, is_ordered=is_ordered))
    return found


def openings_of_pulses(pulses: Iterable[Pulse], until_s: float) -> list[Opening]:
    """Return when each output carried a pulse that opens; a new width begins a new opening."""
    found: list[Opening] = []
    now: dict[int, Pulse] = {}
    for pulse in pulses:
        before = now.get(pulse.valve)
        if before is not None and before.share == pulse.share:
            continue
        if before is not None:
            found.append(
                Opening(pulse.valve, before.at_s, pulse.at_s, before.share, pulse.is_ordered)
            )
            del now[pulse.valve]
        if pulse.share > 0.0:
            now[pulse.valve] = pulse
    found += [Opening(one.valve, one.at_s, until_s, one.share, False) for one in now.values()]
    return sorted(found, key=lambda one: one.from_s)
