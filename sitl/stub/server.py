"""Puts a stub together from its parts, and runs it in real time: clock, links, and ticks."""

from __future__ import annotations

import asyncio
import json
import logging
import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from companion.errors import ConfigError, LinkError
from sitl.airframes import DRAWN, Airframe, EstimatorNoise
from sitl.earth import Earth
from sitl.stub.ardupilot import ardupilot
from sitl.stub.autopilot import Autopilot
from sitl.stub.faults import Fault, FaultClock
from sitl.stub.firmware import Firmware, Parts
from sitl.stub.flight import Flight
from sitl.stub.mission_items import MissionItem
from sitl.stub.outputs import ActuatorOutputs, Outputs, ServoOrder, ServoOutputs
from sitl.stub.parameters import Parameters, ardupilot_table
from sitl.stub.protocol import Channel, SigningKey
from sitl.stub.px4 import COMMANDS_PER_S, nan_keeps, px4, px4_parameters
from sitl.stub.scenario import Scenario
from sitl.stub.sprayer import Sprayer
from sitl.stub.watchdog import Watchdog, Watched
from sitl.stub.world import ARDUPILOT_NOISE, PX4_NOISE, Estimator, Pose, World
from sitl.vehicle import Corners

# ------------------------------------------------------------------------------------- put together

AUTOPILOTS = ("ardupilot", "px4")


@dataclass(frozen=True, slots=True, kw_only=True)
class StubOptions:
    """What a stub is made of; home is where it stands and the origin of its frame.

    `faults` come on top of those of the scenario; `noise` takes the place of the firmware's and
    of the scenario's, `believed` that of the estimate that they would make. `signing_time` is the
    time stamp that a signed link begins with. ArduPilot's watchdog script runs where it is told
    what is `watched`.
    """

    home: Earth
    autopilot: str = "ardupilot"
    home_altitude_m: float = 60.0
    heading_deg: float = 0.0
    items: tuple[MissionItem, ...] = ()
    speed_m_s: float = 5.0
    airframe: Airframe = DRAWN
    gust_m_s: float | None = None
    corners: Corners = "stop"
    noise: EstimatorNoise | None = None
    scenario: Scenario = field(default_factory=Scenario)
    faults: tuple[Fault, ...] = ()
    signing_time: int = 0
    seed: int = 0
    believed: Estimator | None = None
    watched: Watched | None = None


def build_autopilot(
    options: StubOptions,
    *,
    start_s: float,
    written: Callable[[ServoOrder], None] = lambda _order: None,
) -> Autopilot:
    """Return a stub that stands at home; `written` hears every servo order."""
    scenario = options.scenario
    firmware = firmware_of(options.autopilot, scenario)
    parameters = parameters_of(options, scenario)
    world = World(Pose(time_s=start_s, east_m=0.0, north_m=0.0, heading_deg=options.heading_deg))
    flight = Flight(
        world,
        options.home,
        parameters,
        home_altitude_m=options.home_altitude_m,
        airframe=(
            options.airframe
            if options.gust_m_s is None
            else replace(options.airframe, gust_m_s=options.gust_m_s)
        ),
        seed=options.seed,
        zero_is_a_place=firmware.zero_is_a_place,
        corners=options.corners,
    )
    flight.set_items(options.items, start_s)
    faults = FaultClock((*scenario.faults, *options.faults), start_s=start_s)
    autopilot = Autopilot(
        Parts(
            firmware=firmware,
            flight=flight,
            estimator=options.believed or Estimator(world, noise_of(options), seed=options.seed),
            outputs=_outputs(firmware, parameters, written),
            parameters=parameters,
            faults=faults,
            wind_towards_m_s=scenario.wind_towards_m_s,
            drift_ppm=scenario.drift_ppm,
            uptime_s=scenario.uptime_s,
            key=_key(options),
            seed=options.seed,
        ),
        start_s=start_s,
    )
    if options.watched is not None and options.autopilot == "ardupilot":
        autopilot.script = Watchdog(options.watched, autopilot)
    return autopilot


