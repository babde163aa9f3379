"""How each kind of fault is done to a flight."""

from __future__ import annotations

import asyncio
import math
import resource
import signal
import time
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING

from sitl.stub.faults import Fault, FaultClock, FaultKind
from sitl.stub.mission_items import LOITER, Phase
from tests.bench.faults.cases import PROCESS_KINDS, Draw, Kind
from tests.bench.faults.place import ORIGIN
from tests.bench.faults.record import Struck
from tests.bench.faults.wire import HEARTBEAT, POSITION

if TYPE_CHECKING:
    from tests.bench.faults.flight import Flight

STALE_S = 1.2
STOP_AFTER_FULL_S = 1.5
_DEGREES_E7 = 1e-7


async def strike(flight: Flight) -> None:
    """Do to a flight what its case says."""
    kind = flight.draw.case.kind
    if kind in PROCESS_KINDS:
        await _signal(flight)
    else:
        await _STRIKES[kind](flight)


async def _signal(flight: Flight) -> None:
    names, _, whom = flight.draw.case.kind.value.rpartition(" ")
    engine = flight.engine_pid or 0
    pids = {"companion": [flight.pid], "engine": [engine], "both": [flight.pid, engine]}[whom]
    if flight.draw.engine_first:
        pids.reverse()
    for name in names.split(", "):
        if name == "SIGCONT":
            await asyncio.sleep(flight.draw.stands_s)
        await _send(flight, pids, signal.Signals[name])


async def _send(flight: Flight, pids: list[int], number: signal.Signals) -> None:
    for place, pid in enumerate(pids):
        if place > 0:
            await asyncio.sleep(flight.draw.apart_s)
        # One may be dead already by the other's end, or by the other's hand.
        if pid not in flight.deaths:
            flight.send(pid, number)


async def _disable(flight: Flight) -> None:
    flight.vehicle.enable(False)


async def _disarm(flight: Flight) -> None:
    flight.vehicle.autopilot.flight.armed = False
    flight.vehicle.beat()


async def _leave_mode(flight: Flight) -> None:
    flight.vehicle.autopilot.flight.mode = LOITER
    flight.vehicle.beat()


async def _land(flight: Flight) -> None:
    flight.vehicle.autopilot.flight.phase = Phase.DESCEND
    flight.vehicle.tell_landed()


async def _drop_positions(flight: Flight) -> None:
    flight.vehicle.wire.dropped = frozenset({POSITION})


async def _drop_heartbeats(flight: Flight) -> None:
    flight.vehicle.wire.dropped = frozenset({HEARTBEAT})


async def _silence(flight: Flight) -> None:
    flight.vehicle.wire.dropped = None


async def _freeze(flight: Flight) -> None:
    fault = Fault(kind=FaultKind.STALE_POSITION)
    flight.vehicle.autopilot.faults = FaultClock((fault,), start_s=time.monotonic())


async def _stick(flight: Flight) -> None:
    kept: list[tuple[int, int]] = []

    def same(place: tuple[int, int]) -> tuple[int, int]:
        kept.append(place)
        return kept[0]

    flight.vehicle.wire.place = same


async def _make_stale(flight: Flight) -> None:
    flight.vehicle.wire.late_s = STALE_S


async def _jump(flight: Flight) -> None:
    north, east = jump_of(flight.draw)

    def shifted(place: tuple[int, int]) -> tuple[int, int]:
        return place[0] + north, place[1] + east

    flight.vehicle.wire.place = shifted


def jump_of(draw: Draw) -> tuple[int, int]:
    """Return by how much the positions jump, north and east, in 1e-7 degrees: 3 to 30 m."""
    distance_m = 3.0 * 10.0**draw.share
    angle = 2.0 * math.pi * draw.second_share
    latitude, longitude = ORIGIN.to_geographic(
        east_m=distance_m * math.cos(angle), north_m=distance_m * math.sin(angle)
    )
    return (
        round((float(latitude) - ORIGIN.latitude_deg) / _DEGREES_E7),
        round((float(longitude) - ORIGIN.longitude_deg) / _DEGREES_E7),
    )


async def _zero(flight: Flight) -> None:
    flight.vehicle.wire.place = lambda place: (0, 0)


async def _reboot(flight: Flight) -> None:
    """Fall silent with no pulses, and come back some time later, disarmed, with a new clock."""
    vehicle = flight.vehicle
    vehicle.wire.dropped = None
    vehicle.autopilot.outputs.reset(time.monotonic())
    vehicle.autopilot.flight.armed = False
    await asyncio.sleep(0.1 + 1.4 * flight.draw.share)
    vehicle.reboot()
    vehicle.wire.dropped = frozenset()
    vehicle.beat()


async def _fill_disk(flight: Flight) -> None:
    """Let it write no file any more, as on a full disk but for the number of the error."""
    hard = resource.prlimit(flight.pid, resource.RLIMIT_FSIZE)[1]
    resource.prlimit(flight.pid, resource.RLIMIT_FSIZE, (0, hard))
    await asyncio.sleep(STOP_AFTER_FULL_S)
    flight.vehicle.enable(False)


async def _lose_link(flight: Flight) -> None:
    flight.struck.append(Struck(time.monotonic(), "link"))
    await flight.vehicle.hang_up()


async def _lose_chip(flight: Flight) -> None:
    flight.struck.append(Struck(time.monotonic(), "chip"))
    flight.chip.gone.touch()


_STRIKES: dict[Kind, Callable[[Flight], Awaitable[None]]] = {
    Kind.DISABLED: _disable,
    Kind.DISARMED: _disarm,
    Kind.MODE: _leave_mode,
    Kind.LANDING: _land,
    Kind.ABSENT: _drop_positions,
    Kind.FROZEN: _freeze,
    Kind.STUCK: _stick,
    Kind.STALE: _make_stale,
    Kind.JUMP: _jump,
    Kind.ZERO: _zero,
    Kind.NO_HEARTBEAT: _drop_heartbeats,
    Kind.SILENCE: _silence,
    Kind.REBOOT: _reboot,
    Kind.DISK_FULL: _fill_disk,
    Kind.LINK_TCP: _lose_link,
    Kind.LINK_PTY: _lose_link,
    Kind.CHIP_GONE: _lose_chip,
}
