"""What each error costs: the same flights again with one error after the other switched off.

    python -m tests.bench.split [--seeds 4] [--speeds 2,5] [--outputs gpio,servo] [--page]

The rest stays as it is in every flight of the benchmarks: position, velocity, jitter of the link,
scatter of the valves, gusts, and a table of the flow that is straight between its points.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

from analysis.evaluation import Evaluation, evaluate
from companion.core.inputs import Input, Telemetry
from companion.core.setup import Setup
from sitl.anyang import ACCELERATION_M_S2, START_S, demo_route
from sitl.earth import Earth
from sitl.flight import MESSAGE_DELAY_S, FlightOptions, fly
from sitl.profile import PlantProfile, load_profile
from sitl.trajectory import Trajectory
from sitl.valve_calibration import (
    calibrate_curves,
    calibrate_valves,
    with_curves,
    with_figures,
)
from sitl.vehicle import Vehicle
from sitl.workers import do_all
from tests.bench.flights import Task, place
from tests.bench.report import made_by
from tests.bench.sprayers import PLANT, Output, known_setup, options_of, sprayer_setup

PAGE = Path(__file__).parents[2] / "docs" / "measurements" / "split.md"
PAGE_TEXT = """<!-- Written by `python -m tests.bench.split --page`; do not edit. -->

# What each error costs

`{command}`, {today}, in simulation: the example's field with one error after the other switched
off. The margin is what stays unsprayed inside the border, 0.10 m of it by `border_buffer_m`;
*least* is the smallest of all crossings, *outside* what fell beyond.

{tables}
How to read it:

- **Border.** What servo outputs leave more than GPIO is the pulses: where a driver board puts them
  is not known here. With GPIO what is left beyond the buffer is the spread of the valves' delays:
  the slowest and the quickest are reckoned with. The buffer covers the error of the position.
- **Misapplied.** The scatter of the valves' flow and the flow between the points of the bucket test
  cost most. `vrspray calibrate valves` measures the first, `vrspray calibrate curve` the second:
  their rows fly with what the twin's meter said.
- **Lag.** Messages, gusts and the valves' lags each cost about a centimetre; none dominates.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A flight: what is flown, and how its messages are changed on the way."""

    setup: Setup
    path: Trajectory
    profile: PlantProfile
    options: FlightOptions

    def exact(self, item: Input, *, place: bool, velocity: bool, arrival: bool) -> Input:
        """Return a position with some of its errors taken off; its estimator stays as late."""
        if not isinstance(item, Telemetry):
            return item
        truth = self.path.truths_at([item.boot_s - self.options.estimator_lag_s])[0]
        if place:
            frame = self.setup.frame
            earth = Earth(frame.latitude_deg, frame.longitude_deg)
            latitude, longitude = earth.to_geographic(truth.east_m, truth.north_m)
            item = replace(item, latitude_deg=latitude, longitude_deg=longitude)
        if velocity:
            item = replace(
                item,
                velocity_east_m_s=truth.velocity_east_m_s,
                velocity_north_m_s=truth.velocity_north_m_s,
            )
        return replace(item, received_s=item.boot_s + MESSAGE_DELAY_S) if arrival else item

    def flown(
        self,
        speed_m_s: float,
        *,
        place: bool = False,
        velocity: bool = False,
        arrival: bool = False,
    ) -> Evaluation:
        """Fly and judge it."""

        def exact(items: Iterator[Input]) -> Iterator[Input]:
            for item in items:
                yield self.exact(item, place=place, velocity=velocity, arrival=arrival)

        is_exact = place or velocity or arrival
        result = fly(
            self.setup,
            self.path,
            self.profile,
            self.options,
            speed_m_s=speed_m_s,
            disturb=exact if is_exact else None,
        )
        return evaluate(result.record)


def calm(speed_m_s: float, seed: int) -> Trajectory:
    """Return the path of a speed without gusts."""
    vehicle = Vehicle(
        demo_route(speed_m_s),
        start_s=START_S,
        seed=seed,
        acceleration_m_s2=ACCELERATION_M_S2,
        gust_m_s=0.0,
    )
    return vehicle.fly_to_end()


def _alike(profile: PlantProfile, *, lag: bool = False, flow: bool = False) -> PlantProfile:
    return replace(
        profile,
        lag_scatter=0.0 if lag else profile.lag_scatter,
        flow_scatter=0.0 if flow else profile.flow_scatter,
    )


def _options(**changed: object) -> Callable[[Case, float, int], Evaluation]:
    def flown(case: Case, speed_m_s: float, _seed: int) -> Evaluation:
        return replace(case, options=replace(case.options, **changed)).flown(speed_m_s)  # type: ignore[arg-type]

    return flown


def _calibrated(case: Case, speed_m_s: float, seed: int, *, shaped: bool) -> Evaluation:
    """Fly the same sprayer with what its meter says of it on the ground, through GPIO."""
    ground, on_ground = sprayer_setup(PLANT, "gpio"), options_of("gpio", seed)
    setup = case.setup
    if shaped:
        setup = with_curves(setup, calibrate_curves(ground, case.profile, on_ground)[0])
    found = calibrate_valves(ground, case.profile, on_ground).found
    return replace(case, setup=with_figures(setup, found)).flown(speed_m_s)


