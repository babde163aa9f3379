"""The control loop's end of the operator's page: it writes frames, and takes orders.

Pure. A frame is one small JSON object; what is no number is null in it. Places are metres in the
flight's frame.

The newest frames pass to the page's process in shared memory, written without waiting and never
full. The writer overwrites the oldest slot; a reader that falls behind loses the oldest values and
nothing else. Each slot has its number and a checksum, so that a reader that is overtaken while it
reads notices it: there is no lock that anybody could hold.

The page is a process of its own. What it shows goes through shared memory (`live.py`), which is
never full and never waited for; what it orders comes back in small packets, of which a few are
read in each step. So nothing that a browser does, or the page's own end, can delay a valve. A page
that ends is started again.
"""

from __future__ import annotations

import asyncio
import json
import logging
import math
import mmap
import os
import socket
import struct
import subprocess
import sys
import threading
import time
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal

import shapely
from shapely import Geometry

from companion.core.setup import Setup
from companion.core.types import Decision, Input, VehicleState
from companion.errors import ConfigError
from companion.simulated import SIMULATED

# ------------------------------------------------------------------------------------------- frames

# A frame that does not fit its slot goes without what stands for each valve.
_LONG = ("duty", "rates_l_ha")
_SHORT_BYTES = 500


def number(value: float | None, digits: int = 2) -> float | None:
    """Return a number for JSON; None for what is none.

    >>> number(1.2345), number(math.nan), number(None)
    (1.23, None, None)
    """
    if value is None or not math.isfinite(value):
        return None
    return round(value, digits)


def shown_key(decision: Decision) -> tuple[object, ...]:
    """Return what the operator sees at once when it changes: valves, state and reasons."""
    state = decision.state
    return (
        tuple(duty > 0.0 for duty in decision.plan.duty),
        decision.sprayer,
        decision.inhibits,
        state is not None and (state.enabled, state.estop, state.armed),
        len(decision.findings),
    )


def frame_of(decision: Decision, *, horizon_s: float) -> dict[str, Any]:
    """Return what the page shows of a decision; `horizon_s` is how far the orders look ahead."""
    state = decision.state
    found: dict[str, Any] = {
        "now_s": round(decision.now_s, 3),
        "state": decision.sprayer.value,
        "inhibits": sorted(reason.value for reason in decision.inhibits),
        "duty": [round(duty, 3) for duty in decision.plan.duty],
        "rates_l_ha": [number(rate) for rate in decision.rate_l_ha],
        "target_l_min": number(decision.target_flow_l_min, 3),
        "flow_l_min": number(decision.flow_l_min, 3),
        "out_of_range": decision.out_of_range_count,
        "findings": [
            {"kind": finding.kind.value, "text": finding.text, "valve": finding.valve}
            for finding in decision.findings[:8]
        ],
    }
    if state is not None:
        found["vehicle"] = _vehicle(state, decision.now_s, horizon_s)
        found["liquid"] = _liquid(state, decision.now_s)
    return found


def _vehicle(state: VehicleState, now_s: float, horizon_s: float) -> dict[str, Any]:
    heard_s = state.heartbeat_received_s
    return {
        "east_m": number(state.east_m),
        "north_m": number(state.north_m),
        "ahead_east_m": number(state.east_m + state.velocity_east_m_s * horizon_s),
        "ahead_north_m": number(state.north_m + state.velocity_north_m_s * horizon_s),
        "heading_deg": number(state.heading_deg, 1),
        "speed_m_s": number(math.hypot(state.velocity_east_m_s, state.velocity_north_m_s)),
        "height_m": number(state.height_m),
        "armed": state.armed,
        "mode": state.mode,
        "in_air": state.in_air,
        "enabled": state.enabled,
        "estop": state.estop,
        "fix": None if state.fix is None else int(state.fix),
        "accuracy_m": number(state.horizontal_accuracy_m, 3),
        "wind_m_s": number(state.wind_m_s, 1),
        "position_age_s": number(now_s - state.position_received_s),
        "heartbeat_age_s": None if heard_s is None else number(now_s - heard_s),
        "link_up": state.link_up,
        "rate_percent": number(state.rate_percent, 1),
    }


