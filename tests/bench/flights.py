"""Accuracy over many flights: campaigns over the example's field and over hard ones.

The perfect-knowledge run has the same path and the same scattered sprayer, the true position and
each valve's own lag and flow, and no driver board between core and valves: the strictest that a
flight can be compared with.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analysis.evaluation import Evaluation, evaluate
from companion.errors import VrsprayError
from sitl.anyang import EXAMPLE, demo_trajectory
from sitl.campaign.bundle import Bundle, bundle_of, unpack
from sitl.campaign.dataset import open_dataset, read_columns
from sitl.campaign.design import Campaign, read_campaign
from sitl.campaign.flying import figures_of
from sitl.campaign.running import Done, Tally, Workers, fly_missing, pool_of
from sitl.conditions import CONDITIONS, condition_of, laid_out
from sitl.flight import FlightOptions, fly
from sitl.profile import load_profile
from tests.bench.sprayers import PLANT, Output, known_setup, sprayer_setup

if TYPE_CHECKING:
    from collections.abc import Iterator

    from companion.core.setup import Setup
    from sitl.profile import PlantProfile
    from sitl.trajectory import Trajectory

CAMPAIGNS = EXAMPLE.parent / "campaigns"
ACCURACY, HARD_CONDITIONS = CAMPAIGNS / "accuracy.toml", CAMPAIGNS / "hard-conditions.toml"
SPEED, CONDITION = "vehicle.speed_m_s", "flight.field"
SLOW_M_S = (2.0, 3.0, 4.0, 5.0, 6.0)
FAST_M_S = (8.0, 10.0, 12.0, 15.0)
PINPOINT_M_S = (3.0, 5.0, 6.0, 8.0, 15.0)
PAPER_M_S = 5.0
# The time of a whole run is what these spare: a board that is only reported, and every second
# sprayer of the other make in the hard conditions.
FREE_RUNNING_M_S = (3.0, 5.0)
PINPOINT_SHARE = 2
PAPER_METHODS = ("none", "look-ahead", "look-ahead-stated")
OURS, PERFECT = ("gpio", "servo"), "perfect"
PINPOINT = tuple(f"pinpoint, {case}" for case in (*OURS, PERFECT))
FLOWN = tuple(f"flown, {case}" for case in (*OURS, PERFECT))
# Of a sprayer on the vehicle that is fitted to logs of real flights.
VEHICLE = "-on-flown-vehicle"
FIELD = "field"
NOMINAL, IDENTIFIED = "nominal", "identified"


@dataclass(frozen=True, slots=True, kw_only=True)
class Flown:
    """What is kept of one flight; `lags` says where the controller had them from."""

    plant: str = PLANT
    condition: str = FIELD
    lags: str = NOMINAL
    speed_m_s: float
    method: str
    output: str
    seed: int
    mean_m: float | None
    mean_abs_m: float | None
    max_abs_m: float | None
    count: int
    apart: int
    missed: int
    settled_mean_m: float | None
    settled_mean_abs_m: float | None
    accuracy_percent: float | None
    settled_accuracy_percent: float | None
    perfect_accuracy_percent: float | None
    perfect_mean_abs_m: float | None = None
    perfect_max_abs_m: float | None = None
    misapplied_percent: float | None
    limit_ratio: float | None
    off_target_ml: float
    border_margin_m: float | None
    border_bound_m: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Flights:
    """Which flights of a campaign file are flown: cases and seeds, and values of what is varied.

    With a `controller` of one's own, `module:Class`, that flies instead of ours.
    """

    file: Path
    cases: tuple[str, ...]
    seeds: tuple[int, ...]
    values: Mapping[str, Sequence[Any]]
    controller: str | None = None

    def campaign(self) -> Campaign:
        """Return the campaign cut down to them."""
        whole = read_campaign(self.file)
        cases = {name: settings for name, settings in whole.cases if name in self.cases}
        assert cases.keys() == set(self.cases), self.cases
        if self.controller is not None:
            file, colon, name = self.controller.rpartition(":")
            place = str(Path(file).resolve()) if file.endswith(".py") else file
            own = {"method.controller": f"{place}{colon}{name}"}
            cases = {n: s if PERFECT in n else {**s, **own} for n, s in cases.items()}
        factors = [
            replace(each, values=tuple(self.values.get(each.name, each.values)))
            for each in whole.factors
        ]
        return replace(whole, seeds=self.seeds, cases=tuple(cases.items()), factors=tuple(factors))

    @property
    def count(self) -> int:
        """Return how many flights they are."""
        return self.campaign().flights


def field_flights(seeds: Iterable[int], *, is_quick: bool) -> list[Flights]:
    """Return what there is to fly over the example with P1's sprayer."""
    slow = (PAPER_M_S,) if is_quick else SLOW_M_S
    fast = () if is_quick else FAST_M_S
    free = tuple(speed for speed in FREE_RUNNING_M_S if speed in slow)
    found = [
        _flights(ACCURACY, (*OURS, PERFECT), seeds, {SPEED: slow}),
        _flights(ACCURACY, ("free-running",), seeds, {SPEED: free}),
        _flights(ACCURACY, PAPER_METHODS, seeds, {SPEED: (PAPER_M_S,)}),
        _flights(ACCURACY, FLOWN, seeds, {SPEED: (PAPER_M_S,)}),
    ]
    # Above the speeds of the paper nothing is held against perfect knowledge.
    return [*found, _flights(ACCURACY, OURS, seeds, {SPEED: fast})] if fast else found


