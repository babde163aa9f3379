"""How commands and missions come in and are answered, and what both firmwares do alike.

`ardupilot.py` and `px4.py` hold what each of them does; what is in neither table is UNSUPPORTED.
Here are also TIMESYNC, PING, the parameter protocol, and the refusal of file transfer.

ArduPilot's item 0 is home: it is replaced by the true home when it is read back. PX4 has no home
in its mission; the flight's list has one, which the wire does not count. A fence is kept and read
back, and flown through; rally points are not kept.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sitl.stub.faults import FaultKind
from sitl.stub.firmware import CommandHandler, Params, Upload
from sitl.stub.mission_items import (
    AUTO,
    LAND,
    LOITER,
    RTL,
    WARNING,
    MissionItem,
    Phase,
    item_message,
    item_of,
)
from sitl.stub.parameters import SPEED_MAX_M_S, SPEED_MIN_M_S
from sitl.stub.protocol import AUTOPILOT_SYSTEM, Message, dialect, sender

if TYPE_CHECKING:
    from sitl.stub.firmware import Autopilot
    from sitl.stub.protocol import Channel

ACCEPTED: int = dialect.MAV_RESULT_ACCEPTED
REJECTED: int = dialect.MAV_RESULT_TEMPORARILY_REJECTED
DENIED: int = dialect.MAV_RESULT_DENIED
UNSUPPORTED: int = dialect.MAV_RESULT_UNSUPPORTED
FAILED: int = dialect.MAV_RESULT_FAILED
_FORCE = 21196  # MAV_CMD_COMPONENT_ARM_DISARM param2: arm or disarm whatever the checks say


def arm(autopilot: Autopilot, params: Params, now_s: float, *, refused: int) -> int:
    """Arm or disarm; `refused` is how the firmware says no."""
    flight = autopilot.flight
    if params[0] == 1.0:
        return ACCEPTED if flight.arm(now_s) else refused
    if params[0] == 0.0:
        return ACCEPTED if flight.disarm(now_s, force=params[1] == _FORCE) else refused
    return UNSUPPORTED


def to_mode(mode: int, *, refused: int) -> CommandHandler:
    """Return a command that changes to one mode."""

    def handler(autopilot: Autopilot, _channel: Channel, _params: Params, now_s: float) -> int:
        return ACCEPTED if autopilot.flight.set_mode(mode, now_s) else refused

    return handler


def set_current(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    """Go on with another item of the mission."""
    if not 0.0 <= params[0] < 65536.0:
        return DENIED
    sequence = int(params[0]) + autopilot.firmware.first_item
    return ACCEPTED if autopilot.flight.set_sequence(sequence, now_s) else FAILED


def change_speed(autopilot: Autopilot, _channel: Channel, params: Params, _now_s: float) -> int:
    """Set the speed of the legs to come."""
    if not SPEED_MIN_M_S <= params[1] <= SPEED_MAX_M_S:
        return FAILED
    autopilot.parameters.put_speed("cruise", params[1])
    return ACCEPTED


def get_interval(autopilot: Autopilot, channel: Channel, params: Params, _now_s: float) -> int:
    """Tell how often a message comes."""
    if not 0.0 <= params[0] < 2**16:
        return FAILED
    message_id = int(params[0])
    stream = channel.streams.get(message_id)
    if message_id not in autopilot.firmware.builders:
        interval_us = 0
    else:
        interval_us = -1 if stream is None else round(stream.interval_s * 1e6)
    autopilot.send(channel, dialect.MAVLink_message_interval_message(message_id, interval_us))
    return ACCEPTED


def request(refused: int) -> CommandHandler:
    """Return MAV_CMD_REQUEST_MESSAGE; `refused` is the answer for what there is not."""

    def handler(autopilot: Autopilot, channel: Channel, params: Params, now_s: float) -> int:
        if not 0.0 <= params[0] < 2**24 or not autopilot.has(int(params[0]), now_s):
            return refused
        autopilot.send(channel, autopilot.build(int(params[0]), now_s))
        return ACCEPTED

    return handler


def request_fixed(message_id: int) -> CommandHandler:
    """Return a command that asks for one certain message."""

    def handler(autopilot: Autopilot, channel: Channel, _params: Params, now_s: float) -> int:
        autopilot.send(channel, autopilot.build(message_id, now_s))
        return ACCEPTED

    return handler


def reboot(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    """Restart, on the ground only."""
    if autopilot.flight.armed or params[0] != 1.0:
        return FAILED
    autopilot.reboot(now_s)
    return ACCEPTED


def shared(*, refused: int, unknown: int) -> dict[int, CommandHandler]:
    """Return the commands of both autopilots; they differ in how they refuse."""
    return {
        dialect.MAV_CMD_NAV_LAND: to_mode(LAND, refused=refused),
        dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH: to_mode(RTL, refused=refused),
        dialect.MAV_CMD_NAV_LOITER_UNLIM: to_mode(LOITER, refused=refused),
        dialect.MAV_CMD_DO_CHANGE_SPEED: change_speed,
        dialect.MAV_CMD_GET_MESSAGE_INTERVAL: get_interval,
        dialect.MAV_CMD_REQUEST_MESSAGE: request(unknown),
        dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: request_fixed(
            dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION
        ),
        dialect.MAV_CMD_GET_HOME_POSITION: request_fixed(dialect.MAVLINK_MSG_ID_HOME_POSITION),
        dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: reboot,
    }


def handle_long(autopilot: Autopilot, channel: Channel, message: Message, now_s: float) -> None:
    """Carry out a COMMAND_LONG and acknowledge it."""
    last = (message.param5, message.param6, message.param7)
    _take(autopilot, channel, message, now_s, last)


def handle_int(autopilot: Autopilot, channel: Channel, message: Message, now_s: float) -> None:
    """Carry out a COMMAND_INT and acknowledge it; PX4 takes x and y for degrees of 1e-7."""
    scale = autopilot.firmware.int_scale
    last = (message.x * scale, message.y * scale, message.z)
    _take(autopilot, channel, message, now_s, last)


def _take(
    autopilot: Autopilot,
    channel: Channel,
    message: Message,
    now_s: float,
    last: tuple[float, float, float],
) -> None:
    """Carry a command out, now or when the firmware's queue comes to it."""
    command, peer = int(message.command), sender(message)
    params = (message.param1, message.param2, message.param3, message.param4, *last)
    if autopilot.strikes(FaultKind.COMMAND_BLOCKED, now_s, command=command):
        return

    def carry_out(at_s: float) -> None:
        handler = autopilot.firmware.commands.get(command)
        result: int | None = UNSUPPORTED
        if handler is not None:
            result = handler(autopilot, channel, params, at_s)
        if result is not None:
            autopilot.acknowledge(channel, command, result, to=peer, now_s=at_s)

    queue = autopilot.queue
    if queue is None or command in autopilot.firmware.commands_at_once:
        carry_out(now_s)
    elif not queue.put(carry_out, now_s):
        autopilot.says(f"vehicle_command lost: {command}")
    elif command in autopilot.firmware.mixed_at_once:
        autopilot.firmware.mixed_at_once[command](autopilot, params, now_s)


