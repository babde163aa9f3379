"""What the link understands besides the inputs of the core."""

from __future__ import annotations

from dataclasses import dataclass

from companion.core.types import Input
from companion.link.mission_messages import MissionCurrent, MissionTransfer


@dataclass(frozen=True, slots=True, kw_only=True)
class Sender:
    """System and component that a message came from."""

    system_id: int
    component_id: int


@dataclass(frozen=True, slots=True, kw_only=True)
class CommandReceived:
    """COMMAND_LONG or COMMAND_INT, whoever it is for; parameters 3 to 7 are not kept.

    `confirmation` counts retransmissions; COMMAND_INT has none: None. `sequence` is the frame's
    number; `is_late`: its sender has said something newer, or the same, before.
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
