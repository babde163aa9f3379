"""What the link understands besides the inputs of the core."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any, Literal

from companion.core.types import AttitudeReport, ImuReport, Input
from companion.link.census import AUTOPILOT_COMPONENT

RADIO_STATUS = 109  # a radio's own report: never signed, and no word of the vehicle

# The mission protocol as far as we read along: one MAVLink message to one of our types.

_UNKNOWN_STATE, _ACTIVE_STATE = 0, 3  # MISSION_STATE
_FLOWN_STATES = frozenset({_UNKNOWN_STATE, _ACTIVE_STATE})
# MAV_FRAME whose places are latitude and longitude: GLOBAL, GLOBAL_RELATIVE_ALT,
# GLOBAL_TERRAIN_ALT, each also in its older _INT form.
_GLOBAL_FRAMES = frozenset({0, 3, 5, 6, 10, 11})


class MissionStep(Enum):
    """What a message of a transfer says."""

    COUNT = "count"  # so many items there are
    ITEM = "item"
    ENDED = "ended"  # acknowledged or refused
    UPLOAD = "upload"  # somebody writes the mission
    DOWNLOAD = "download"  # somebody reads it


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionItem:
    """One item; `place` is latitude and longitude in degrees, None where it has none."""

    command: int
    param1: float | None
    param2: float | None
    place: tuple[float, float] | None


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionCurrent:
    """MISSION_CURRENT of the vehicle: which of how many items it flies to.

    `total` is 0 where it is not told; `is_flown` is False where the mission is paused, complete
    or not begun. `is_active` says the same of one that tells, and is None where it does not.
    """

    received_s: float
    sequence: int
    total: int
    is_flown: bool = True
    is_active: bool | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionTransfer:
    """A message of a transfer of the mission itself, whoever it is between.

    `number` is the count or the item's number. `is_current`: that item is flown to.
    """

    received_s: float
    system_id: int
    component_id: int
    target_system: int
    target_component: int
    step: MissionStep
    number: int = 0
    item: MissionItem | None = None
    is_current: bool = False


def finite(value: float) -> float | None:
    """Return a number of a message; None for NaN and for what is infinite.

    >>> finite(float("inf")), finite(float("nan")), finite(0.0)
    (None, None, 0.0)
    """
    return value if math.isfinite(value) else None


def _current(m: Any, received_s: float) -> MissionCurrent:
    # 65535 is the total of a vehicle that has no missions; old ones send neither total nor state.
    told = m.mission_state != _UNKNOWN_STATE
    return MissionCurrent(
        received_s=received_s,
        sequence=m.seq,
        total=m.total,
        is_flown=m.mission_state in _FLOWN_STATES,
        is_active=m.mission_state == _ACTIVE_STATE if told else None,
    )


def _transfer(
    m: Any,
    received_s: float,
    step: MissionStep,
    number: int = 0,
    item: MissionItem | None = None,
    *,
    is_current: bool = False,
) -> MissionTransfer | None:
    if m.mission_type != 0:
        return None  # of a fence or of rally points
    return MissionTransfer(
        received_s=received_s,
        system_id=m.get_srcSystem(),
        component_id=m.get_srcComponent(),
        target_system=m.target_system,
        target_component=m.target_component,
        step=step,
        number=number,
        item=item,
        is_current=is_current,
    )


def _count(m: Any, received_s: float) -> MissionTransfer | None:
    return _transfer(m, received_s, MissionStep.COUNT, m.count)


def _item(m: Any, received_s: float) -> MissionTransfer | None:
    place = (m.x / 1e7, m.y / 1e7)
    has_place = m.frame in _GLOBAL_FRAMES and place != (0.0, 0.0)
    item = MissionItem(
        command=m.command,
        param1=finite(m.param1),
        param2=finite(m.param2),
        place=place if has_place else None,
    )
    # ArduPilot has other meanings for numbers above 1.
    return _transfer(m, received_s, MissionStep.ITEM, m.seq, item, is_current=m.current == 1)


def _ended(m: Any, received_s: float) -> MissionTransfer | None:
    return _transfer(m, received_s, MissionStep.ENDED, m.type)


def _asked(m: Any, received_s: float) -> MissionTransfer | None:
    # A vehicle asks for items that are written to it, anyone else for items to read.
    is_vehicle = m.get_srcComponent() == AUTOPILOT_COMPONENT
    return _transfer(m, received_s, MissionStep.UPLOAD if is_vehicle else MissionStep.DOWNLOAD)


def _read(m: Any, received_s: float) -> MissionTransfer | None:
    return _transfer(m, received_s, MissionStep.DOWNLOAD)


def _written(m: Any, received_s: float) -> MissionTransfer | None:
    return _transfer(m, received_s, MissionStep.UPLOAD)


Transfer = Callable[[Any, float], MissionTransfer | None]

CURRENT: dict[int, Callable[[Any, float], MissionCurrent]] = {42: _current}
TRANSFERS: dict[int, Transfer] = {
    38: _written,  # MISSION_WRITE_PARTIAL_LIST
    40: _asked,  # MISSION_REQUEST
    43: _read,  # MISSION_REQUEST_LIST
    44: _count,
    45: _written,  # MISSION_CLEAR_ALL
    47: _ended,
    51: _asked,  # MISSION_REQUEST_INT
    73: _item,
}


# Attitude and accelerometer.

_MILLI_G_M_S2 = 9.80665e-3
_ACCELEROMETER = 7  # x, y and z in HIGHRES_IMU_UPDATED_FLAGS


def _attitude(m: Any, received_s: float) -> AttitudeReport | None:
    told = (m.roll, m.pitch, m.yaw, m.rollspeed, m.pitchspeed, m.yawspeed)
    if not all(map(math.isfinite, told)):
        return None
    return AttitudeReport(
        received_s=received_s,
        boot_s=m.time_boot_ms / 1000.0,
        roll_deg=math.degrees(m.roll),
        pitch_deg=math.degrees(m.pitch),
        yaw_deg=math.degrees(m.yaw),
        roll_rate_deg_s=math.degrees(m.rollspeed),
        pitch_rate_deg_s=math.degrees(m.pitchspeed),
        yaw_rate_deg_s=math.degrees(m.yawspeed),
    )


def _scaled_imu(m: Any, received_s: float) -> ImuReport:
    return ImuReport(
        received_s=received_s,
        boot_s=m.time_boot_ms / 1000.0,
        forward_m_s2=m.xacc * _MILLI_G_M_S2,
        right_m_s2=m.yacc * _MILLI_G_M_S2,
        down_m_s2=m.zacc * _MILLI_G_M_S2,
    )


def _highres_imu(m: Any, received_s: float) -> ImuReport | None:
    """Return what the first accelerometer feels; None where the message has only other sensors."""
    if m.fields_updated & _ACCELEROMETER != _ACCELEROMETER or m.id != 0:
        return None
    if not all(map(math.isfinite, (m.xacc, m.yacc, m.zacc))):
        return None
    return ImuReport(
        received_s=received_s,
        boot_s=m.time_usec / 1e6,
        forward_m_s2=m.xacc,
        right_m_s2=m.yacc,
        down_m_s2=m.zacc,
    )


INERTIAL: dict[int, Callable[[Any, float], AttitudeReport | ImuReport | None]] = {
    26: _scaled_imu,
    30: _attitude,
    105: _highres_imu,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Sender:
    """System and component that a message came from."""

    system_id: int
    component_id: int


@dataclass(frozen=True, slots=True, kw_only=True)
class CommandReceived:
    """COMMAND_LONG or COMMAND_INT, whoever it is for; parameters 3 to 7 are not kept.

    `confirmation` counts retransmissions; COMMAND_INT has none: None. `sequence` is the frame's
    number; `is_late`: its sender has said something newer, or the same, before. `source` is `web`
    for an order of the operator's page, which goes the same way and has no frame.
    """

    received_s: float
    sender: Sender
    target_system: int
    target_component: int
    command: int
    param1: float | None
    param2: float | None
    confirmation: int | None = 0
    sequence: int = 0
    is_late: bool = False
    source: Literal["command", "web"] = "command"


@dataclass(frozen=True, slots=True, kw_only=True)
class AckReceived:
    """COMMAND_ACK of the vehicle. It names the command, but not which of several alike."""

    received_s: float
    command: int
    result: int
    target_system: int
    target_component: int


@dataclass(frozen=True, slots=True, kw_only=True)
class TimesyncReceived:
    """TIMESYNC, a question (`tc1_ns` is 0) or an answer."""

    received_s: float
    sender: Sender
    tc1_ns: int
    ts1_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class PingReceived:
    """PING, still asked by some ground stations."""

    received_s: float
    sender: Sender
    time_us: int
    sequence: int
    target_system: int
    target_component: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ParamAsked:
    """PARAM_REQUEST_LIST or PARAM_REQUEST_READ: all, or one by its name or its index."""

    received_s: float
    target_system: int
    target_component: int
    is_all: bool
    name: str = ""
    index: int = -1


@dataclass(frozen=True, slots=True, kw_only=True)
class ParamSet:
    """PARAM_SET: a station wants a parameter to have a value."""

    received_s: float
    target_system: int
    target_component: int
    name: str
    value: float | None
    kind: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ParamValue:
    """PARAM_VALUE of the autopilot; what `value` means depends on `kind` and on the firmware."""

    received_s: float
    name: str
    value: float
    kind: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoOutput:
    """SERVO_OUTPUT_RAW: what the autopilot's outputs do, channel 1 first; 0 is no pulse."""

    received_s: float
    port: int
    pulse_us: tuple[int, ...]
    boot_s: float | None = None


