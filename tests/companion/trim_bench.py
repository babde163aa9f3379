"""A sprayer of one line behind the trim: a gain, a dead time, a meter that counts with noise."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field

from companion.core.options import flow_trim
from companion.core.options.flow_trim import FlowTrim, TrimMemory, Trimming
from companion.core.types import FlowReport, FlowTrimState
from tests.builders import LAG, setup

STEP_S = 0.05
PULSE_ML = 1000.0 / 4600.0


@dataclass
class TrimBench:
    """Steps 20 times a second; `gain` and `wanted_l_min` may be changed between two runs."""

    law: FlowTrim = field(default_factory=FlowTrim)
    gain: float = 1.08
    dead_s: float = 0.105
    wanted_l_min: float = 4.0
    meter_noise: float = 0.0
    seed: int = 1
    set_count: int = 1
    index: int = 0
    begin_s: float = 100.0

    def __post_init__(self) -> None:
        self.trimming = Trimming.of(self.law, LAG, setup().pwm)
        self.now_s = self.begin_s
        # Spraying begins after a pause, as it does in the controller.
        self.memory: TrimMemory = flow_trim.pause(
            flow_trim.begin(self.set_count), None, now_s=self.now_s
        )
        self.metered_ml = 0.0
        self.chance = random.Random(self.seed)
        self.on_its_way: list[tuple[float, float]] = []
        self.flow_ml_s = 0.0
        self.trims: list[float] = []
        self.states: list[FlowTrimState] = []

    @property
    def trim(self) -> float:
        return self.memory.sets[self.index].trim

    @property
    def state(self) -> FlowTrimState:
        return self.memory.state

    def report(self) -> FlowReport:
        return FlowReport(
            received_s=self.now_s, volume_ml=math.floor(self.metered_ml / PULSE_ML) * PULSE_ML
        )

    def step(
        self,
        *,
        report: FlowReport | None = None,
        meter: bool = True,
        is_steady: bool = True,
        is_saturated: bool = False,
    ) -> None:
        """Let the flow run for a step, then follow it; `report` in place of the meter's own."""
        self._flow()
        seen = report or (self.report() if meter else self.memory.report)
        self.memory = flow_trim.follow(
            self.trimming,
            self.memory,
            seen,
            is_steady=is_steady,
            is_saturated=is_saturated,
            now_s=self.now_s,
        )
        commanded = self.wanted_l_min / self.trim
        self.memory = flow_trim.ordered(
            self.trimming, self.memory, flow_l_min=commanded, index=self.index, now_s=self.now_s
        )
        self.on_its_way.append((self.now_s + self.dead_s, commanded * 1000.0 / 60.0))
        self.trims.append(self.trim)
        self.states.append(self.state)

    def _flow(self) -> None:
        begin_s, self.now_s = self.now_s, self.now_s + STEP_S
        true_ml = 0.0
        while self.on_its_way and self.on_its_way[0][0] <= self.now_s:
            at_s, flow_ml_s = self.on_its_way.pop(0)
            true_ml += self.flow_ml_s * (at_s - begin_s)
            begin_s, self.flow_ml_s = at_s, flow_ml_s
        true_ml += self.flow_ml_s * (self.now_s - begin_s)
        noise = 1.0 + self.meter_noise * self.chance.gauss(0.0, 1.0)
        self.metered_ml += max(self.gain * true_ml * noise, 0.0)

    def run(self, seconds: float) -> TrimBench:
        """Spray on, all steady."""
        for _ in range(round(seconds / STEP_S)):
            self.step()
        return self


def tracking(**change: object) -> TrimBench:
    """Return a bench that tracks and whose trim has come near the gain."""
    return TrimBench(**change).run(40.0)  # type: ignore[arg-type]
