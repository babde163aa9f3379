"""What the slow trim of the flow brings, on a sprayer that does not do what its table says.

    python -m tests.bench.flow_trim --seeds 6 [--speed 5] [--gain 1.08] [--gain 1.0]

flies the example's field with and without the trim, the same path and sprayer each time, pulsed
and with noise, and prints one JSON object: volume error, spraying accuracy and the trim's own
path. The meter's gain is drawn by seed within +-3 %.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean

from analysis.evaluation import evaluate
from companion.core.options.flow_trim import FlowTrim
from companion.core.types import Decision
from sitl.anyang import demo_lags, demo_setup, demo_trajectory
from sitl.flight import FlightOptions, fly
from sitl.profile import load_profile
from tests.bench.figures import Figure
from tests.bench.sprayers import scaled_flow

METER_RATE_HZ = 50.0
# Flow over the table: what a worn set of nozzles gives, and a sprayer just calibrated.
GAINS = (1.08, 1.0)
MEAN_TARGET, WORST_TARGET = 98.0, 96.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Trimmed:
    """One flight."""

    speed_m_s: float
    gain: float
    seed: int
    trim: bool
    volume_error_percent: float
    accuracy_percent: float
    settled_accuracy_percent: float | None
    lag_mean_abs_m: float | None
    trim_end: float | None
    trim_mean: float | None
    trim_half: float | None
    states: dict[str, int]


def flown(speed_m_s: float, gain: float, seed: int, law: FlowTrim | None) -> Trimmed:
    """Fly once over the example's field."""
    table = load_profile("wang-2024")
    setup = replace(demo_setup(speed_m_s), lag=demo_lags("gpio"), flow_trim=law)
    trims: list[float] = []
    states: Counter[str] = Counter()

    def seen(decision: Decision) -> None:
        if decision.flow_trim is not None and decision.flow_trim_state is not None:
            states[decision.flow_trim_state.value] += 1
            if decision.flow_l_min > 0.0:
                trims.append(decision.flow_trim)

    result = fly(
        setup,
        demo_trajectory(speed_m_s, seed),
        scaled_flow(table, gain),
        FlightOptions(seed=seed, meter_rate_hz=METER_RATE_HZ),
        speed_m_s=speed_m_s,
        observer=seen,
    )
    found = evaluate(result.record)
    return Trimmed(
        speed_m_s=speed_m_s,
        gain=gain,
        seed=seed,
        trim=law is not None,
        volume_error_percent=found.volume_error_percent or 0.0,
        accuracy_percent=found.spraying_accuracy_percent or 0.0,
        settled_accuracy_percent=found.settled_accuracy_percent,
        lag_mean_abs_m=found.lag_distance_m.mean_abs,
        trim_end=trims[-1] if trims else None,
        trim_mean=fmean(trims) if trims else None,
        trim_half=fmean(trims[len(trims) // 2 :]) if trims else None,
        states=dict(states),
    )


def summary(flights: Sequence[Trimmed]) -> dict[str, float | None]:
    """Return means and the worst flight of flights of one kind."""
    accuracies = [flight.accuracy_percent for flight in flights]
    lags = [flight.lag_mean_abs_m for flight in flights if flight.lag_mean_abs_m is not None]
    return {
        "flights": len(flights),
        "volume_error_mean_abs_percent": fmean(abs(f.volume_error_percent) for f in flights),
        "volume_error_worst_percent": max((f.volume_error_percent for f in flights), key=abs),
        "accuracy_mean_percent": fmean(accuracies),
        "accuracy_worst_percent": min(accuracies),
        "lag_mean_abs_m": fmean(lags) if lags else None,
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One path of one sprayer, with and without the trim."""

    gain: float
    seed: int
    speed_m_s: float = 5.0


def fly_task(task: Task) -> list[Trimmed]:
    """Fly both ways."""
    return [flown(task.speed_m_s, task.gain, task.seed, law) for law in (None, FlowTrim())]


def figures(flights: Sequence[Trimmed], *, section: str) -> list[Figure]:
    """Return the accuracy with the trim, beside that without."""
    made = []
    for gain in sorted({flight.gain for flight in flights}):
        alike = [flight for flight in flights if flight.gain == gain]
        ours = summary([flight for flight in alike if flight.trim])
        other = summary([flight for flight in alike if not flight.trim])
        where = f"{100.0 * (gain - 1.0):+.0f} % of flow" if gain != 1.0 else "calibrated flow"
        for name, words, target in (
            ("mean", "mean", MEAN_TARGET),
            ("worst", "worst seed", WORST_TARGET),
        ):
            key = f"accuracy_{name}_percent"
            made.append(
                Figure(
                    key=f"flow_trim_{name}_{gain:g}",
                    what=f"spraying accuracy, 3 % meter and slow trim, {where}: {words}",
                    value=ours[key],
                    unit="%",
                    n=sum(flight.trim for flight in alike),
                    target=target,
                    is_at_least=True,
                    alternative={"without a trim": other[key]},
                    details=ours,
                    section=section,
                    row=f"spraying accuracy with the 3 % meter and slow trim: {words}",
                )
            )
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly and print."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.flow_trim", description=__doc__)
    parser.add_argument("--seeds", type=int, default=6, help="flights of a kind")
    parser.add_argument("--speed", type=float, action="append", help="m/s; 5 unless told")
    parser.add_argument("--gain", type=float, action="append", help="flow over table; 1.08 and 1")
    parser.add_argument("--settle-s", type=float, default=FlowTrim().settle_s)
    given = parser.parse_args(arguments)
    flights = []
    for speed_m_s in given.speed or [5.0]:
        for gain in given.gain or [1.08, 1.0]:
            for seed in range(1, given.seeds + 1):
                for law in (None, FlowTrim(settle_s=given.settle_s)):
                    flights.append(flown(speed_m_s, gain, seed, law))
                    sys.stderr.write(f"{flights[-1]}\n")
    kinds = sorted({(f.speed_m_s, f.gain, f.trim) for f in flights})
    rows = [
        {"speed_m_s": speed_m_s, "gain": gain, "trim": trim}
        | summary([f for f in flights if (f.speed_m_s, f.gain, f.trim) == (speed_m_s, gain, trim)])
        for speed_m_s, gain, trim in kinds
    ]
    sys.stdout.write(json.dumps({"flow_trim": rows}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
