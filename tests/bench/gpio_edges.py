"""How late edges are: 24 valves at 11 Hz beside a busy parent: `python -m tests.bench.gpio_edges`.

The same plans, twenty a second, go to the valve engine (its own process, with and without
real-time priority), to the same engine on the parent's event loop, and to one on a thread of the
parent. The parent spends its time on JSON, as a journal, a page and a link make it do. The lines
are memory: what is measured is waiting, not the GPIO call (27 to 35 us in a User-Mode-Linux
kernel). An edge counts as late from its planned time until after its write.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from companion.core.types import PwmLimits, SprayPlan, TimedChange
from companion.output.engine.engine import Engine
from companion.output.engine.lines import MemoryLines
from companion.output.engine.process import boot_s
from companion.output.engine.wire import (
    EngineSetup,
    Issued,
    Kind,
    Wiring,
    edges_from,
    pack_plan,
    unpack,
)
from companion.output.gpio import GpioExecutor
from companion.runtime import precise_event_loop
from tests.bench.figures import Figure

VALVES, PLAN_S, LEASE_S = 24, 0.05, 0.3
PWM = PwmLimits(frequency_hz=11.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01)
TARGET_FIFO_MS, TARGET_PLAIN_MS, TARGET_CPU_PERCENT = 1.0, 3.0, 5.0
DUTIES = (0.3, 0.5, 0.65, 0.8)
_ROW = {"row": list(range(200)), "text": "x" * 500}


def setup(*, realtime: bool) -> EngineSetup:
    """Return 24 valves, a return valve and an ALIVE line in memory."""
    wiring = Wiring(valves=tuple(range(VALVES)), return_line=VALVES, alive_line=VALVES + 1)
    return EngineSetup(wiring=wiring, pwm=PWM, backend="memory", realtime=realtime)


def plan(number: int, now_s: float) -> SprayPlan:
    """Return a plan: all duties move with every twentieth, as zones do once a second."""
    zone = number // 20
    duty = tuple(DUTIES[(zone + valve) % len(DUTIES)] for valve in range(VALVES))
    after = tuple(DUTIES[(zone + 1 + valve) % len(DUTIES)] for valve in range(VALVES))
    at_s = now_s + (20 - number % 20) * PLAN_S
    changes = [TimedChange(at_s=at_s, valve=valve, duty=d) for valve, d in enumerate(after)]
    return SprayPlan(
        sequence=number,
        issued_s=now_s,
        duty=duty,
        changes=tuple(changes),
        lease_until_s=now_s + LEASE_S,
    )


def burn(for_s: float) -> None:
    """Be busy with the interpreter in hand."""
    end_s = time.monotonic() + for_s
    while time.monotonic() < end_s:
        json.loads(json.dumps(_ROW))


async def busy(until_s: float) -> None:
    """Keep the event loop busy: 5 ms of JSON, then whoever waits has a turn."""
    while time.monotonic() < until_s:
        burn(0.005)
        await asyncio.sleep(0.0005)


def cpu_s(pid: int) -> float:
    """Return the processor time that a process has had."""
    try:
        return int(Path(f"/proc/{pid}/schedstat").read_text().split()[0]) * 1e-9
    except FileNotFoundError:
        return math.nan  # it ended: its fault tells why


def wakes(pid: int) -> int:
    """Return how often a process has gone to sleep by itself, to be woken again."""
    try:
        text = Path(f"/proc/{pid}/status").read_text()
    except FileNotFoundError:
        return 0
    return int(text.partition("\nvoluntary_ctxt_switches:")[2].split()[0])


async def own_process(for_s: float, *, realtime: bool) -> dict[str, Any]:
    """Return what the engine shows as a process of its own."""
    executor = GpioExecutor(setup(realtime=realtime), late_max_s=math.inf)
    executor.issued = type(executor.issued)(maxlen=1_000_000)
    await executor.start()
    pid = executor.engine_pid or 0
    begin_s = time.monotonic()
    begin_cpu_s, begin_wakes = cpu_s(pid), wakes(pid)
    load = asyncio.create_task(busy(begin_s + for_s))
    number = 0
    while time.monotonic() < begin_s + for_s:
        executor.submit(plan(number, time.monotonic()))
        number += 1
        await asyncio.sleep(PLAN_S)
    took_s = time.monotonic() - begin_s
    share, woken = (cpu_s(pid) - begin_cpu_s) / took_s, wakes(pid) - begin_wakes
    await load
    found = _figures(list(executor.issued))
    status, warnings, fault = executor.status, executor.warnings, executor.fault
    await executor.stop()
    return found | {
        "cpu_percent": 100.0 * share,
        "wakes_a_second": woken / took_s,
        "us_a_wake": 1e6 * share * took_s / max(woken, 1),
        "writes_a_second": status.writes / took_s,
        "standstills": status.stops,
        "dropped_reports": status.dropped_reports,
        "refused_plans": status.rejected,
        "lease_ends": status.lease_ends,
        "fault": fault,
        "realtime": realtime and not any("priority" in text for text in warnings),
    }


class InProcess:
    """The same engine without a process of its own; its reports stay here."""

    def __init__(self) -> None:
        self.issued: list[Issued] = []
        given = setup(realtime=False)
        self.engine = Engine(
            given,
            MemoryLines(given.wiring.safe_levels),
            clock=time.monotonic,
            boot_clock=boot_s,
            send=self._take,
        )

    def _take(self, packet: bytes) -> bool:
        kind, body = unpack(packet)
        if kind is Kind.EDGES:
            self.issued += edges_from(body)
        return True

    def submit(self, number: int) -> None:
        """Hand it a plan by the same bytes."""
        self.engine.receive(*unpack(pack_plan(plan(number, time.monotonic()))))

    def figures(self) -> dict[str, Any]:
        """Return what it showed."""
        return _figures(self.issued) | {"standstills": self.engine.stops}


async def on_the_loop(for_s: float) -> dict[str, Any]:
    """Return what the same engine shows on timers of the busy event loop."""
    mine = InProcess()
    loop = asyncio.get_running_loop()
    end_s = time.monotonic() + for_s

    def wake() -> None:
        mine.engine.turn()
        if time.monotonic() < end_s:
            loop.call_at(mine.engine.next_s, wake)

    loop.call_soon(wake)
    load = asyncio.create_task(busy(end_s))
    number = 0
    while time.monotonic() < end_s:
        mine.submit(number)
        number += 1
        await asyncio.sleep(PLAN_S)
    await load
    return mine.figures()


async def on_a_thread(for_s: float) -> dict[str, Any]:
    """Return what the same engine shows on a thread beside the busy event loop."""
    mine = InProcess()
    end_s = time.monotonic() + for_s
    numbers = iter(range(1_000_000))
    next_plan_s = [time.monotonic()]

    def run() -> None:
        while time.monotonic() < end_s:
            # The thread makes the plans itself: no lock between the two may be blamed.
            if next_plan_s[0] <= time.monotonic():
                mine.submit(next(numbers))
                next_plan_s[0] += PLAN_S
            mine.engine.turn()
            wait_s = min(mine.engine.next_s, next_plan_s[0]) - time.monotonic()
            if wait_s > 0.0:
                time.sleep(wait_s)

    thread = threading.Thread(target=run)
    thread.start()
    await busy(end_s)
    await asyncio.to_thread(thread.join)
    return mine.figures()


def _figures(issued: Iterable[Issued]) -> dict[str, Any]:
    """Return lateness [ms], and edges skipped: two moves of one output that are no change."""
    edges = list(issued)
    late_ms = sorted((edge.actual_s - edge.planned_s) * 1e3 for edge in edges)
    if not late_ms:
        return {"edges": 0}
    return {
        "edges": len(edges),
        "skipped": skipped(edges),
        "median_ms": late_ms[len(late_ms) // 2],
        "p99_ms": late_ms[int(0.99 * len(late_ms))],
        "p999_ms": late_ms[int(0.999 * len(late_ms))],
        "max_ms": late_ms[-1],
    }


def skipped(edges: Iterable[Issued]) -> int:
    """Return how many periods a pulsing valve went without a pulse."""
    last: dict[int, float] = {}
    count = 0
    for edge in edges:
        if edge.is_open and edge.duty > 0.0:
            before_s = last.get(edge.output)
            if before_s is not None:
                # A zone restarts the period, so up to half a period more lies between.
                count += max(int((edge.planned_s - before_s) / PWM.period_s - 0.8), 0)
            last[edge.output] = edge.planned_s
        elif edge.duty == 0.0:
            last.pop(edge.output, None)
    return count


def measure(for_s: float) -> dict[str, dict[str, Any]]:
    """Return all four ways, one after the other."""
    ways: dict[str, Callable[[], Any]] = {
        "process, SCHED_FIFO": lambda: own_process(for_s, realtime=True),
        "process, SCHED_OTHER": lambda: own_process(for_s, realtime=False),
        "asyncio": lambda: on_the_loop(for_s),
        "thread": lambda: on_a_thread(for_s),
    }
    found = {}
    for name, way in ways.items():
        with asyncio.Runner(loop_factory=precise_event_loop) as runner:
            found[name] = runner.run(way())
    return found


def gpio_edges(*, seed: int = 0, is_quick: bool = False) -> list[Figure]:
    """Return the figures; `seed` is not used: nothing here is drawn."""
    found = measure(5.0 if is_quick else 20.0)
    fifo, plain = found["process, SCHED_FIFO"], found["process, SCHED_OTHER"]
    others = {name: found[name].get("p99_ms") for name in ("asyncio", "thread")}
    if not fifo["realtime"]:
        fifo = {}
    return [
        Figure(
            key="gpio_p99_fifo_ms",
            what="24 valves at 11 Hz, real-time: lateness of edges, p99",
            value=fifo.get("p99_ms"),
            unit="ms",
            n=fifo.get("edges", 0),
            target=TARGET_FIFO_MS,
            alternative=others,
            details=found | {"load_average": os.getloadavg()[0]},
        ),
        Figure(
            key="gpio_p99_plain_ms",
            what="the same without real-time priority",
            value=plain["p99_ms"],
            unit="ms",
            n=plain["edges"],
            target=TARGET_PLAIN_MS,
            alternative=others,
        ),
        Figure(
            key="gpio_skipped",
            what="pulses skipped",
            value=max(way.get("skipped", 0) for way in (fifo, plain)),
            unit="",
            n=plain["edges"] + fifo.get("edges", 0),
            target=0.0,
        ),
        Figure(
            key="gpio_cpu_percent",
            what="processor of the valve engine, of one core",
            value=fifo.get("cpu_percent", plain["cpu_percent"]),
            unit="%",
            n=plain["edges"],
            target=TARGET_CPU_PERCENT,
        ),
    ]


def main(arguments: list[str]) -> int:
    """Print all four ways; the argument is how long each is measured [s]."""
    for_s = float(arguments[0]) if arguments else 20.0
    load = os.getloadavg()[0]
    found = measure(for_s)
    about = {"seconds": for_s, "load": load, "cores": os.cpu_count()}
    sys.stdout.write(json.dumps(about | found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
