"""An hour of simulated flight with random faults: `python -m tests.bench.hour [hours] [seed]`.

The closed loop over the demo's field, flight after flight, each with faults of its own drawn at
random: those of `sitl/fly.py` and, beside them, fields that are no number, reports that
stop, a link that delays and repeats. The operator enables again every few seconds, so that there
is something to close.
"""

from __future__ import annotations

import gc
import json
import math
import resource
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from companion.core.types import (
    Decision,
    EstimatorReport,
    Fix,
    GnssReport,
    HeartbeatReport,
    Inhibit,
    Input,
    LandedReport,
    OperatorCommand,
    SpeedReport,
    WindReport,
)
from sitl.anyang import START_S, demo_route
from sitl.flight import FlightOptions, fly
from sitl.fly import ON_INPUTS, with_faults
from sitl.outputs import PlanFollower
from sitl.profile import load_profile
from sitl.stub.faults import Fault
from sitl.vehicle import Vehicle
from tests.bench.fields import PROFILE, example
from tests.bench.oracle import Oracle, open_under
from tests.message_way import Way, sent_over

SPEED_M_S = 5.0
EVERY_S = 8.0  # between the starts of two faults, on average
LONGEST_S = 6.0
ENABLE_S = 3.0
# A flight's own arrays come and go; what stays of each flight would add up to more than this.
GROWTH_MAX_MIB = 16.0
_NO_NUMBERS = (math.nan, math.inf, -math.inf)


def faults_of(rng: np.random.Generator, duration_s: float) -> tuple[Fault, ...]:
    """Return faults at random over a flight."""
    kinds = sorted(ON_INPUTS)
    return tuple(
        Fault(
            kind=kinds[int(rng.integers(len(kinds)))],
            at_s=float(rng.uniform(0.0, duration_s)),
            duration_s=float(rng.uniform(0.1, LONGEST_S)),
            delay_s=float(rng.uniform(0.01, 5.0)),
            mode=int(rng.integers(0, 29)),
            fix=int(rng.integers(0, 5)),
        )
        for _ in range(math.ceil(duration_s / EVERY_S))
    )


def _bad_report(rng: np.random.Generator, now_s: float) -> Input:
    """Return a report that has to close."""
    bad: tuple[Input, ...] = (
        HeartbeatReport(received_s=now_s, autopilot="ardupilot", armed=False, mode="AUTO"),
        HeartbeatReport(received_s=now_s, autopilot="ardupilot", armed=True, mode="LOITER"),
        GnssReport(received_s=now_s, fix=Fix.FIX_3D),
        EstimatorReport(received_s=now_s, healthy=False),
        LandedReport(received_s=now_s, in_air=None),
        WindReport(received_s=now_s, speed_m_s=math.nan),
        WindReport(received_s=now_s, speed_m_s=9.0),
        SpeedReport(received_s=now_s, ground_speed_m_s=math.nan),
        OperatorCommand(received_s=now_s, enable=False, source="command"),
    )
    return bad[int(rng.integers(len(bad)))]


def _no_number(rng: np.random.Generator, item: Input) -> Input:
    """Return an input with one of its numbers replaced by one that is none."""
    names = [
        found.name
        for found in fields(item)
        if isinstance(getattr(item, found.name), float) and found.name != "received_s"
    ]
    if not names:
        return item
    value = _NO_NUMBERS[int(rng.integers(len(_NO_NUMBERS)))]
    return replace(item, **{names[int(rng.integers(len(names)))]: value})


def disturbed(items: Iterable[Input], rng: np.random.Generator) -> Iterator[Input]:
    """Yield the inputs with fields that are no number, bad reports, silences of one kind."""
    silent: type | None = None
    until_s = enable_s = -math.inf
    for item in items:
        now_s = item.received_s
        if now_s >= enable_s:
            enable_s = now_s + ENABLE_S
            yield OperatorCommand(received_s=now_s, enable=True, source="command")
        if rng.random() < 0.002:
            yield _bad_report(rng, now_s)
        if now_s >= until_s:
            silent = type(item) if rng.random() < 0.0005 else None
            until_s = now_s + (float(rng.uniform(1.0, LONGEST_S)) if silent else 0.0)
        if silent is not None and isinstance(item, silent):
            continue
        if isinstance(item, GnssReport):
            yield WindReport(received_s=now_s, speed_m_s=3.0)
        yield _no_number(rng, item) if rng.random() < 0.001 else item


