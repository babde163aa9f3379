"""All that the engine must know before it starts, and its way through a packet."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

from companion.core.nozzle import PwmLimits
from companion.output.engine.wiring import Wiring

Backend = Literal["gpiod", "spi595", "memory", "file"]

# A lease that reaches farther is a mistake of clocks: the configuration allows 2 s.
LEASE_MAX_S = 2.5
# Wake-ups later than this at the 99th percentile: 30 mm at 6 m/s.
WAKE_LATE_MAX_S = 0.005


@dataclass(frozen=True, slots=True, kw_only=True)
class EngineSetup:
    """Wiring, limits of the valves, the device, and what of the system to ask for.

    `device` is a chip's name, path or label, the file of an SPI device, or a file of levels.
    `overrun_s` is how much longer a valve delivers than its pulse lasts, where it is known.
    `wake_late_max_s` is what the self-test allows; None is `WAKE_LATE_MAX_S` for real outputs, and
    no limit for those in memory or a file, which move nothing.
    """

    wiring: Wiring
    pwm: PwmLimits
    backend: Backend = "gpiod"
    device: str = "gpiochip0"
    overrun_s: float = 0.0
    lease_max_s: float = LEASE_MAX_S
    realtime: bool = True
    spi_hz: int = 1_000_000
    wake_late_max_s: float | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.overrun_s <= self.pwm.min_off_s:
            raise ValueError(f"overrun_s must lie in [0, min_off_s], got {self.overrun_s}")
        if not 0.0 < self.lease_max_s <= 10.0:
            raise ValueError(f"lease_max_s must lie in (0, 10], got {self.lease_max_s}")
        if not 10_000 <= self.spi_hz <= 20_000_000:
            raise ValueError(f"spi_hz must lie in [10000, 20000000], got {self.spi_hz}")
        if self.wake_late_max_s is not None and not self.wake_late_max_s >= 0.0:
            raise ValueError(f"wake_late_max_s must be at least 0, got {self.wake_late_max_s}")
        if self.backend not in get_args(Backend):
            raise ValueError(f"no such lines: {self.backend}")

    @property
    def late_max_s(self) -> float:
        """Return how late wake-ups may be, at the 99th percentile, for the self-test to pass."""
        if self.wake_late_max_s is not None:
            return self.wake_late_max_s
        return WAKE_LATE_MAX_S if self.backend in ("gpiod", "spi595") else math.inf

    def as_bytes(self) -> bytes:
        """Return the set-up as text of JSON."""
        return json.dumps(asdict(self)).encode()

    @classmethod
    def from_bytes(cls, data: bytes) -> EngineSetup:
        """Return the set-up of `as_bytes`; ValueError or TypeError for anything else."""
        found: dict[str, Any] = json.loads(data)
        wiring, pwm = dict(found.pop("wiring")), found.pop("pwm")
        wiring["valves"] = tuple(wiring["valves"])
        return cls(wiring=Wiring(**wiring), pwm=PwmLimits(**pwm), **found)
