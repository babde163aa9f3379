"""One turn of the engine: edges that are due to the lines, reports and signs of life to the parent.

It has its clocks, lines and socket given, so that a test can run it in a time of its own. Whatever
goes wrong closes: a write that fails, a level that does not read back, a standstill.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from itertools import islice

from companion.core.types import SprayPlan
from companion.output.engine.lines import Lines
from companion.output.engine.selftest import wrong_lines
from companion.output.engine.wire import (
    EDGES_MAX,
    EngineSetup,
    Kind,
    RefusedError,
    Status,
    pack,
    pack_edges,
    pack_status,
    plan_from,
)
from companion.output.pwm import Edge, PulseEngine

# Between two signs of life; the ALIVE line changes as often, four times in a monostable's 0.2 s.
BEAT_S = 0.05
# Two turns are at most a beat apart; longer, and the process was stopped, or the computer slept.
GAP_S = 0.1
# A sign of life waits this long for an edge, so that it seldom costs a wake-up of its own.
BEAT_LATER_S = 0.005
# An edge later than this is counted: 6 mm at 6 m/s.
LATE_COUNTED_S = 0.001
_REPORTS_MAX = 4096


class Engine:
    """Owns the lines. `clock` is the companion's; `boot_clock` also runs while the computer sleeps.

    `send` hands a packet to the companion and says whether it was taken; it never waits.
    """

    def __init__(
        self,
        setup: EngineSetup,
        lines: Lines,
        *,
        clock: Callable[[], float],
        boot_clock: Callable[[], float],
        send: Callable[[bytes], bool],
    ) -> None:
        self._wiring = setup.wiring
        self._lines = lines
        self._clock, self._boot_clock = clock, boot_clock
        self._send = send
        now_s = clock()
        self._schedule = Schedule(setup, start_s=now_s)
        self._seen_s = boot_clock()
        self._beat_s = now_s + BEAT_S
        self._safe = self._levels = self._wiring.safe_levels
        self._alive_bit = 0 if self._wiring.alive is None else 1 << self._wiring.alive
        # What `Issued` has, as bare tuples: some hundred are made a second.
        self._reports: deque[tuple[float, float, int, bool, float]] = deque(maxlen=_REPORTS_MAX)
        outputs = range(len(setup.wiring.valves) + setup.wiring.has_return)
        self._levels_of = [
            tuple(setup.wiring.level(n, is_open=is_open) << n for is_open in (False, True))
            for n in outputs
        ]
        self._due_s = math.inf
        self.fault: str | None = None
        self.accepted = self.rejected = self.edges = self.dropped = 0
        self.stops = self.writes = self.late = 0
        self.worst_late_s = 0.0
        self.refusal = ""
        self._close_all()
        self._check_levels()

    @property
    def next_s(self) -> float:
        """Return when the next turn is due."""
        return min(self._beat_s + BEAT_LATER_S, self._due_s)

    def receive(self, kind: Kind, body: bytes) -> None:
        """Take a packet of the companion; one that is no good is counted and changes nothing."""
        try:
            if kind is not Kind.PLAN:
                raise RefusedError(f"a packet of kind {kind.name}")
            plan = plan_from(body)
        except RefusedError as refused:
            self.refuse(str(refused))
            return
        self._notice_standstill()
        refusal = self._schedule.submit(plan, self._clock())
        if refusal is not None:
            self.refuse(refusal)
            return
        self._look_ahead()
        self.accepted += 1

    def refuse(self, reason: str) -> None:
        """Count a packet that is not acted on."""
        self.rejected += 1
        self.refusal = reason

    def turn(self) -> None:
        """Do what is due."""
        self._notice_standstill()
        now_s = self._clock()
        if self._due_s <= now_s:
            self._issue(self._schedule.due(now_s))
            self._look_ahead()
        if self._beat_s <= now_s:
            self._beat(now_s)

    def fail(self, text: str) -> None:
        """Close for good; the ALIVE line stands still from now on."""
        if self.fault is None:
            self.fault = text
            self._schedule.halt(self._clock())
            self._look_ahead()
            self._close_all()

    def close(self) -> None:
        """Close everything and let go of the lines, whatever happens on the way."""
        try:
            self._lines.write(self._safe)
            self._note_closed()
        finally:
            self._lines.release()

    def status(self) -> Status:
        """Return how it is."""
        return Status(
            at_s=self._clock(),
            sequence=self._schedule.sequence,
            accepted=self.accepted,
            rejected=self.rejected,
            edges=self.edges,
            dropped_reports=self.dropped,
            lease_ends=self._schedule.lease_end_count,
            stops=self.stops,
            writes=self.writes,
            late=self.late,
            worst_late_us=min(round(self.worst_late_s * 1e6), 2**32 - 1),
            is_alive=self._is_well(self._clock()),
        )

    # ------------------------------------------------------------------------------- inside

    def _is_well(self, now_s: float) -> bool:
        return self.fault is None and now_s < self._schedule.lease_until_s

    def _notice_standstill(self) -> None:
        """Close everything first if this process stood still; plans made before then are void."""
        boot_s = self._boot_clock()
        gap_s = boot_s - self._seen_s
        self._seen_s = boot_s
        if gap_s <= GAP_S:
            return
        self._close_all()
        self.stops += 1
        self._schedule.halt(self._clock())
        self._look_ahead()

    def _look_ahead(self) -> None:
        """Note when something is due next; nothing is after a fault."""
        self._due_s = self._schedule.next_s if self.fault is None else math.inf

    def _issue(self, edges: list[Edge]) -> None:
        if not edges:
            return
        levels, levels_of = self._levels, self._levels_of
        for _, output, is_open, _ in edges:
            levels = levels & ~(1 << output) | levels_of[output][is_open]
        if levels != self._levels:
            self._write(levels)
        actual_s = self._clock()
        self._note([(at_s, actual_s, output, o, duty) for at_s, output, o, duty in edges])
        # Stopped between the look at the clock and the write, it has written what is past.
        self._notice_standstill()

    def _close_all(self) -> None:
        self._write(self._safe)
        self._note_closed()

    def _note_closed(self) -> None:
        """Report every output as moved: whoever follows the reports need not guess."""
        now_s, count = self._clock(), len(self._wiring.valves)
        outputs = range(count + self._wiring.has_return)
        self._note([(now_s, now_s, n, n >= count, float(n >= count)) for n in outputs])

    def _note(self, issued: list[tuple[float, float, int, bool, float]]) -> None:
        self.edges += len(issued)
        for planned_s, actual_s, *_ in issued:
            late_s = actual_s - planned_s
            if late_s > self.worst_late_s:
                self.worst_late_s = late_s
            if late_s > LATE_COUNTED_S:
                self.late += 1
        # A full queue drops the oldest by itself.
        self.dropped += max(len(self._reports) + len(issued) - _REPORTS_MAX, 0)
        self._reports.extend(issued)

    def _write(self, levels: int) -> None:
        self._levels = levels
        try:
            self._lines.write(levels)
        except OSError as error:
            self.fail(f"outputs cannot be written: {error.strerror or error}")
        else:
            self.writes += 1

    def _beat(self, now_s: float) -> None:
        # In the mean as often as said; after a standstill it begins anew.
        late = now_s - self._beat_s >= BEAT_S
        self._beat_s = (now_s if late else self._beat_s) + BEAT_S
        self._check_levels()
        if self.fault is not None:
            self._write(self._safe)
            self._send(pack(Kind.FAULT, self.fault.encode()))
        elif self._is_well(now_s) and self._alive_bit:
            self._write(self._levels ^ self._alive_bit)
        self.report()

    def _check_levels(self) -> None:
        try:
            found = self._lines.read()
        except OSError as error:
            self.fail(f"outputs cannot be read: {error.strerror or error}")
            return
        if found is not None and found != self._levels:
            wrong = wrong_lines(found, self._levels, self._wiring)
            self.fail(f"outputs do not take their level: {wrong}")

    def report(self) -> None:
        """Send the edges since the last report, and the status; what is not taken waits."""
        while self._reports:
            batch = list(islice(self._reports, EDGES_MAX))
            if not self._send(pack_edges(batch)):
                break
            for _ in batch:
                self._reports.popleft()
        self._send(pack_status(self.status()))


# From plans to the edges that are due: which plans are taken, and what ends them.
#
# Pure: it knows no clock and no line. A plan that is refused changes nothing: the last one goes on
# until its own lease ends.

# Companion and engine read the same clock; a plan of the future means that they do not.
FUTURE_MAX_S = 0.01


class Schedule:
    """The valves' future until the lease ends, on the companion's monotonic clock."""

    def __init__(self, setup: EngineSetup, *, start_s: float) -> None:
        count, has_return = len(setup.wiring.valves), setup.wiring.has_return
        self._setup = setup
        self._count = count
        self._pulses = self._closed(start_s)
        self._late = LateEdges(
            count + has_return,
            count,
            min_on_s=setup.pwm.min_on_s,
            min_off_s=setup.pwm.min_off_s,
        )
        self._since_s = start_s
        self.sequence = -1
        self.lease_until_s = -math.inf
        self.lease_end_count = 0

    def refusal(self, plan: SprayPlan, now_s: float) -> str | None:
        """Return why a plan is not to be taken at `now_s`; None if it is."""
        for is_good, reason in (
            (len(plan.duty) == self._count, "for another number of valves"),
            (plan.sequence > self.sequence, "out of order"),
            (plan.issued_s >= self._since_s, "made before the engine started or was stopped"),
            (plan.issued_s <= now_s + FUTURE_MAX_S, "made in the future"),
            (now_s < plan.lease_until_s, "its lease is over"),
            (plan.lease_until_s <= now_s + self._setup.lease_max_s, "its lease is too long"),
        ):
            if not is_good:
                return reason
        return None

    def submit(self, plan: SprayPlan, now_s: float) -> str | None:
        """Replace the future by `plan`, or return why not."""
        refusal = self.refusal(plan, now_s)
        if refusal is None:
            self.sequence = plan.sequence
            self.lease_until_s = plan.lease_until_s
            self._pulses.submit(plan, now_s=now_s)
        return refusal

    def due(self, now_s: float) -> list[Edge]:
        """Return the edges to write now; the end of the lease is among their causes."""
        if -math.inf < self.lease_until_s <= now_s:
            self.lease_until_s = -math.inf
            self.lease_end_count += 1
        return self._late.pass_on(self._pulses.advance(now_s), now_s)

    @property
    def next_s(self) -> float:
        """Return when something is due next."""
        return min(self._pulses.next_look_s(), self._late.next_s)

    def halt(self, now_s: float) -> None:
        """Forget all plans: whoever calls has closed everything. Only plans made later count."""
        self._pulses = self._closed(now_s)
        self._late.clear(now_s)
        self._since_s = now_s
        self.lease_until_s = -math.inf

    def _closed(self, now_s: float) -> PulseEngine:
        return PulseEngine(
            self._setup.pwm,
            self._count,
            start_s=now_s,
            overrun_s=self._setup.overrun_s,
            has_return=self._setup.wiring.has_return,
        )


# Edges that come late are issued, never skipped: what a late machine does to the pulses.
#
# A pulse that opens late keeps its length but for a twentieth, by which the following pulses come
# back to their places; a minimum time that a delay has eaten is waited for. Closing for good
# (duty 0) waits for nothing. Pure: who owns the clock asks for what is due.

# What the usual wake-up is late by shifts nothing: the next edge is on its time again.
LATE_S = 0.0003
# Of its length a late pulse keeps this much, or the delay would never be made up for.
KEPT = 0.95


class _Line:
    __slots__ = ("is_open", "late_s", "moved_s", "planned_s", "queue")

    def __init__(self, *, is_open: bool) -> None:
        self.is_open = is_open
        self.queue: deque[Edge] = deque()
        self.moved_s = self.planned_s = -math.inf
        self.late_s = 0.0


class LateEdges:
    """Holds each output's edges until their time, in their order."""

    def __init__(self, outputs: int, valves: int, *, min_on_s: float, min_off_s: float) -> None:
        self._lines = tuple(_Line(is_open=number >= valves) for number in range(outputs))
        self._valves = valves
        self._min_on_s, self._min_off_s = min_on_s, min_off_s
        self._waiting: set[int] = set()

    def add(self, edges: Iterable[Edge]) -> None:
        """Take edges in the order of their times."""
        for edge in edges:
            queue = self._lines[edge.valve].queue
            # Towards the safe state there is no pulse to keep: what it was to do before is void.
            is_return = edge.valve >= self._valves
            if edge.is_open if is_return else not edge.is_open and edge.duty == 0.0:
                queue.clear()
            queue.append(edge)
            self._waiting.add(edge.valve)

    @property
    def next_s(self) -> float:
        """Return when the next edge that was held up may be issued."""
        if not self._waiting:
            return math.inf
        lines = self._lines
        return min(self._due_s(lines[n], lines[n].queue[0]) for n in self._waiting)

    def pass_on(self, edges: list[Edge], now_s: float) -> list[Edge]:
        """Return what is to be written now, of `edges` and of what was held up before."""
        if not self._waiting and self._all_at_once(edges, now_s):
            return edges
        self.add(edges)
        return self.due(now_s)

    def due(self, now_s: float) -> list[Edge]:
        """Return what is to be written now; an output moves at most once."""
        out = []
        for number in sorted(self._waiting):
            line = self._lines[number]
            moved = False
            while line.queue and self._due_s(line, line.queue[0]) <= now_s:
                edge = line.queue[0]
                if edge.is_open != line.is_open:
                    if moved:
                        break
                    moved = True
                    self._move(line, edge, now_s)
                line.queue.popleft()
                out.append(edge)
            if not line.queue:
                self._waiting.discard(number)
        return out

    def _all_at_once(self, edges: list[Edge], now_s: float) -> bool:
        """Take edges of one output each if nothing holds any of them up: the usual case."""
        lines = self._lines
        if len(edges) > 1 and len({edge.valve for edge in edges}) < len(edges):
            return False
        for edge in edges:
            if self._due_s(lines[edge.valve], edge) > now_s:
                return False
        for edge in edges:
            line = lines[edge.valve]
            if edge.is_open != line.is_open:
                self._move(line, edge, now_s)
        return True

    def clear(self, now_s: float) -> None:
        """Forget everything: all valves were closed, the return valve opened, by other means."""
        for number, line in enumerate(self._lines):
            line.queue.clear()
            line.is_open = number >= self._valves
            line.moved_s, line.late_s = now_s, 0.0
        self._waiting.clear()

    def _move(self, line: _Line, edge: Edge, now_s: float) -> None:
        line.is_open = edge.is_open
        line.moved_s, line.planned_s = now_s, edge.at_s
        late_s = now_s - edge.at_s
        line.late_s = late_s if late_s > LATE_S else 0.0

    def _due_s(self, line: _Line, edge: Edge) -> float:
        at_s, valve, is_open, duty = edge
        if valve >= self._valves or is_open == line.is_open or (not is_open and duty == 0.0):
            return at_s
        if is_open:
            # A hair less than the minimum: sums of times are not exact.
            return max(at_s, line.moved_s + self._min_off_s - 1e-9)
        length_s = KEPT * (at_s - line.planned_s) if line.late_s else 0.0
        return max(at_s, line.moved_s + max(length_s, self._min_on_s - 1e-9))
