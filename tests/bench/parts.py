"""The parts of `make bench`: each has a name, a section of the page, and figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import partial
from typing import TypeVar

from sitl.workers import do_all
from tests.bench import (
    clocks,
    flow_laws,
    flow_trim,
    identification,
    identification_figures,
    identified,
    pump,
)
from tests.bench.accuracy import UNKNOWN_FACTOR, accuracy
from tests.bench.figures import Figure
from tests.bench.flights import (
    PAPER_METHODS,
    Flights,
    Flown,
    condition_flights,
    condition_names,
    field_flights,
    fly_all,
    pinpoint_flights,
)
from tests.bench.timings import TIMINGS, arrival_times, core_times, edge_times, map_times

Work = TypeVar("Work")
Done = TypeVar("Done")
Say = Callable[[str], None]

FIELD_SECTION = "Accuracy over the example's field"
CONDITIONS_SECTION = "Accuracy in hard conditions"
IDENTIFIED_SECTION = "Accuracy with lags from a previous flight"
UNKNOWN_SECTION = "A sprayer that the controller does not know"
IDENTIFICATION_SECTION = "Identified lags"
TRIM_SECTION = "Closed loop on flow"
PUMP_SECTION = "A pump that makes the flow"
OWN_SECTION = "A method of your own"
LAW_SECTION = "Three laws of the flow"


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """How much is measured; `flights` is that of calibration missions.

    `controller` is a method of one's own, `module:Class`, flown beside ours.
    """

    seed: int = 1
    count: int = 20
    is_quick: bool = False
    flights: int = 0
    processes: int = 2
    controller: str | None = None
    say: Say = lambda _: None

    @property
    def seeds(self) -> range:
        """Return the seeds of every accuracy."""
        return range(self.seed, self.seed + self.count)


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """What is measured in one go."""

    name: str
    section: str
    run: Callable[[Options], list[Figure]]

    @property
    def is_timed(self) -> bool:
        """Return whether it measures time."""
        return self.section == TIMINGS


def _each(
    function: Callable[[Work], Done], works: Sequence[Work], options: Options, name: str
) -> list[Done]:
    """Return what comes of all pieces of work, and tell how far it is."""
    done = 0

    def told() -> None:
        nonlocal done
        done += 1
        if done % 10 == 0 or done == len(works):
            options.say(f"{name}: {done} of {len(works)}")

    return do_all(function, works, processes=options.processes, on_done=told)


def _flown(todo: Sequence[Flights], options: Options, name: str) -> list[Flown]:
    done, count = 0, sum(each.count for each in todo)

    def told() -> None:
        nonlocal done
        done += 1
        if done % 50 == 0 or done == count:
            options.say(f"{name}: {done} of {count} flights")

    return fly_all(todo, processes=options.processes, progress=told)


def _flights(todo: Sequence[Flights], options: Options, name: str, *, section: str) -> list[Figure]:
    """Return our accuracy over these flights, and that of one's own method beside it."""
    figures = accuracy(_flown(todo, options, name), section=section)
    if options.controller is None:
        return figures
    again = [
        replace(each, controller=options.controller)
        for each in todo
        if not set(each.cases) & set(PAPER_METHODS)
    ]
    own = _unjudged(accuracy(_flown(again, options, f"{name}, own"), section=OWN_SECTION))
    return figures + [replace(one, key=f"own_{one.key}") for one in own]


def _field(options: Options) -> list[Figure]:
    todo = field_flights(options.seeds, is_quick=options.is_quick)
    return _flights(todo, options, "field", section=FIELD_SECTION)


def _pinpoint(options: Options) -> list[Figure]:
    todo = pinpoint_flights(options.seeds, is_quick=options.is_quick)
    return _flights(todo, options, "pinpoint", section=FIELD_SECTION)


def _condition(options: Options, *, name: str) -> list[Figure]:
    todo = condition_flights(name, options.seeds)
    return _flights(todo, options, name, section=CONDITIONS_SECTION)


def _identified(options: Options) -> list[Figure]:
    """Fly with lags from the flight before; those flights show how good the lags are, too."""
    works = identified.tasks(options.seeds, is_quick=options.is_quick)
    done = _each(identified.fly_task, works, options, "identified")
    flown = [each for one in done for each in one.flown]
    figures = accuracy(flown, section=IDENTIFIED_SECTION)
    for plant, output in sorted({(one.plant, output) for one in done for output in one.compared}):
        alike = [one.compared[output] for one in done if one.plant == plant]
        rows = [row for several in alike for row in several]
        figures += identification_figures.figures(
            rows, len(alike), where=f"{plant}, {output}", section=IDENTIFIED_SECTION
        )
    return figures