def _liquid(state: VehicleState, now_s: float) -> dict[str, Any]:
    flow, pressure, tank = state.flow, state.pressure, state.tank
    return {
        "meter_ml": None if flow is None else number(flow.volume_ml, 1),
        "meter_s": None if flow is None else number(flow.received_s, 3),
        "meter_age_s": None if flow is None else number(now_s - flow.received_s),
        "meter_fault": "" if flow is None else flow.fault,
        "pressure_kpa": None if pressure is None else number(pressure.pressure_kpa, 1),
        "pressure_fault": "" if pressure is None else pressure.fault,
        "tank_l": None if tank is None else number(tank.level_l),
        "tank_fault": "" if tank is None else tank.fault,
    }


def packed(frame: dict[str, Any], most_bytes: int) -> bytes:
    """Return a frame as JSON of at most `most_bytes`, without the valves where it needs be.

    Names that are long without end leave only what is short.
    """
    data = _json(frame)
    if len(data) > most_bytes:
        data = _json({key: value for key, value in frame.items() if key not in _LONG})
    if len(data) > most_bytes:
        short = {key: value for key, value in frame.items() if len(_json(value)) <= _SHORT_BYTES}
        data = _json({key: [] for key in frame if key not in _LONG} | short)
    return data


def _json(value: object) -> bytes:
    return json.dumps(value, separators=(",", ":"), allow_nan=False).encode()


def map_object(setup: Setup) -> dict[str, Any]:
    """Return the ground and the boom as the page draws them, in metres of the flight's frame."""
    prescription, boom = setup.prescription, setup.boom
    return {
        "origin": {
            "latitude_deg": setup.frame.latitude_deg,
            "longitude_deg": setup.frame.longitude_deg,
        },
        "bounds_m": [round(side, 2) for side in prescription.bounds_m],
        "sha256": prescription.sha256,
        "field": _rings(prescription.field),
        "field_m2": round(prescription.field.area, 1),
        "zones": [
            {
                "name": zone.name,
                "rate_l_ha": round(zone.rate_l_ha, 3),
                "areas": _rings(zone.polygon),
            }
            for zone in prescription.zones
        ],
        # How far orders lead the ground.
        "ahead_s": round(setup.longest_s, 3),
        "default_rate_l_ha": prescription.default_rate_l_ha,
        "boom": {
            "width_m": boom.width_m,
            "valves": [
                {
                    "name": valve.name,
                    "right_m": round(valve.right_m, 3),
                    "forward_m": round(valve.forward_m, 3),
                    "width_m": round(valve.width_m, 3),
                }
                for valve in boom.valves
            ],
        },
    }


def _rings(geometry: Geometry) -> list[list[list[float]]]:
    """Return polygons as lists of rings, a ring as east, north, east, north, ... in metres."""
    found = []
    for part in shapely.get_parts(geometry):
        rings = [part.exterior, *part.interiors]
        found.append([shapely.get_coordinates(ring).round(2).ravel().tolist() for ring in rings])
    return found


SLOTS = 256
SLOT_BYTES = 8192
_COUNT = struct.Struct("<Q")
_HEAD = struct.Struct("<QII")  # number, length, CRC-32
_BEGIN = 64
PAYLOAD_MAX = SLOT_BYTES - _HEAD.size
SIZE = _BEGIN + SLOTS * SLOT_BYTES


def new_memory() -> int:
    """Return a descriptor of anonymous memory for a ring; whoever inherits it may map it."""
    descriptor = os.memfd_create("vrspray-page", os.MFD_CLOEXEC)
    os.ftruncate(descriptor, SIZE)
    return descriptor


class RingWriter:
    """Puts values into a ring; a call copies some bytes and does nothing else."""

    def __init__(self, descriptor: int) -> None:
        self._map = mmap.mmap(descriptor, SIZE)
        (self._count,) = _COUNT.unpack_from(self._map, 0)

    def put(self, payload: bytes) -> bool:
        """Add a value; False where it is too large for a slot."""
        if len(payload) > PAYLOAD_MAX:
            return False
        number = self._count + 1
        at = _BEGIN + (number % SLOTS) * SLOT_BYTES
        _HEAD.pack_into(self._map, at, 0, 0, 0)  # a reader of the old value sees that it goes
        begin = at + _HEAD.size
        self._map[begin : begin + len(payload)] = payload
        _HEAD.pack_into(self._map, at, number, len(payload), zlib.crc32(payload))
        self._count = number
        _COUNT.pack_into(self._map, 0, number)
        return True

    def close(self) -> None:
        """Let go of the memory."""
        self._map.close()


