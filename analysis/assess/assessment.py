"""Everything that can be said of a flown journal, in one call: what report and exports take.

How far off the worst change of a flight may lie, as a bound and not as a guess. The largest lag
distance of the model is no such figure: it leaves out what the journal cannot know, and the truth
of simulated flights was up to three times as large. Here every change has its modelled distance and
an uncertainty; the bound is the distance that all of them keep with a probability of 95 %, taken as
independent. Where errors are shared, as of valves over one boundary, the true probability is higher
(Sidak 1967, JASA 62:626). `python -m tests.bench.worst` measures it.

The figures of one flight that people quote, each worked out once. Headline, tiles, balance and
legal record read them here, so that no page contradicts itself. Litres are those of the flow meter
where there is one, else those of the model, and say which.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from analysis.assess.breakdowns import Breakdowns, breakdowns, ways_between
from analysis.assess.causes import Causes, causes_of
from analysis.assess.cell_maps import CellMaps, cell_maps
from analysis.assess.ground import Ground, Treated, ground_of, treated_of
from analysis.dose import flow_samples, misapplied_parts
from analysis.evaluation import Changes, Distances, Evaluation, changes_of, evaluate_strips
from analysis.flown.applied_record import record_of
from analysis.flown.holes import GAP_S
from analysis.flown.modelled_flow import meter_within_percent, metered_l, ordered_s
from analysis.lag import Verdict
from analysis.strips import Strip, strips_of
from analysis.student import (
    Interval,
    crossings_of,
    mean_interval,
    ratio_interval,
    t_factor,
)
from companion.core.inputs import Fix
from companion.wording import CUT

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from analysis.flight_record import FlightRecord
    from analysis.flown.applied_flight import AppliedFlight, Floats
    from analysis.lag import Step
    from companion.core.schedule import LagModel

CONFIDENCE = 0.95
# Standard deviations of what a journal cannot know. Position of a receiver with a fixed RTK
# solution: 1.4 cm of noise and 1.4 cm that wanders (1 cm + 1 ppm, as receivers state it).
POSITION_M = 0.020
# When a position was measured: the autopilot's jitter, and a calibration that is good to 5 ms.
JITTER_S, CALIBRATION_S = 0.003, 0.005
# When an order acts: a servo frame of 20 ms, evenly spread, and where in it the pulse falls.
FRAME_S, PULSE_S = 0.0058, 0.005
# How much the valves of a boom differ in their lag.
VALVE_SHARE = 0.05
# The flow's own noise moves a small step more than a large one: this over the relative step.
# Found on 60 twin flights, and tried on others.
FLOW_M = 0.013
_HALVINGS = 40


@dataclass(frozen=True, slots=True, kw_only=True)
class Worst:
    """The bound in metres, or None and why there is none; `count` is of the changes it is for."""

    bound_m: float | None
    why_not: str
    count: int

    def as_json(self) -> dict[str, Any]:
        """Return it as a JSON object."""
        return {
            "bound_m": self.bound_m,
            "confidence": CONFIDENCE,
            "why_not": self.why_not,
            "count": self.count,
        }


def worst_of(
    flight: AppliedFlight,
    steps: Sequence[Step],
    *,
    also: Sequence[tuple[AppliedFlight, Sequence[Step]]] = (),
) -> Worst:
    """Return how far off the worst measured change may lie; borders are not among them."""
    measured = [
        (step, each)
        for each, its in ((flight, steps), *also)
        for step in its
        if step.lag_distance_m is not None and not step.change.border
    ]
    flights = [flight, *(each for each, _ in also)]
    why_not = next(filter(None, (_why_not(each, len(measured)) for each in flights)), "")
    if why_not:
        return Worst(bound_m=None, why_not=why_not, count=len(measured))
    lag_m = np.array([step.lag_distance_m for step, _ in measured], dtype=np.float64)
    sd_m = np.array([uncertainty_m(step, each.setup.lag) for step, each in measured])
    return Worst(bound_m=bound_m(lag_m, sd_m), why_not="", count=len(measured))


def _why_not(flight: AppliedFlight, count: int) -> str:
    if not count:
        return "no change of rate was measured"
    if flight.setup.pumping is not None:
        return "the pump makes the flow, and when it does is known too roughly"
    if flight.unknown or flight.lost:
        return "a part of the journal is missing"
    if flight.fix is None:
        return "the journal has no quality of the position"
    begin = np.searchsorted(flight.fix.time_s, flight.time_s[0], "right") - 1
    told = flight.fix.value[max(int(begin), 0) :]
    if not len(told) or not (told >= Fix.RTK_FIXED).all():
        return "the position was not a fixed RTK solution all the time: it may be off by metres"
    return ""


def uncertainty_m(step: Step, lag: LagModel) -> float:
    """Return one standard deviation of where a change fell, in metres along the track."""
    change = step.change
    its_s = {
        (False, True): lag.on_s,
        (True, False): lag.off_s,
    }.get(
        (change.before_l_ha > 0.0, change.after_l_ha > 0.0),
        lag.up_s if change.after_l_ha > change.before_l_ha else lag.down_s,
    )
    time_s = math.hypot(JITTER_S, CALIBRATION_S, FRAME_S, PULSE_S, VALVE_SHARE * its_s)
    # By volume the flow's noise is that of the whole way, which is longer than a line's metre.
    flow_m = FLOW_M * max(step.volume_m, 1.0) / change.relative
    return math.hypot(POSITION_M, change.speed_m_s * time_s, flow_m)


def bound_m(lag_m: Floats, sd_m: Floats, confidence: float = CONFIDENCE) -> float:
    """Return the distance that all changes keep with this probability.

    >>> round(bound_m(np.zeros(1), np.ones(1)), 2)
    1.96
    >>> round(bound_m(np.zeros(200), np.full(200, 0.05)), 2)
    0.18
    """
    low = float(np.abs(lag_m).max())
    high = low + 10.0 * float(sd_m.max())
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        inside = _normal((middle - lag_m) / sd_m) - _normal((-middle - lag_m) / sd_m)
        low, high = (low, middle) if float(np.prod(inside)) >= confidence else (middle, high)
    return high


def _normal(values: Floats) -> Floats:
    """Return the normal distribution's cumulative function."""
    found: Floats = 0.5 * np.array(list(map(math.erfc, (-values / math.sqrt(2.0)).tolist())))
    return found


