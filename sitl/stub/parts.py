"""What an autopilot is put together from."""

from __future__ import annotations

from dataclasses import dataclass

from sitl.stub.estimator import Estimator
from sitl.stub.faults import FaultClock
from sitl.stub.firmware import CommandQueue, Firmware
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
