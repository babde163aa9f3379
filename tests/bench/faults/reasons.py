"""When everything has to be closed, by what was said on the wire and what was done. Pure.

An oracle: of the core's code it uses none, and the limits stand here again. It knows less than the
interlock: it says when valves must be closed, never that they should be open.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

from tests.bench.faults.cases import SEEN_S, TOLD_S, Kind
from tests.bench.faults.record import Record
from tests.bench.faults.wire import COMMAND, HEARTBEAT, LANDED, POSITION, Sent

POSITION_AGE_S, HEARTBEAT_AGE_S = 0.8, 2.5
# Whoever stood still for longer asks the operator again; clocks are read by two processes.
CONSENT_S, CLOCKS_S = 2.0, 0.1
JUMP_M, STUCK_M, CONFIRMED = 2.0, 0.15, 5
AUTO, IN_AIR, DO_SPRAYER = 3.0, 2.0, 216.0
_M_PER_DEGREE = 111_000.0


class Reason(NamedTuple):
    """Everything is closed from `at_s` + `limit_s` to `until_s`."""

    what: str
    at_s: float
    limit_s: float
    until_s: float = math.inf


def reasons_of(record: Record) -> list[Reason]:
    """Return why all must be closed between enabling and end, the earliest limit first."""
    found = [*_struck(record)]
    for rule in (_commands, _heartbeats, _landed, _positions_old, _positions_wrong):
        found += _joined(rule(record.sent))
    known = [
        reason
        for reason in found
        if reason.until_s > record.enabled_s and reason.at_s < record.until_s
    ]
    return sorted(known, key=lambda reason: reason.at_s + reason.limit_s)


def _joined(reasons: Iterable[Reason]) -> list[Reason]:
    """Return reasons with those of one kind as one that follow each other without a gap."""
    found: list[Reason] = []
    newest: dict[str, int] = {}
    for reason in reasons:
        place = newest.get(reason.what)
        if place is not None and reason.at_s <= found[place].until_s:
            until_s = max(reason.until_s, found[place].until_s)
            found[place] = found[place]._replace(until_s=until_s)
        else:
            newest[reason.what] = len(found)
            found.append(reason)
    return found


def _struck(record: Record) -> Iterator[Reason]:
    for struck in record.struck[:1]:
        yield Reason(struck.what, struck.at_s, record.draw.case.limit_s, _goes_on_s(record))


def _goes_on_s(record: Record) -> float:
    """Return until when a fault that was struck closes everything.

    A companion that goes on opens nothing before five positions that left after that, and nothing
    at all after a long stop. An engine that was stopped for so long has been replaced by nobody.
    """
    goes_on = [one.at_s for one in record.struck if one.what.startswith("SIGCONT")]
    if record.draw.case.kind is Kind.CONT_ENGINE or not goes_on:
        return math.inf
    if goes_on[0] - record.struck[0].at_s > CONSENT_S + CLOCKS_S:
        return math.inf
    fresh = [one.made_s for one in _of(record.sent, POSITION) if one.made_s > goes_on[0]]
    return fresh[CONFIRMED - 1] if len(fresh) >= CONFIRMED else math.inf


def _of(sent: Sequence[Sent], message: int) -> list[Sent]:
    return [one for one in sent if one.message == message]


def _commands(sent: Sequence[Sent]) -> Iterator[Reason]:
    commands = [one for one in _of(sent, COMMAND) if one.fields[0] == DO_SPRAYER]
    for number, one in enumerate(commands):
        if one.fields[1] == 0.0:
            later = [after.at_s for after in commands[number:] if after.fields[1] == 1.0]
            yield Reason("disabled", one.at_s, TOLD_S, min(later, default=math.inf))


def _heartbeats(sent: Sequence[Sent]) -> Iterator[Reason]:
    beats = _of(sent, HEARTBEAT)
    for one in beats:
        if one.fields[0] == 0.0:
            yield Reason("disarmed", one.at_s, TOLD_S)
        if one.fields[1] != AUTO:
            yield Reason("mode", one.at_s, TOLD_S)
    ends = [*(one.at_s for one in beats[1:]), math.inf]
    for one, end_s in zip(beats, ends, strict=True):
        old_s = one.at_s + HEARTBEAT_AGE_S
        if end_s > old_s:
            yield Reason("heartbeat old", old_s, SEEN_S, end_s)


def _landed(sent: Sequence[Sent]) -> Iterator[Reason]:
    states = _of(sent, LANDED)
    ends = [*(one.at_s for one in states[1:]), math.inf]
    for one, end_s in zip(states, ends, strict=True):
        if one.fields[0] != IN_AIR:
            yield Reason("landing", one.at_s, TOLD_S, end_s)


def _positions_old(sent: Sequence[Sent]) -> Iterator[Reason]:
    """Yield when the newest position that has arrived was made more than 0.8 s ago."""
    positions = _of(sent, POSITION)
    ends = [*(one.at_s for one in positions[1:]), math.inf]
    for one, end_s in zip(positions, ends, strict=True):
        old_s = max(one.made_s + POSITION_AGE_S, one.at_s)
        if end_s > old_s:
            yield Reason("position old", old_s, SEEN_S, end_s)


def _positions_wrong(sent: Sequence[Sent]) -> Iterator[Reason]:
    """Yield from each position that cannot be true until others have confirmed what follows."""
    positions = _of(sent, POSITION)
    same_m = 0.0
    for number, (before, now) in enumerate(pairwise(positions), start=1):
        why, same_m = _wrong(before.fields, now.fields, same_m)
        if why is not None:
            # The fifth position confirms it, so nothing opens before that one arrives.
            after = positions[number + CONFIRMED - 1 :]
            until_s = after[0].at_s if after else math.inf
            yield Reason(why, now.at_s, SEEN_S, until_s)


def _wrong(
    before: Sequence[float], now: Sequence[float], same_m: float
) -> tuple[str | None, float]:
    """Return what is wrong with a position, and how far one that stands claims to have gone."""
    dt_s = now[0] - before[0]
    speed_m_s = math.hypot(now[3], now[4])
    if now[1] == now[2] == 0.0:
        return "position 0, 0", 0.0
    if now[1:3] == before[1:3]:
        same_m += speed_m_s * dt_s
        return ("position frozen" if same_m > STUCK_M else None), same_m
    narrow = math.cos(math.radians(now[1]))
    north_m = (now[1] - before[1]) * _M_PER_DEGREE - before[3] * dt_s
    east_m = (now[2] - before[2]) * _M_PER_DEGREE * narrow - before[4] * dt_s
    if not math.hypot(north_m, east_m) <= JUMP_M + 0.1:
        return "position jumped", 0.0
    if speed_m_s == 0.0 and math.hypot(before[3], before[4]) > 2.0:
        return "position frozen", 0.0
    return None, 0.0