# What was sprayed by four ways to know it: prescription, model, meter, tank.

ML_PER_L = 1000.0
# A level that rises by more within a reading is a refill, and no noise.
REFILL_L = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Balance:
    """Litres of a flight; None where there is no such sensor, or it said too little.

    `prescribed_l` is the integral of the prescription over the ground that was treated, once.
    Percentages are of what stands second in their name. Litres by the meter are within
    `meter_within_percent` of the truth; None where the curves contradict it.
    """

    prescribed_l: float
    model_l: float
    meter_l: float | None
    tank_l: float | None
    tank_start_l: float | None
    tank_end_l: float | None
    refilled_l: float | None
    model_to_prescribed_percent: float | None
    meter_to_prescribed_percent: float | None
    meter_to_model_percent: float | None
    tank_to_model_percent: float | None
    tank_to_meter_percent: float | None
    meter_within_percent: float | None

    def as_json(self) -> dict[str, Any]:
        """Return all figures."""
        return asdict(self)


def balance_of(flight: AppliedFlight, model_ml: float, asked_l: float) -> Balance:
    """Return the balance of a flight whose model put out `model_ml` where `asked_l` were asked."""
    start_l, end_l, refilled_l = _tank(flight)
    tank_l = None
    if start_l is not None and end_l is not None and refilled_l is not None:
        tank_l = start_l + refilled_l - end_l
    return _balance(
        asked_l,
        model_ml / ML_PER_L,
        metered_l(flight),
        tank_l,
        (start_l, end_l, refilled_l),
    )


