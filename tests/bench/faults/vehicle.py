"""The vehicle of a flight: the stub autopilot in its pass, its link, and what hangs on its outputs.

Whoever starts it gets the link's URL for the companion. Over a serial link it is a pseudo-terminal.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from sitl.outputs import DriverBoard
from sitl.profile import load_profile
from sitl.stub.mission_items import AUTO, Phase
from sitl.stub.outputs import ServoOrder
from sitl.stub.protocol import (
    AUTOPILOT_SYSTEM,
    COMPANION_COMPONENT,
    GROUND_COMPONENT,
    GROUND_SYSTEM,
    Channel,
    Message,
    Speaker,
    dialect,
)
from sitl.stub.server import StubOptions, StubServer, build_autopilot
from sitl.stub.world import Rest
from tests.bench.faults.cases import LinkKind, Output
from tests.bench.faults.levels import Pulse, openings_of_pulses
from tests.bench.faults.place import CHANNELS, CLOSED_US, DITHER_US, FULL_US, ORIGIN, Pass
from tests.bench.faults.record import Opening
from tests.bench.faults.terminal import Terminal
from tests.bench.faults.wire import HEARTBEAT, LANDED, POSITION, Wire
from tests.lua_bindings import FakeAutopilot

# Below this share of the span a pulse is closed, for the board too.
_OPEN_SHARE = 0.01
# GPS_RAW_INT, VFR_HUD, EKF_STATUS_REPORT.
_ASKED_FOR = (24, 74, 193)


class Vehicle(StubServer):
    """Use as `async with Vehicle(...) as vehicle`; it stands before the field until `go`."""

    def __init__(self, output: Output, link: LinkKind, *, seed: int) -> None:
        now_s = time.monotonic()
        options = StubOptions(home=ORIGIN, heading_deg=90.0, seed=seed)
        autopilot = build_autopilot(options, start_s=now_s, written=self._written)
        super().__init__(autopilot, () if link == "pty" else (_URLS[link],))
        self.path = Pass(start_s=now_s + 1e6)
        self.wire = Wire()
        self.pulses: list[Pulse] = []
        self.texts: list[str] = []
        self.is_decided_for = False  # until then the companion's guardian closes
        autopilot.hears = self._hear
        self._link = link
        self._terminal: Terminal | None = None
        self._speaker = Speaker(GROUND_SYSTEM, GROUND_COMPONENT)
        self._by_script = False
        self._script: FakeAutopilot | None = None
        self._board: DriverBoard | None = None
        self._edges: list[Pulse] = []
        self._hang_on(output, now_s, seed)
        flight = autopilot.flight
        flight.armed, flight.mode, flight.phase = True, AUTO, Phase.ROUTE
        flight.world.begin(Rest(self.path.pose_at(now_s)), now_s=now_s)

    def _hang_on(self, output: Output, now_s: float, seed: int) -> None:
        if output == "script":
            parameters: dict[str, float | None] = {
                "SPRW_FIRST": CHANNELS[0],
                "SPRW_LAST": CHANNELS[-1],
            }
            # The script counts from its own boot; where within its 20 ms it runs is by chance.
            self._script = FakeAutopilot(
                set_output=self._script_writes, parameters=parameters, boot_ms=0
            )
            self._script_zero_s = now_s + seed % 20 / 1000.0
            self.autopilot.script = _Clocked(self._script, self._script_zero_s)
        elif output == "dither":
            self._board = DriverBoard(
                load_profile("wang-2024").pwm,
                len(CHANNELS),
                seed=seed,
                start_s=now_s,
                dither_us=DITHER_US,
            )

    # -------------------------------------------------------------------------------- link

    async def __aenter__(self) -> Vehicle:
        await super().__aenter__()
        if self._link == "pty":
            self._terminal = Terminal(self)
        return self

    async def __aexit__(self, *what: object) -> None:
        if self._terminal is not None:
            self._terminal.close()
        await super().__aexit__(*what)

    @property
    def url(self) -> str:
        """Return how the companion finds it."""
        if self._terminal is not None:
            return f"serial:{self._terminal.name}:115200"
        kind = "tcp" if self._link == "tcp" else "udpout"
        return f"{kind}:127.0.0.1:{self.ports[0]}"

    def attach(self, name: str, send: Callable[[bytes], None]) -> Channel:
        """Take a peer on, behind the wire."""
        return super().attach(name, self.wire.towards_companion(send))

    def received(self, channel: Channel, received: bytes) -> None:
        """Take bytes in, as far as the wire lets them through."""
        if not self.wire.is_cut:
            super().received(channel, received)

    async def hang_up(self) -> None:
        """Take the link away for good."""
        if self._terminal is not None:
            self._terminal.close()
        await self._close_links()

    @property
    def is_known(self) -> bool:
        """Return whether the companion has been told all that it decides by."""
        known = {HEARTBEAT, POSITION, LANDED, *_ASKED_FOR} <= self.wire.kinds
        return known and self.is_decided_for

    # ------------------------------------------------------------------------------ flight

    def go(self) -> None:
        """Begin the pass."""
        self.path = Pass(start_s=time.monotonic())
        self.autopilot.flight.world.begin(self.path, now_s=self.path.start_s)

    def enable(self, is_on: bool) -> None:
        """Send the operator's command."""
        command = dialect.MAVLink_command_long_message(
            AUTOPILOT_SYSTEM,
            COMPANION_COMPONENT,
            dialect.MAV_CMD_DO_SPRAYER,
            0,
            *(1.0 if is_on else 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        )
        self.autopilot.relay(self._speaker.frame(command))

    def beat(self) -> None:
        """Send a heartbeat now."""
        now_s = time.monotonic()
        self.autopilot.broadcast(self.autopilot.firmware.heartbeat(self.autopilot, now_s))

    def tell_landed(self) -> None:
        """Send EXTENDED_SYS_STATE now."""
        self.autopilot.broadcast(self.autopilot.build(245, time.monotonic()))

    def reboot(self) -> None:
        """Begin anew: another time since boot, no streams, no pulses, its script from the start."""
        self.autopilot.reboot(time.monotonic())
        if self._script is not None:
            self._script.restart_scripts()

    def _hear(self, message: Message, _now_s: float) -> None:
        if message.get_type() == "STATUSTEXT":
            self.texts.append(str(message.text))
        self.is_decided_for |= message.get_type() == "NAMED_VALUE_FLOAT"

    # ----------------------------------------------------------------------------- outputs

    @property
    def heard_outputs(self) -> int:
        """Return how many of the valves' outputs have been ordered."""
        return len({pulse.valve for pulse in self.pulses if pulse.is_ordered})

    def openings(self, until_s: float) -> tuple[list[Opening], list[Opening]]:
        """Return when valves were open behind the board, and when their outputs were."""
        own = openings_of_pulses(self.pulses, until_s)
        if self._board is None:
            return own, own
        for edge in self._board.advance(until_s):
            self._edges.append(Pulse(edge.at_s, edge.valve, float(edge.is_open), False))
        return openings_of_pulses(self._edges, until_s), own

    def _script_writes(self, channel: int, pulse_us: int) -> None:
        self._by_script = True
        try:
            self.autopilot.set_output(channel, pulse_us)
        finally:
            self._by_script = False

    def _written(self, order: ServoOrder) -> None:
        if order.channel not in CHANNELS:
            return
        share = max((order.pulse_us - CLOSED_US) / (FULL_US - CLOSED_US), 0.0)
        valve = order.channel - CHANNELS[0]
        at_s = time.monotonic()
        is_open = share >= _OPEN_SHARE
        self.pulses.append(Pulse(at_s, valve, share if is_open else 0.0, not self._by_script))
        if self._script is not None and not self._by_script:
            self._script.order(order.channel, order.pulse_us)
        if self._board is not None:
            self._board.order(at_s, valve, float(order.pulse_us))


_URLS: dict[LinkKind, str] = {"udp": "udpin:127.0.0.1:0", "tcp": "tcpin:127.0.0.1:0"}


class _Clocked:
    """The script on the stub's clock, with a zero of its own."""

    def __init__(self, script: FakeAutopilot, zero_s: float) -> None:
        self._script, self._zero_s = script, zero_s

    def on_message(self, raw: bytes, now_s: float) -> None:
        self._script.on_message(raw, now_s - self._zero_s)

    def update(self, now_s: float) -> None:
        self._script.update(now_s - self._zero_s)
