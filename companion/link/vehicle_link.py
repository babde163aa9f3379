"""The link as the runtime knows it: a transport with a component behind it."""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from companion.core.types import (
    Decision,
    DeclarationReport,
    Input,
    OperatorCommand,
    RateOverride,
)
from companion.link.census import Census, Vehicle, autopilot_name
from companion.link.component import Component, ComponentOptions
from companion.link.intake import Intake, Source
from companion.link.outputs import OutputListener
from companion.link.parameters import Parameters
from companion.link.service import Answer, OnEvent
from companion.link.streams import LinkStatistics
from companion.link.transport import (
    LinkUrl,
    OnBytes,
    OnChange,
    OnTrouble,
    Reconnecting,
    TcpTransport,
    Transport,
    open_udp,
    parse_url,
)
from companion.simulated import SIMULATED

if TYPE_CHECKING:
    from companion.link.signing import Signing

OnStatistics = Callable[[float, Mapping[str, float | None]], None]

_logger = logging.getLogger(__name__)

_EARLY_MAX, _KEPT_MAX = 512, 50_000
_STATISTICS_S = 60.0
_DOWN = "link is down"
# A turn reads no longer than this and a slice: what else is due comes between.
_READ_S = 0.001
_SAMPLE_S = 1.0


class VehicleLink:
    """Implements `companion.ports.VehicleLink` by MAVLink.

    Bytes are stamped when they arrive and decoded when the control loop asks, so that whatever
    goes wrong with them goes wrong inside the loop, whose `finally` closes the valves.
    """

    def __init__(
        self,
        url: str,
        options: ComponentOptions,
        *,
        parameters: Parameters | None = None,
        signing: Signing | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._url = url
        self._clock = clock
        self._signing = signing
        self._spoke: tuple[Source, float] | None = None
        self._transport: Transport | None = None
        self._wake: Callable[[], None] = _nothing
        self.component = Component(options, self._send, parameters=parameters, signing=signing)
        self._intake = Intake(self.component.codec.counts)
        self.component.on_event = self._event
        self.component.on_valid = self._adopt
        self._on_event: OnEvent | None = None
        self._early: deque[tuple[float, str, str]] = deque(maxlen=_EARLY_MAX)
        self._kept: list[Input] = []
        self._on_statistics: OnStatistics | None = None
        self._sampled_s = float("-inf")
        self._watch = Watch(url, self.component, self._event)
        self._statistics_s: float | None = None
        self.statistics: LinkStatistics | None = None
        self._changed = False
        self._heard, self._told = True, True
        self.has_been_heard = False

    @property
    def fault(self) -> str | None:
        """Return why nothing reaches the vehicle, or which one it is; None while all is well.

        A link that was away counts as up again once a step has been taken, which orders all
        closed, and the vehicle has been heard: nothing opens on what was known before.
        """
        if self._transport is None or not self._transport.is_up:
            return _DOWN
        if not (self._heard and self._told):
            return "link is reconnecting"
        finding = blocking(self.component.codec.census, self._clock())
        return None if finding is None else finding.text

    async def open(self, wake: Callable[[], None]) -> None:
        """Open the link, or begin to try where waiting can help; raises a `LinkError`.

        One that is open stays so, and wakes another from now on.
        """
        self._wake = wake
        if self._transport is not None:
            return
        self._transport = await open_transport(
            self._url, self._on_bytes, self._on_change, self._on_trouble
        )
        if self._transport.is_up:
            _logger.info("link up: %s", self._url)
            self._watch.link_up(self._clock())
        else:
            self._heard = self._told = False

    def on_order_ack(self, take: Callable[[int], None]) -> None:
        """Have the result (MAV_RESULT) of every order that is answered given to `take`."""
        self.component.on_order_ack = take

    def on_event(self, take: OnEvent) -> None:
        """Have what happens on the link given to `take(at_s, kind, text)`, for the record."""
        self._on_event = take
        for event in self._early:
            take(*event)
        self._early.clear()

    def on_statistics(self, take: OnStatistics) -> None:
        """Have how the link does given to `take(at_s, values)` once a second, for the record."""
        self._on_statistics = take

    def receive(self) -> list[Input]:
        """Return what came in since the last call, in its order."""
        if self._changed:
            self._changed = False
            self.component.link_changed(self._clock())
        inputs, self._kept = self._kept, []
        until_s = self._clock() + _READ_S
        while taken := self._intake.take():
            for data, received_s, source in taken:
                self._spoke = (source, received_s)
                inputs.extend(self.component.receive(data, received_s, source))
            if self._clock() >= until_s:
                break
        if self._intake.has_more():
            # Not at once: what else waits for the event loop comes first.
            asyncio.get_running_loop().call_soon(self._wake)
        self._heard = self._heard or any(
            not isinstance(item, OperatorCommand | RateOverride) for item in inputs
        )
        return inputs

    def attend(self) -> None:
        """Take what comes before anybody decides; it is kept for `receive`.

        We speak only where nobody speaks to us before: who hears us may think that we are ready.
        """
        self.component.starting(True)
        self._kept = self.receive()[-_KEPT_MAX:]
        self.component.starting(False)
        if self._url.startswith("udpout:"):
            self.tell(None, self._clock())

    def on_refilled(self, take: Callable[[float], bool]) -> None:
        """Have the operator's fillings given to `take(litres)`, which says whether it can be."""
        self.component.on_refilled = take

    def obey_page(self, name: str, value: float | None, received_s: float) -> Answer:
        """Carry out an order of the operator's page as if the ground station had commanded it."""
        return self.component.obey_page(name, value, received_s)

    def declare(self, report: DeclarationReport) -> Answer:
        """Take what the operator declared on the page, on the ground."""
        return self.component.declare(report)

    @property
    def tank_l(self) -> float | None:
        """Return what is left in the tank, counted down from the last filling that was told."""
        return self.component.tank_l

    def announce(self, text: str) -> None:
        """Tell the operator of something that is as it should be."""
        self.component.note(text)

    @property
    def mission_active(self) -> bool | None:
        """Whether the vehicle says that it flies its mission; None where it does not say."""
        return self.component.mission_active

    @property
    def rival(self) -> str | None:
        """Return who speaks here as we do, such as a companion that is flying; None: nobody."""
        address = self.component.address
        if not self.component.codec.census.is_heard(*address, self._clock()):
            return None
        return f"another companion is using {address[0]}/{address[1]}"

    def order(self, channel: int, pulse_us: int) -> bool:
        """Order a servo output; False where the order could not leave."""
        return self.component.order(channel, pulse_us)

    def flush_orders(self) -> bool:
        """Send the orders that leave together; False where they could not leave."""
        return self.component.outputs.flush()

    def follow_outputs(self, listener: OutputListener) -> None:
        """Have all that the vehicle says of its outputs given to who orders them."""
        self.component.outputs.listener = listener

    def way(self) -> tuple[Any, dict[str, Any]]:
        """Return by what the vehicle is reached now, and as whom, for one who closes for us."""
        transport, stamp = self._transport, 0 if self._signing is None else self._signing.stamp
        handle, peers = (None, ()) if transport is None else (transport.handle, transport.peers)
        return handle, {"peers": peers, "system": self.component.address[0], "stamp": stamp}

    @property
    def signing_key(self) -> bytes:
        """Return the key that the link is signed with; empty where it is not."""
        return b"" if self._signing is None else self._signing.key

    def note_outputs(self, text: str) -> None:
        """Tell operator, log and record of something about the outputs that should be seen to."""
        _logger.warning("outputs: %s", text)
        self.component.warn(text)
        self._event(self._clock(), "outputs", text)

    def tell(self, decision: Decision | None, now_s: float) -> None:
        """Send what is due: sign of life, heartbeat, texts, values, requests."""
        self.component.tick(decision, now_s)
        is_up = self._transport is None or self._transport.is_up
        self._told = self._told or is_up
        if is_up:
            self._watch.look(now_s)
        self._keep_count(now_s)

    def tell_fault(self, text: str) -> None:
        """Tell the operator once of something that does not work; a link that is down cannot."""
        if text == _DOWN:
            return
        finding = blocking(self.component.codec.census, self._clock())
        is_that = finding is not None and finding.text == text
        self.component.fault(finding.short if finding is not None and is_that else text)

    async def close(self) -> None:
        """Let go; may be called twice and before `open`."""
        transport, self._transport = self._transport, None
        if transport is not None:
            await transport.close()
            self._count(self._clock())
            if self._signing is not None:
                self._signing.keep(is_last=True)
            _logger.info("link closed: %s", self._url)

    def _send(self, data: bytes) -> bool:
        return self._transport is not None and self._transport.send(data)

    def _on_bytes(self, data: bytes) -> None:
        transport = self._transport
        speaker = None if transport is None else transport.speaker
        if self._intake.put(data, self._clock(), speaker, is_known=self._knows(speaker)):
            self._wake()

    def _adopt(self, is_vehicle: bool) -> None:
        """Have the answers sent to whoever just said something valid.

        Before anything is answered: what the vehicle is asked at once must reach it.
        """
        self.has_been_heard = True
        if self._transport is not None and self._spoke is not None:
            source, now_s = self._spoke
            self._transport.adopt(source.speaker, now_s, is_vehicle=is_vehicle)
            source.know(self._intake.strangers, is_known=self._knows(source.speaker))

    def _knows(self, speaker: Any) -> bool:
        """Whether it is the only other end of our line, or was adopted."""
        return speaker is None or (self._transport is not None and speaker in self._transport.peers)

    def _on_change(self, is_up: bool) -> None:
        _logger.warning("link %s: %s", "is up" if is_up else "was lost", self._url)
        self._changed = is_up
        self._heard = self._told = False
        self._intake = Intake(self.component.codec.counts)
        if is_up:
            self._watch.link_up(self._clock())
        self._wake()

    def _on_trouble(self, text: str) -> None:
        _logger.warning("%s; trying again", text)
        self._event(self._clock(), "link", text)

    def _event(self, at_s: float, kind: str, text: str) -> None:
        if kind == SIMULATED:
            _logger.info("simulated vehicle: %s", text)
        if self._on_event is not None:
            self._on_event(at_s, kind, text)
        else:
            self._early.append((at_s, kind, text))

    def _keep_count(self, now_s: float) -> None:
        """Write statistics down once a minute, and the signing stamp when it is due."""
        if self._signing is not None:
            self._signing.keep()
        if self._on_statistics is not None and now_s - self._sampled_s >= _SAMPLE_S:
            self._sampled_s = now_s
            self._on_statistics(now_s, asdict(self._read(now_s, "sample")))
        if self._statistics_s is None:
            self._statistics_s = now_s
        elif now_s - self._statistics_s >= _STATISTICS_S:
            self._statistics_s = now_s
            self._count(now_s)

    def _count(self, now_s: float) -> None:
        self.statistics = self._read(now_s, "line")
        self._event(now_s, "link", self.statistics.line())

    def _read(self, now_s: float, series: str) -> LinkStatistics:
        component = self.component
        return component.meter.read(
            component.codec,
            now_s,
            series=series,
            position_hz=component.position_rate_hz,
            round_trip_s=component.clock.round_trip_s,
        )


def _nothing() -> None:
    """Do nothing: there is no one to wake yet."""


# Watches a link that is up, and says in one line what is wrong with it.

_LOOK_S = 0.5
# A sender who is over his share by so much between two looks, in bytes or in frames, is a flood.
_FLOOD_BYTES, _FLOOD_FRAMES = 4096, 50


class Watch:
    """Compares what came in since the link came up with what must come in."""

    def __init__(self, url: str, component: Component, tell: OnEvent) -> None:
        self._url_text = url
        self._url: LinkUrl | None = None
        self._component = component
        self._tell = tell
        self._teller = Teller()
        self._up_s: float | None = None
        self._looked_s = float("-inf")
        self._before = (0, 0, 0)
        self._excess = (0, 0)
        self._is_met = False
        self._is_twin_told = False

    def link_up(self, now_s: float) -> None:
        """Begin to count anew."""
        self._up_s = now_s
        self._before = self._counts()

    def _counts(self) -> tuple[int, int, int]:
        counts = self._component.codec.counts
        return counts.bytes_in, counts.frames, counts.refused_frames

    def look(self, now_s: float) -> None:
        """Say what is new; called at every step."""
        if self._up_s is None or now_s - self._looked_s < _LOOK_S:
            return
        self._looked_s = now_s
        self._greet(now_s)
        self._look_for_twin(now_s)
        finding = self._teller.news(self._find(now_s, self._up_s), now_s)
        if finding is not None:
            _logger.warning("%s", finding.text)
            self._component.warn(finding.short)
            self._tell(now_s, "link", finding.text)

    def _find(self, now_s: float, up_s: float) -> Finding | None:
        component = self._component
        now, before = self._counts(), self._before
        met_s = component.met_s
        seen = Seen(
            up_s=now_s - up_s,
            byte_count=now[0] - before[0],
            frame_count=now[1] - before[1],
            refused_count=now[2] - before[2],
            asked_s=None if component.is_answered or met_s is None else now_s - met_s,
            now_s=now_s,
        )
        flood = self._flood()
        return find(self._parsed(), component.codec.census, seen) or flood

    def _flood(self) -> Finding | None:
        """Return that somebody sends more than is read; what is within its share is."""
        counts, before = self._component.codec.counts, self._excess
        self._excess = (counts.excess_bytes, counts.excess_frames)
        more_bytes, more_frames = (now - old for now, old in zip(self._excess, before, strict=True))
        if more_bytes < _FLOOD_BYTES and more_frames < _FLOOD_FRAMES:
            return None
        return Finding(
            text=f"{self._url_text}: somebody sends more than is read ({counts.excess_bytes} B and "
            f"{counts.excess_frames} frames dropped so far); the vehicle's messages are read: find "
            "the sender, or close the port to it",
            short="link: a flood of messages is dropped",
        )

    def _parsed(self) -> LinkUrl:
        if self._url is None:
            self._url = parse_url(self._url_text)
        return self._url

    def _greet(self, now_s: float) -> None:
        vehicle = self._component.codec.vehicle
        if vehicle is None or self._is_met:
            return
        self._is_met = True
        text = f"vehicle: system {vehicle.system_id}, {autopilot_name(vehicle.autopilot)}"
        _logger.info("%s", text)
        self._tell(now_s, "link", text)

    def _look_for_twin(self, now_s: float) -> None:
        """Say once that another component speaks as we do: routers then lose half of both."""
        system_id, component_id = self._component.address
        if self._is_twin_told or not self._component.codec.census.is_heard(
            system_id, component_id, now_s
        ):
            return
        self._is_twin_told = True
        text = f"another component uses {system_id}/{component_id}, or our own messages come back"
        _logger.warning("%s: set link.component_id to a number that nobody has", text)
        self._component.warn(f"{system_id}/{component_id} twice: set link.component_id")
        self._tell(now_s, "link", text)


async def open_transport(
    url: str, on_bytes: OnBytes, on_change: OnChange, on_trouble: OnTrouble | None = None
) -> Transport:
    """Open `url`; raises a `LinkError` of one line that says what it sees and what to change.

    `on_change` is told of every loss and return after that; TCP and serial links come back by
    themselves, UDP has nothing to lose. With `on_trouble` a link for which waiting can help is
    not refused: its one line goes there, and it is tried until it opens.
    """
    parts = parse_url(url)
    if parts.kind in ("udpin", "udpout"):
        return await open_udp(parts, on_bytes)
    link: Reconnecting
    if parts.kind == "tcp":
        link = TcpTransport(parts, on_bytes, on_change, on_trouble)
    else:
        # Imported where it is needed: pyserial is of no use to a UDP link.
        from companion.link.serial_port import SerialTransport

        link = SerialTransport(parts, on_bytes, on_change, on_trouble)
    await link.open()
    return link


# What is wrong with a link, from what is seen of it: one line with what to change.
#
# Pure: counts and times in, words out. A reason that holds is found within `PATIENCE_S` of the
# link's coming up, well inside the five seconds that an operator waits.

PATIENCE_S = 2.0
# Three heartbeats that did not come; an answer is there within a tenth of a second, or lost.
QUIET_S = 3.0
# Noise of a wire that hangs loose is a few bytes; a wrong baud rate turns every frame into some.
_NOISE_BYTES = 64
_KNOWN = {0: "generic", 4: "OpenPilot", 13: "SmartAP", 14: "AirRails", 15: "ReflexV"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """What is seen and what to do; `short` fits the operator's screen (43 characters)."""

    text: str
    short: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """What has come in since the link came up, `up_s` ago."""

    up_s: float
    byte_count: int
    frame_count: int
    refused_count: int
    # How long ago the streams were asked for without any answer; None once one came.
    asked_s: float | None
    now_s: float


def blocking(census: Census, now_s: float) -> Finding | None:
    """Return why nothing may open whatever else holds: two vehicles, or one we cannot know."""
    rivals = census.rivals(now_s)
    vehicle = census.vehicle
    if vehicle is None:
        return None
    if rivals:
        numbers = sorted({*rivals[:5], vehicle.system_id})
        systems = ", ".join(map(str, numbers))
        first = ",".join(map(str, numbers[:2])) + (".." if len(numbers) > 2 else "")
        return Finding(
            text=f"more than one autopilot on this link (systems {systems}): set link.system_id to "
            "the one with this sprayer, and restart",
            short=f"autopilots {first}: set link.system_id",
        )
    if not (vehicle.is_ardupilot or vehicle.is_px4):
        name = _KNOWN.get(vehicle.autopilot, "unknown")
        return Finding(
            text=f"system {vehicle.system_id} runs firmware {vehicle.autopilot} ({name}), neither "
            "ArduPilot nor PX4: set link.system_id to another vehicle, or change the firmware",
            short=f"firmware {vehicle.autopilot}: not ArduPilot or PX4",
        )
    return None


def find(url: LinkUrl, census: Census, seen: Seen) -> Finding | None:
    """Return what keeps the vehicle from being heard; None while all is well, or too early."""
    if not seen.up_s >= PATIENCE_S:
        return None
    if seen.frame_count == 0:
        return _nothing_usable(url, seen)
    if census.vehicle is None:
        return _no_vehicle(url, census, seen.now_s)
    return _vehicle_quiet(url, census, census.vehicle, seen)


def _vehicle_quiet(url: LinkUrl, census: Census, vehicle: Vehicle, seen: Seen) -> Finding | None:
    heard_s = census.vehicle_heard_s
    if heard_s is None or not seen.now_s - heard_s <= QUIET_S:
        number = vehicle.system_id
        return Finding(
            text=f"{url.text}: system {number} has stopped sending heartbeats: is it on, and is "
            "the "
            "cable or the radio still connected?",
            short=f"no heartbeat from system {number}",
        )
    if seen.asked_s is not None and seen.asked_s >= QUIET_S:
        return Finding(
            text=f"{url.text}: the autopilot is heard but does not answer: our messages do not "
            "reach "
            "it; check the wire from our TX to its RX, or the router's way back",
            short="autopilot heard but does not answer",
        )
    return None


def _nothing_usable(url: LinkUrl, seen: Seen) -> Finding | None:
    if seen.byte_count == 0:
        return Finding(text=_silence(url), short="link: nothing received")
    if seen.refused_count == 0:
        return _no_frames(url, seen.byte_count)
    return Finding(
        text=f"{url.text}: {seen.refused_count} frames arrived, none signed with our key: give the "
        "autopilot and the companion the same key (link.signing_key_file)",
        short="frames are not signed with our key",
    )


def _silence(url: LinkUrl) -> str:
    advice = {
        "udpin": f"make the autopilot or its router send to port {url.number} of this computer",
        "udpout": f"is anything listening at {url.place} port {url.number}, and does it answer?",
        "tcp": "the other end accepts the connection but sends nothing: is it a MAVLink program?",
        "serial": "check that TX is wired to RX and ground to ground, that the autopilot is on, "
        "and "
        "that its port speaks MAVLink 2 (ArduPilot SERIALn_PROTOCOL = 2, PX4 MAV_n_CONFIG)",
    }[url.kind]
    return f"{url.text}: nothing arrives; {advice}"


def _no_frames(url: LinkUrl, count: int) -> Finding | None:
    if url.kind == "serial":
        if count < _NOISE_BYTES:
            return Finding(text=_silence(url), short="link: nothing received")
        return Finding(
            text=f"{url.text}: {count} bytes arrive but no MAVLink: the autopilot probably uses "
            f"a baud rate other than {url.number}; write its rate (ArduPilot SERIALn_BAUD, PX4 "
            "SER_TELn_BAUD) at the end of link.url",
            short=f"no MAVLink at {url.number} baud: wrong baud?",
        )
    return Finding(
        text=f"{url.text}: {count} bytes arrive but no MAVLink: another program sends to this "
        "port; stop it, or write another port in link.url",
        short="bytes arrive but no MAVLink",
    )


def _no_vehicle(url: LinkUrl, census: Census, now_s: float) -> Finding:
    others, wanted = census.autopilots(now_s), census.wanted_system_id
    if wanted and others:
        there = ", ".join(map(str, others[:5]))
        return Finding(
            text=f"{url.text}: no autopilot with system {wanted}, but one with {there}: set "
            f"link.system_id = {others[0]}, or 0 for the only one there is",
            short=f"system {wanted} silent, heard {there[:12]}",
        )
    who = census.who(now_s)
    heard = f"heard: {who}" if who else "no heartbeat at all"
    return Finding(
        text=f"{url.text}: MAVLink arrives but no autopilot ({heard}): is the autopilot connected "
        "to this router, and do its heartbeats come through?",
        short="no autopilot heard",
    )


class Teller:
    """Says a finding when it is new, and again every minute while it lasts.

    One that comes and goes, as with a heartbeat at the edge of a radio's reach, is said every
    ten seconds at most.
    """

    AGAIN_S = 60.0
    FLICKER_S = 10.0

    def __init__(self) -> None:
        self._said_s: dict[str, float] = {}
        self._lasting: str | None = None

    def news(self, finding: Finding | None, now_s: float) -> Finding | None:
        """Return the finding if it is to be said now."""
        # The counts in a text grow; what is found is named by its short form.
        if finding is None:
            self._lasting = None
            return None
        short = finding.short
        pause_s = self.AGAIN_S if short == self._lasting else self.FLICKER_S
        # Two that take turns are told no more often than one that comes and goes.
        self._said_s = {
            key: at_s for key, at_s in self._said_s.items() if now_s - at_s < self.AGAIN_S
        }
        if now_s - self._said_s.get(short, -math.inf) < pause_s:
            return None
        self._said_s[short], self._lasting = now_s, short
        return finding