def _balance(
    asked_l: float,
    model_l: float,
    meter_l: float | None,
    tank_l: float | None,
    levels_l: tuple[float | None, float | None, float | None] = (None, None, None),
) -> Balance:
    start_l, end_l, refilled_l = levels_l
    return Balance(
        prescribed_l=asked_l,
        model_l=model_l,
        meter_l=meter_l,
        tank_l=tank_l,
        tank_start_l=start_l,
        tank_end_l=end_l,
        refilled_l=refilled_l,
        model_to_prescribed_percent=_off(model_l, asked_l),
        meter_to_prescribed_percent=_off(meter_l, asked_l),
        meter_to_model_percent=_off(meter_l, model_l),
        tank_to_model_percent=_off(tank_l, model_l),
        tank_to_meter_percent=_off(tank_l, meter_l),
        meter_within_percent=meter_within_percent(meter_l, model_l),
    )


def _sum(values: Iterable[float | None]) -> float | None:
    """Return a sum; of what one flight does not know there is none."""
    known = list(values)
    return None if None in known else sum(each for each in known if each is not None)


def _tank(flight: AppliedFlight) -> tuple[float | None, float | None, float | None]:
    """Return first and last level, and what was filled in between."""
    if flight.tank_l is None:
        return None, None, None
    level: Floats = flight.tank_l.value[np.isfinite(flight.tank_l.value)]
    if len(level) < 2:
        return None, None, None
    rises = np.diff(level)
    return float(level[0]), float(level[-1]), float(rises[rises > REFILL_L].sum())


def _off(value: float | None, reference: float | None) -> float | None:
    if value is None or reference is None or not reference > 0.0:
        return None
    return 100.0 * (value - reference) / reference


