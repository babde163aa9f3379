"""Valves on this computer's own lines: plans go to the valve engine, its reports come back.

The engine is a process of its own, see `companion/output/engine`. It closes everything when the
lease of its last plan ends, when this process dies, and when it stood still. One that gives no
sign of life is killed here, its lines are taken over and held closed. A fault stays one.
"""

from __future__ import annotations

import asyncio
import json
import logging
import sys
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

from companion.core.types import SprayPlan
from companion.errors import ActuatorError
from companion.output.child import KILL_MAX_S, Child
from companion.output.engine.lines import Lines, open_lines
from companion.output.engine.selftest import SelfTest
from companion.output.engine.wire import (
    EngineSetup,
    Issued,
    Kind,
    RefusedError,
    Status,
    edges_from,
    pack,
    pack_plan,
    status_from,
    unpack,
)
from companion.output.timed import Lateness, OnOrder

# -P: a module of the working directory is none of ours, whatever its name. Not -I, which would
# also leave out a user's own site-packages, where this program may be installed.
COMMAND = (sys.executable, "-P", "-m", "companion.output.engine")

_logger = logging.getLogger(__name__)

# Four signs of life missed: together with the look at it, closed 0.25 s after it stopped.
SILENCE_MAX_S = 0.2
WATCH_S = 0.05
START_MAX_S = 10.0
STOP_MAX_S = 1.0
# What lies behind the lease is not carried out; a period that leads up to it is.
BEYOND_LEASE_S = 0.25
# Edges later than this at the 99th percentile are a fault; fewer than so many prove nothing.
LATE_MAX_S = 0.005
_LATE_COUNT_MIN = 500
_LATE_CHECK_S = 1.0
_KEPT = 10_000