Message = (
    Input
    | CommandReceived
    | AckReceived
    | TimesyncReceived
    | PingReceived
    | ParamAsked
    | ParamSet
    | ParamValue
    | ServoOutput
    | MissionCurrent
    | MissionTransfer
)


# What is left in the tank, once the operator has said that it was filled.

# A step that comes later than this was not spraying: the lease had ended.
_STEP_MAX_S = 0.5


class Tank:
    """Counts down from a filling by the flow that was ordered; None until the first filling.

    A display for the operator, not a measurement: nothing opens or closes by it.
    """

    def __init__(self, capacity_l: float | None = None) -> None:
        self.capacity_l = capacity_l
        self.level_l: float | None = None
        self._last: tuple[float, float] | None = None

    def filled(self, litres: float | None) -> bool:
        """Take a filling, 0 for a full tank; return whether it can be one."""
        level_l = self.capacity_l if litres == 0.0 else litres
        most_l = 10_000.0 if self.capacity_l is None else self.capacity_l
        if level_l is None or not 0.0 < level_l <= most_l:
            return False
        self.level_l = level_l
        return True

    def flows(self, flow_l_min: float, now_s: float) -> None:
        """Take the flow from now on."""
        last, self._last = self._last, (flow_l_min, now_s)
        if last is None or self.level_l is None:
            return
        step_s = min(now_s - last[1], _STEP_MAX_S)
        self.level_l = max(self.level_l - last[0] * step_s / 60.0, 0.0)
