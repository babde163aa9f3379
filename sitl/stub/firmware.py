"""What tells one firmware from the other: tables and rules that the rest of the stub asks for.

`ardupilot.py` and `px4.py` make one each. A table stands for behaviour that was read in the
firmware's source or measured on its SITL.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from sitl.stub.faults import Fault, FaultClock, FaultKind
from sitl.stub.flight import Flight
from sitl.stub.mission_items import INFO, MissionItem
from sitl.stub.outputs import Outputs
from sitl.stub.parameters import Parameters
from sitl.stub.protocol import Channel, Message, SigningKey, dialect
from sitl.stub.sprayer import Battery
from sitl.stub.world import Estimator, Pose
from sitl.vehicle import Leaning

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


@dataclass(slots=True, kw_only=True)
class Upload:
    """A mission or a fence on its way in."""

    channel: Channel
    peer: tuple[int, int]
    count: int
    asked_s: float
    heard_s: float
    kind: int = dialect.MAV_MISSION_TYPE_MISSION
    items: list[MissionItem] = field(default_factory=list)


class Autopilot(Protocol):
    """The stub as the handlers of its messages and commands see it."""

    firmware: Firmware
    flight: Flight
    outputs: Outputs
    parameters: Parameters
    faults: FaultClock
    wind_towards_m_s: tuple[float, float]
    channels: list[Channel]
    upload: Upload | None
    fence: tuple[MissionItem, ...]
    batteries: Callable[[float], Sequence[Battery]]
    battery_turn: int
    queue: CommandQueue | None
    says: Callable[[str], None]
    utc_offset_s: float

    def send(self, channel: Channel, message: Message) -> None:
        """Send a message of the autopilot to one peer."""

    def broadcast(self, message: Message) -> None:
        """Send a message of the autopilot to all peers."""

    def tell(self, text: str, *, severity: int = INFO) -> None:
        """Send a STATUSTEXT to all peers."""

    def strikes(self, kind: FaultKind, now_s: float, *, command: int = 0) -> Fault | None:
        """Return the fault of a kind that is in force and strikes this time."""

    def acknowledge(
        self, channel: Channel, command: int, result: int, *, to: tuple[int, int], now_s: float
    ) -> None:
        """Answer a command, as far as the faults let the answer through."""

    def has(self, message_id: int, now_s: float) -> bool:
        """Return whether a message can be sent now."""

    def build(self, message_id: int, now_s: float) -> Message:
        """Return a message that can be asked for."""

    def boot_ms(self, now_s: float) -> int:
        """Return milliseconds since boot, 32 bits."""

    def boot_ns(self, now_s: float) -> int:
        """Return nanoseconds since boot, the time of TIMESYNC."""

    def sample_s(self, now_s: float) -> float:
        """Return when the estimate was made that is sent now."""

    def believed(self, now_s: float) -> Pose:
        """Return the estimated pose; frozen and at rest while the estimator is lost."""

    def received(self, now_s: float) -> Pose:
        """Return the receiver's last place, at its stamp."""

    def leaning(self, now_s: float) -> Leaning:
        """Return how the copter truly leans, as its sensors have it."""

    def estimator_lost(self, now_s: float) -> bool:
        """Return whether the estimator says that it has no position."""

    def wire_sequence(self, sequence: int) -> int:
        """Return the number that an item of the flight has on the wire."""

    def home_item(self) -> MissionItem:
        """Return home as item 0 of the mission."""

    def reboot(self, now_s: float) -> None:
        """Start the clock again and forget streams and outputs; the twin flies on."""


# PX4's way of a command from the receiver to the Commander: a short queue that loses.
#
# The Commander takes one command per loop of about 10 ms; the queue holds eight, and more than 20
# to 30 commands a second in total are not safe (vehicle_command lost; PX4 #16630, #16635, #20430).
# Modelled as eight commands at once and `per_s` of them a second in the long run; what is beyond is
# lost, with its acknowledgement. Those that get through are answered 4 to 12 ms later, as measured
# on a PX4 1.16 SITL; DO_SET_ACTUATOR is at the outputs by then, which hear it themselves.

Job = Callable[[float], None]
_DELAY_S = (0.004, 0.012)


class CommandQueue:
    """Keeps jobs until they are due."""

    def __init__(self, *, depth: int, per_s: float, seed: int) -> None:
        self.lost_count = 0
        self._depth, self._per_s = float(depth), per_s
        self._room = float(depth)
        self._room_at_s: float | None = None
        self._jobs: deque[tuple[float, Job]] = deque()
        # Not for secrets: the same seed must give the same delays.
        self._random = random.Random(seed)

    def put(self, job: Job, now_s: float) -> bool:
        """Take a job; false if it is lost."""
        since_s = now_s - (now_s if self._room_at_s is None else self._room_at_s)
        self._room = min(self._room + max(since_s, 0.0) * self._per_s, self._depth)
        self._room_at_s = now_s
        if self._room < 1.0:
            self.lost_count += 1
            return False
        self._room -= 1.0
        due_s = now_s + self._random.uniform(*_DELAY_S)
        if self._jobs:
            due_s = max(due_s, self._jobs[-1][0])
        self._jobs.append((due_s, job))
        return True

    def run(self, now_s: float) -> None:
        """Do the jobs that are due."""
        while self._jobs and self._jobs[0][0] <= now_s:
            _, job = self._jobs.popleft()
            job(now_s)

    def clear(self) -> None:
        """Forget all jobs."""
        self._jobs.clear()

    def next_due_s(self) -> float:
        """Return when the next job is due; infinite without one."""
        return self._jobs[0][0] if self._jobs else float("inf")


# What an autopilot is put together from.


@dataclass(frozen=True, slots=True, kw_only=True)
class Parts:
    """The parts, and how its clock runs; `uptime_s` is how long it has run at the start."""

    firmware: Firmware
    flight: Flight
    estimator: Estimator
    outputs: Outputs
    parameters: Parameters
    faults: FaultClock
    wind_towards_m_s: tuple[float, float] = (0.0, 0.0)
    drift_ppm: float = 0.0
    uptime_s: float = 0.0
    key: SigningKey | None = None
    seed: int = 0

    def queue(self) -> CommandQueue | None:
        """Return the queue that commands go through, for a firmware that has one."""
        depth = self.firmware.queue_depth
        if depth is None:
            return None
        return CommandQueue(depth=depth, per_s=self.firmware.commands_per_s, seed=self.seed)
