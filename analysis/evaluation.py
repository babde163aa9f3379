"""How well a flight put the prescription on the ground: every metric, in one call.

Used by the demo, the report and the benchmarks, so that a figure means the same everywhere. Signs:
+ is too late, further along the track. docs/explanation/metrics.md has the definitions; the modules
beside this one have one metric each.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Literal

import numpy as np

from analysis.border import (
    BorderCrossing,
    border_crossings,
    held_by_border,
    margin_bound_m,
    off_target,
)
from analysis.changes import Run, find_runs, stretches_of
from analysis.dose import (
    flow_accuracy,
    misapplied_percent,
    section_error_percent,
    volume_error_percent,
)
from analysis.flight_record import FlightMeta, FlightRecord, whole_boom
from analysis.holds import BESIDE_S, holds_of, with_unknown
from analysis.lag import SettledStep, Step, Verdict, measure_settled, measure_steps
from analysis.published import P1_RESULTS
from analysis.strips import Strip, strips_of
from analysis.track import tracks_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.flight_record import Spans
    from analysis.strips import Strip


__all__ = [
    "P1_RESULTS",
    "Changes",
    "Distances",
    "Evaluation",
    "FlightMeta",
    "FlightRecord",
    "changes_of",
    "evaluate",
    "evaluate_strips",
    "limit_ratio",
    "whole_boom",
]


# Gaps and overlaps at every switch on and off, as section control is judged.


@dataclass(frozen=True, slots=True, kw_only=True)
class Switch:
    """One switch of one valve: ground left out, ground sprayed that should not be.

    Both follow from the volume-equivalent switch against the boundary, times the strip's width;
    a switch that never came leaves out its whole stretch, or sprays it.
    """

    valve: int
    kind: Literal["on", "off"]
    time_s: float
    border: bool
    gap_m2: float
    overlap_m2: float


def switches_of(strip: Strip, steps: Sequence[Step]) -> list[Switch]:
    """Return every switch of one strip whose place is known."""
    lengths_m = {run.start_s: run.end_m - run.start_m for run in strip.stretches}
    found: list[Switch] = []
    for step in steps:
        change = step.change
        if change.before_l_ha > 0.0 and change.after_l_ha > 0.0:
            continue
        late_m = step.lag_distance_m
        if step.verdict is Verdict.MISSED:
            late_m = lengths_m[change.time_s]
        if late_m is None:
            continue
        kind: Literal["on", "off"] = "on" if change.after_l_ha > 0.0 else "off"
        area_m2 = late_m * strip.track.value(strip.track.across_m, change.time_s)
        gap_m2 = area_m2 if kind == "on" else -area_m2
        found.append(
            Switch(
                valve=change.valve,
                kind=kind,
                time_s=change.time_s,
                border=change.border,
                gap_m2=max(gap_m2, 0.0),
                overlap_m2=max(-gap_m2, 0.0),
            )
        )
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Distances:
    """Signed distances in metres, summed up; None without any."""

    mean: float | None
    mean_abs: float | None
    max_abs: float | None
    min: float | None
    max: float | None
    count: int

    @staticmethod
    def of(values_m: Iterable[float | None]) -> Distances:
        """Return the summary of the values that there are."""
        values = np.array([value for value in values_m if value is not None])
        if not len(values):
            return Distances(mean=None, mean_abs=None, max_abs=None, min=None, max=None, count=0)
        return Distances(
            mean=float(values.mean()),
            mean_abs=float(np.abs(values).mean()),
            max_abs=float(np.abs(values).max()),
            min=float(values.min()),
            max=float(values.max()),
            count=len(values),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Changes:
    """What became of the changes of rate, and what was applied: half of the time of an evaluation.

    As in an `Evaluation`, for those who judge very many flights and need no more.
    """

    lag_distance_m: Distances
    apart: int
    missed: int
    off_target_ml: float
    off_line_ml: float
    applied_ml: float
    steps: tuple[Step, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """Every metric of one flight; None where the flight had nothing to measure it on.

    `apart` and `missed` go with `lag_distance_m`; the settled lag has its own. `steps`,
    `settled_steps`, `crossings` and `switches` are each single one, for pictures and tables.
    """

    meta: FlightMeta
    lag_distance_m: Distances
    apart: int
    missed: int
    settled_lag_distance_m: Distances
    settled_apart: int
    settled_missed: int
    spraying_accuracy_percent: float | None
    settled_accuracy_percent: float | None
    starting_accuracy_percent: float | None
    misapplied_percent: float | None
    border_margin_m: Distances
    border_bound_m: float | None
    off_target_ml: float
    off_line_ml: float
    gap_m2: float
    overlap_m2: float
    volume_error_percent: float | None
    zone_volume_error_percent: dict[str, float]
    section_volume_error_percent: dict[str, float]
    applied_ml: float
    steps: tuple[Step, ...]
    settled_steps: tuple[SettledStep, ...]
    crossings: tuple[BorderCrossing, ...]
    switches: tuple[Switch, ...]

    def as_json(self, *, limit_ratio: float | None = None) -> dict[str, object]:
        """Return one entry of the results' `flights`; `limit_ratio` needs a second flight."""
        settled = asdict(self.settled_lag_distance_m)
        settled |= {"apart": self.settled_apart, "missed": self.settled_missed}
        return {
            **asdict(self.meta),
            "lag_distance_m": asdict(self.lag_distance_m),
            "settled_lag_distance_m": settled,
            "spraying_accuracy_percent": self.spraying_accuracy_percent,
            "misapplied_percent": self.misapplied_percent,
            "limit_ratio": limit_ratio,
            "settled_accuracy_percent": self.settled_accuracy_percent,
            "starting_accuracy_percent": self.starting_accuracy_percent,
            "border_margin_m": asdict(self.border_margin_m) | {"bound": self.border_bound_m},
            "off_target_ml": self.off_target_ml,
            "off_line_ml": self.off_line_ml,
            "missed": self.missed,
            "apart": self.apart,
            "gap_m2": self.gap_m2,
            "overlap_m2": self.overlap_m2,
            "volume_error_percent": self.volume_error_percent,
            "zone_volume_error_percent": dict(self.zone_volume_error_percent),
            "section_volume_error_percent": dict(self.section_volume_error_percent),
            "applied_ml": self.applied_ml,
        }


