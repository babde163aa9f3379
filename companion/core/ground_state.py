"""What ground work has to know of the vehicle; neither place nor map is in it.

Everything is as the vehicle said it last, with the time at which it was heard: whoever asks judges
the age. What was never heard is `None`, and never counts as good.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from companion.core.types import (
    EstopReport,
    HeartbeatReport,
    Input,
    LandedReport,
    OperatorCommand,
    OutputReport,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundState:
    """What has been heard so far.

    `mission_active` is what MISSION_CURRENT says, `None` where it does not say. `estop_line` is
    whether the switch on a line is pressed. `was_stopped` stays: whoever presses it, or enables,
    disables or stops by MAVLink, wants something else than ground work.
    """

    heartbeat: HeartbeatReport | None = None
    landed: LandedReport | None = None
    output: OutputReport | None = None
    mission_active: bool | None = None
    estop_line: bool | None = None
    was_stopped: bool = False


def _estop(state: GroundState, item: EstopReport) -> GroundState:
    if item.pressed is not False:
        state = replace(state, was_stopped=True)
    return replace(state, estop_line=item.pressed) if item.source == "line" else state


_OBSERVED: dict[type, Callable[[GroundState, Any], GroundState]] = {
    HeartbeatReport: lambda state, item: replace(state, heartbeat=item),
    LandedReport: lambda state, item: replace(state, landed=item),
    OutputReport: lambda state, item: replace(state, output=item),
    EstopReport: _estop,
    OperatorCommand: lambda state, _: replace(state, was_stopped=True),
}


def observe_ground(state: GroundState, item: Input) -> GroundState:
    """Return `state` with one more input; what ground work does not need changes nothing."""
    take = _OBSERVED.get(type(item))
    return state if take is None else take(state, item)
