"""What tells one firmware from the other: tables and rules that the rest of the stub asks for.

`ardupilot.py` and `px4.py` make one each. A table stands for behaviour that was read in the
firmware's source or measured on its SITL.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from sitl.stub.protocol import Message

if TYPE_CHECKING:
    from sitl.stub.autopilot import Autopilot
    from sitl.stub.channel import Channel

Params = tuple[float, ...]
Builder = Callable[["Autopilot", float], Message]
# Returns the MAV_RESULT; none is a command that the firmware never acknowledges.
CommandHandler = Callable[["Autopilot", "Channel", Params, float], int | None]
MessageHandler = Callable[["Autopilot", "Channel", Message, float], None]
Version = tuple[int, int, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class Firmware:
    """A personality.

    `commands_at_once` are answered by the receiver itself; the others of a firmware with a
    `queue_depth` go through a queue that is emptied `commands_per_s` times a second. The outputs
    hear those `mixed_at_once` themselves; only the answer waits for the queue.
    `first_item` is how many items of the flight's list the wire does not count: home, on PX4.
    `keeps_item`: the same mission, uploaded again, goes on with the item that was left.
    `zero_is_a_place` tells PX4, which flies to 0, 0, from ArduPilot, to which that means "here".
    """

    name: str
    version: Version
    heartbeat: Builder
    messages: Mapping[str, MessageHandler]
    commands: Mapping[int, CommandHandler]
    builders: Mapping[int, Builder]
    refuses_item: Callable[[Message], int | None]
    int_scale: float
    silent: frozenset[int] = frozenset()
    also: Mapping[int, Callable[[Autopilot, float], Message | None]] = field(default_factory=dict)
    withholds: Callable[[Autopilot, int, float], bool]
    groups: Mapping[int, tuple[int, ...]]
    default_rates_hz: Mapping[int, float]
    commands_at_once: frozenset[int] = frozenset()
    mixed_at_once: Mapping[int, Callable[[Autopilot, Params, float], None]] = field(
        default_factory=dict
    )
    queue_depth: int | None = None
    commands_per_s: float = 30.0
    first_item: int = 0
    zero_is_a_place: bool = False
    keeps_item: bool = False
    busy_factor: float = 1.0
    interval_kinds_max: int | None = None
    timesync_s: float = 10.0
    system_in_timesync: bool = False
    carries_out_for_unheard: bool = False
    forwards: bool = True
    tells_of_actions: bool = True
    position_step_s: float = 0.0
