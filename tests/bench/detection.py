"""How soon each fault of the liquid is noticed and named on the twin, and how often a healthy one.

    python -m tests.bench.detection --flights 10 [--hours 10] [--fidelity averaged] [--no-pressure]

sprays the example's field at 4 to 6 m/s: the plans of some flights of the whole controller with
its trim (`PATHS` a speed), each time with another sprayer, with the gain, noise and pulses of the
profile's meter, and with a pressure sensor of 1 % noise. A fault begins at a random moment of a
pass that goes on for four seconds more. Faults that move the total flow by less than 10 % are
counted apart, until after the next turn, where all valves are closed. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
from itertools import pairwise
from statistics import fmean

from sitl.liquid_faults import LiquidFault, LiquidFaultKind
from tests.bench.detection_duty import by_duty
from tests.bench.liquid_flights import Fidelity, Flight, found_in, moved_by, ordered

SPEEDS_M_S = (4.0, 5.0, 6.0)
# A fault begins after the first seconds of spraying, with this much of the pass to come.
LEARNT_S, AHEAD_S = 5.0, 4.0
# A fault is waited for until after the next turn.
UNTIL_S = 40.0
PATHS = 2
MOVED_MIN = 0.10
TARGET_S = 3.0
# What is named so is right: a loss as large as a valve's flow may be either, and so may a gain;
# a tank runs empty with air first.
ALIKE = {
    "clog": {"clog", "stuck-closed"},
    "stuck-closed": {"stuck-closed", "clog"},
    "leak": {"leak", "stuck-open"},
    "stuck-open": {"stuck-open", "leak"},
    "tank-empty": {"tank-empty", "air"},
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Watched:
    """One flight with one fault."""

    kind: str
    seed: int
    speed_m_s: float
    share: float
    moved: float
    duty: float
    found_s: float | None
    named: str | None
    final: str | None
    valve: int | None
    valve_named: int | None
    latched: tuple[str, ...]
    before: bool


@cache
def spraying_times(speed_m_s: float, path: int) -> tuple[tuple[float, float], ...]:
    """Return (time, mean duty) at which a flight has seconds of a pass before it."""
    seen = ordered(speed_m_s, path)
    on = [(d.now_s, sum(d.plan.duty) / len(d.plan.duty)) for d in seen if d.flow_l_min > 0.0]
    times = [at_s for at_s, _ in on]
    ends = [a for a, b in pairwise(times) if b - a > 0.5] + times[-1:]
    begins = times[:1] + [b for a, b in pairwise(times) if b - a > 0.5]
    return tuple(
        (at_s, duty)
        for at_s, duty in on
        if at_s - times[0] > LEARNT_S
        and min(end_s - at_s for end_s in ends if end_s >= at_s) > AHEAD_S
        and min(at_s - begin_s for begin_s in begins if begin_s <= at_s) > 0.5
    )


def drawn(kind: LiquidFaultKind, chance: random.Random, from_s: float) -> LiquidFault:
    """Return a fault of a kind."""
    share, valve = 0.0, None
    if kind is LiquidFaultKind.CLOG:
        share = chance.uniform(0.10, 0.30)
        if chance.random() < 0.3:
            valve, share = chance.randrange(6), chance.uniform(0.6, 0.9)
    elif kind is LiquidFaultKind.SUPPLY:
        share = chance.uniform(0.10, 0.30)
    elif kind is LiquidFaultKind.LEAK:
        share = chance.uniform(0.05, 0.25)
    elif kind in (LiquidFaultKind.STUCK_CLOSED, LiquidFaultKind.STUCK_OPEN):
        valve = chance.randrange(6)
    return LiquidFault(kind=kind, from_s=from_s, share=share, valve=valve)


def watched(
    kind: LiquidFaultKind, seed: int, fidelity: Fidelity = "averaged", *, pressure: bool = True
) -> Watched:
    """Fly once with a fault."""
    chance = random.Random(f"{kind} {seed}")
    speed_m_s = chance.choice(SPEEDS_M_S)
    path = 1 + seed % PATHS
    from_s, duty = chance.choice(spraying_times(speed_m_s, path))
    fault = drawn(kind, chance, from_s)
    around = [d for at_s, d in spraying_times(speed_m_s, path) if 0.0 <= at_s - from_s <= TARGET_S]
    flight = Flight(speed_m_s=speed_m_s, path=path, seed=seed, fidelity=fidelity, pressure=pressure)
    changes = found_in(flight, (fault,), until_s=from_s + UNTIL_S)
    after = [(at_s - from_s, memory) for at_s, memory in changes if at_s > from_s]
    found_s = after[0][0] if after else None
    named = [memory for at_s, memory in after if at_s <= max(TARGET_S, found_s or 0.0)]
    final = named[-1].findings[-1] if named else None
    return Watched(
        kind=kind.value,
        seed=seed,
        speed_m_s=speed_m_s,
        share=fault.share,
        moved=fmean(moved_by(fault, each) for each in [duty, *around]),
        duty=duty,
        found_s=found_s,
        named=after[0][1].findings[-1].kind.value if after else None,
        final=None if final is None else final.kind.value,
        valve=fault.valve,
        valve_named=None if final is None else final.valve,
        latched=tuple(sorted(reason.value for reason in named[-1].latched)) if named else (),
        before=any(at_s <= from_s for at_s, _ in changes),
    )


def summary(flights: Sequence[Watched]) -> dict[str, object]:
    """Return what came of the flights of one kind."""
    large = [flight for flight in flights if flight.moved >= MOVED_MIN]
    times = sorted(f.found_s for f in large if f.found_s is not None)
    kind = flights[0].kind
    alike = ALIKE.get(kind, {kind})
    small = [f for f in flights if f.moved < MOVED_MIN]
    return {
        "flights": len(flights),
        "moved_10_percent": len(large),
        "within_3_s": sum(time <= TARGET_S for time in times),
        "missed": sum(f.found_s is None for f in large),
        "median_s": times[len(times) // 2] if times else None,
        "worst_s": times[-1] if times else None,
        "named_exactly": sum(f.final == kind for f in large),
        "named_alike": sum(f.final in alike for f in large),
        "first_names": dict(Counter(f.named for f in large)),
        "final_names": dict(Counter(f.final for f in large)),
        "valve_right": sum(f.valve_named == f.valve for f in large if f.valve_named is not None),
        "valve_wrong": sum(f.valve_named != f.valve for f in large if f.valve_named is not None),
        "smaller": len(small),
        "smaller_found": sum(f.found_s is not None for f in small),
        "smaller_worst_s": max((f.found_s for f in small if f.found_s is not None), default=None),
        "alarm_before": sum(f.before for f in flights),
    }


def healthy(hours: float, fidelity: Fidelity, *, pressure: bool) -> dict[str, object]:
    """Fly without a fault until the hours are over; count the findings."""
    flights, flown_s, sprayed_s = 0, 0.0, 0.0
    alarms: list[dict[str, object]] = []
    while flown_s < hours * 3600.0:
        flights += 1
        speed_m_s, path = SPEEDS_M_S[flights % len(SPEEDS_M_S)], 1 + flights // 3 % PATHS
        flight = Flight(
            speed_m_s=speed_m_s,
            path=path,
            seed=1000 + flights,
            fidelity=fidelity,
            pressure=pressure,
        )
        seen = ordered(speed_m_s, path)
        flown_s += seen[-1].now_s - seen[0].now_s
        on = sum(d.flow_l_min > 0.0 for d in seen) / len(seen)
        sprayed_s += on * (seen[-1].now_s - seen[0].now_s)
        changes = found_in(flight)
        if changes:
            text = changes[0][1].findings[0].text
            alarms.append({"seed": flight.seed, "speed_m_s": speed_m_s, "text": text})
            sys.stderr.write(f"{alarms[-1]}\n")
    return {
        "flights": flights,
        "hours": flown_s / 3600.0,
        "hours_spraying": sprayed_s / 3600.0,
        "false_alarms": len(alarms),
        "alarms": alarms,
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly and print."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.detection", description=__doc__)
    parser.add_argument("--flights", type=int, default=10, help="of each fault")
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--hours", type=float, default=0.0, help="of healthy flying")
    parser.add_argument("--fidelity", choices=("averaged", "pulsed"), default="averaged")
    parser.add_argument("--no-pressure", action="store_true", help="without a pressure sensor")
    parser.add_argument("--only", action="append", choices=[kind.value for kind in LiquidFaultKind])
    parser.add_argument("--by-duty", type=int, default=0, help="seeds of each fault and duty")
    parser.add_argument("--details", action="store_true", help="each flight on standard error")
    given = parser.parse_args(arguments)
    pressure = not given.no_pressure
    kinds = [LiquidFaultKind(kind) for kind in given.only or LiquidFaultKind]
    by_kind: dict[str, list[Watched]] = defaultdict(list)
    for kind in kinds if given.flights else ():
        for seed in range(given.first_seed, given.first_seed + given.flights):
            flight = watched(kind, seed, given.fidelity, pressure=pressure)
            by_kind[kind.value].append(flight)
            if given.details:
                sys.stderr.write(f"{json.dumps(asdict(flight))}\n")
    said: dict[str, object] = {
        "fidelity": given.fidelity,
        "pressure": pressure,
        "faults": {kind: summary(flights) for kind, flights in by_kind.items()},
    }
    if given.by_duty:
        said["by_duty"] = by_duty(given.fidelity, seeds=given.by_duty, pressure=pressure)
    if given.hours > 0.0:
        said["healthy"] = healthy(given.hours, given.fidelity, pressure=pressure)
    sys.stdout.write(json.dumps(said, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
