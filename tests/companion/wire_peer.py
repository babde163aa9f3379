"""The least autopilot that `run` can fly with: it flies east, streams what is asked for, obeys.

It encodes on its own and shares nothing with the companion's link, so that a wrong scale factor
cannot cancel out.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.core.frame import LocalFrame
from tests.virtual_time import Delivery, WireLink, now_s

HEALTHY_EKF = 1 | 2 | 4 | 8 | 16 | 32
ACCEPTED, UNSUPPORTED = 0, 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """A servo order as it arrived."""

    at_s: float
    channel: int
    pulse_us: int


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def heard(port: int) -> Iterator[None]:
    """Say an autopilot's heartbeat, and no more, to a port of this computer."""
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    is_over = threading.Event()

    def say() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            while not is_over.wait(0.05):
                with contextlib.suppress(OSError):  # nobody listens yet, or any more
                    out.sendto(mav.heartbeat_encode(2, 3, 0, 0, 4).pack(mav), ("127.0.0.1", port))

    speaker = threading.Thread(target=say)
    speaker.start()
    try:
        yield
    finally:
        is_over.set()
        speaker.join()


def _begin_s() -> float:
    try:
        return now_s()
    except RuntimeError:  # made before the loop that it is to fly on: that of the computer
        return time.monotonic()


