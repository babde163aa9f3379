"""What an autopilot is put together from."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from sitl.stub.estimator import Estimator
from sitl.stub.faults import FaultClock
from sitl.stub.firmware import Firmware
from sitl.stub.flight import Flight
from sitl.stub.outputs import Outputs
from sitl.stub.parameters import Parameters
from sitl.stub.protocol import SigningKey


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