class RingReader:
    """Takes values out of a ring that another process writes; begins with the newest."""

    def __init__(self, descriptor: int) -> None:
        self._map = mmap.mmap(descriptor, SIZE, access=mmap.ACCESS_READ)
        self._read = max(self._written() - 1, 0)

    def _written(self) -> int:
        (count,) = _COUNT.unpack_from(self._map, 0)
        return int(count)

    def news(self) -> Iterator[bytes]:
        """Yield what was written since the last call, oldest first; without what is overwritten."""
        count = self._written()
        # The slot that is overwritten next is not worth a race.
        for number in range(max(self._read + 1, count - SLOTS + 2), count + 1):
            payload = self._at(number)
            if payload is not None:
                yield payload
        self._read = max(count, self._read)

    def _at(self, number: int) -> bytes | None:
        at = _BEGIN + (number % SLOTS) * SLOT_BYTES
        found, length, checksum = _HEAD.unpack_from(self._map, at)
        if found != number or length > PAYLOAD_MAX:
            return None
        begin = at + _HEAD.size
        payload = bytes(self._map[begin : begin + length])
        return payload if zlib.crc32(payload) == checksum else None


# ------------------------------------------------------------------------------- the page's process

_logger = logging.getLogger(__name__)

# Steps come up to a step too early or too late for it.
FRAME_S, _STEP_S = 0.1, 0.01
# The state of the journal and the like: looked up once a second.
EXTRA_S = 1.0
ORDER_BYTES_MAX = 1024
ORDERS_AT_ONCE = 4
ORDERS_PER_S = 20
# An order to open that waited for longer, in a companion that stood still, is not carried out.
ENABLE_AGE_MAX_S = 1.0
# A page that ends at once is not started more often than this.
RESTART_S = 3.0
END_S, END_LOOK_S = 2.0, 0.02
EVENTS_KEPT = 40
BIND_TRIES_S = 3.0