def evaluate(record: FlightRecord) -> Evaluation:
    """Return every metric of a flight."""
    return evaluate_strips(record, strips_of(record))


def evaluate_strips(record: FlightRecord, strips: Sequence[Strip]) -> Evaluation:
    """Return every metric of a flight whose strips are at hand."""
    steps = [_steps(strip, record) for strip in strips]
    changes = _changes(record, strips, steps)
    switches = [
        switch
        for strip, each in zip(strips, steps, strict=True)
        for switch in switches_of(strip, each)
    ]
    crossings = [c for strip in strips for c in border_crossings(strip, record.prescription)]
    whole = tracks_of(whole_boom(record))[0]
    stretches = stretches_of(find_runs(whole, record.prescription))
    of_boom = measure_settled(whole, stretches, record.orders, record.nozzle_sets)
    settled = _known(of_boom, stretches, [*record.unknown, *map(_spared_spans, strips)])
    accuracy = flow_accuracy(strips)
    volume_error, zone_errors = volume_error_percent(strips, record.prescription)
    return Evaluation(
        meta=record.meta,
        lag_distance_m=changes.lag_distance_m,
        apart=changes.apart,
        missed=changes.missed,
        settled_lag_distance_m=Distances.of(step.lag_distance_m for step in settled),
        settled_apart=sum(step.small for step in settled) + len(of_boom) - len(settled),
        settled_missed=sum(not step.small and step.lag_distance_m is None for step in settled),
        spraying_accuracy_percent=accuracy.all_percent,
        settled_accuracy_percent=accuracy.settled_percent,
        starting_accuracy_percent=accuracy.starting_percent,
        misapplied_percent=misapplied_percent(strips),
        border_margin_m=Distances.of(crossing.margin_m for crossing in crossings),
        border_bound_m=margin_bound_m(crossings, position_sd_m=record.position_sd_m),
        off_target_ml=changes.off_target_ml,
        off_line_ml=changes.off_line_ml,
        gap_m2=sum(switch.gap_m2 for switch in switches),
        overlap_m2=sum(switch.overlap_m2 for switch in switches),
        volume_error_percent=volume_error,
        zone_volume_error_percent=zone_errors,
        section_volume_error_percent=section_error_percent(strips, record.boom),
        applied_ml=changes.applied_ml,
        steps=changes.steps,
        settled_steps=tuple(settled),
        crossings=tuple(crossings),
        switches=tuple(switches),
    )


