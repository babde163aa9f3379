"""The mission protocol: upload, download, clear, set current; one transfer at a time.

ArduPilot's item 0 is home: it is replaced by the true home when it is read back. PX4 has no home
in its mission; the flight's list has one, which the wire does not count.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from sitl.stub.mission_items import MissionItem, item_message, item_of
from sitl.stub.modes import AUTO, Phase
from sitl.stub.protocol import Message, dialect, sender

if TYPE_CHECKING:
    from sitl.stub.autopilot import Autopilot
    from sitl.stub.channel import Channel

_ACCEPTED = dialect.MAV_MISSION_ACCEPTED
_SLOW_S = 1.0
_RETRY_S = 1.0
_TIMEOUT_S = 8.0
COUNT_MAX = 2000


@dataclass(slots=True, kw_only=True)
class Upload:
    """A mission on its way in."""

    channel: Channel
    peer: tuple[int, int]
    count: int
    asked_s: float
    heard_s: float
    items: list[MissionItem] = field(default_factory=list)


def _acknowledge(autopilot: Autopilot, channel: Channel, peer: tuple[int, int], kind: int) -> None:
    autopilot.send(channel, dialect.MAVLink_mission_ack_message(peer[0], peer[1], kind))


def _ask(autopilot: Autopilot, upload: Upload, now_s: float) -> None:
    upload.asked_s = now_s
    request = dialect.MAVLink_mission_request_int_message(
        upload.peer[0], upload.peer[1], len(upload.items)
    )
    autopilot.send(upload.channel, request)


def handle_count(autopilot: Autopilot, channel: Channel, message: Message, now_s: float) -> None:
    """Begin an upload; fences and rally points are not kept."""
    peer = sender(message)
    if message.mission_type != dialect.MAV_MISSION_TYPE_MISSION:
        kind = _ACCEPTED if message.count == 0 else dialect.MAV_MISSION_UNSUPPORTED
        reply = dialect.MAVLink_mission_ack_message(peer[0], peer[1], kind, message.mission_type)
        autopilot.send(channel, reply)
        return
    if autopilot.upload is not None and autopilot.upload.peer != peer:
        _acknowledge(autopilot, channel, peer, dialect.MAV_MISSION_DENIED)
        return
    if message.count > COUNT_MAX:
        _acknowledge(autopilot, channel, peer, dialect.MAV_MISSION_NO_SPACE)
        return
    if message.count == 0:
        autopilot.flight.set_items((), now_s)
        _acknowledge(autopilot, channel, peer, _ACCEPTED)
        return
    channel.busy_until_s = now_s + _SLOW_S
    upload = Upload(channel=channel, peer=peer, count=message.count, asked_s=now_s, heard_s=now_s)
    autopilot.upload = upload
    _ask(autopilot, upload, now_s)


def handle_item(autopilot: Autopilot, channel: Channel, message: Message, now_s: float) -> None:
    """Take one item in and ask for the next one, or end the upload."""
    upload = autopilot.upload
    if upload is None or sender(message) != upload.peer:
        return
    upload.heard_s = now_s
    channel.busy_until_s = now_s + _SLOW_S
    if message.seq != len(upload.items):
        _ask(autopilot, upload, now_s)
        return
    refusal = autopilot.firmware.refuses_item(message)
    if refusal is not None:
        autopilot.upload = None
        _acknowledge(autopilot, channel, upload.peer, refusal)
        return
    upload.items.append(item_of(message))
    if len(upload.items) < upload.count:
        _ask(autopilot, upload, now_s)
        return
    autopilot.upload = None
    home = (autopilot.home_item(),) * autopilot.firmware.first_item
    autopilot.flight.set_items((*home, *upload.items), now_s)
    _acknowledge(autopilot, channel, upload.peer, _ACCEPTED)


def tick(autopilot: Autopilot, now_s: float) -> None:
    """Ask again for an item that did not come; give up after eight seconds."""
    upload = autopilot.upload
    if upload is None:
        return
    if now_s - upload.heard_s > _TIMEOUT_S:
        autopilot.upload = None
        kind = dialect.MAV_MISSION_OPERATION_CANCELLED
        _acknowledge(autopilot, upload.channel, upload.peer, kind)
    elif now_s - upload.asked_s > _RETRY_S:
        _ask(autopilot, upload, now_s)


def handle_list(autopilot: Autopilot, channel: Channel, message: Message, now_s: float) -> None:
    """Say how many items there are."""
    peer, kind = sender(message), message.mission_type
    own = kind == dialect.MAV_MISSION_TYPE_MISSION
    items = len(autopilot.flight.items)
    count = max(items - autopilot.firmware.first_item, 0) if own else 0
    channel.busy_until_s = now_s + _SLOW_S
    autopilot.send(channel, dialect.MAVLink_mission_count_message(peer[0], peer[1], count, kind))


def handle_request(autopilot: Autopilot, channel: Channel, message: Message, now_s: float) -> None:
    """Send one item."""
    items, peer = autopilot.flight.items, sender(message)
    number = message.seq + autopilot.firmware.first_item
    if not number < len(items) or message.mission_type != 0:
        _acknowledge(autopilot, channel, peer, dialect.MAV_MISSION_INVALID_SEQUENCE)
        return
    channel.busy_until_s = now_s + _SLOW_S
    item = autopilot.home_item() if number == 0 else items[number]
    current = message.seq == autopilot.wire_sequence(autopilot.flight.sequence)
    autopilot.send(channel, item_message(item, message.seq, current=current, to=peer))


def handle_clear(autopilot: Autopilot, channel: Channel, message: Message, now_s: float) -> None:
    """Forget the mission."""
    if message.mission_type in (
        dialect.MAV_MISSION_TYPE_MISSION,
        dialect.MAV_MISSION_TYPE_ALL,
    ):
        autopilot.flight.set_items((), now_s)
    peer = sender(message)
    reply = dialect.MAVLink_mission_ack_message(peer[0], peer[1], _ACCEPTED, message.mission_type)
    autopilot.send(channel, reply)


def handle_set_current(
    autopilot: Autopilot, _channel: Channel, message: Message, now_s: float
) -> None:
    """Go on with another item; MISSION_CURRENT says which one it is."""
    autopilot.flight.set_sequence(message.seq + autopilot.firmware.first_item, now_s)
    autopilot.broadcast(current(autopilot))


def current(autopilot: Autopilot) -> Message:
    """Return MISSION_CURRENT; the total does not count home."""
    flight = autopilot.flight
    state = dialect.MISSION_STATE_NOT_STARTED
    if len(flight.items) < 2:
        state = dialect.MISSION_STATE_NO_MISSION
    elif flight.mission_complete:
        state = dialect.MISSION_STATE_COMPLETE
    elif flight.mode == AUTO and flight.phase is not Phase.GROUND:
        state = dialect.MISSION_STATE_ACTIVE
    return dialect.MAVLink_mission_current_message(
        autopilot.wire_sequence(flight.sequence), max(len(flight.items) - 1, 0), state, 0
    )
