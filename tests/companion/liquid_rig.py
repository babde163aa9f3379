"""A sprayer whose liquid can go wrong, and what watches it."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field, replace

from companion.core.options.flow_meter import Detection, Watching
from companion.core.options.liquid_faults import WatchMemory, follow
from companion.core.types import (
    FaultKind,
    FlowReport,
    PressureReport,
    SprayPlan,
    TankReport,
)
from tests.builders import CURVE, SPRAYING, setup

NAN, INF = math.nan, math.inf
STEP_S = 0.05
DUTIES, KPA = (0.0, 0.5, 1.0), (164.0, 227.0, 290.0)
LAW = Detection(pressure_duty=DUTIES, pressure_kpa=KPA, reserve_l=1.0)
OPEN_ML_S = 6.096 * 1000.0 / 60.0 / 6.0


@dataclass
class Rig:
    """A sprayer of six valves whose liquid can go wrong; steps 20 times a second.

    `flows` are factors of each valve's flow, `stuck_open` valves flow whatever is ordered.
    """

    law: Detection = LAW
    duty: tuple[float, ...] = (0.6,) * 6
    flows: list[float] = field(default_factory=lambda: [1.0] * 6)
    stuck_open: set[int] = field(default_factory=set)
    leak_ml_s: float = 0.0
    pressure: float = 1.0
    gain: float = 1.0
    noise: float = 0.01
    supply: float = 1.0
    bubbles: float = 0.0
    meter: bool = True
    enabled: bool = True
    tank: TankReport | None = None
    fault: str = ""
    order_late_s: float = 0.0
    count_late_s: float = 0.0
    is_held_up: bool = False
    now_s: float = 100.0
    seed: int = 1

    def __post_init__(self) -> None:
        base = setup()
        self.watching = Watching.of(self.law, base.nozzle_sets, base.lag, base.pwm)
        self.memory = WatchMemory()
        self.ml = 0.0
        self.chance = random.Random(self.seed)
        self.plan: SprayPlan | None = None
        self.past: list[tuple[float, tuple[float, ...]]] = []
        self.in_force: tuple[float, ...] = (0.0,) * 6
        self.arrived: tuple[float, FlowReport] | None = None

    @property
    def kinds(self) -> list[FaultKind]:
        return [finding.kind for finding in self.memory.findings]

    def flow_ml_s(self, duty: tuple[float, ...]) -> float:
        total = self.leak_ml_s
        for valve, each in enumerate(duty):
            ordered = CURVE.flow_for(each) * 1000.0 / 60.0 / 6.0
            total += OPEN_ML_S if valve in self.stuck_open else ordered * self.flows[valve]
        bubble = 1.0 - self.chance.uniform(0.0, self.bubbles)
        return total * self.supply * bubble

    def step(self) -> None:
        self.now_s += STEP_S
        lag_s = 0.115 + self.order_late_s
        delayed = [duty for at_s, duty in self.past if at_s <= self.now_s - lag_s]
        if not self.is_held_up:
            self.in_force = delayed[-1] if delayed else (0.0,) * 6
        duty = self.in_force
        factor = self.gain * (1.0 + self.noise * self.chance.gauss(0.0, 1.0))
        self.ml += max(self.flow_ml_s(duty) * STEP_S * factor, 0.0)
        counted_s = self.now_s - self.count_late_s
        flow = FlowReport(received_s=counted_s, volume_ml=NAN if self.fault else self.ml)
        if not self.is_held_up or self.arrived is None:
            self.arrived = self.now_s, flow
        heard_s, flow = self.arrived
        mean = sum(duty) / 6.0
        kpa = (164.0 + 126.0 * mean) * self.pressure
        state = replace(
            SPRAYING,
            time_s=self.now_s,
            position_received_s=heard_s,
            enabled=self.enabled,
            flow=replace(flow, fault=self.fault) if self.meter else None,
            pressure=PressureReport(received_s=self.now_s, pressure_kpa=kpa),
            tank=self.tank,
        )
        self.memory = follow(
            self.watching, self.memory, self.plan, state, index=0, now_s=self.now_s
        )
        self.past.append((self.now_s, self.duty))
        self.plan = SprayPlan(
            sequence=1,
            issued_s=self.now_s,
            duty=self.duty,
            changes=(),
            lease_until_s=self.now_s + 0.3,
        )

    def run(self, seconds: float) -> Rig:
        for _ in range(round(seconds / STEP_S)):
            self.step()
        return self

    def until_found(self, most_s: float = 3.0) -> float:
        """Return after how long something is found; fails when nothing is."""
        begin_s = self.now_s
        while not self.memory.findings:
            assert self.now_s - begin_s < most_s, "nothing was found"
            self.step()
        return self.now_s - begin_s


def healthy(**given: object) -> Rig:
    """Return a rig that has sprayed for ten seconds without a finding."""
    rig = Rig(**given).run(10.0)  # type: ignore[arg-type]
    assert not rig.memory.findings
    return rig