class WirePeer:
    """Autopilot 1/1 on any byte transport: give it `write`, and feed it by `feed`."""

    def __init__(self, frame: LocalFrame, *, east_m: float, speed_m_s: float = 5.0) -> None:
        self.frame = frame
        self.start_east_m, self.speed_m_s = east_m, speed_m_s
        self.started_s = _begin_s()
        self.mode, self.armed, self.landed_state = 3, True, 2
        self.autopilot = 3
        self.twin = False  # somebody else speaks as component 191
        self.is_landed_told = True
        self.mission_state = 0  # not told
        self.servo_result = ACCEPTED
        self.is_silent = False
        self.has_script = True
        self.orders: list[Order] = []
        self.messages: list[Any] = []
        self.outputs: dict[int, int] = {}
        self.write: Callable[[bytes], None] = lambda data: None
        self._mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._ground = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        self._twin = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        self._streams: dict[int, asyncio.Task[None]] = {}
        self._news = asyncio.Event()
        self.clock: Callable[[], float] | None = None
        self.answers_time = False

    def sign(self, key: bytes, clock: Callable[[], float] = time.time) -> None:
        """Sign everything by a clock (Unix time), and follow later stamps, as others do."""
        self.clock = clock
        for mav in (self._mav, self._ground, self._parser):
            mav.signing.secret_key = key
        self._mav.signing.sign_outgoing = self._ground.signing.sign_outgoing = True

    def _pack(self, mav: mavlink.MAVLink, message: Any) -> bytes:
        if self.clock is not None:
            stamp = round((self.clock() - 1_420_070_400) * 1e5)
            known = max(mav.signing.timestamp, self._parser.signing.timestamp)
            mav.signing.timestamp = max(stamp, known + 1)
        return bytes(message.pack(mav))

    # ---------------------------------------------------------------------------- life

    def begin(self) -> None:
        """Begin the heartbeat; everything else is streamed when it is asked for."""
        self.stream(0, 1.0)

    async def end(self) -> None:
        for task in self._streams.values():
            task.cancel()
        await asyncio.gather(*self._streams.values(), return_exceptions=True)

    def forget_streams(self) -> None:
        """Stop all streams but the heartbeat, as a reboot does."""
        for message_id in [key for key in self._streams if key]:
            self._streams.pop(message_id).cancel()

    def stream(self, message_id: int, interval_s: float) -> None:
        if message_id in self._streams:
            self._streams.pop(message_id).cancel()
        self._streams[message_id] = asyncio.get_running_loop().create_task(
            self._repeat(message_id, interval_s)
        )

    async def _repeat(self, message_id: int, interval_s: float) -> None:
        next_s = now_s()
        while True:
            if not self.is_silent:
                self.send(message_id)
            next_s += interval_s
            await asyncio.sleep(max(0.0, next_s - now_s()))

    # ----------------------------------------------------------------------------- out

    def east_m(self, at_s: float) -> float:
        return self.start_east_m + self.speed_m_s * (at_s - self.started_s)

    def place(self, *, east_m: float) -> None:
        """Put the vehicle somewhere; it flies on from there."""
        self.start_east_m += east_m - self.east_m(now_s())

    def send(self, message_id: int) -> None:
        message = self._compose(message_id)
        if message is not None:
            self.write(self._pack(self._mav, message))
            self._mav.seq = (self._mav.seq + 1) % 256
        if self.twin and message_id == 0:
            beat = self._twin.heartbeat_encode(18, 8, 0, 0, 4)
            self.write(bytes(beat.pack(self._twin)))

    def _compose(self, message_id: int) -> Any:
        at_s = now_s()
        mav, boot_ms = self._mav, round((at_s - self.started_s) * 1000) + 60_000
        speed_cm_s = round(self.speed_m_s * 100)
        latitude, longitude = self.frame.to_geographic(self.east_m(at_s), 3.0)
        pulses = [self.outputs.get(channel, 0) for channel in range(1, 17)]
        return {
            0: lambda: mav.heartbeat_encode(
                2, self.autopilot, 1 | (128 if self.armed else 0), self.mode, 4
            ),
            33: lambda: mav.global_position_int_encode(
                boot_ms,
                round(latitude * 1e7),
                round(longitude * 1e7),
                60_000,
                3_500,
                0,
                speed_cm_s,
                0,
                9_000,
            ),
            74: lambda: mav.vfr_hud_encode(0.0, self.speed_m_s, 90, 0, 60.0, 0.0),
            24: lambda: mav.gps_raw_int_encode(
                0, 6, round(latitude * 1e7), round(longitude * 1e7), 0, 0, 0, 0, 0, 20, h_acc=14
            ),
            193: lambda: mav.ekf_status_report_encode(HEALTHY_EKF, 0.1, 0.1, 0.1, 0.1, 0.0),
            245: lambda: (
                mav.extended_sys_state_encode(0, self.landed_state) if self.is_landed_told else None
            ),
            42: lambda: mav.mission_current_encode(1, 4, self.mission_state),
            65: lambda: mav.rc_channels_encode(boot_ms, 8, *([1500] * 8), *([65535] * 10), 255),
            36: lambda: mav.servo_output_raw_encode(0, 0, *pulses),
        }.get(message_id, lambda: None)()

    def command_companion(self, command: int, param1: float) -> None:
        """Send a command of the ground station to component 1/191."""
        message = self._ground.command_long_encode(1, 191, command, 0, param1, 0, 0, 0, 0, 0, 0)
        self.write(self._pack(self._ground, message))
        self._ground.seq = (self._ground.seq + 1) % 256

    def enable(self, is_on: bool = True) -> None:
        self.command_companion(216, 1.0 if is_on else 0.0)

    def garbage(self) -> None:
        self.write(bytes(range(256)) + b"\xfd\x10\xfe\x00\xfd" * 9)

    # ------------------------------------------------------------------------------ in

    def feed(self, data: bytes) -> None:
        at_s = now_s()
        for message in self._parser.parse_buffer(data) or []:
            if message.get_srcComponent() != 191:
                continue
            self.messages.append(message)
            if message.get_type() == "PARAM_REQUEST_READ":
                self._tell_parameter(message.param_id)
            if message.get_type() == "COMMAND_LONG" and message.target_component == 1:
                self._obey(message, at_s)
            if message.get_type() == "TIMESYNC" and message.tc1 == 0 and self.answers_time:
                boot_s = at_s - self.started_s + 60.0
                answer = self._mav.timesync_encode(round(boot_s * 1e9), message.ts1)
                self.write(self._pack(self._mav, answer))
        self._news.set()

    def _tell_parameter(self, name: str) -> None:
        """Answer for the outputs, and that the watchdog script runs; other names are not there."""
        if self.autopilot == 3 and name.startswith(("SERVO", "SPRAY_", "BRD_", "SPRW_")):
            value = float(self.has_script and name == "SPRW_ENABLE")
            found = self._mav.param_value_encode(name.encode(), value, 9, 1, 0)
            self.write(bytes(found.pack(self._mav)))

    def _obey(self, command: Any, now_s: float) -> None:
        result = ACCEPTED
        if command.command == 183:
            result = self.servo_result
            order = Order(at_s=now_s, channel=int(command.param1), pulse_us=int(command.param2))
            self.orders.append(order)
            if result == ACCEPTED:
                self.outputs[order.channel] = order.pulse_us
        elif command.command == 511:
            self.stream(int(command.param1), command.param2 / 1e6)
        else:
            result = UNSUPPORTED
        ack = self._mav.command_ack_encode(command.command, result, 0, 0, 1, 191)
        self.write(self._pack(self._mav, ack))

    # ------------------------------------------------------------------------- to await

    async def until(self, done: Callable[[], bool], *, within_s: float = 10.0) -> None:
        """Wait until something that the companion sent makes `done` true."""
        async with asyncio.timeout(within_s):
            while not done():
                self._news.clear()
                await self._news.wait()

    def of(self, kind: str) -> list[Any]:
        return [message for message in self.messages if message.get_type() == kind]

    def texts(self) -> list[str]:
        return [message.text for message in self.of("STATUSTEXT")]

    @property
    def open_channels(self) -> list[int]:
        return [channel for channel, pulse_us in self.outputs.items() if pulse_us > 1000]

    @property
    def is_spraying(self) -> bool:
        return bool(self.open_channels)

    @property
    def is_ready(self) -> bool:
        """Whether all is closed and the companion decides: before that its guardian closes."""
        return self.is_all_closed and bool(self.of("NAMED_VALUE_FLOAT"))

    @property
    def is_all_closed(self) -> bool:
        return len(self.outputs) == 6 and not self.is_spraying


