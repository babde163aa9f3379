"""From a message of the vehicle to the last order's bytes: the companion's own share.

The whole companion runs in one process with a vehicle on UDP loopback, as `vrspray run` has it:
link, core, servo output, journal. The clock starts when the event loop hands the datagram over,
and stops when the socket has taken the last order; what the vehicle's side costs is not in it.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from companion.core.options.coverage import Coverage
from companion.core.setup import Setup
from companion.core.types import Decision, Input, OperatorCommand, Telemetry
from companion.journal.journal import Journal
from companion.link.component import ComponentOptions
from companion.link.vehicle_link import VehicleLink
from companion.output.servo import ServoExecutor, ServoOptions
from companion.ports import Recorder
from companion.runtime import NoRecorder, execute, run
from tests.bench.fields import grid_setup
from tests.bench.figures import Figure, spread
from tests.companion.wire_peer import WirePeer, free_port, over_udp

VALVE_COUNT = 24
# ArduPilot counts its outputs from 1 to 32.
CHANNELS = tuple(range(1, VALVE_COUNT + 1))
PAUSE_S = 0.05
WARM_UP = 6  # even: it ends as it began
TARGET_S = 0.005


@dataclass(slots=True)
class Stamps:
    """Takes the times of a flight; a recorder in front of another one."""

    recorder: Recorder
    wish_s: float | None = None
    position_s: float | None = None
    orders_s: list[float] = field(default_factory=list)
    to_orders_s: list[float] = field(default_factory=list)
    to_plan_s: list[float] = field(default_factory=list)
    taken: asyncio.Event = field(default_factory=asyncio.Event)

    def record_input(self, item: Input) -> None:
        """Remember when what decides was received."""
        if isinstance(item, OperatorCommand):
            self.wish_s = item.received_s
            self.orders_s.clear()
        elif isinstance(item, Telemetry):
            self.position_s = item.received_s
        self.recorder.record_input(item)

    def record_coverage(self, coverage: Coverage) -> None:
        """Pass it on."""
        self.recorder.record_coverage(coverage)

    def record_decision(self, decision: Decision) -> None:
        """Take the times: the executor has the plan, and what was due has left."""
        if self.position_s is not None:
            self.to_plan_s.append(time.monotonic() - self.position_s)
            self.position_s = None
        if self.wish_s is not None and len(self.orders_s) >= VALVE_COUNT:
            self.to_orders_s.append(self.orders_s[-1] - self.wish_s)
            self.taken.set()
        self.wish_s = None
        self.recorder.record_decision(decision)

    def record_event(self, at_s: float, kind: str, text: str) -> None:
        """Hand it on."""
        self.recorder.record_event(at_s, kind, text)


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """Seconds from messages to orders, and from positions to plans."""

    to_orders_s: tuple[float, ...]
    to_plan_s: tuple[float, ...]


def arrivals(*, seed: int, count: int = 300, side: int = 150) -> list[Figure]:
    """Measure with a journal as in flight, and without one beside it."""
    setup = grid_setup(side, side, valve_count=VALVE_COUNT, seed=seed)
    with (
        tempfile.TemporaryDirectory() as folder,
        Journal.create(Path(folder), setup=setup) as journal,
    ):
        full = measure(setup, journal, count)
    bare = measure(setup, NoRecorder(), count)
    return [
        _figure("message_to_orders", "a message to the last of 24 orders", full, bare, "orders"),
        _figure(
            "position_to_plan", "a position to the new plan at the executor", full, bare, "plan"
        ),
    ]


def _figure(key: str, what: str, full: Measured, bare: Measured, which: str) -> Figure:
    samples = full.to_orders_s if which == "orders" else full.to_plan_s
    beside = bare.to_orders_s if which == "orders" else bare.to_plan_s
    found = spread(samples)
    return Figure(
        key=key,
        what=f"{what}: p99",
        value=found["p99"] * 1e3,
        unit="ms",
        n=len(samples),
        target=TARGET_S * 1e3,
        alternative={"without a journal": spread(beside)["p99"] * 1e3},
        details={f"{name}_ms": value * 1e3 for name, value in found.items()},
    )


def measure(setup: Setup, recorder: Recorder, count: int) -> Measured:
    """Run the companion and let the operator enable and disable it `count` times."""
    found: list[Stamps] = []
    try:
        execute(lambda: _flight(setup, recorder, count, found.append))
    finally:
        gc.unfreeze()
    return Measured(to_orders_s=tuple(found[0].to_orders_s), to_plan_s=tuple(found[0].to_plan_s))


async def _flight(
    setup: Setup, recorder: Recorder, count: int, keep: Callable[[Stamps], None]
) -> int:
    stamps = Stamps(recorder)
    keep(stamps)
    port = free_port()
    link = VehicleLink(f"udpin:127.0.0.1:{port}", ComponentOptions())

    def order(channel: int, pulse_us: int) -> bool:
        has_left = link.order(channel, pulse_us)
        stamps.orders_s.append(time.monotonic())
        return has_left

    executor = ServoExecutor(ServoOptions(channels=CHANNELS), order)
    link.on_order_ack(executor.acknowledge)
    flying = asyncio.create_task(run(setup, link=link, executor=executor, recorder=stamps))
    try:
        async with over_udp(WirePeer(setup.frame, east_m=20.0), port) as peer:
            await peer.until(lambda: len(peer.outputs) == VALVE_COUNT)
            await _toggle(peer, stamps, count)
    finally:
        flying.cancel()
        # A companion that failed says why; that it was cancelled is no failure.
        with contextlib.suppress(asyncio.CancelledError):
            await flying
    return 0


async def _toggle(peer: WirePeer, stamps: Stamps, count: int) -> None:
    """Disable and enable at any phase of the streams; the first few are not counted."""
    rng = np.random.default_rng(0)
    peer.enable()
    await peer.until(lambda: len(peer.open_channels) == VALVE_COUNT)
    for number in range(count + WARM_UP):
        if number == WARM_UP:
            stamps.to_orders_s.clear()
            stamps.to_plan_s.clear()
        stamps.taken.clear()
        peer.enable(number % 2 == 1)
        async with asyncio.timeout(5.0):
            await stamps.taken.wait()
        await asyncio.sleep(PAUSE_S * float(rng.uniform(0.5, 1.5)))