# A link carries so many PARAM_VALUE in one go; the rest of a list follows.
LIST_BURST = 10
LIST_EVERY_S = 0.02
# MAVLink FTP: operation NAK, error "fail"; the payload of FILE_TRANSFER_PROTOCOL is 251 bytes.
_NAK = 129
_FAIL = 1
_PAYLOAD_SIZE = 251


def handle_timesync(autopilot: Autopilot, channel: Channel, message: Message, now_s: float) -> None:
    """Answer a request with the time since boot; answers to ours need nothing."""
    if message.tc1 == 0:
        reply = dialect.MAVLink_timesync_message(autopilot.boot_ns(now_s), message.ts1)
        autopilot.send(channel, reply)


def timesync_request(autopilot: Autopilot, now_s: float) -> Message:
    """Return a request of the autopilot; ArduPilot adds its system id to its own time."""
    added = AUTOPILOT_SYSTEM if autopilot.firmware.system_in_timesync else 0
    return dialect.MAVLink_timesync_message(0, autopilot.boot_ns(now_s) + added)


def handle_ping(autopilot: Autopilot, channel: Channel, message: Message, _now_s: float) -> None:
    """Answer a PING to everybody with its own time and number."""
    if message.target_system == 0 and message.target_component == 0:
        peer = sender(message)
        reply = dialect.MAVLink_ping_message(message.time_usec, message.seq, peer[0], peer[1])
        autopilot.send(channel, reply)