class _Datagrams(asyncio.DatagramProtocol):
    def __init__(self, peer: WirePeer) -> None:
        self._peer = peer

    def datagram_received(self, data: bytes, addr: Any) -> None:
        self._peer.feed(data)

    def error_received(self, exc: Exception) -> None:
        """Nobody listens yet, or no longer."""


@contextlib.asynccontextmanager
async def over_udp(peer: WirePeer, port: int) -> Any:
    """Have the peer speak to a companion that listens at `port`."""
    transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
        lambda: _Datagrams(peer), remote_addr=("127.0.0.1", port)
    )
    peer.write = transport.sendto
    peer.begin()
    try:
        yield peer
    finally:
        await peer.end()
        transport.close()


@contextlib.asynccontextmanager
async def over_wire(peer: WirePeer, link: WireLink) -> Any:
    """Have the peer speak to a companion in this process, on virtual time."""
    peer.write = Delivery(link.arrive).send
    link.deliver = peer.feed  # type: ignore[method-assign]
    peer.begin()
    try:
        yield peer
    finally:
        await peer.end()


class TcpHost:
    """Listens like SITL does, and can hang up and listen again."""

    def __init__(self, peer: WirePeer) -> None:
        self.peer = peer
        self.port = free_port(socket.SOCK_STREAM)
        self.connected = asyncio.Event()
        self._server: asyncio.Server | None = None
        self._writer: asyncio.StreamWriter | None = None

    async def listen(self) -> None:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", self.port)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writer = writer
        self.peer.write = writer.write
        self.connected.set()
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(4096):
                self.peer.feed(data)
        self.peer.write = lambda data: None
        self.connected.clear()

    async def hang_up(self) -> None:
        assert self._writer is not None
        self.peer.write = lambda data: None
        self._writer.close()
        with contextlib.suppress(ConnectionError):
            await self._writer.wait_closed()

    async def close(self) -> None:
        if self._server is not None:
            self._server.close()
            await self.hang_up()
            await self._server.wait_closed()
