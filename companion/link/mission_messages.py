"""The mission protocol as far as we read along: one MAVLink message to one of our types."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any

from companion.link.census import AUTOPILOT_COMPONENT

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
