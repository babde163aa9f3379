"""What the report says in sentences: the verdict, and what a reader must know before any figure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from analysis.assess.causes import Cause
from analysis.assess.rate_wishes import rate_wishes
from analysis.flown.holes import UNREAD
from analysis.flown.unknown import GAP_S
from analysis.report.clock import duration_text
from analysis.report.facts import wind_note
from companion.core.types import Inhibit

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from analysis.assess.assessment import Assessment
    from analysis.flown.applied_flight import AppliedFlight
    from analysis.report.clock import Clock
    from analysis.report.legal import LegalRecord
    from analysis.report.treated import Treated

Severity = Literal["mark", "warning", "note"]

# Reasons that speak of the position, and those that a person had to answer.
POSITION = frozenset(
    {
        Inhibit.NO_POSITION, Inhibit.STALE_POSITION, Inhibit.INVALID_POSITION,
        Inhibit.POSITION_FROZEN, Inhibit.CLOCK_DISAGREES, Inhibit.FIX_TOO_LOW,
        Inhibit.ACCURACY_TOO_LOW, Inhibit.ESTIMATOR_UNHEALTHY,
    }
)  # fmt: skip
LATCHED = frozenset(
    {
        Inhibit.ESTOP, Inhibit.REARM_NEEDED, Inhibit.OUTPUT_FAULT, Inhibit.LEAK,
        Inhibit.VALVE_STUCK_OPEN, Inhibit.NO_FLOW, Inhibit.TANK_EMPTY, Inhibit.FLOW_FAULT,
    }
)  # fmt: skip
# A meter of 3 % and a curve of a few percent may differ by this much and be sound.
METER_OFF_PERCENT = 6.0
# More of the ground than this is not flown over closed by the way.
HELD_SHARE = 0.01
UNKNOWN = "Nothing can be said of what was sprayed: too little of the journal can be read."


@dataclass(frozen=True, slots=True, kw_only=True)
class Caution:
    """One thing to know; a `mark` stands large above all."""

    severity: Severity
    code: str
    text: str

    def as_json(self) -> dict[str, str]:
        """Return it as a JSON object."""
        return {"severity": self.severity, "code": self.code, "text": self.text}


def verdict_of(
    assessment: Assessment | None, treated: Treated, *, is_whole: bool = True
) -> dict[str, Any]:
    """Return the figures of the verdict, and the verdict in one sentence.

    What was sprayed in a flight of which too little can be read, nobody knows: null, and not zero.
    """
    if assessment is None or assessment.evaluation.applied_ml <= 0.0:
        return {
            "sentence": "Nothing was sprayed in this flight." if is_whole else UNKNOWN,
            "applied_l": 0.0 if is_whole else None,
            "prescribed_l": None,
            "area_ha": treated.area_ha if is_whole else None,
            "within_10_percent": None,
            "worst_lag_distance_m": None,
            "outside_ml": None,
        }
    evaluation, balance = assessment.evaluation, assessment.balance
    figures = {
        "applied_l": balance.model_l,
        "prescribed_l": balance.prescribed_l,
        "area_ha": treated.area_ha,
        "within_10_percent": assessment.causes.within_percent,
        "worst_lag_distance_m": evaluation.lag_distance_m.max_abs,
        "outside_ml": evaluation.off_target_ml,
    }
    sentence = _sentence(figures, assessment.flight.training)
    return {"sentence": sentence if is_whole else f"By what could be read: {sentence}", **figures}


def _sentence(figures: Mapping[str, Any], training: str | None) -> str:
    applied_l, prescribed_l = figures["applied_l"], figures["prescribed_l"]
    what = {
        "water": "L of water applied",
        "dry": "L would have been applied",
        "simulated": "L applied in a simulation",
    }
    done = what.get(training or "", "L applied")
    parts = [f"{applied_l:.2f} {done} on {figures['area_ha']:.2f} ha"]
    if prescribed_l:
        off = 100.0 * (applied_l - prescribed_l) / prescribed_l
        parts[0] += f", where the map asked for {prescribed_l:.2f} L ({off:+.1f} %)"
    if figures["within_10_percent"] is not None:
        within = figures["within_10_percent"]
        parts.append(f"{within:.1f} % of the ground got its rate within 10 %")
    if figures["worst_lag_distance_m"] is not None:
        worst_m = figures["worst_lag_distance_m"]
        parts.append(f"the worst change of rate lay {worst_m:.2f} m from its boundary")
    parts.append(f"{figures['outside_ml']:.1f} mL fell outside the border")
    return "; ".join(parts) + "."


def warnings_of(
    flight: AppliedFlight,
    assessment: Assessment | None,
    clock: Clock,
    records: Sequence[LegalRecord],
    *,
    treated: Treated,
    unread: Sequence[str],
    why_not_evaluated: str,
) -> list[Caution]:
    """Return what must be known, the gravest first."""
    found = [
        *_training(flight),
        *_journal(flight, clock),
        *(_warning("unread", f"Of the journal could not be read: {each}.") for each in unread),
        *_inhibited(flight, assessment, treated),
        *held_ground(assessment),
        *_wishes(flight, clock),
        *_wind(flight),
        *_flow(assessment, why_not_evaluated),
        *_records(records),
    ]
    order = ("mark", "warning", "note")
    return sorted(found, key=lambda each: order.index(each.severity))


def _mark(code: str, text: str) -> Caution:
    return Caution(severity="mark", code=code, text=text)


def _warning(code: str, text: str) -> Caution:
    return Caution(severity="warning", code=code, text=text)


def _note(code: str, text: str) -> Caution:
    return Caution(severity="note", code=code, text=text)


def _training(flight: AppliedFlight) -> Iterator[Caution]:
    if flight.training == "water":
        yield _mark("training", "TRAINING WITH WATER: no product was applied")
    elif flight.training == "dry":
        yield _mark("training", "DRY RUN: no valve was opened, nothing was applied")
    elif flight.training == "simulated":
        yield _mark("training", "SIMULATION: nothing was flown, nothing was applied")
    elif flight.training is None:
        yield _note(
            "training-unknown",
            "The journal does not say whether a product was sprayed: it is an old one.",
        )


def _journal(flight: AppliedFlight, clock: Clock) -> Iterator[Caution]:
    if not flight.is_closed:
        yield _warning("cut", "The journal was cut: up to its last second is missing.")
    if flight.lost:
        yield _warning("rows-lost", f"{flight.lost} rows of the journal are lost.")
    if not clock.is_verified:
        yield _warning("clock", "Times are by the clock of the companion, which nobody verified.")


def _wind(flight: AppliedFlight) -> Iterator[Caution]:
    note = wind_note(flight)
    if note:
        fix = "Measure it on the ground and give it (application.wind_m_s)."
        yield _note("wind-unknown", f"{note[0].upper()}{note[1:]}. {fix}")


def _inhibited(
    flight: AppliedFlight, assessment: Assessment | None, treated: Treated
) -> Iterator[Caution]:
    held_s = held_between(flight, treated.first_s, treated.last_s)
    for code, reasons, text in (
        ("position", POSITION, "Position not good enough during the work, valves held closed"),
        ("fault", LATCHED, "Faults or stops held the valves closed during the work"),
    ):
        found = {key: held_s[key] for key in sorted(reasons & held_s.keys())}
        if found:
            times = ", ".join(f"{key} {value:.1f} s" for key, value in found.items())
            yield _warning(code, f"{text}: {times}.")
    if assessment is not None and assessment.durations.unknown_s > 0.0:
        gap = duration_text(assessment.durations.unknown_s)
        yield _warning("gap", f"For {gap} the journal does not say what the sprayer did.")
    yield from _faults(event.text or event.kind for event in flight.events if _is_fault(event.kind))


def held_ground(assessment: Assessment | None) -> Iterator[Caution]:
    """Yield which ground was flown over closed: after the last spraying, too."""
    if assessment is None:
        return
    causes = assessment.causes
    held_m2 = causes.by_cause[Cause.INHIBIT]
    by_reason = sorted(causes.by_inhibit.items(), key=lambda each: -each[1])
    reasons = ", ".join(f"{name} {area_m2:.0f} m2" for name, area_m2 in by_reason if name != UNREAD)
    if not reasons or not held_m2 > HELD_SHARE * causes.judged_m2:
        return
    yield _warning(
        "held-ground",
        f"{held_m2:.0f} m2 were flown over with the valves held closed: {reasons}.",
    )


def held_between(
    flight: AppliedFlight, first_s: float | None, last_s: float | None
) -> dict[str, float]:
    """Return for how long each reason held the valves closed between two times.

    Before the first and after the last spraying much is missing, and rightly so.
    """
    held_s: dict[str, float] = {}
    if first_s is None or last_s is None:
        return held_s
    ends_s = [*flight.time_s[1:].tolist(), *flight.time_s[-1:].tolist()]
    for begin_s, end_s, reasons in zip(
        flight.time_s.tolist(), ends_s, flight.inhibits, strict=True
    ):
        length_s = min(end_s, last_s) - max(begin_s, first_s)
        if reasons and 0.0 < length_s <= GAP_S:
            for reason in reasons.split():
                held_s[reason] = held_s.get(reason, 0.0) + length_s
    return held_s


def _wishes(flight: AppliedFlight, clock: Clock) -> Iterator[Caution]:
    wishes = rate_wishes(flight)
    if wishes:
        each = ", ".join(
            f"{percent:g} % from {clock.text(at_s) or 'a time not known'}"
            for at_s, percent in wishes
        )
        yield _warning(
            "rate-override", f"The operator asked for another part of the prescribed rates: {each}."
        )


def _is_fault(kind: str) -> bool:
    return kind.startswith("fault-") or kind == "standstill"


def _faults(texts: Iterable[str]) -> Iterator[Caution]:
    for text in dict.fromkeys(texts):
        yield _warning("fault", f"Fault in flight: {text}.")


def _flow(assessment: Assessment | None, why_not: str) -> Iterator[Caution]:
    if assessment is None:
        yield _warning("not-evaluated", f"No metric can be computed: {why_not}.")
        return
    evaluation, balance = assessment.evaluation, assessment.balance
    off = balance.meter_to_model_percent
    if off is not None and not abs(off) <= METER_OFF_PERCENT:
        yield _warning(
            "meter",
            f"The flow meter counted {off:+.1f} % against what the calibrated curves stand for: "
            "one of them is wrong.",
        )
    if evaluation.missed:
        yield _warning("missed", f"{evaluation.missed} changes of rate never happened.")
    if evaluation.off_target_ml > 1.0:
        yield _warning("outside", f"{evaluation.off_target_ml:.1f} mL fell outside the border.")


def _labels(record: LegalRecord) -> Iterator[str]:
    """Yield what is missing in words; the record itself has the keys by which it is said."""
    for entry in record.entries:
        if entry.is_missing:
            yield entry.label[:1].lower() + entry.label[1:]
    yield from record.why_not


def _records(records: Sequence[LegalRecord]) -> Iterator[Caution]:
    for record in records:
        if not record.is_complete:
            yield _warning(
                "record",
                f"The {record.profile} record of the application is INCOMPLETE; missing: "
                f"{', '.join(_labels(record))}.",
            )