def firmware_of(autopilot: str, scenario: Scenario) -> Firmware:
    """Return the personality, in the version that the scenario wants."""
    if autopilot not in AUTOPILOTS:
        raise ConfigError(f"--autopilot {autopilot}: choose one of {', '.join(AUTOPILOTS)}")
    version, where = scenario.version, scenario.source
    if autopilot == "ardupilot":
        if version is not None and not (4, 0, 0) <= version < (5, 0, 0):
            raise ConfigError(f"{where}: firmware.version: ArduPilot is known from 4.0.0 on")
        if scenario.commands_per_s is not None:
            raise ConfigError(
                f"{where}: firmware.commands_per_s: ArduPilot has no queue of commands"
            )
        return ardupilot() if version is None else ardupilot(version)
    if version is not None and not (1, 14, 0) <= version < (2, 0, 0):
        raise ConfigError(f"{where}: firmware.version: PX4 is known from 1.14.0 on")
    per_s = scenario.commands_per_s or COMMANDS_PER_S
    return px4(commands_per_s=per_s) if version is None else px4(version, commands_per_s=per_s)


def parameters_of(options: StubOptions, scenario: Scenario) -> Parameters:
    """Return the firmware's parameters as the scenario sets them."""
    is_px4, watched = options.autopilot == "px4", options.watched
    script = {} if watched is None else watched.table()
    parameters = px4_parameters() if is_px4 else Parameters({**ardupilot_table(), **script})
    parameters.put_speed("cruise", options.speed_m_s)
    for name, value in scenario.parameters.items():
        if name not in parameters:
            raise ConfigError(
                f"{scenario.source}: parameters.{name}: the stub of {options.autopilot} has no "
                "such parameter"
            )
        parameters.put(name, value)
    return parameters


def noise_of(options: StubOptions) -> EstimatorNoise:
    """Return how far the position is from the truth."""
    if options.noise is not None:
        return options.noise
    own = options.airframe.noise
    if own == ARDUPILOT_NOISE and options.autopilot == "px4":
        own = PX4_NOISE
    return replace(own, **options.scenario.position)


def _outputs(
    firmware: Firmware, parameters: Parameters, written: Callable[[ServoOrder], None]
) -> Outputs:
    if firmware.name == "px4":
        return ActuatorOutputs(parameters, written, nan_keeps=nan_keeps(firmware.version))
    return ServoOutputs(parameters, written)


def _key(options: StubOptions) -> SigningKey | None:
    secret = options.scenario.signing_key
    if secret is None:
        return None
    return SigningKey(secret=secret, timestamp=options.signing_time)


# The log of the truth: path, volumes and orders of one flight, as arrays and a summary.
#
# `truth.npz` holds time_s, east_m, north_m, height_m, heading_deg (unwrapped), velocity_east_m_s,
# velocity_north_m_s (n), volume_ml (n, valves; cumulative), and of the servo orders order_time_s,
# order_valve, order_pulse_us (m). Times are seconds on the machine's monotonic clock, metres are
# in the frame whose origin `truth.json` names.

Floats = NDArray[np.float64]

SPACING_S = 0.002
_PATH_S = 0.01  # the vehicle's own step; between two of them the path is as good as straight