@dataclass(slots=True)
class Watch:
    """The oracle and a follower of the plans beside a flight."""

    valve_count: int
    oracle: Oracle = field(default_factory=Oracle)
    wrong: list[str] = field(default_factory=list)
    reasons: Counter[Inhibit] = field(default_factory=Counter)
    open_steps: int = 0
    steps: int = 0
    follower: PlanFollower = field(init=False)

    def __post_init__(self) -> None:
        self.follower = PlanFollower(self.valve_count)

    def judge(self, decision: Decision) -> None:
        """Take one decision."""
        self.steps += 1
        self.reasons.update(decision.inhibits)
        self.follower.submit(decision.plan, now_s=decision.now_s)
        self.follower.orders.clear()
        is_open = any(self.follower.duty)
        self.open_steps += is_open
        problem = open_under(decision, self.oracle)
        if problem is None and is_open and decision.inhibits:
            problem = f"{decision.now_s}: open under {sorted(decision.inhibits)}"
        if problem is not None and len(self.wrong) < 20:
            self.wrong.append(problem)


def flight(seed: int) -> tuple[float, Watch]:
    """Fly once; return simulated seconds, and what was seen."""
    rng = np.random.default_rng((seed, 600))
    setup = example(SPEED_M_S)
    setup = replace(setup, limits=replace(setup.limits, speed_check_required=True))
    path = Vehicle(demo_route(SPEED_M_S), start_s=START_S, seed=seed).fly_to_end()
    watch = Watch(len(setup.boom.valves))
    faults = faults_of(rng, float(path.time_s[-1]) - START_S)
    way = Way(delay_s=0.01, lost_share=0.02, repeated_share=0.01, late_share=0.01, late_s=0.3)

    def disturb(items: Iterator[Input]) -> Iterator[Input]:
        faulty = with_faults(disturbed(items, rng), faults, start_s=START_S)
        return sent_over(faulty, replace(way, timesync=seed % 2 == 0), seed=seed)

    result = fly(
        setup,
        path,
        load_profile(PROFILE),
        FlightOptions(seed=seed, fidelity="averaged"),
        speed_m_s=SPEED_M_S,
        observer=watch.judge,
        on_input=watch.oracle.hear,
        disturb=disturb,
    )
    return result.simulated_s, watch


def resident_mib() -> float:
    """Return the memory that this process has now (Linux)."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return round(pages * resource.getpagesize() / 2**20, 1)


def hour(hours: float, seed: int) -> dict[str, Any]:
    """Return what came of so many hours, flight after flight."""
    began_s, simulated_s, number = time.perf_counter(), 0.0, 0
    wrong: list[str] = []
    reasons: Counter[Inhibit] = Counter()
    open_steps = steps = 0
    memory_mib: list[float] = []
    while simulated_s < 3600.0 * hours:
        flown_s, watch = flight(seed + number)
        simulated_s += flown_s
        wrong += [f"seed {seed + number}: {text}" for text in watch.wrong]
        reasons.update(watch.reasons)
        open_steps, steps, number = open_steps + watch.open_steps, steps + watch.steps, number + 1
        del watch
        gc.collect()
        memory_mib.append(resident_mib())
    return {
        "simulated_s": round(simulated_s, 1),
        "flights": number,
        "seeds": [seed, seed + number - 1],
        "steps": steps,
        "open_steps": open_steps,
        "inhibited_steps": {str(reason): count for reason, count in reasons.most_common()},
        "wrong": wrong[:20],
        "memory_mib_after_each_flight": memory_mib,
        "wall_s": round(time.perf_counter() - began_s, 1),
    }


def main() -> int:
    """Print what was found; fail for a valve that was open, or for memory that grew."""
    hours = float(sys.argv[1]) if len(sys.argv) > 1 else 1.0
    found = hour(hours, int(sys.argv[2]) if len(sys.argv) > 2 else 1)
    sys.stdout.write(json.dumps(found, indent=2) + "\n")
    memory = found["memory_mib_after_each_flight"]
    grew = max(memory) - memory[len(memory) // 3] > GROWTH_MAX_MIB
    return int(bool(found["wrong"]) or found["open_steps"] == 0 or grew)


if __name__ == "__main__":
    sys.exit(main())
