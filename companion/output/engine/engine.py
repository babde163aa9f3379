"""One turn of the engine: edges that are due to the lines, reports and signs of life to the parent.

It has its clocks, lines and socket given, so that a test can run it in a time of its own. Whatever
goes wrong closes: a write that fails, a level that does not read back, a standstill.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from itertools import islice

from companion.output.engine.lines import Lines
from companion.output.engine.schedule import Schedule
from companion.output.engine.selftest import wrong_lines
from companion.output.engine.setup import EngineSetup
from companion.output.engine.wire import (
    EDGES_MAX,
    Kind,
    RefusedError,
    Status,
    pack,
    pack_edges,
    pack_status,
    plan_from,
)
from companion.output.pulse_train import Edge

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
