"""Orders that overtake each other on their way to the vehicle: no valve stays open by it.

A way that may swap two datagrams hands an order over only after one that left later. The autopilot
holds what it hears last, so an order to open that arrives behind the order to close would last
until the next refresh.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.core.types import DriveChange, DrivePlan, SprayPlan, TimedChange
from companion.output.autopilot_options import DriveOutput
from companion.output.servo import REORDER_S, ServoExecutor, ServoOptions
from tests.builders import now
from tests.companion.test_run_flight import SETUP, Companion
from tests.companion.wire_peer import WirePeer, over_wire
from tests.virtual_time import WireLink

pytestmark = pytest.mark.virtual_time


LEASE_S = 0.3
STEP_S = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Sent:
    """What left at one time: pulses by channel."""

    at_s: float
    pulses: tuple[tuple[int, int], ...]


class Air:
    """The way to the outputs: takes orders as one datagram each, or as PX4 all in one."""

    def __init__(self) -> None:
        self.sent: list[Sent] = []
        self._all: dict[int, int] = {}

    def order(self, channel: int, pulse_us: int) -> bool:
        self.sent.append(Sent(at_s=now(), pulses=((channel, pulse_us),)))
        return True

    def stage(self, channel: int, pulse_us: int) -> bool:
        self._all[channel] = pulse_us
        return True

    def flush(self) -> bool:
        self.sent.append(Sent(at_s=now(), pulses=tuple(self._all.items())))
        return True

    def arrivals(self, delay_s: Callable[[int], float]) -> list[tuple[float, int, int]]:
        """Return when each pulse arrives, where the datagrams take different ways."""
        late = sorted(
            (each.at_s + delay_s(number), number, each) for number, each in enumerate(self.sent)
        )
        return [(at_s, *pulse) for at_s, _, each in late for pulse in each.pulses]


def executor_of(air: Air, *, is_px4: bool, options: ServoOptions) -> ServoExecutor:
    if not is_px4:
        return ServoExecutor(options, air.order)
    return ServoExecutor(options, air.stage, flush=air.flush)


async def fly(
    executor: ServoExecutor, opens_s: list[tuple[float, float]], until_s: float, other: float
) -> list[float]:
    """Renew plans as the control loop does, and return when valve 0 and the pump were to close.

    They are open in these times, with trims; valve 1 has a duty of its own.
    """
    begin_s = now()
    spans = [(begin_s + a, begin_s + b) for a, b in opens_s]

    def duty(at_s: float) -> float:
        is_open = any(a <= at_s < b for a, b in spans)
        return 0.5 + 0.003 * (round((at_s - begin_s) / STEP_S) % 5) if is_open else 0.0

    for sequence in range(1, round(until_s / STEP_S)):
        at_s = now()
        edges = [edge for span in spans for edge in span if at_s < edge < at_s + LEASE_S]
        drive = DrivePlan(
            fraction=0.7 if duty(at_s) else 0.0,
            changes=tuple(
                DriveChange(at_s=edge, fraction=0.7 if duty(edge) else 0.0) for edge in edges
            ),
        )
        executor.submit(
            SprayPlan(
                sequence=sequence,
                issued_s=at_s,
                duty=(duty(at_s), other),
                changes=tuple(TimedChange(at_s=edge, valve=0, duty=duty(edge)) for edge in edges),
                lease_until_s=at_s + LEASE_S,
                drives=(drive,),
            )
        )
        await asyncio.sleep(STEP_S)
    return [b for _, b in spans]


OPTIONS = ServoOptions(
    channels=(1, 2), return_channel=3, drives=(DriveOutput(channel=4, stop_us=1100),)
)
# At rest: shut, the return valve open, the pump stopped.
REST_US = {1: 1000, 2: 1000, 3: 2000, 4: 1100}


@pytest.mark.parametrize("is_px4", [False, True], ids=["ardupilot", "px4"])
@pytest.mark.parametrize("dither_us", [0, 8])
@pytest.mark.parametrize("other", [0.0, 0.6], ids=["alone", "beside"])
@pytest.mark.parametrize("seed", range(10))
async def test_no_output_stays_open_where_orders_change_places(
    is_px4: bool, dither_us: int, other: float, seed: int
) -> None:
    chance, air = random.Random(seed), Air()
    executor = executor_of(air, is_px4=is_px4, options=replace(OPTIONS, dither_us=dither_us))
    await executor.start()
    if is_px4:
        executor.met(is_px4=True)
    spans, at_s = [], 0.5
    for _ in range(20):
        length_s = chance.uniform(0.02, 2.0)
        spans.append((at_s, at_s + length_s))
        at_s += length_s + chance.uniform(2.5 * REORDER_S, 1.5)
    closings = await fly(executor, spans, at_s, other)
    heard = air.arrivals(lambda _: chance.choice([0.0, chance.uniform(0.0, REORDER_S)]))
    await executor.stop()
    outputs = [1] if other else [1, 3, 4]
    for channel in outputs:
        for closed_s in closings:
            # What left before has arrived after one window, and the closing once more after two.
            last = [
                pulse
                for at, where, pulse in heard
                if where == channel and at <= closed_s + 2.0 * REORDER_S + 1e-3
            ]
            assert last[-1] == REST_US[channel], (channel, closed_s)


@pytest.mark.parametrize(("is_px4", "dither_us"), [(False, 0), (False, 8), (True, 0)])
async def test_nothing_that_can_wait_leaves_shortly_before_a_planned_closing(
    is_px4: bool, dither_us: int
) -> None:
    air = Air()
    executor = executor_of(air, is_px4=is_px4, options=replace(OPTIONS, dither_us=dither_us))
    await executor.start()
    if is_px4:
        executor.met(is_px4=True)
    spans = [(2.0 * number, 2.0 * number + 1.0 + 0.013 * number) for number in range(40)]
    closings = await fly(executor, spans, 81.0, 0.0)
    before = [
        sent
        for sent in air.sent
        for closed_s in closings
        if closed_s - REORDER_S < sent.at_s < closed_s - 1e-3
        and any(pulse != REST_US[channel] for channel, pulse in sent.pulses if channel != 2)
    ]
    # The return valve opens ahead of the valves, which on PX4 is an order to all of them.
    lead_s = 0.025 + 1e-3
    assert not [
        sent
        for sent in before
        if not (is_px4 and any(0.0 < closed_s - sent.at_s < lead_s for closed_s in closings))
    ]
    await executor.stop()


async def test_a_valve_that_opens_again_is_not_closed_once_more() -> None:
    air = Air()
    executor = executor_of(air, is_px4=False, options=OPTIONS)
    await executor.start()
    begin_s = now()
    (_, closed_s) = await fly(executor, [(0.1, 0.5), (0.55, 2.0)], 1.5, 0.0)
    shut = [sent for sent in air.sent if sent.pulses == ((1, 1000),) and sent.at_s > begin_s + 0.2]
    assert len(shut) == 1
    assert closed_s > now()
    await executor.stop()


async def test_a_wire_keeps_the_order_and_has_nothing_to_say_twice() -> None:
    air = Air()
    executor = ServoExecutor(replace(OPTIONS, refresh_s=10.0), air.order, baud=57_600)
    await executor.start()
    await fly(executor, [(0.1, 0.5)], 1.5, 0.0)
    assert [pulse for sent in air.sent for where, pulse in sent.pulses if where == 1][-1] == 1000
    last_s = max(sent.at_s for sent in air.sent if sent.pulses == ((1, 1000),))
    assert (
        len([sent for sent in air.sent if sent.pulses == ((1, 1000),) and sent.at_s > last_s - 0.5])
        == 1
    )
    await executor.stop()


class Swapping:
    """Hands an order to open over behind the order to close that left after it, within 0.09 s."""

    def __init__(self, peer: WirePeer) -> None:
        self._peer = peer
        self._parser = mavlink.MAVLink(None)
        self._held: dict[int, bytes] = {}
        self._closed_at_s: dict[int, float] = {}
        self.swapped = 0
        self.stayed_open_s = 0.0

    def deliver(self, data: bytes) -> None:
        (message,) = self._parser.parse_buffer(data)
        if message.get_type() != "COMMAND_LONG" or message.command != 183:
            self._peer.feed(data)
            return
        channel, is_open = int(message.param1), message.param2 > 1000.0
        held = self._held.pop(channel, None)
        if is_open:
            if held is not None:
                self._peer.feed(held)
            self._held[channel] = data
            asyncio.get_running_loop().call_later(0.09, self._release, channel, data)
            return
        self._peer.feed(data)
        since_s = self._closed_at_s.pop(channel, None)
        if since_s is not None:
            self.stayed_open_s = max(self.stayed_open_s, now() - since_s)
        if held is not None:
            self._peer.feed(held)
            self.swapped += 1
            self._closed_at_s[channel] = now()

    def _release(self, channel: int, data: bytes) -> None:
        if self._held.get(channel) is data:
            del self._held[channel]
            self._peer.feed(data)


@pytest.mark.sitl
async def test_at_the_border_no_valve_waits_for_its_refresh() -> None:
    """The refresh that left just before its closing arrives behind it."""
    companion = Companion()
    assert isinstance(companion.link, WireLink)
    companion.start()
    west_m, _, east_m, _ = SETUP.prescription.bounds_m
    async with over_wire(WirePeer(SETUP.frame, east_m=west_m + 2.0), companion.link) as peer:
        way = Swapping(peer)
        companion.link.deliver = way.deliver  # type: ignore[method-assign]
        await peer.until(lambda: bool(peer.outputs))
        for number in range(12):
            # Refreshes have another place in each crossing: six valves take turns in a second.
            peer.place(east_m=east_m - 12.0 - 0.37 * number)
            peer.enable()
            await peer.until(lambda: len(peer.open_channels) == 6)
            await peer.until(lambda: peer.is_all_closed)
            await asyncio.sleep(1.2)
            peer.enable(False)
    companion.task.cancel()  # type: ignore[union-attr]
    await asyncio.gather(companion.task, return_exceptions=True)  # type: ignore[arg-type]
    assert way.stayed_open_s <= REORDER_S + 0.02
    assert not way.swapped
