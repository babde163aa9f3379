"""The mission protocol: upload, download, clear, set current; one transfer at a time.

ArduPilot's item 0 is home: it is replaced by the true home when it is read back. PX4 has no home
in its mission; the flight's list has one, which the wire does not count. A fence is kept and read
back, and flown through; rally points are not kept.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sitl.stub.firmware import Upload
from sitl.stub.mission_items import AUTO, MissionItem, Phase, item_message, item_of
from sitl.stub.protocol import Message, dialect, sender

if TYPE_CHECKING:
    from sitl.stub.firmware import Autopilot
    from sitl.stub.protocol import Channel

_ACCEPTED = dialect.MAV_MISSION_ACCEPTED
_SLOW_S = 1.0
_RETRY_S = 1.0
_TIMEOUT_S = 8.0
COUNT_MAX = 2000
# ArduPilot has 560 B for a fence, 8 of them for a vertex; PX4 64 vertices or more, by board.
FENCE_MAX = 64
_MISSION, _FENCE = dialect.MAV_MISSION_TYPE_MISSION, dialect.MAV_MISSION_TYPE_FENCE
_FENCE_COMMANDS = frozenset(
    range(dialect.MAV_CMD_NAV_FENCE_RETURN_POINT, dialect.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION + 1)
)


def _acknowledge(
    autopilot: Autopilot,
    channel: Channel,
    peer: tuple[int, int],
    result: int,
    kind: int = _MISSION,
) -> None:
    autopilot.send(channel, dialect.MAVLink_mission_ack_message(peer[0], peer[1], result, kind))


def _ask(autopilot: Autopilot, upload: Upload, now_s: float) -> None:
    upload.asked_s = now_s
    request = dialect.MAVLink_mission_request_int_message(
        upload.peer[0], upload.peer[1], len(upload.items), upload.kind
    )
    autopilot.send(upload.channel, request)


def handle_count(autopilot: Autopilot, channel: Channel, message: Message, now_s: float) -> None:
    """Begin an upload; rally points are not kept."""
    peer, kind = sender(message), message.mission_type
    if kind not in (_MISSION, _FENCE):
        result = _ACCEPTED if message.count == 0 else dialect.MAV_MISSION_UNSUPPORTED
        _acknowledge(autopilot, channel, peer, result, kind)
        return
    if autopilot.upload is not None and autopilot.upload.peer != peer:
        _acknowledge(autopilot, channel, peer, dialect.MAV_MISSION_DENIED, kind)
        return
    if message.count > (COUNT_MAX if kind == _MISSION else FENCE_MAX):
        _acknowledge(autopilot, channel, peer, dialect.MAV_MISSION_NO_SPACE, kind)
        return
    if message.count == 0:
        _keep(autopilot, kind, (), now_s)
        _acknowledge(autopilot, channel, peer, _ACCEPTED, kind)
        return
    channel.busy_until_s = now_s + _SLOW_S
    upload = Upload(
        channel=channel, peer=peer, count=message.count, asked_s=now_s, heard_s=now_s, kind=kind
    )
    autopilot.upload = upload
    _ask(autopilot, upload, now_s)


def _keep(autopilot: Autopilot, kind: int, items: tuple[MissionItem, ...], now_s: float) -> None:
    if kind == _FENCE:
        autopilot.fence = items
        return
    flight = autopilot.flight
    is_same = repr(items) == repr(flight.items)  # a yaw that is left open is not equal to itself
    if not (autopilot.firmware.keeps_item and is_same and not flight.mission_complete):
        flight.set_items(items, now_s)


def _refusal(autopilot: Autopilot, upload: Upload, message: Message) -> int | None:
    if upload.kind == _MISSION:
        return autopilot.firmware.refuses_item(message)
    return None if message.command in _FENCE_COMMANDS else dialect.MAV_MISSION_UNSUPPORTED


def handle_item(autopilot: Autopilot, channel: Channel, message: Message, now_s: float) -> None:
    """Take one item in and ask for the next one, or end the upload."""
    upload = autopilot.upload
    if upload is None or sender(message) != upload.peer or message.mission_type != upload.kind:
        return
    upload.heard_s = now_s
    channel.busy_until_s = now_s + _SLOW_S
    if message.seq != len(upload.items):
        _ask(autopilot, upload, now_s)
        return
    refusal = _refusal(autopilot, upload, message)
    if refusal is not None:
        autopilot.upload = None
        _acknowledge(autopilot, channel, upload.peer, refusal, upload.kind)
        return
    upload.items.append(item_of(message))
    if len(upload.items) < upload.count:
        _ask(autopilot, upload, now_s)
        return
    autopilot.upload = None
    home = (autopilot.home_item(),) * (autopilot.firmware.first_item if not upload.kind else 0)
    _keep(autopilot, upload.kind, (*home, *upload.items), now_s)
    _acknowledge(autopilot, channel, upload.peer, _ACCEPTED, upload.kind)


def tick(autopilot: Autopilot, now_s: float) -> None:
    """Ask again for an item that did not come; give up after eight seconds."""
    upload = autopilot.upload
    if upload is None:
        return
    if now_s - upload.heard_s > _TIMEOUT_S:
        autopilot.upload = None
        result = dialect.MAV_MISSION_OPERATION_CANCELLED
        _acknowledge(autopilot, upload.channel, upload.peer, result, upload.kind)
    elif now_s - upload.asked_s > _RETRY_S:
        _ask(autopilot, upload, now_s)


def handle_list(autopilot: Autopilot, channel: Channel, message: Message, now_s: float) -> None:
    """Say how many items there are."""
    peer, kind = sender(message), message.mission_type
    items, first = _kept(autopilot, kind)
    channel.busy_until_s = now_s + _SLOW_S
    count = max(len(items) - first, 0)
    autopilot.send(channel, dialect.MAVLink_mission_count_message(peer[0], peer[1], count, kind))


def _kept(autopilot: Autopilot, kind: int) -> tuple[tuple[MissionItem, ...], int]:
    """Return what there is of a kind, and the index of what the wire calls item 0."""
    if kind == _MISSION:
        return autopilot.flight.items, autopilot.firmware.first_item
    return (autopilot.fence if kind == _FENCE else ()), 0


def handle_request(autopilot: Autopilot, channel: Channel, message: Message, now_s: float) -> None:
    """Send one item."""
    peer, kind = sender(message), message.mission_type
    items, first = _kept(autopilot, kind)
    number = message.seq + first
    if not number < len(items):
        _acknowledge(autopilot, channel, peer, dialect.MAV_MISSION_INVALID_SEQUENCE, kind)
        return
    channel.busy_until_s = now_s + _SLOW_S
    is_mission = kind == _MISSION
    item = autopilot.home_item() if is_mission and number == 0 else items[number]
    at = autopilot.wire_sequence(autopilot.flight.sequence)
    current = is_mission and message.seq == at
    autopilot.send(channel, item_message(item, message.seq, current=current, to=peer, kind=kind))


def handle_clear(autopilot: Autopilot, channel: Channel, message: Message, now_s: float) -> None:
    """Forget the mission, the fence, or both."""
    kind = message.mission_type
    for each in (_MISSION, _FENCE):
        if kind in (each, dialect.MAV_MISSION_TYPE_ALL):
            _keep(autopilot, each, (), now_s)
    _acknowledge(autopilot, channel, sender(message), _ACCEPTED, kind)


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
