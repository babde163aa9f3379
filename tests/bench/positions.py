"""What few positions cost, and what attitude and accelerometer bring back.

    python -m tests.bench.positions [--seeds 4] [--rates 20,10,5] [--flights field-5,gusts] [--page]

Every position and velocity message comes at the rate; attitude and accelerometer at 20 Hz, or not
at all. The valves are alike, so that what is seen is the prediction's. Perfect knowledge flies the
same path. With LOCAL_POSITION_NED at 20 Hz between positions the same estimate is told at 20 Hz, in
floats instead of 1e-7 degrees and cm/s.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

from analysis.evaluation import Evaluation, evaluate
from sitl.conditions import condition_of
from sitl.flight import FlightOptions, fly
from sitl.profile import load_profile
from sitl.workers import do_all
from tests.bench.flights import FIELD, Task, place
from tests.bench.report import made_by
from tests.bench.sprayers import PLANT, known_setup, options_of

FLIGHTS = ("field-2", "field-5", "sway", "gusts", "braking")
IMU_HZ = LOCAL_HZ = 20.0
PAGE = Path(__file__).parents[2] / "docs" / "measurements" / "positions.md"
PAGE_TEXT = """<!-- Written by `python -m tests.bench.positions --page`; do not edit. -->

# Few positions, gusts and braking

`{command}`, {today}, in simulation. Positions, velocities and speeds come at the rate; attitude and
accelerometer (`prediction.use_imu`) at 20 Hz or not at all. The valves are alike. *Perfect
knowledge* knows place, speed and sprayer, but not the next gust.

{table}

- **LOCAL_POSITION_NED and ODOMETRY are not used.** They tell the same estimate as
  GLOBAL_POSITION_INT, in floats. At 20 Hz between slower positions they bring what positions at
  20 Hz bring, for as many bytes (28 each; ODOMETRY 233), so a higher `link.position_rate_hz` does
  the same. Where the link carries 5 Hz only, attitude and accelerometer bring back most of it.
- **The worst single distances** are small steps, from 8 % on, at a changing speed: a few per cent
  of wrong flow, divided by the step, are metres, and one such change makes the figure. Perfect
  knowledge, which cannot foretell a gust either, is the bound beside it.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One flight: what is kept of it by (rate, with accelerometer), and by perfect knowledge."""

    flight: str
    found: dict[tuple[float, bool], Evaluation]
    local: Evaluation
    perfect: Evaluation


def measure(todo: tuple[str, int, tuple[float, ...]]) -> Row:
    """Fly one path at every rate, with the accelerometer and without."""
    name, seed, rates = todo
    is_field = name.startswith(FIELD)
    task = Task(
        condition=FIELD if is_field else name,
        speed_m_s=float(name.partition("-")[2]) if is_field else condition_of(name).speed_m_s,
        seed=seed,
    )
    profile = replace(load_profile(PLANT), lag_scatter=0.0, flow_scatter=0.0)
    setup, path = place(task, "gpio")

    def flown(options: FlightOptions) -> Evaluation:
        known = known_setup(setup, profile, "gpio", seed) if options.knows else setup
        return evaluate(fly(known, path, profile, options, speed_m_s=task.speed_m_s).record)

    base = options_of("gpio", seed)
    return Row(
        flight=name,
        found={
            (hz, imu): flown(
                replace(
                    base,
                    position_rate_hz=hz,
                    speed_rate_hz=min(hz, base.speed_rate_hz),
                    imu_rate_hz=IMU_HZ if imu else 0.0,
                )
            )
            for hz in rates
            for imu in (False, True)
        },
        local=flown(replace(base, position_rate_hz=LOCAL_HZ, position_rounded=False)),
        perfect=flown(FlightOptions(seed=seed, knows=True)),
    )


def table(rows: Sequence[Row]) -> list[str]:
    """Return the figures as a table."""
    told = [
        "| Flight | Positions | Accelerometer | Mean lag [m] | Worst [m] | Misapplied [%] |",
        "|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(row.flight for row in rows):
        mine = [row for row in rows if row.flight == name]
        for hz, imu in mine[0].found:
            told.append(
                _line(name, f"{hz:g} Hz", "yes" if imu else "no", [r.found[hz, imu] for r in mine])
            )
        local = [row.local for row in mine]
        told.append(_line(name, f"and LOCAL_POSITION_NED, {LOCAL_HZ:g} Hz", "no", local))
        told.append(_line(name, "perfect knowledge", "", [row.perfect for row in mine]))
    return told


def _line(name: str, rate: str, imu: str, found: Sequence[Evaluation]) -> str:
    lags = [each.lag_distance_m for each in found]
    return (
        f"| {name} | {rate} | {imu} | {fmean(lag.mean_abs or 0.0 for lag in lags):.3f} "
        f"| {max(lag.max_abs or 0.0 for lag in lags):.2f} "
        f"| {fmean(each.misapplied_percent or 0.0 for each in found):.2f} |"
    )


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--rates", default="20,10,5")
    parser.add_argument("--flights", default=",".join(FLIGHTS))
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--page", action="store_true", help=f"write docs/measurements/{PAGE.name}")
    asked = parser.parse_args()
    rates = tuple(float(rate) for rate in asked.rates.split(","))
    todo = [
        (name, seed, rates)
        for name in asked.flights.split(",")
        for seed in range(1, asked.seeds + 1)
    ]
    told = "\n".join(table(do_all(measure, todo, processes=asked.processes)))
    if asked.page:
        PAGE.write_text(PAGE_TEXT.format(**made_by("positions"), table=told))
    sys.stdout.write(f"{told}\n")


if __name__ == "__main__":
    main()