def _perfect(case: Case, speed_m_s: float, seed: int) -> Evaluation:
    known = known_setup(case.setup, case.profile, "gpio", seed)
    options = FlightOptions(seed=seed, knows=True)
    return replace(case, setup=known, options=options).flown(speed_m_s)


CASES: dict[str, Callable[[Case, float, int], Evaluation]] = {
    "as it is": lambda case, speed, _: case.flown(speed),
    "place exact": lambda case, speed, _: case.flown(speed, place=True),
    "velocity exact": lambda case, speed, _: case.flown(speed, velocity=True),
    "no jitter of the link": lambda case, speed, _: case.flown(speed, arrival=True),
    "messages exact: all three": lambda case, speed, _: case.flown(
        speed, place=True, velocity=True, arrival=True
    ),
    "positions at 50 Hz": _options(position_rate_hz=50.0),
    "valves alike in lag": lambda case, speed, _: replace(
        case, profile=_alike(case.profile, lag=True)
    ).flown(speed),
    "valves alike in flow": lambda case, speed, _: replace(
        case, profile=_alike(case.profile, flow=True)
    ).flown(speed),
    "flow straight between points": _options(flow_law="straight"),
    "these two": lambda case, speed, _: replace(
        case,
        profile=_alike(case.profile, flow=True),
        options=replace(case.options, flow_law="straight"),
    ).flown(speed),
    "these two, and messages exact": lambda case, speed, _: replace(
        case,
        profile=_alike(case.profile, flow=True),
        options=replace(case.options, flow_law="straight"),
    ).flown(speed, place=True, velocity=True, arrival=True),
    "each valve measured": lambda case, speed, seed: _calibrated(case, speed, seed, shaped=False),
    "and the curve's shape": lambda case, speed, seed: _calibrated(case, speed, seed, shaped=True),
    "no gusts": lambda case, speed, seed: replace(case, path=calm(speed, seed)).flown(speed),
    "no border buffer": lambda case, speed, _: replace(
        case, setup=replace(case.setup, border_buffer_m=0.0)
    ).flown(speed),
    "perfect knowledge": _perfect,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """The flights of one path through one output, by what was switched off."""

    speed_m_s: float
    output: Output
    found: dict[str, Evaluation]


def measure(todo: tuple[float, Output, int]) -> Row:
    """Fly one path with every error in turn switched off."""
    speed_m_s, output, seed = todo
    setup, path = place(Task(speed_m_s=speed_m_s, seed=seed), output)
    options = options_of(output, seed)
    case = Case(setup=setup, path=path, profile=load_profile(PLANT), options=options)
    found = {name: make(case, speed_m_s, seed) for name, make in CASES.items()}
    return Row(speed_m_s=speed_m_s, output=output, found=found)


def table(rows: Sequence[Row]) -> list[str]:
    """Return the figures as tables, one for each speed and output."""
    told: list[str] = []
    for speed_m_s, output in dict.fromkeys((row.speed_m_s, row.output) for row in rows):
        mine = [row for row in rows if (row.speed_m_s, row.output) == (speed_m_s, output)]
        told += [
            f"**{output}, {speed_m_s:g} m/s**, {len(mine)} seeds",
            "",
            "| Switched off | Mean lag [m] | Worst [m] | Misapplied [%] | Margin [m] | Least [m] "
            "| Outside [mL] |",
            "|---|---|---|---|---|---|---|",
        ]
        told += [_line(name, [row.found[name] for row in mine]) for name in CASES]
        told.append("")
    return told


def _line(name: str, found: Sequence[Evaluation]) -> str:
    lags = [each.lag_distance_m for each in found]
    margins = [each.border_margin_m for each in found]
    return (
        f"| {name} | {fmean(lag.mean_abs or 0.0 for lag in lags):.3f} "
        f"| {max(lag.max_abs or 0.0 for lag in lags):.2f} "
        f"| {fmean(each.misapplied_percent or 0.0 for each in found):.2f} "
        f"| {fmean(margin.mean or 0.0 for margin in margins):.3f} "
        f"| {min(margin.min or 0.0 for margin in margins):.3f} "
        f"| {max(each.off_target_ml for each in found):.1f} |"
    )


def main() -> None:
    """Measure, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--speeds", default="2,5")
    parser.add_argument("--outputs", default="gpio,servo")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--page", action="store_true", help=f"write docs/measurements/{PAGE.name}")
    asked = parser.parse_args()
    todo = [
        (float(speed), output, seed)
        for speed in asked.speeds.split(",")
        for output in asked.outputs.split(",")
        for seed in range(1, asked.seeds + 1)
    ]
    told = "\n".join(table(do_all(measure, todo, processes=asked.processes)))
    if asked.page:
        PAGE.write_text(PAGE_TEXT.format(**made_by("split"), tables=told))
    sys.stdout.write(f"{told}\n")


if __name__ == "__main__":
    main()