def changes_of(record: FlightRecord, strips: Sequence[Strip]) -> Changes:
    """Return what became of the changes of a flight, and what was applied."""
    return _changes(record, strips, [_steps(strip, record) for strip in strips])


def _changes(
    record: FlightRecord, strips: Sequence[Strip], steps: Sequence[Sequence[Step]]
) -> Changes:
    every = [step for each in steps for step in each]
    inside = [step for step in every if not step.change.border]
    off = off_target(strips, record.prescription)
    return Changes(
        lag_distance_m=Distances.of(step.lag_distance_m for step in inside),
        apart=sum(step.verdict not in (Verdict.MEASURED, Verdict.MISSED) for step in inside),
        missed=sum(step.verdict is Verdict.MISSED for step in every),
        off_target_ml=off.outside_ml,
        off_line_ml=off.off_line_ml,
        applied_ml=float((record.volume_ml[-1] - record.volume_ml[0]).sum()),
        steps=tuple(every),
    )


def limit_ratio(flight: Evaluation, perfect: Evaluation) -> float | None:
    """Return the misapplied volume over that of the same flight with perfect knowledge."""
    if flight.misapplied_percent is None or not perfect.misapplied_percent:
        return None
    return flight.misapplied_percent / perfect.misapplied_percent


def _steps(strip: Strip, record: FlightRecord) -> list[Step]:
    """Return the steps of one strip; what border or treated ground held back is not missed."""
    holds = holds_of(strip.track, record.prescription, strip.stretches, strip.orders, strip.spared)
    unknown = record.unknown[strip.track.valve] if record.unknown else ()
    holds = with_unknown(holds, unknown)
    steps = measure_steps(strip.track, strip.stretches, strip.orders, record.duty_limits, holds)
    spared = _spared_spans(strip)
    steps = held_by_border(strip, record.prescription, steps)
    if not (unknown or spared):
        return steps
    found = []
    for step in steps:
        verdict = step.verdict
        if _is_within(step.change.time_s, unknown):
            verdict = Verdict.UNKNOWN
        elif _is_within(step.change.time_s, spared):
            verdict = Verdict.BORDER
        is_same = verdict is step.verdict
        found.append(step if is_same else replace(step, verdict=verdict, lag_distance_m=None))
    return found


def _known(
    steps: Sequence[SettledStep], stretches: Sequence[Run], unknown: Sequence[Spans]
) -> list[SettledStep]:
    """Return the steps on whose two stretches all is known: they are judged by all of both.

    `unknown` are times of which it is not, and those in which a valve of the boom was spared.
    """
    if not any(unknown):
        return list(steps)
    around_s = {b.start_s: (a.start_s, b.end_s) for a, b in pairwise(stretches)}
    spans = [around_s[step.change.time_s] for step in steps]
    return [
        step
        for step, (from_s, until_s) in zip(steps, spans, strict=True)
        if not any(a < until_s and from_s < b for own in unknown for a, b in own)
    ]


def _spared_spans(strip: Strip) -> Spans:
    """Return from when until when one strip was spared."""
    marks_s = strip.track.time_s[strip.track.marks]
    edges = np.flatnonzero(np.diff(strip.spared, prepend=False, append=False))
    ends = np.minimum(edges, len(marks_s) - 1)
    return tuple(zip(marks_s[ends[::2]].tolist(), marks_s[ends[1::2]].tolist(), strict=True))


def _is_within(time_s: float, spans: Sequence[tuple[float, float]]) -> bool:
    """Return whether a time is in a span, or next to one."""
    return any(a - BESIDE_S < time_s < b + BESIDE_S for a, b in spans)