def _identification(options: Options) -> list[Figure]:
    """Fly many calibration missions and nothing else; by default none but those of `identified`."""
    works = [
        identification.Task(seed=seed, output="gpio")
        for seed in range(options.seed, options.seed + options.flights)
    ]
    found = _each(identification.compare, works, options, "identification")
    rows = [row for several in found for row in several]
    where = f"{len(works)} flights, gpio"
    return identification_figures.figures(
        rows, len(works), where=where, section=IDENTIFICATION_SECTION
    )


def _unknown(options: Options) -> list[Figure]:
    works = identified.unknown_tasks(options.seeds)
    done = _each(identified.fly_task, works, options, "unknown")
    flown = [each for one in done for each in one.flown]
    before = [each for each in flown if each.lags == identified.UNKNOWN]
    after = [each for each in flown if each.lags == identified.RECOVERED]
    return [
        *accuracy(after, section=UNKNOWN_SECTION, factor=UNKNOWN_FACTOR),
        *_unjudged(accuracy(before, section=UNKNOWN_SECTION)),
    ]


def _unjudged(figures: Sequence[Figure]) -> list[Figure]:
    """Return figures that are only there to be compared with."""
    return [replace(figure, target=None, row="") for figure in figures]


def _flow_trim(options: Options) -> list[Figure]:
    works = [
        flow_trim.Task(gain=gain, seed=seed) for gain in flow_trim.GAINS for seed in options.seeds
    ]
    done = _each(flow_trim.fly_task, works, options, "flow trim")
    return flow_trim.figures([each for pair in done for each in pair], section=TRIM_SECTION)


def _pump(options: Options) -> list[Figure]:
    done = _each(pump.fly_task, list(options.seeds), options, "pump")
    return pump.figures(done, section=PUMP_SECTION)


def _flow_laws(options: Options) -> list[Figure]:
    done = _each(flow_laws.fly_task, flow_laws.tasks(options.seeds), options, "flow laws")
    return flow_laws.figures(done, section=LAW_SECTION)


def _clocks(options: Options) -> list[Figure]:
    return clocks.clock_figures(seed=options.seed, count=options.count)


def _core(options: Options) -> list[Figure]:
    return core_times(seed=options.seed, is_quick=options.is_quick)


def _maps(options: Options) -> list[Figure]:
    return map_times(seed=options.seed, is_quick=options.is_quick)


def _arrivals(options: Options) -> list[Figure]:
    return arrival_times(seed=options.seed, is_quick=options.is_quick)


def _edges(options: Options) -> list[Figure]:
    return edge_times(seed=options.seed, is_quick=options.is_quick)


PARTS: tuple[Part, ...] = (
    Part(name="steps", section=TIMINGS, run=_core),
    Part(name="maps", section=TIMINGS, run=_maps),
    Part(name="arrivals", section=TIMINGS, run=_arrivals),
    Part(name="gpio-edges", section=TIMINGS, run=_edges),
    Part(name="field", section=FIELD_SECTION, run=_field),
    Part(name="pinpoint", section=FIELD_SECTION, run=_pinpoint),
    Part(name="flow-laws", section=LAW_SECTION, run=_flow_laws),
    Part(name="identified", section=IDENTIFIED_SECTION, run=_identified),
    Part(name="unknown", section=UNKNOWN_SECTION, run=_unknown),
    Part(name="flow-trim", section=TRIM_SECTION, run=_flow_trim),
    Part(name="pump", section=PUMP_SECTION, run=_pump),
    Part(name="clocks", section=clocks.SECTION, run=_clocks),
    *(
        Part(name=name, section=CONDITIONS_SECTION, run=partial(_condition, name=name))
        for name in condition_names()
    ),
    Part(name="identification", section=IDENTIFICATION_SECTION, run=_identification),
)


def chosen(patterns: Sequence[str], options: Options) -> list[Part]:
    """Return the parts that a pattern fits, all without one; shell patterns such as `arc-*`."""
    parts = [part for part in PARTS if part.name != "identification" or options.flights]
    if not patterns:
        return parts
    return [part for part in parts if any(fnmatchcase(part.name, each) for each in patterns)]