def handle_file_transfer(
    autopilot: Autopilot, channel: Channel, message: Message, now_s: float
) -> None:
    """Refuse: there are no files here, and a client then goes on without."""
    channel.busy_until_s = now_s + 1.0
    asked = bytes(message.payload)
    sequence = (int.from_bytes(asked[0:2], "little") + 1) & 0xFFFF
    answer = bytearray(_PAYLOAD_SIZE)
    answer[0:2] = sequence.to_bytes(2, "little")
    answer[2], answer[3], answer[4], answer[5], answer[12] = asked[2], _NAK, 1, asked[3], _FAIL
    peer = sender(message)
    reply = dialect.MAVLink_file_transfer_protocol_message(0, peer[0], peer[1], list(answer))
    autopilot.send(channel, reply)


def handle_parameter_list(
    autopilot: Autopilot, channel: Channel, _message: Message, now_s: float
) -> None:
    """Begin to send the whole table; the other streams of that peer are slowed meanwhile."""
    channel.busy_until_s = now_s + 1.0
    channel.parameters_left = list(range(len(autopilot.parameters)))
    send_parameters(autopilot, channel, now_s)


def send_parameters(autopilot: Autopilot, channel: Channel, now_s: float) -> None:
    """Send what the link takes of a list in one go."""
    left = channel.parameters_left
    if not left or now_s < channel.parameters_due_s:
        return
    channel.busy_until_s = now_s + 1.0
    channel.parameters_due_s = now_s + LIST_EVERY_S
    for index in left[:LIST_BURST]:
        name = autopilot.parameters.name_at(index)
        if name is not None:
            _send_parameter(autopilot, channel, name, now_s)
    del left[:LIST_BURST]


def _send_parameter(autopilot: Autopilot, channel: Channel, name: str, now_s: float) -> None:
    if autopilot.strikes(FaultKind.PARAM_LOST, now_s) is None:
        autopilot.send(channel, autopilot.parameters.message(name))


def handle_parameter_read(
    autopilot: Autopilot, channel: Channel, message: Message, now_s: float
) -> None:
    """Send one parameter by index or name; an unknown one gets no answer."""
    name: str | None = message.param_id
    if message.param_index >= 0:
        name = autopilot.parameters.name_at(message.param_index)
    if name is not None and name in autopilot.parameters:
        _send_parameter(autopilot, channel, name, now_s)


def handle_parameter_set(
    autopilot: Autopilot, _channel: Channel, message: Message, now_s: float
) -> None:
    """Set one parameter and tell everybody its new value."""
    name = message.param_id
    if name not in autopilot.parameters:
        return
    if autopilot.strikes(FaultKind.PARAM_LOST, now_s) is not None:
        return
    value = autopilot.parameters.decoded(name, message)
    if value is None:
        if autopilot.parameters.bytewise:
            autopilot.tell(f"param types mismatch param: {name}", severity=WARNING)
        return
    autopilot.parameters.put(name, value)
    for channel in autopilot.channels:
        _send_parameter(autopilot, channel, name, now_s)


# ----------------------------------------------------------------------------------------- missions

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
