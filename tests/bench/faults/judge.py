"""What a flight was like: how soon it closed, whether it stayed closed, what fell outside. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from tests.bench.faults.cases import CONT_KINDS, PROCESS_KINDS, Kind
from tests.bench.faults.place import SPEED_M_S, lags
from tests.bench.faults.reasons import Reason, reasons_of
from tests.bench.faults.record import Opening, Record
from tests.bench.faults.strike import jump_of

# What one of the example's valves delivers open: 6.096 L/min over six.
FULL_ML_S = 6.096e3 / 60.0 / 6.0
# Times are those of one clock, read by several processes.
CLOCK_S = 0.001
# Orders that were under way when a process was stopped are carried out by then.
STOPPING_S = 0.05
# What survives a fault sprays on: some opening begins later than this after it.
SPRAYS_ON_S = 1.0
# By then five positions have confirmed a jump, and nothing flows any more from before it.
BELIEVED_S = 0.3
_STEP_S = 0.002
_M_PER_DEGREE = 111_000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """One flight judged; `wrong` says what must not be.

    `closed_s` is from the cause to when the last valve was closed (0: none was open then). `ml`
    outside the border are of openings that engine or companion ordered; `held_ml` of those that a
    dead or stopped one could not close any more.
    """

    kind: Kind
    output: str
    number: int
    closed_s: float
    limit_s: float
    was_open: bool
    ml: float
    held_ml: float
    crossed: bool
    late_s: float
    waited_s: float
    wrong: tuple[str, ...]


def judge(record: Record) -> Verdict:
    """Return the verdict on a flight."""
    case = record.draw.case
    reasons = reasons_of(record)
    openings = judged(record)
    cause = reasons[0] if reasons else None
    at_s = record.fault_s if cause is None else cause.at_s
    ordered, held = split(record, at_s)
    ml = outside_ml(record, ordered)
    wrong = [*_wrong_times(openings, reasons), *_wrong_ends(record)]
    if cause is None:
        wrong.append("nothing that happened is a reason to close")
    if any(one.from_s < record.enabled_s for one in openings):
        wrong.append("open before it was enabled")
    if ml > 0.0:
        wrong.append(f"{ml:.2f} mL ordered outside")
    if case.kind is Kind.DISK_FULL and not _sprays_on(record, openings):
        wrong.append("the full disk ended the spraying")
    leaves_s = record.draw.leaves_s
    return Verdict(
        kind=case.kind,
        output=case.output,
        number=record.draw.number,
        closed_s=0.0 if cause is None else closed_after_s(openings, cause),
        limit_s=case.limit_s,
        was_open=any(one.from_s <= at_s < one.to_s for one in openings),
        ml=ml,
        held_ml=outside_ml(record, held),
        crossed=leaves_s is not None,
        late_s=record.late_s,
        waited_s=record.waited_s,
        wrong=tuple(wrong),
    )


def judged(record: Record) -> Sequence[Opening]:
    """Return what the times are judged by: without the ALIVE monostable where it is not needed."""
    case = record.draw.case
    behind = case.output == "dither" or case.kind in (
        Kind.STOP_BOTH,
        Kind.CONT_BOTH,
        Kind.CHIP_GONE,
    )
    return record.openings if behind else record.own


def closed_after_s(openings: Iterable[Opening], reason: Reason) -> float:
    """Return how long after its cause the last valve was closed, while it is in force."""
    ends = [
        min(one.to_s, reason.until_s)
        for one in openings
        if one.to_s > reason.at_s and one.from_s < reason.until_s
    ]
    return max(ends, default=reason.at_s) - reason.at_s


def _wrong_times(openings: Sequence[Opening], reasons: Iterable[Reason]) -> Iterator[str]:
    for what, at_s, limit_s, until_s in reasons:
        closed_s = at_s + limit_s + CLOCK_S
        late = [one for one in openings if one.to_s > closed_s and one.from_s < until_s]
        if late:
            end_s = max(min(one.to_s, until_s) for one in late)
            yield f"{what}: open {end_s - at_s:.3f} s after it, limit {limit_s:g} s"


def _wrong_ends(record: Record) -> Iterator[str]:
    """Yield what is wrong with how the companion ended: alive to the end, and in good order."""
    kind = record.draw.case.kind
    if record.engine_left:
        yield "the engine lives on without its companion"
    if "Traceback" in record.errors:
        yield f"traceback: {record.errors.strip().splitlines()[-1]}"
    is_killed = kind in PROCESS_KINDS - CONT_KINDS and not kind.value.endswith("engine")
    if not is_killed and record.ended_s is None:
        yield f"the companion ended by itself (exit {record.exit_code})"
    elif not is_killed and record.exit_code != 0:
        yield f"the companion ended with {record.exit_code}"
    if kind is Kind.DISK_FULL and record.lost_rows == 0:
        yield "the disk was not full: no row was lost"


def _sprays_on(record: Record, openings: Iterable[Opening]) -> bool:
    return any(one.to_s > record.fault_s + SPRAYS_ON_S for one in openings)


def split(record: Record, cause_s: float) -> tuple[list[Opening], list[Opening]]:
    """Return what was ordered, and what was held open after the cause by nobody's order."""
    own = [_as_stopped(record, one, cause_s) for one in record.own]
    ordered = [
        one if one.is_ordered else one._replace(to_s=min(one.to_s, cause_s))
        for one in own
        if one.is_ordered or one.from_s < cause_s
    ]
    held = [
        one._replace(from_s=max(one.from_s, cause_s))
        for one in (_as_stopped(record, each, cause_s) for each in record.openings)
        if not one.is_ordered and one.to_s > cause_s
    ]
    return ordered, held