def pinpoint_flights(seeds: Iterable[int], *, is_quick: bool) -> list[Flights]:
    """Return what there is to fly over the example with valves at the nozzles."""
    speeds = (PAPER_M_S,) if is_quick else PINPOINT_M_S
    slow = tuple(speed for speed in speeds if speed <= SLOW_M_S[-1])
    fast = tuple(speed for speed in speeds if speed > SLOW_M_S[-1])
    found = [_flights(ACCURACY, PINPOINT, seeds, {SPEED: slow})]
    return [*found, _flights(ACCURACY, PINPOINT[:-1], seeds, {SPEED: fast})] if fast else found


def condition_flights(name: str, seeds: Iterable[int]) -> list[Flights]:
    """Return what there is to fly in one hard condition."""
    seeds, values = list(seeds), {CONDITION: (name,)}
    return [
        _flights(HARD_CONDITIONS, (*OURS, PERFECT), seeds, values),
        _flights(HARD_CONDITIONS, PINPOINT, seeds[::PINPOINT_SHARE], values),
    ]


def _flights(
    file: Path, cases: tuple[str, ...], seeds: Iterable[int], values: Mapping[str, Sequence[Any]]
) -> Flights:
    return Flights(file=file, cases=cases, seeds=tuple(seeds), values=values)


def condition_names() -> list[str]:
    """Return the names of all hard conditions."""
    return [condition.name for condition in CONDITIONS]


def fly_all(
    todo: Sequence[Flights], *, processes: int, progress: Callable[[], None] = lambda: None
) -> list[Flown]:
    """Fly everything, in `processes` processes where that is more than one."""
    rows = [row for each in todo for row in _rows(each, processes, progress)]
    perfect = {_place_of(row): row for row in rows if row["method"] == PERFECT}
    return [_flown_of(row, perfect.get(_place_of(row))) for row in rows if row["method"] != PERFECT]


def _rows(flights: Flights, processes: int, progress: Callable[[], None]) -> list[dict[str, Any]]:
    campaign = flights.campaign()
    bundle = bundle_of(campaign)
    with tempfile.TemporaryDirectory(prefix="vrspray-bench-") as folder:
        dataset = open_dataset(campaign, bundle, Path(folder) / "flown")
        here = _here(bundle) if processes == 1 else pool_of(processes, bundle)
        with here as workers:
            fly_missing(dataset, bundle, workers, Tally(), tell=lambda _: progress())
        rows: list[dict[str, Any]] = read_columns(dataset.folder, None).to_pylist()
    fixed = {**{each.name: each.values[0] for each in campaign.factors}, **campaign.fixed}
    for row in rows:
        assert row["error"] is None, row["error"]
        if row["case"] in FLOWN:
            row["plant"] += VEHICLE
    return [{**fixed, **row} for row in rows]