class TruthLog:
    """Notes from when to when was flown; everything else is worked out at the end."""

    def __init__(self, world: World, sprayer: Sprayer, home: Earth) -> None:
        self.from_s: float | None = None
        self.until_s = 0.0
        self.distance_m = 0.0
        self._world = world
        self._sprayer = sprayer
        self._home = home
        self._last: Pose | None = None

    def tick(self, now_s: float, *, flying: bool) -> None:
        """Note that the flight goes on."""
        if not flying:
            return
        if self.from_s is None:
            self.from_s = now_s
        self.until_s = now_s
        pose, last = self._world.pose_at(now_s), self._last
        if last is not None:
            self.distance_m += math.hypot(pose.east_m - last.east_m, pose.north_m - last.north_m)
        self._last = pose

    def summary(self) -> dict[str, Any]:
        """Return the figures of the flight so far."""
        volume_ml = self._volume_ml(np.array([self.until_s]))[0] if self.from_s else np.zeros(0)
        return {
            "flight_s": round(self.until_s - self.from_s, 3) if self.from_s else 0.0,
            "distance_m": round(self.distance_m, 2),
            "volume_l": round(float(volume_ml.sum()) / 1000.0, 6),
            "volume_ml": [round(float(value), 3) for value in volume_ml],
            "orders": len(self._sprayer.orders),
            "origin": {
                "latitude_deg": self._home.latitude_deg,
                "longitude_deg": self._home.longitude_deg,
            },
            "channels": list(self._sprayer.options.channels),
            "profile": self._sprayer.options.profile,
            "board": self._sprayer.options.board,
        }

    def write(self, folder: Path, summary: dict[str, Any]) -> None:
        """Write `truth.npz` and `truth.json`."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
            np.savez_compressed(folder / "truth.npz", **self._arrays())
            text = json.dumps(summary, indent=1) + "\n"
            (folder / "truth.json").write_text(text, encoding="utf-8")
        except OSError as error:
            reason = error.strerror or str(error)
            raise ConfigError(f"{folder}: the truth cannot be written ({reason})") from error

    def _arrays(self) -> dict[str, Any]:
        from_s = self.from_s if self.from_s is not None else 0.0
        time_s = np.arange(from_s, max(self.until_s, from_s), SPACING_S)
        arrays: dict[str, Any] = {"time_s": time_s, "volume_ml": self._volume_ml(time_s)}
        arrays.update(self._path(time_s))
        orders = self._sprayer.orders
        valves = {channel: i for i, channel in enumerate(self._sprayer.options.channels)}
        arrays["order_time_s"] = np.array([order.at_s for order in orders], dtype=np.float64)
        arrays["order_valve"] = np.array([valves[order.channel] for order in orders], dtype=int)
        arrays["order_pulse_us"] = np.array([order.pulse_us for order in orders], dtype=int)
        return arrays

    def _path(self, time_s: Floats) -> dict[str, Floats]:
        """Return the path at `time_s`, straight between steps of the vehicle."""
        if len(time_s) == 0:
            return {}
        knots_s = np.arange(time_s[0], self.until_s, _PATH_S)
        poses = [self._world.pose_at(float(knot_s)) for knot_s in knots_s]

        def along(name: str) -> Floats:
            values = np.array([getattr(pose, name) for pose in poses], dtype=np.float64)
            if name == "heading_deg":
                values = np.degrees(np.unwrap(np.radians(values)))
            return np.interp(time_s, knots_s, values)

        names = ("east_m", "north_m", "height_m", "velocity_east_m_s", "velocity_north_m_s")
        path = {name: along(name) for name in names}
        path["heading_deg"] = along("heading_deg")
        return path

    def _volume_ml(self, time_s: Floats) -> Floats:
        return self._sprayer.volume_ml(time_s)


# ------------------------------------------------------------------------------------- in real time

_TICK_S = 0.02


class StubServer:
    """Use as `async with StubServer(autopilot, urls) as server`; `ports` are the local ones.

    `late_s` is how late each tick was: on a busy machine the vehicle itself is irregular, and a
    test that judges a companion has to know it.
    """

    def __init__(self, autopilot: Autopilot, urls: Sequence[str]) -> None:
        self.autopilot = autopilot
        self.ports: list[int] = []
        self.late_s: list[float] = []
        self.ticked: Callable[[float], None] = lambda _now_s: None
        self._urls = urls
        self._links: list[Link] = []
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> StubServer:
        try:
            for url in self._urls:
                self._links.append(await open_link(url, self))
        except BaseException:
            await self._close_links()
            raise
        self.ports = [link.port for link in self._links]
        self._task = asyncio.create_task(self._run())
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        await self._close_links()

    async def wait(self) -> None:
        """Wait for the end of the run, which comes only with an error."""
        if self._task is not None:
            await asyncio.shield(self._task)

    def attach(self, name: str, send: Callable[[bytes], None]) -> Channel:
        """Take a new peer on."""
        return self.autopilot.attach(name, send)

    def detach(self, channel: Channel) -> None:
        """Let a peer go."""
        self.autopilot.detach(channel)

    def received(self, channel: Channel, received: bytes) -> None:
        """Take bytes of a peer in, with the time at which they were read."""
        self.autopilot.receive(channel, received, time.monotonic())

    async def _run(self) -> None:
        due_s = time.monotonic()
        while True:
            now_s = time.monotonic()
            self.late_s.append(now_s - due_s)
            self.autopilot.tick(now_s)
            self.ticked(now_s)
            due_s = min(max(self.autopilot.next_due_s(), now_s), now_s + _TICK_S)
            await asyncio.sleep(max(due_s - time.monotonic(), 0.0))

    async def _close_links(self) -> None:
        for link in self._links:
            await link.close()
        self._links.clear()


# The sockets of the stub: UDP towards a peer or waiting for peers, TCP as client or server.
#
# Every peer is a channel of its own: every address on a UDP socket, every TCP connection.

_logger = logging.getLogger(__name__)

Address = tuple[str, int]

_PEERS_MAX = 16
_RECONNECT_S = 0.5
_CLOSE_WAIT_S = 0.5
_BACKLOG_MAX = 256 * 1024


class Hub(Protocol):
    """What peers are attached to."""

    def attach(self, name: str, send: Callable[[bytes], None]) -> Channel:
        """Take a new peer on."""

    def detach(self, channel: Channel) -> None:
        """Let a peer go."""

    def received(self, channel: Channel, received: bytes) -> None:
        """Take bytes of a peer in."""


class Link(Protocol):
    """An open socket; `port` is the local one where others find it."""

    port: int

    async def close(self) -> None:
        """Close it and let all of its peers go."""


@dataclass(frozen=True, slots=True)
class LinkUrl:
    """A kind of link with its host and port."""

    kind: str
    host: str
    port: int

    @classmethod
    def parse(cls, url: str) -> LinkUrl:
        """Return the parts of `KIND:HOST:PORT`.

        >>> LinkUrl.parse("udpout:127.0.0.1:14550")
        LinkUrl(kind='udpout', host='127.0.0.1', port=14550)
        """
        kind, _, rest = url.partition(":")
        host, _, port = rest.rpartition(":")
        if kind not in _OPENERS or not host or not port.isdigit() or int(port) > 65535:
            kinds = ", ".join(_OPENERS)
            raise LinkError(f"link {url!r}: write KIND:HOST:PORT, where KIND is one of {kinds}")
        return cls(kind, host, int(port))


async def open_link(url: str, hub: Hub) -> Link:
    """Open a link by its URL."""
    parts = LinkUrl.parse(url)
    try:
        return await _OPENERS[parts.kind](parts, hub)
    except OSError as error:
        reason = error.strerror or str(error)
        raise LinkError(f"link {url!r}: {reason}; choose another port with --link") from error


# ------------------------------------------------------------------------------------------ UDP


class _Udp(asyncio.DatagramProtocol):
    """A UDP socket with the peers that were heard on it."""

    port = 0

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._transport: asyncio.DatagramTransport | None = None
        self._channels: dict[Address, Channel] = {}

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.DatagramTransport", transport)
        self.port = transport.get_extra_info("sockname")[1]

    def add_peer(self, address: Address) -> Channel:
        """Take an address on; the oldest goes where there are too many."""
        if len(self._channels) >= _PEERS_MAX:
            self._hub.detach(self._channels.pop(next(iter(self._channels))))

        def send(frame: bytes) -> None:
            if self._transport is not None and not self._transport.is_closing():
                self._transport.sendto(frame, address)

        channel = self._hub.attach(f"udp:{address[0]}:{address[1]}", send)
        self._channels[address] = channel
        return channel

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        address = (addr[0], addr[1])
        channel = self._channels.get(address) or self.add_peer(address)
        self._hub.received(channel, data)

    def error_received(self, exc: Exception) -> None:
        _logger.debug("udp: %s", exc)

    async def close(self) -> None:
        for channel in self._channels.values():
            self._hub.detach(channel)
        self._channels.clear()
        if self._transport is not None:
            self._transport.close()


async def _open_udpin(url: LinkUrl, hub: Hub) -> Link:
    loop = asyncio.get_running_loop()
    address = (url.host, url.port)
    _, udp = await loop.create_datagram_endpoint(lambda: _Udp(hub), local_addr=address)
    return udp


async def _open_udpout(url: LinkUrl, hub: Hub) -> Link:
    loop = asyncio.get_running_loop()
    found = await loop.getaddrinfo(url.host, url.port)
    family, address = found[0][0], found[0][4]
    # Not connected: a peer that is not there yet then makes no error, and others may speak up.
    _, udp = await loop.create_datagram_endpoint(lambda: _Udp(hub), family=family, local_addr=None)
    udp.add_peer((str(address[0]), int(address[1])))
    return udp


# ------------------------------------------------------------------------------------------ TCP


async def _serve_stream(
    hub: Hub, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
) -> None:
    """Keep one TCP connection as a channel until it ends."""

    def send(frame: bytes) -> None:
        # A peer that does not read loses messages; the vehicle does not wait for it.
        if not writer.is_closing() and writer.transport.get_write_buffer_size() < _BACKLOG_MAX:
            writer.write(frame)

    host, port = writer.get_extra_info("peername")[:2]
    channel = hub.attach(f"tcp:{host}:{port}", send)
    try:
        while received := await reader.read(4096):
            hub.received(channel, received)
    except OSError as error:
        _logger.debug("tcp: %s", error)
    finally:
        hub.detach(channel)
        writer.close()
        await _let_go(writer)


async def _let_go(writer: asyncio.StreamWriter) -> None:
    """Wait for a connection's end; a peer that does not read what is on its way loses it."""
    closed = asyncio.ensure_future(writer.wait_closed())
    if not (await asyncio.wait({closed}, timeout=_CLOSE_WAIT_S))[0]:
        writer.transport.abort()
    with suppress(OSError):
        await closed