def _as_stopped(record: Record, one: Opening, cause_s: float) -> Opening:
    """Return an opening as ordered by nobody that was closed only by who went on after a stop.

    Or by the guardian, after a companion that was killed or stopped.
    """
    case = record.draw.case
    is_guarded = case.kind in (Kind.KILL_COMPANION, Kind.STOP_COMPANION) and case.output != "gpio"
    goes_on = case.kind in CONT_KINDS and (case.output, case.kind) != ("gpio", Kind.CONT_COMPANION)
    held = goes_on or is_guarded
    is_held = held and one.from_s < cause_s + STOPPING_S < one.to_s - STOPPING_S
    return one._replace(is_ordered=False) if is_held else one


def outside_ml(record: Record, openings: Iterable[Opening]) -> float:
    """Return what flows outside the field, by the measured lags of the sprayer."""
    lag = lags(record.draw.case.output)
    on_s, off_s = lag["on_start_s"] + lag["output_s"], lag["off_end_s"] + lag["output_s"]
    return sum(
        one.share * FULL_ML_S * _outside_s(record, one.from_s + on_s, one.to_s + off_s)
        for one in openings
    )


def _outside_s(record: Record, from_s: float, to_s: float) -> float:
    """Return how much of a time the vehicle was outside, where it said that it was."""
    field_m = record.draw.field_m(SPEED_M_S)
    steps = max(math.ceil((to_s - from_s) / _STEP_S), 1)
    step_s = (to_s - from_s) / steps
    out = 0
    for number in range(steps):
        at_s = from_s + (number + 0.5) * step_s
        # A jump that is told for long enough is where the vehicle is, as far as anyone knows.
        east_m = record.path.pose_at(at_s).east_m + _jumped_m(record, at_s)
        out += not 0.0 <= east_m <= field_m
    return out * step_s


def _jumped_m(record: Record, at_s: float) -> float:
    if record.draw.case.kind is not Kind.JUMP or at_s < record.fault_s + BELIEVED_S:
        return 0.0
    return jump_of(record.draw)[1] * 1e-7 * _M_PER_DEGREE * math.cos(math.radians(36.0))