@dataclass(frozen=True, slots=True, kw_only=True)
class Durations:
    """Seconds of a flight; a second with several inhibits counts for each, and once in all."""

    recorded_s: float
    spraying_s: float
    inhibited_s: float
    by_inhibit_s: Mapping[str, float]
    unknown_s: float

    def as_json(self) -> dict[str, Any]:
        """Return all figures."""
        return {
            "recorded_s": self.recorded_s,
            "spraying_s": self.spraying_s,
            "inhibited_s": self.inhibited_s,
            "by_inhibit_s": dict(self.by_inhibit_s),
            "unknown_s": self.unknown_s,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Assessment:
    """A flight judged from its journal.

    `record` and `strips` are what it was computed from. `intervals` has a mean with its 95 %
    interval for each key of the contract that is a mean.
    """

    flight: AppliedFlight
    record: FlightRecord
    strips: tuple[Strip, ...]
    evaluation: Evaluation
    worst: Worst
    intervals: Mapping[str, Interval]
    breakdowns: Breakdowns
    cells: CellMaps | None
    causes: Causes
    ground: Ground
    balance: Balance
    durations: Durations
    counts: Mapping[str, int]
    notes: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Return all figures; maps and single changes are arrays and not in it."""
        flight = self.flight
        return {
            "journal": flight.path.name,
            "is_closed": flight.is_closed,
            "lost": flight.lost,
            "training": flight.training,
            "simulated": flight.simulated.word,
            "simulated_because": flight.simulated.because,
            "source": "model",
            "utc_source": flight.utc_source,
            **self.evaluation.as_json(),
            "worst": self.worst.as_json(),
            "intervals": {name: each.as_json() for name, each in self.intervals.items()},
            "breakdowns": self.breakdowns.as_json(),
            "cells": None if self.cells is None else self.cells.as_json(),
            "causes": {**self.causes.as_json(), **_judged(self.cells)},
            "balance": self.balance.as_json(),
            "durations": self.durations.as_json(),
            "counts": dict(self.counts),
            "notes": list(self.notes),
        }


def _judged(cells: CellMaps | None) -> dict[str, Any]:
    return {
        "judged_m2": 0.0 if cells is None else cells.judged_m2,
        "within_10_percent": None if cells is None else cells.within_percent,
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class Essentials:
    """Of an assessment what the figures that people quote are made of, in half of its time."""

    evaluation: Changes
    worst: Worst
    cells: CellMaps | None
    ground: Ground
    balance: Balance


def essentials_of(flight: AppliedFlight, *, marked: bool = False) -> Essentials:
    """Return what `figures_of` takes; EvaluationError where there is nothing to evaluate."""
    record = record_of(flight)
    strips = strips_of(record)
    changes = changes_of(record, strips)
    ground = ground_of(flight, record, strips, treated_of(flight), marked=marked)
    return Essentials(
        evaluation=changes,
        worst=worst_of(flight, changes.steps),
        cells=cell_maps(record, strips, duties_of(flight, record.time_s), flown=ground.own),
        ground=ground,
        balance=balance_of(flight, changes.applied_ml, ground.asked_l),
    )


def together(parts: Sequence[Assessment], treated: Treated) -> Essentials:
    """Return what all sorties of a job did to one field: ground once, doses and litres in sum."""
    first, *others = parts
    evaluations = [each.evaluation for each in parts]
    steps = tuple(step for each in evaluations for step in each.steps)
    ground = ground_of(
        first.flight,
        first.record,
        first.strips,
        treated,
        also=[(each.flight, each.record, each.strips) for each in others],
    )
    balances = [each.balance for each in parts]
    return Essentials(
        evaluation=Changes(
            lag_distance_m=Distances.of(s.lag_distance_m for s in steps if not s.change.border),
            apart=sum(each.apart for each in evaluations),
            missed=sum(each.missed for each in evaluations),
            off_target_ml=sum(each.off_target_ml for each in evaluations),
            off_line_ml=sum(each.off_line_ml for each in evaluations),
            applied_ml=sum(each.applied_ml for each in evaluations),
            steps=steps,
        ),
        worst=worst_of(
            first.flight,
            first.evaluation.steps,
            also=[(each.flight, each.evaluation.steps) for each in others],
        ),
        cells=cell_maps(
            first.record,
            [strip for each in parts for strip in each.strips],
            [duty for each in parts for duty in duties_of(each.flight, each.record.time_s)],
            flown=ground.own,
        ),
        ground=ground,
        balance=_balance(
            ground.asked_l,
            sum(each.model_l for each in balances),
            _sum(each.meter_l for each in balances),
            _sum(each.tank_l for each in balances),
        ),
    )


def assess(
    flight: AppliedFlight,
    *,
    cell_m: float | None = None,
    treated: Treated | None = None,
) -> Assessment:
    """Return everything of a flight; EvaluationError where it has nothing to evaluate."""
    record = record_of(flight)
    strips = strips_of(record)
    evaluation = evaluate_strips(record, strips)
    ground = ground_of(flight, record, strips, treated or treated_of(flight))
    return Assessment(
        flight=flight,
        record=record,
        strips=tuple(strips),
        evaluation=evaluation,
        worst=worst_of(flight, evaluation.steps),
        intervals=_intervals(evaluation, strips, flight.setup.lag),
        breakdowns=breakdowns(evaluation, strips),
        cells=cell_maps(
            record, strips, duties_of(flight, record.time_s), cell_m=cell_m, flown=ground.own
        ),
        causes=causes_of(flight, strips, evaluation.steps, ground),
        ground=ground,
        balance=balance_of(flight, evaluation.applied_ml, ground.asked_l),
        durations=_durations(flight),
        counts=_counts(flight, evaluation),
        notes=tuple(_notes(flight)),
    )


def duties_of(flight: AppliedFlight, time_s: Floats) -> list[Floats]:
    """Return the duty of each valve whose flow comes out at each time."""
    order_s = ordered_s(flight.changes) + flight.setup.lag.output_s + flight.setup.lag.up_s
    found: list[Floats] = []
    for valve in range(len(flight.setup.boom.valves)):
        its = flight.changes.valve == valve
        duty = np.concatenate(([0.0], flight.changes.duty[its]))
        found.append(duty[np.searchsorted(order_s[its], time_s, "right")])
    return found


def _intervals(
    evaluation: Evaluation, strips: Sequence[Strip], lag: LagModel
) -> dict[str, Interval]:
    inside = [step for step in evaluation.steps if not step.change.border]
    lags = [(s.change.time_s, s.lag_distance_m) for s in inside if s.lag_distance_m is not None]
    settled = [
        (s.change.time_s, s.lag_distance_m)
        for s in evaluation.settled_steps
        if s.lag_distance_m is not None
    ]
    shared_m = [uncertainty_m(s, lag) for s in inside if s.lag_distance_m is not None]
    sd_m = float(np.mean(shared_m)) if shared_m else 0.0
    margins = [(each.time_s, each.margin_m) for each in evaluation.crossings]
    samples = flow_samples(strips)
    ways = ways_between(evaluation, samples.time_s)
    wrong = misapplied_parts(strips)
    return {
        "lag_distance_m": _shared(_of(lags), sd_m),
        "lag_distance_abs_m": _no_less_than_0(
            _shared(_of((at_s, abs(lag_m)) for at_s, lag_m in lags), sd_m)
        ),
        "settled_lag_distance_m": _of(settled),
        "border_margin_m": _of(margins),
        "spraying_accuracy_percent": mean_interval(samples.accuracy_percent, ways),
        "misapplied_percent": ratio_interval(
            100.0 * wrong.wrong_ml, wrong.asked_ml, ways_between(evaluation, wrong.time_s)
        ),
    }


def _shared(interval: Interval, sd_m: float) -> Interval:
    """Return it wider by what no number of changes averages out: position, lags and curves."""
    if interval.low is None or interval.mean is None:
        return interval
    half_m = math.hypot(interval.mean - interval.low, t_factor(1000) * sd_m)
    return replace(interval, low=interval.mean - half_m, high=interval.mean + half_m)


def _no_less_than_0(interval: Interval) -> Interval:
    """Return an interval of what cannot be negative: few measurements make it symmetric."""
    return interval if interval.low is None else replace(interval, low=max(interval.low, 0.0))


def _of(pairs: Iterable[tuple[float, float]]) -> Interval:
    times = np.array(list(pairs), dtype=np.float64).reshape(-1, 2)
    return mean_interval(times[:, 1], crossings_of(times[:, 0]))


def _durations(flight: AppliedFlight) -> Durations:
    lengths_s = np.diff(flight.time_s, append=flight.time_s[-1])
    known_s = np.where(lengths_s <= GAP_S, lengths_s, 0.0)
    by_inhibit: dict[str, float] = {}
    inhibited_s = 0.0
    for reasons in sorted(set(flight.inhibits) - {""}):
        its = np.array([each == reasons for each in flight.inhibits], dtype=np.bool_)
        held_s = float(known_s[its].sum())
        inhibited_s += held_s
        for reason in reasons.split():
            by_inhibit[reason] = by_inhibit.get(reason, 0.0) + held_s
    return Durations(
        recorded_s=float(known_s.sum()),
        spraying_s=float(known_s[flight.flow_l_min > 0.0].sum()),
        inhibited_s=inhibited_s,
        by_inhibit_s=dict(sorted(by_inhibit.items())),
        unknown_s=float((lengths_s - known_s).sum()),
    )


def _counts(flight: AppliedFlight, evaluation: Evaluation) -> dict[str, int]:
    return {
        "samples": len(flight.time_s),
        "valve_changes": len(flight.changes.duty),
        "actual_times": int(np.isfinite(flight.changes.actual_s).sum()),
        "changes": sum(not step.change.border for step in evaluation.steps),
        "border_crossings": len(evaluation.crossings),
        "switches": len(evaluation.switches),
        "events": len(flight.events),
        "lost": flight.lost,
    }


def _notes(flight: AppliedFlight) -> Iterable[str]:
    """Yield what a reader of the figures has to know."""
    yield (
        "positions are the autopilot's, flows are modelled from the executed changes: errors of "
        "position, lags and flow curves are not in these figures"
    )
    if flight.setup.pumping is not None:
        yield "the pump makes the flow: changes are known to the time between two decisions only"
    if not np.isfinite(flight.changes.actual_s).any():
        yield "the output did not tell when it gave its orders: planned times are used"
    if not flight.is_closed:
        yield CUT
    if flight.lost:
        yield f"{flight.lost} rows are missing in the journal"


By = Literal["flow meter", "model", "nothing"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    """What was applied, where, and how well; None where nothing is known of it.

    `applied_by` says what the litres are known by; `metered_l` and `modelled_l` stand beside them.
    `prescribed_l` is for the ground treated, as `area_ha` is. `untreated_m2` is all ground with a
    rate that was not treated, `untreated_l` what the map asks there, `untreated_percent` its share;
    `missed_m2`
    of it lay under lines that were flown, `left_m2` is other flights'. What fell in the field, off
    the planned lines, is `off_line_ml`. `worst_m` is a bound over `lag_count` of
    `change_count` changes, `unjudged` why not of the others: `analysis.assess.assessment`.
    """

    applied_l: float | None
    applied_by: By | None
    metered_l: float | None
    modelled_l: float | None
    prescribed_l: float | None
    off_percent: float | None
    area_ha: float | None
    mean_rate_l_ha: float | None
    asked_rate_l_ha: float | None
    within_10_percent: float | None
    mean_lag_m: float | None
    lag_count: int
    change_count: int
    unjudged: Mapping[str, int]
    worst_m: float | None
    worst_why_not: str
    outside_ml: float | None
    off_line_ml: float | None
    missed_m2: float | None
    left_m2: float | None
    doubled_m2: float | None
    untreated_m2: float | None
    untreated_percent: float | None
    untreated_l: float | None

    def as_json(self) -> dict[str, Any]:
        """Return all figures."""
        return asdict(self)


def nothing_sprayed(area_ha: float | None, *, is_known: bool) -> Figures:
    """Return the figures of a flight without spraying, or of one of which too little is known."""
    return Figures(
        applied_l=0.0 if is_known else None,
        applied_by="nothing" if is_known else None,
        metered_l=None,
        modelled_l=None,
        prescribed_l=None,
        off_percent=None,
        area_ha=area_ha if is_known else None,
        mean_rate_l_ha=None,
        asked_rate_l_ha=None,
        within_10_percent=None,
        mean_lag_m=None,
        lag_count=0,
        change_count=0,
        unjudged={},
        worst_m=None,
        worst_why_not="nothing was sprayed" if is_known else "too little can be read",
        outside_ml=None,
        off_line_ml=None,
        missed_m2=None,
        left_m2=None,
        doubled_m2=None,
        untreated_m2=None,
        untreated_percent=None,
        untreated_l=None,
    )


def figures_of(
    assessment: Assessment | Essentials | None, *, area_ha: float, is_whole: bool = True
) -> Figures:
    """Return the figures; `area_ha` is the ground that open valves went over.

    What was sprayed in a flight of which too little can be read, nobody knows: None, and not zero.
    """
    if assessment is None or assessment.evaluation.applied_ml <= 0.0:
        return nothing_sprayed(area_ha, is_known=is_whole)
    evaluation, balance, ground = assessment.evaluation, assessment.balance, assessment.ground
    inside = [step for step in evaluation.steps if not step.change.border]
    metered = balance.meter_l is not None
    applied_l = balance.meter_l if balance.meter_l is not None else balance.model_l
    asked_l = balance.prescribed_l
    return Figures(
        applied_l=applied_l,
        applied_by="flow meter" if metered else "model",
        metered_l=balance.meter_l,
        modelled_l=balance.model_l,
        prescribed_l=asked_l,
        off_percent=(
            balance.meter_to_prescribed_percent if metered else balance.model_to_prescribed_percent
        ),
        area_ha=area_ha,
        mean_rate_l_ha=applied_l / area_ha if area_ha > 0.0 else None,
        asked_rate_l_ha=asked_l / area_ha if area_ha > 0.0 else None,
        within_10_percent=None if assessment.cells is None else assessment.cells.within_percent,
        mean_lag_m=evaluation.lag_distance_m.mean_abs,
        lag_count=evaluation.lag_distance_m.count,
        change_count=len(inside),
        unjudged=dict(
            Counter(step.verdict.value for step in inside if step.verdict is not Verdict.MEASURED)
        ),
        worst_m=assessment.worst.bound_m,
        worst_why_not=assessment.worst.why_not,
        outside_ml=evaluation.off_target_ml,
        off_line_ml=evaluation.off_line_ml,
        missed_m2=ground.missed_m2,
        left_m2=ground.untreated_m2 - ground.missed_m2,
        doubled_m2=ground.doubled_m2,
        untreated_m2=ground.untreated_m2,
        untreated_percent=(
            100.0 * ground.untreated_m2 / ground.rated_m2 if ground.rated_m2 > 0.0 else None
        ),
        untreated_l=ground.untreated_l,
    )