OrderName = Literal["stop", "enable", "disable", "refilled", "declare", "field"]
ORDERS: tuple[OrderName, ...] = ("stop", "enable", "disable", "refilled", "declare", "field")
# Such an order counts in the moment in which it was given, or not at all.
MOMENTARY = ("enable", "field")
DECLARED_MAX, WORD_MAX = 8, 60


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """What the operator wants, taken at `boot_s`.

    `value` is litres for `refilled`, `said` what was declared, by dotted key, for `declare`.
    """

    number: int
    name: OrderName
    boot_s: float
    value: float | None = None
    said: tuple[tuple[str, str | float], ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What came of an order: inputs for the core, and a line for the operator."""

    accepted: bool
    text: str
    inputs: tuple[Input, ...] = ()


Obey = Callable[[Order, float], Outcome]


def parse_order(packet: bytes) -> Order | None:
    """Return the order in a packet of the page; None for anything else.

    >>> parse_order(b'{"number": 1, "name": "stop", "boot_s": 5.0}')
    Order(number=1, name='stop', boot_s=5.0, value=None, said=())
    >>> parse_order(b'{"name": "open"}') is None
    True
    """
    try:
        found = json.loads(packet)
        name, value = found["name"], found.get("value")
        if name not in ORDERS:
            return None
        return Order(
            number=int(found["number"]),
            name=name,
            boot_s=float(found["boot_s"]),
            value=None if value is None else float(value),
            said=_said(found.get("said")),
        )
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None


def _said(found: object) -> tuple[tuple[str, str | float], ...]:
    """Return what was declared, words and numbers by key; ValueError for anything else."""
    if found is None:
        return ()
    if not isinstance(found, dict) or len(found) > DECLARED_MAX:
        raise ValueError("no declaration")
    for value in found.values():
        is_word = isinstance(value, str) and len(value) <= WORD_MAX
        if not (is_word or (type(value) in (int, float) and math.isfinite(value))):
            raise ValueError("no declaration")
    return tuple(found.items())


def listen(
    host: str, port: int, *, port_by: str = "web.port", host_by: str = "web.host"
) -> socket.socket:
    """Return a socket that listens at the page's address; a `ConfigError` where it cannot be had.

    A companion that was killed leaves its page to end by itself: the port is free a moment later.
    """
    until_s = time.monotonic() + BIND_TRIES_S
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    while True:
        found = socket.socket(family, socket.SOCK_STREAM)
        try:
            found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            found.bind((host, port))
            found.listen(64)
        except OSError as error:
            found.close()
            if time.monotonic() >= until_s:
                raise ConfigError(
                    f"{port_by}: cannot listen on {host} port {port}: "
                    f"{(error.strerror or str(error)).lower()}; "
                    f"write another {port_by} or {host_by}"
                ) from error
            time.sleep(0.1)
        else:
            return found


class OperatorPage:
    """Implements `companion.ports.Sensor`: what it reads are the operator's orders.

    Args:
        listener: the socket that the page serves; closed at the end.
        about: what the page has to know, as JSON has it: the map, the tokens, limits.
        obey: carries an order out as the link does with a command, and says what came of it.
        horizon_s: how far ahead orders are given, for the look-ahead point.
        declared: what of label and weather is declared; shown with each state.
    """

    def __init__(
        self,
        listener: socket.socket,
        about: dict[str, Any],
        *,
        obey: Obey,
        horizon_s: float,
        declared: Callable[[], dict[str, Any]] = dict,
        clock: Callable[[], float] = time.monotonic,
        boot_clock: Callable[[], float] = lambda: time.clock_gettime(time.CLOCK_BOOTTIME),
    ) -> None:
        self._listener = listener
        self._about = json.dumps(about, allow_nan=False).encode()
        self._obey = obey
        self._horizon_s = horizon_s
        self._declared = declared
        self._clock, self._boot_clock = clock, boot_clock
        self._memory = new_memory()
        self._ring = RingWriter(self._memory)
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._told_s = self._extras_s = float("-inf")
        self._key: tuple[object, ...] | None = None
        self._extra: dict[str, Any] = {}
        self._events: deque[tuple[float, str, str]] = deque(maxlen=EVENTS_KEPT)
        self._event_count = 0
        self._is_simulated = False
        # The last decision, and whether the run ends for another field.
        self.newest: Decision | None = None
        self.is_restarting = False
        self._taken_s: deque[float] = deque(maxlen=ORDERS_PER_S)
        self._orders: socket.socket | None = None
        self._child: subprocess.Popen[bytes] | None = None
        self._started_s = float("-inf")
        self._is_starting = False
        self._is_open = False
        # What else is shown, such as the state of the journal; asked once a second.
        self.extras: Callable[[], dict[str, Any]] = dict

    # ------------------------------------------------------------------- what the page is told

    def note(self, at_s: float, kind: str, text: str) -> None:
        """Take an event for the page's list."""
        if kind == SIMULATED:
            self._is_simulated = text.startswith("yes")
            return
        self._events.append((round(at_s, 2), kind[:40], text[:200]))
        self._event_count += 1

    def show(self, decision: Decision) -> None:
        """Show a decision: at once where valves, state or reasons changed, else at 10 Hz."""
        self.newest = decision
        key, now_s = shown_key(decision), decision.now_s
        is_news = key != self._key
        if not is_news and now_s - self._told_s < FRAME_S - _STEP_S:
            return
        self._key, self._told_s = key, now_s
        if now_s - self._extras_s >= EXTRA_S:
            self._extras_s, self._extra = now_s, self.extras()
        frame = frame_of(decision, horizon_s=self._horizon_s)
        frame |= self._extra
        frame["declared"] = self._declared()
        frame["urgent"] = is_news
        frame["simulated"] = self._is_simulated
        frame["event_count"] = self._event_count
        if self._events:
            frame["events"] = list(self._events)[-6:]
        self._ring.put(packed(frame, PAYLOAD_MAX))
        with suppress(BlockingIOError):
            os.eventfd_write(self._wake, 1)

    # --------------------------------------------------------------------------- what it orders

    async def open(self, wake: Callable[[], None]) -> None:  # noqa: ARG002 - steps come anyway
        """Start the page."""
        self._is_open = True
        self._start()

    def read(self, now_s: float) -> Sequence[Input]:
        """Return what the operator ordered; a few packets at most, however many were sent."""
        if self._orders is None:
            self._restart(now_s)
            return ()
        inputs: list[Input] = []
        for _ in range(ORDERS_AT_ONCE):
            try:
                packet = self._orders.recv(ORDER_BYTES_MAX)
            except BlockingIOError:
                break
            except OSError:
                packet = b""
            if not packet:
                self._ended()
                break
            inputs.extend(self._take(packet, now_s))
        return inputs

    def _take(self, packet: bytes, now_s: float) -> tuple[Input, ...]:
        order = parse_order(packet)
        if order is None:
            return ()
        full = len(self._taken_s) == ORDERS_PER_S and now_s - self._taken_s[0] < 1.0
        if full and order.name != "stop":
            outcome = Outcome(accepted=False, text="too many orders: wait a second")
        elif order.name in MOMENTARY and not 0.0 <= self._boot_clock() - order.boot_s <= (
            ENABLE_AGE_MAX_S
        ):
            outcome = Outcome(accepted=False, text=f"late {order.name} not taken: try again")
        else:
            if order.name != "stop":
                self._taken_s.append(now_s)
            outcome = self._obey(order, now_s)
        self._reply(order, outcome)
        return outcome.inputs

    def _reply(self, order: Order, outcome: Outcome) -> None:
        answer = {"number": order.number, "accepted": outcome.accepted, "text": outcome.text}
        if self._orders is not None:
            with suppress(OSError):
                self._orders.send(json.dumps(answer).encode())

    # ------------------------------------------------------------------------------ its process

    def _start(self) -> None:
        """Start the page's process; quick, and its work is its own."""
        self._started_s = self._clock()
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        about = os.memfd_create("vrspray-page-about", os.MFD_CLOEXEC)
        try:
            with os.fdopen(os.dup(about), "wb") as file:
                file.write(self._about)
            passed = (self._memory, self._wake, theirs.fileno(), self._listener.fileno(), about)
            self._child = subprocess.Popen(
                [sys.executable, "-P", "-m", "companion.web", *map(str, passed), str(os.getpid())],
                pass_fds=passed,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is for the companion, which closes the valves
            )
        except OSError as error:
            _logger.warning("operator's page: %s", error.strerror or error)
            ours.close()
            return
        finally:
            os.close(about)
            theirs.close()
        ours.setblocking(False)
        self._orders = ours

    def _ended(self) -> None:
        """Let go of a page that ended."""
        if self._orders is not None:
            self._orders.close()
            self._orders = None
        if self._is_open:
            _logger.warning("the operator's page ended; it is started again")

    def _restart(self, now_s: float) -> None:
        """Start a page anew, in a thread: the loop does not wait for the system's fork."""
        if not self._is_open or self._is_starting or now_s - self._started_s < RESTART_S:
            return
        self._is_starting = True
        if self._child is not None:
            self._child.poll()

        def start() -> None:
            try:
                self._start()
            finally:
                self._is_starting = False

        threading.Thread(target=start, name="page", daemon=True).start()

    async def close(self) -> None:
        """End the page; may be called twice and before `open`."""
        self._is_open = False
        self._ended()
        child, self._child = self._child, None
        if child is not None:
            await _ended_within(child, END_S)
        if self._wake >= 0:
            self._ring.close()
            for descriptor in (self._memory, self._wake):
                os.close(descriptor)
            self._wake = -1
            self._listener.close()


async def _ended_within(child: subprocess.Popen[bytes], wait_s: float) -> None:
    """Wait for a process that has been told to end; kill it when it does not."""
    for _ in range(round(wait_s / END_LOOK_S)):
        if child.poll() is not None:
            return
        await asyncio.sleep(END_LOOK_S)
    child.kill()
    with suppress(subprocess.TimeoutExpired):
        child.wait(END_LOOK_S)