class GpioExecutor:
    """Speaks with the engine by a socket; never waits but in `start` and `stop`.

    `issued` holds the last edges with their planned and actual time; `on_issued`, if set, is
    given them as they come, some twenty times a second; `on_order`, if set, is told of each first
    edge with another duty. `on_event`, if set, is told of the self-test:
    `on_event(at_s, kind, text)`.
    """

    def __init__(
        self,
        setup: EngineSetup,
        *,
        command: Sequence[str] = COMMAND,
        late_max_s: float = LATE_MAX_S,
    ) -> None:
        self._setup = setup
        self._count = len(setup.wiring.valves)
        self._command = tuple(command)
        self._late_max_s = late_max_s
        self._child: Child | None = None
        self._held = HeldLines(setup)
        self._timer: asyncio.TimerHandle | None = None
        self._ready, self._ended = asyncio.Event(), asyncio.Event()
        self._fault: str | None = None
        self._sequence = -1
        self._heard_s = self._checked_s = 0.0
        self._is_stopping = False
        self.status = Status()
        self.warnings: list[str] = []
        self.self_test: SelfTest | None = None
        self.lateness = Lateness()
        self.unsent_count = 0
        self.issued: deque[Issued] = deque(maxlen=_KEPT)
        self.on_issued: Callable[[Sequence[Issued]], None] | None = None
        self.on_order: OnOrder | None = None
        self._told_duty: dict[int, float] = {}
        self.on_event: Callable[[float, str, str], None] | None = None

    @property
    def fault(self) -> str | None:
        """Why the outputs cannot be trusted; None while the engine is well."""
        return self._fault

    @property
    def is_guarded(self) -> bool:
        """Whether something closes when this computer fails: its lines then carry nothing."""
        return True

    @property
    def lease_end_count(self) -> int:
        """Return how often the engine closed because no plan came."""
        return self.status.lease_ends

    @property
    def engine_pid(self) -> int | None:
        """Return the process id of the engine."""
        return None if self._child is None else self._child.pid

    async def start(self) -> None:
        """Start the engine; on return it has the lines, closed, or the fault says why not.

        What fails its self-test stays here with a fault and never opens, so that whoever looks at
        the vehicle's messages is told; a restart tests anew.

        Raises:
            ActuatorError: no engine answers at all.
        """
        loop = asyncio.get_running_loop()
        self._child = Child(self._command)
        loop.add_reader(self._child.socket, self._read)
        self._send(pack(Kind.SETUP, self._setup.as_bytes()))
        try:
            await asyncio.wait_for(self._ready.wait(), START_MAX_S)
        except TimeoutError:
            self._fail(f"valve engine not ready within {START_MAX_S:g} s")
        if self.self_test is None:
            await self.stop()
            raise ActuatorError(self._fault or "valve engine not ready")
        for text in self.warnings:
            _logger.warning("%s", text)
        (_logger.warning if self.self_test.fault else _logger.info)("%s", self.self_test.text())
        if self.on_event is not None:
            self.on_event(loop.time(), "self-test", self.self_test.text())
        self._heard_s = self._checked_s = loop.time()
        self._timer = loop.call_later(WATCH_S, self._watch)

    def submit(self, plan: SprayPlan) -> None:
        """Hand a plan to the engine; an older one changes nothing."""
        if len(plan.duty) != self._count:
            raise ValueError(f"plan for {len(plan.duty)} valves, executor has {self._count}")
        if self._timer is None or self._fault is not None or plan.sequence <= self._sequence:
            return
        self._sequence = plan.sequence
        end_s = plan.lease_until_s + BEYOND_LEASE_S
        if plan.changes and not plan.changes[-1].at_s < end_s:
            plan = replace(plan, changes=tuple(c for c in plan.changes if c.at_s < end_s))
        try:
            packet = pack_plan(plan)
        except RefusedError as refused:
            # The valves stay on the last plan until its lease ends.
            _logger.warning("plan not sent: %s", refused)
            self.unsent_count += 1
            return
        self._send(packet)

    async def stop(self) -> None:
        """Have the engine close everything and end; one that does not is killed."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        child = self._child
        if child is not None:
            self._is_stopping = True
            self._send(pack(Kind.STOP))
            with suppress(TimeoutError):
                await asyncio.wait_for(self._ended.wait(), STOP_MAX_S)
            if not self._ended.is_set():
                child.kill()
                self._held.take(asyncio.get_running_loop().time())
            self._disconnect()
            # It has closed its end or was killed: what is left of its end is short.
            await child.ended(KILL_MAX_S)
            self._child = None
            _logger.info(
                "%d edges, latest by %.1f ms, %d plans refused, %d leases ended, %d standstills",
                self.status.edges,
                self.status.worst_late_us / 1e3,
                self.status.rejected,
                self.status.lease_ends,
                self.status.stops,
            )
        self._held.release()

    # ------------------------------------------------------------------------------- inside

    def _send(self, packet: bytes) -> None:
        # A full socket: the engine stands still, and is soon missed.
        if self._child is None or not self._child.send(packet):
            self.unsent_count += 1

    def _read(self) -> None:
        """Take what the engine sent."""
        if self._child is None:
            return
        for packet in self._child.packets():
            if not packet:
                self._engine_ended()
                return
            self._heard_s = asyncio.get_running_loop().time()
            try:
                self._take(*unpack(packet))
            except RefusedError as refused:
                self._fail(f"valve engine: {refused}")

    def _take(self, kind: Kind, body: bytes) -> None:
        if kind is Kind.STATUS:
            before, self.status = self.status, status_from(body)
            if before.rejected != self.status.rejected:
                _logger.warning("the valve engine refused a plan")
            if before.stops != self.status.stops:
                _logger.warning("the valve engine stood still and closed everything")
        elif kind is Kind.EDGES:
            edges = edges_from(body)
            self.issued.extend(edges)
            for edge in edges:
                self.lateness.add(max(edge.actual_s - edge.planned_s, 0.0))
            if self.on_issued is not None:
                self.on_issued(edges)
            if self.on_order is not None:
                self._tell_orders(self.on_order, edges)
        elif kind is Kind.READY:
            self._take_ready(json.loads(body))
        elif kind is Kind.FAULT:
            text = body.decode(errors="replace")
            # Before it is ready: it could not have its lines, and that is its whole self-test.
            self.self_test = self.self_test or SelfTest(fault=text)
            self._fail(f"valve engine: {text}")

    def _tell_orders(self, on_order: OnOrder, edges: Sequence[Issued]) -> None:
        for edge in edges:
            if edge.output < self._count and edge.duty != self._told_duty.get(edge.output, 0.0):
                self._told_duty[edge.output] = edge.duty
                on_order(edge.output, edge.duty, edge.planned_s, edge.actual_s)

    def _take_ready(self, ready: dict[str, Any]) -> None:
        self.warnings = list(ready["warnings"])
        self.self_test = SelfTest.from_object(ready["self_test"])
        if self.self_test.fault:
            self._fail(f"valve engine: {self.self_test.fault}")
        self._ready.set()

    def _engine_ended(self) -> None:
        """Let go of an engine that ended, or is to: what it leaves is closed from here."""
        self._disconnect()
        self._ended.set()
        if not self._is_stopping and self._child is not None:
            self._fail("valve engine ended by itself")
            self._child.kill()
            self._held.take(asyncio.get_running_loop().time())

    def _disconnect(self) -> None:
        if self._child is not None and self._child.is_connected:
            asyncio.get_running_loop().remove_reader(self._child.socket)
            self._child.disconnect()

    def _watch(self) -> None:
        """Look whether the engine lives; what it sent while this process was busy counts."""
        loop = asyncio.get_running_loop()
        self._timer = loop.call_later(WATCH_S, self._watch)
        self._read()
        now_s = loop.time()
        if not (self._ended.is_set() or now_s - self._heard_s <= SILENCE_MAX_S):
            self._fail(f"valve engine silent for {now_s - self._heard_s:.2f} s")
            self._engine_ended()
        elif self._ended.is_set():
            self._held.take(now_s)
        if not now_s - self._checked_s < _LATE_CHECK_S:
            self._checked_s = now_s
            late_s = self.lateness.quantile_s(0.99)
            enough = len(self.lateness.recent_s) >= _LATE_COUNT_MIN
            if enough and late_s is not None and not late_s <= self._late_max_s:
                self._fail(f"valves late: 1 % of edges by more than {late_s * 1e3:.1f} ms")
                # It closes by itself when its lease ends; this is sooner.
                self._send(pack(Kind.STOP))

    def _fail(self, text: str) -> None:
        """Note the first fault; whoever waits for the start need not."""
        if self._fault is None:
            self._fault = text
        self._ready.set()


# Lines of an engine that is gone: driven to their safe levels from here, and held there.

# Somebody else may still hold them: tried soon, and later not more often than this.
FIRST_S, MOST_S = 0.05, 1.0


class HeldLines:
    """Takes the lines as soon as they can be had; `take` is called again and again."""

    def __init__(self, setup: EngineSetup) -> None:
        self._setup = setup
        self._lines: Lines | None = None
        self._next_s, self._wait_s = float("-inf"), FIRST_S
        self._told = ""

    def take(self, now_s: float) -> None:
        """Have them at their safe levels; what prevents it is logged once."""
        if self._lines is not None or now_s < self._next_s:
            return
        try:
            self._lines = open_lines(self._setup)
        except ActuatorError as error:
            if self._told != str(error):
                self._told = str(error)
                _logger.error("lines cannot be taken over: %s", error)
            self._next_s, self._wait_s = now_s + self._wait_s, min(2.0 * self._wait_s, MOST_S)

    def release(self) -> None:
        """Let go of them."""
        if self._lines is not None:
            with suppress(OSError):
                self._lines.release()
            self._lines = None
