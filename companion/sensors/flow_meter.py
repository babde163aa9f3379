"""A pulse flow meter as a sensor: edges from a line, counts to the core.

Edges come through `EdgeSource`: from the kernel's GPIO (`cli/sensor_parts.py`) or from a list.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from companion.core.types import FlowReport, Input


class EdgeSource(Protocol):
    """Rising edges of one line, in their order."""

    def open(self) -> None:
        """Take the line."""

    def read(self) -> Sequence[Edge]:
        """Return what came since the last call; never waits. OSError where the line is gone."""

    def close(self) -> None:
        """Let go of the line; may be called twice and before `open`."""


class VirtualEdges:
    """Edges that are put in by hand: for tests and for a bench without a meter."""

    def __init__(self) -> None:
        self.is_open = False
        self._edges: list[Edge] = []
        self._number = 0

    def put(self, *times_s: float, lost: int = 0) -> None:
        """Add edges at these times, `lost` of them before the first dropped by the kernel."""
        self._number += lost
        for at_s in times_s:
            self._number += 1
            self._edges.append(Edge(at_s, self._number))

    def open(self) -> None:
        """Begin."""
        self.is_open = True

    def read(self) -> Sequence[Edge]:
        """Return what was put in."""
        edges, self._edges = self._edges, []
        return edges

    def close(self) -> None:
        """End."""
        self.is_open = False


class FlowMeter:
    """Counts while it is open; read at every step."""

    def __init__(self, meter: Meter, source: EdgeSource) -> None:
        self.counter = PulseCounter(meter)
        self._source = source

    async def open(self, wake: Callable[[], None]) -> None:  # noqa: ARG002 - steps come anyway
        """Take the line: SensorError where that cannot be had."""
        self._source.open()

    def read(self, now_s: float) -> Sequence[Input]:
        """Return the count, or why there is none."""
        try:
            edges = self._source.read()
        except OSError as error:
            text = f"flow meter: its line cannot be read: {error.strerror or error}"
            return [FlowReport(received_s=now_s, volume_ml=math.nan, fault=text)]
        for edge in edges:
            self.counter.take(edge)
        return [self.counter.report(now_s)]

    def volume_ml(self) -> float:
        """Return what has been counted since the start."""
        return self.counter.volume_ml

    async def close(self) -> None:
        """Let go of the line."""
        self._source.close()


# Counting the pulses of a flow meter by the times that the kernel gave to their edges.
#
# A late reader loses nothing: the count is known at the time of its last edge, exactly. The kernel
# numbers the edges of a line, so that edges which its buffer dropped are known too.

# A mean over whole PWM periods of about this time; edges are kept for twice of it.
WINDOW_S = 1.0
KEPT_S = 2.0 * WINDOW_S
# A pulse that follows the last one sooner than half the shortest period is an echo of its edge.
ECHO_SHARE = 0.5
ECHOES_MAX = 0.05
# A meter that has lost or added pulses is not believed for this long after the last of them.
FAULT_S = 1.0


class Edge(NamedTuple):
    """One rising edge: when, on the monotonic clock, and its number on the line, from 1."""

    at_s: float
    number: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Meter:
    """What is known of the meter: its factor, and the largest flow that can be."""

    pulses_per_l: float
    flow_max_l_min: float
    pwm_period_s: float

    def __post_init__(self) -> None:
        for name in ("pulses_per_l", "flow_max_l_min", "pwm_period_s"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")

    @property
    def period_min_s(self) -> float:
        """Return the time between two pulses at the largest flow.

        >>> Meter(pulses_per_l=6000.0, flow_max_l_min=10.0, pwm_period_s=0.1).period_min_s
        0.001
        """
        return 60.0 / (self.pulses_per_l * self.flow_max_l_min)

    @property
    def window_s(self) -> float:
        """Return whole PWM periods: in their mean the pulses of the valves cancel."""
        return max(round(WINDOW_S / self.pwm_period_s), 1) * self.pwm_period_s


class PulseCounter:
    """Edges in, counts out; pure, it knows no clock but that of the edges."""

    def __init__(self, meter: Meter) -> None:
        self.meter = meter
        self.count = 0
        self.lost_count = 0
        self.echo_count = 0
        self._edges: deque[tuple[float, int]] = deque()  # time, count with it
        self._echoes: deque[float] = deque()
        self._number: int | None = None
        self._lost_s = -math.inf
        self._is_loss_told = True
        self._reported_s = -math.inf

    def take(self, edge: Edge) -> None:
        """Count an edge; those that its number shows to be lost are counted with it."""
        at_s = edge.at_s
        if not math.isfinite(at_s):
            return
        lost = 0 if self._number is None else edge.number - self._number - 1
        self._number = edge.number
        if lost > 0:
            self.count += lost
            self.lost_count += lost
            self._lost_s = at_s
            self._is_loss_told = False
        if self._edges and not at_s - self._edges[-1][0] >= ECHO_SHARE * self.meter.period_min_s:
            self.echo_count += 1
            self._echoes.append(at_s)
            return
        self.count += 1
        self._edges.append((at_s, self.count))
        while self._edges[0][0] < at_s - KEPT_S:
            self._edges.popleft()
        while self._echoes and self._echoes[0] < at_s - KEPT_S:
            self._echoes.popleft()

    @property
    def volume_ml(self) -> float:
        """Return what has been counted since the start."""
        return self.count * 1000.0 / self.meter.pulses_per_l

    def fault(self, now_s: float) -> str:
        """Return in words why the count cannot be believed; empty while it can."""
        if not self._is_loss_told:
            # What a full buffer drops are its oldest edges: at the first look the loss is as old
            # as all that the buffer holds.
            self._lost_s, self._is_loss_told = max(self._lost_s, now_s), True
        if not now_s - self._lost_s > FAULT_S:
            return f"flow meter: {self.lost_count} pulses lost"
        echoes = sum(1 for at_s in self._echoes if now_s - at_s <= FAULT_S)
        if echoes > ECHOES_MAX * max(len(self._edges), 20):
            return "flow meter: pulses come twice; shield its wire, check its pull-up"
        flow_l_min = self.flow_l_min(now_s)
        if not flow_l_min <= 1.1 * self.meter.flow_max_l_min:
            return (
                f"flow meter: {flow_l_min:.1f} L/min, more than flow_meter.flow_max_l_min = "
                f"{self.meter.flow_max_l_min:g}"
            )
        return ""

    def flow_l_min(self, now_s: float) -> float:
        """Return the mean flow of the last whole PWM periods; 0 where nothing came in them."""
        if not self._edges or not now_s - self._edges[-1][0] < self.meter.window_s:
            return 0.0
        last_s, last = self._edges[-1]
        from_s = last_s - self.meter.window_s
        before: tuple[float, int] | None = None
        for at_s, count in self._edges:
            if at_s > from_s:
                then = float(count - 1)
                if before is not None:
                    share = (from_s - before[0]) / (at_s - before[0])
                    then = before[1] + share * (count - before[1])
                pulses = last - then
                break
            before = (at_s, count)
        return pulses / self.meter.window_s * 60.0 / self.meter.pulses_per_l

    def report(self, now_s: float) -> FlowReport:
        """Return the count, at the time of its last edge where that is news, else now."""
        fault = self.fault(now_s)
        at_s = now_s
        if self._edges and self._reported_s < self._edges[-1][0] <= now_s:
            at_s = self._edges[-1][0]
        self._reported_s = at_s
        if fault:
            return FlowReport(received_s=at_s, volume_ml=math.nan, fault=fault)
        return FlowReport(received_s=at_s, volume_ml=self.volume_ml)