class _TcpServer:
    """A TCP server; every client is a channel."""

    def __init__(self, hub: Hub) -> None:
        self.port = 0
        self._hub = hub
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    async def open(self, url: LinkUrl) -> None:
        self._server = await asyncio.start_server(self._accept, url.host, url.port)
        self.port = self._server.sockets[0].getsockname()[1]

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        try:
            await _serve_stream(self._hub, reader, writer)
        except asyncio.CancelledError:
            _logger.debug("tcp: closed with the server")
        finally:
            self._tasks.discard(task)

    async def close(self) -> None:
        if self._server is not None:
            self._server.close()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)


class _TcpClient:
    """A TCP client that connects again for as long as it is open."""

    def __init__(self, url: LinkUrl, hub: Hub) -> None:
        self.port = 0
        self._task = asyncio.create_task(self._run(url, hub))

    async def _run(self, url: LinkUrl, hub: Hub) -> None:
        while True:
            try:
                reader, writer = await asyncio.open_connection(url.host, url.port)
            except OSError as error:
                _logger.debug("tcp: %s", error)
            else:
                await _serve_stream(hub, reader, writer)
            await asyncio.sleep(_RECONNECT_S)

    async def close(self) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)


async def _open_tcpin(url: LinkUrl, hub: Hub) -> Link:
    server = _TcpServer(hub)
    await server.open(url)
    return server


async def _open_tcp(url: LinkUrl, hub: Hub) -> Link:
    return _TcpClient(url, hub)


_OPENERS = {
    "udpout": _open_udpout,
    "udpin": _open_udpin,
    "tcp": _open_tcp,
    "tcpin": _open_tcpin,
}