def _place_of(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """Return what a flight shares with that of perfect knowledge: sprayer, field, speed, seed."""
    return row["plant"], row.get(CONDITION), row["speed_m_s"], row["seed"]


def _flown_of(row: Mapping[str, Any], perfect: Mapping[str, Any] | None) -> Flown:
    best: Mapping[str, Any] = perfect or {}
    misapplied, least = row["misapplied_percent"], best.get("misapplied_percent")
    board = "free-running" if row.get("case") == "free-running" else row["output"]
    return Flown(
        plant=row["plant"],
        condition=row.get(CONDITION, FIELD),
        speed_m_s=row["speed_m_s"],
        method=row["method"],
        output=board,
        seed=row["seed"],
        mean_m=row["lag_distance_mean_m"],
        mean_abs_m=row["lag_distance_mean_abs_m"],
        max_abs_m=row["lag_distance_max_abs_m"],
        count=row["lag_distance_count"],
        apart=row["apart"],
        missed=row["missed"],
        settled_mean_m=row["settled_lag_distance_mean_m"],
        settled_mean_abs_m=row["settled_lag_distance_mean_abs_m"],
        accuracy_percent=row["spraying_accuracy_percent"],
        settled_accuracy_percent=row["settled_accuracy_percent"],
        perfect_accuracy_percent=best.get("spraying_accuracy_percent"),
        perfect_mean_abs_m=best.get("lag_distance_mean_abs_m"),
        perfect_max_abs_m=best.get("lag_distance_max_abs_m"),
        misapplied_percent=misapplied,
        limit_ratio=misapplied / least if misapplied is not None and least else None,
        off_target_ml=row["off_target_ml"],
        border_margin_m=row["border_margin_mean_m"],
        border_bound_m=row["border_bound_m"],
    )


@contextmanager
def _here(bundle: Bundle) -> Iterator[Workers]:
    """Yield a worker that is this process."""
    with tempfile.TemporaryDirectory(prefix="vrspray-bench-") as root:
        yield _Here(unpack(bundle, Path(root)))


class _Here:
    deaths = 1
    lost_count = 0

    def __init__(self, folder: Path) -> None:
        self.folder: Path | None = folder

    def count(self) -> int:
        return 1

    def submit(self, function: Callable[..., Done], *given: Any) -> Future[Done]:
        done: Future[Done] = Future()
        try:
            done.set_result(function(*given))
        except VrsprayError as error:
            done.set_exception(error)
        return done

    def lost(self, error: BaseException) -> bool:
        return False

    def renew(self) -> None: ...


# Single flights of other benches, whose controller is measured anew before each.


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """A path: over the example at one speed, or over a hard field."""

    plant: str = PLANT
    condition: str = FIELD
    speed_m_s: float = PAPER_M_S
    seed: int


def place(task: Task, output: Output) -> tuple[Setup, Trajectory]:
    """Return the controller's set-up with nominal lags, and the path."""
    if task.condition == FIELD:
        setup = sprayer_setup(task.plant, output, task.speed_m_s)
        return setup, demo_trajectory(task.speed_m_s, task.seed)
    return laid_out(condition_of(task.condition), task.seed, sprayer_setup(task.plant, output))


def perfect(task: Task, profile: PlantProfile | None = None) -> Evaluation | None:
    """Fly with perfect knowledge; above the speeds of the paper nothing is held against it."""
    if task.speed_m_s > SLOW_M_S[-1]:
        return None
    profile = profile or load_profile(task.plant)
    setup, path = place(task, "gpio")
    known = known_setup(setup, profile, "gpio", task.seed)
    options = FlightOptions(seed=task.seed, knows=True)
    return evaluate(fly(known, path, profile, options, speed_m_s=task.speed_m_s).record)


def kept(
    found: Evaluation,
    *,
    task: Task,
    output: str,
    perfect: Evaluation | None,
    lags: str = NOMINAL,
) -> Flown:
    """Return what is kept of a flight, beside that with perfect knowledge."""
    meta = found.meta
    row = figures_of(found) | {
        "plant": task.plant,
        "speed_m_s": meta.speed_m_s,
        "method": meta.method,
        "output": output,
        "seed": meta.seed,
        **({} if task.condition == FIELD else {CONDITION: task.condition}),
    }
    return replace(_flown_of(row, None if perfect is None else figures_of(perfect)), lags=lags)
