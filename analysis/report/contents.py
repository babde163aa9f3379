"""All that a report says, as one JSON object: page, PDF and `report.json` are made of it alone."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from analysis.assess.causes import Cause, rate_wishes
from analysis.flown.holes import GAP_S, UNREAD
from analysis.flown.modelled_flow import METER_OFF_PERCENT, meter_text
from analysis.journals.content import content_sha256
from analysis.lag import Verdict
from analysis.published import P1_RESULTS
from analysis.report.clock import duration_text
from analysis.report.label import label_of
from analysis.report.legal_fields import wind_note
from companion.cli.answer import finite
from companion.core.types import Inhibit
from companion.simulated import SIMULATED
from companion.wording import CUT

if TYPE_CHECKING:
    from analysis.assess.assessment import Assessment, Figures
    from analysis.assess.breakdowns import AccuracyGroup
    from analysis.assess.ground import Treated
    from analysis.flown.applied_flight import AppliedFlight
    from analysis.report.clock import Clock
    from analysis.report.legal import LegalRecord
    from analysis.report.legal_fields import Told
    from companion.core.boom import Valve
    from companion.core.schedule import LagModel


REPORT_VERSION = 2
# Keys of the contract that stand in every report, and are null where nothing could be evaluated.
METRICS = (
    "lag_distance_m", "settled_lag_distance_m", "spraying_accuracy_percent", "misapplied_percent",
    "limit_ratio", "settled_accuracy_percent", "starting_accuracy_percent", "border_margin_m",
    "off_target_ml", "off_line_ml", "missed", "apart", "gap_m2", "overlap_m2",
    "volume_error_percent",
)  # fmt: skip
# Of the journal's meta, what is not shown as such.
_LONG = ("setup", "config_toml", "application_json", "declared_json", "flight_map_json")


def contents_of(
    flight: AppliedFlight,
    assessment: Assessment | None,
    *,
    treated: Treated,
    figures: Figures,
    clock: Clock,
    told: Told,
    records: Sequence[LegalRecord],
    unread: Sequence[str] = (),
    why_not_evaluated: str = "",
) -> dict[str, Any]:
    """Return the whole content of a report."""
    label = label_of(flight, treated, clock, told)
    warnings = warnings_of(
        flight,
        assessment,
        clock,
        records,
        treated=treated,
        unread=unread,
        why_not_evaluated=why_not_evaluated,
    )
    is_whole = not (unread or flight.lost)
    is_known = is_whole or assessment is not None
    metrics = {"journal": flight.path.name, **dict.fromkeys(METRICS)}
    contents = {
        "report_version": REPORT_VERSION,
        "program": {"name": "vrspray", "version": _version()},
        "flight": {
            **_flight(flight, treated, clock, told, is_known=is_known),
            "unread": list(unread),
        },
        "verdict": verdict_of(
            figures,
            SIMULATED if flight.simulated.is_simulated else flight.training,
            is_whole=is_whole,
        ),
        "warnings": [warning.as_json() for warning in warnings],
        **(metrics if assessment is None else assessment.as_json()),
        "table_5": None if assessment is None else table_5(assessment.breakdowns.accuracy),
        "published": P1_RESULTS,
        "events": [
            {"time": clock.text(event.at_s), "time_s": event.at_s, "kind": event.kind,
             "text": event.text}
            for event in flight.events
        ],
        "label": label,
        "application": {record.profile: record.as_json() for record in records},
        "setup": _setup(flight),
        "definitions": {
            key: {"name": name, "unit": unit, "text": text}
            for key, (name, unit, text) in DEFINITIONS.items()
        },
    }  # fmt: skip
    cleaned: dict[str, Any] = finite(contents)
    return cleaned


def table_5(groups: Sequence[AccuracyGroup]) -> dict[str, Any]:
    """Return spraying accuracy by rate (rows) and speed (columns), as P1's Table 5 turned."""
    speeds = sorted(
        {
            (group.speed_low_m_s, group.speed_high_m_s)
            for group in groups
            if group.speed_low_m_s is not None and group.speed_high_m_s is not None
        }
    )
    rates = list(dict.fromkeys(group.rate_l_ha for group in groups))
    of = {(group.rate_l_ha, group.speed_low_m_s): group.percent.as_json() for group in groups}
    return {
        "speeds_m_s": [list(each) for each in speeds],
        "rows": [
            {"rate_l_ha": rate, "percent": [of.get((rate, low)) for low, _ in speeds]}
            for rate in rates
        ],
    }


def _version() -> str:
    try:
        return version("vrspray")
    except PackageNotFoundError:
        return "unknown"


def _flight(
    flight: AppliedFlight, treated: Treated, clock: Clock, told: Told, *, is_known: bool
) -> dict[str, Any]:
    """Return what, where, when and by whom; what was treated only where that is known."""
    has_samples = len(flight.time_s) > 0
    frame = flight.setup.frame
    latitude_deg, longitude_deg = frame.latitude_deg, frame.longitude_deg
    if not treated.area.is_empty:
        place = treated.area.representative_point()
        latitude_deg, longitude_deg = frame.to_geographic(float(place.x), float(place.y))
    return {
        "file": flight.path.name,
        "sha256": content_sha256(flight.path),
        "is_closed": flight.is_closed,
        "lost": flight.lost,
        "training": flight.training,
        "simulated": flight.simulated.word,
        "simulated_because": flight.simulated.because,
        "simulated_label": flight.simulated.label,
        "started": clock.text(float(flight.time_s[0])) if has_samples else None,
        "ended": clock.text(float(flight.time_s[-1])) if has_samples else None,
        "spraying_from": clock.text(treated.first_s),
        "spraying_until": clock.text(treated.last_s),
        "duration_s": flight.duration_s if has_samples or is_known else None,
        "time_zone": clock.zone_name,
        "clock": clock.source_text,
        "clock_verified": clock.is_verified,
        "latitude_deg": latitude_deg,
        "longitude_deg": longitude_deg,
        "treated_area_ha": treated.area_ha if is_known else None,
        "field_area_ha": float(flight.setup.prescription.field.area) / 1e4,
        "told": dict(told.values),
        "told_after_flight": sorted(told.after),
        "meta": {key: value for key, value in flight.meta.items() if key not in _LONG},
    }


def _setup(flight: AppliedFlight) -> dict[str, Any]:
    """Return what the sprayer was set to."""
    setup, meta = flight.setup, flight.meta
    return {
        "method": str(setup.method),
        "border": setup.border,
        "border_buffer_m": setup.border_buffer_m,
        "across": setup.across,
        "lag": asdict(setup.lag),
        "pwm": asdict(setup.pwm),
        "boom": {
            "width_m": setup.boom.width_m,
            "valves": [valve_in_force(valve, setup.lag) for valve in setup.boom.valves],
        },
        "nozzle_sets": [
            {
                "valves": [setup.boom.valves[valve].name for valve in nozzles.valves],
                "duty": list(nozzles.curve.duty),
                "flow_l_min": list(nozzles.curve.flow_l_min),
                "shares": [nozzles.share(valve) for valve in nozzles.valves],
            }
            for nozzles in setup.nozzle_sets
        ],
        "has_flow_trim": setup.flow_trim is not None,
        "has_drift_offset": setup.drift is not None,
        "sprays_lines_only": setup.lines is not None,
        "map_sha256": setup.prescription.sha256,
        "config_sha256": _text_sha256(meta),
        "calibration_sha256": meta.get("calibration_sha256"),
        "config_path": meta.get("config_path"),
        "config_overrides": meta.get("config_overrides"),
        "config_toml": meta.get("config_toml"),
        "versions": {
            key.removeprefix("version_"): value
            for key, value in meta.items()
            if key.startswith("version_")
        },
        "platform": meta.get("platform"),
    }


def valve_in_force(valve: Valve, lag: LagModel) -> dict[str, Any]:
    """Return a valve with the lags in force for it: the set's, and what it is later than that."""
    of_set = (lag.on_s, lag.off_s, lag.up_s, lag.down_s)
    in_force = {
        f"{kind}_s": set_s + own_s
        for kind, set_s, own_s in zip(
            ("on", "off", "up", "down"), of_set, valve.lags_s, strict=True
        )
    }
    is_own = valve.flow_factor != 1.0 or any(valve.lags_s)
    return asdict(valve) | {"lags_in_force": in_force, "has_own_figures": is_own}


def _text_sha256(meta: Mapping[str, str]) -> str | None:
    text = meta.get("config_toml")
    return None if text is None else hashlib.sha256(text.encode()).hexdigest()


# What the report says in sentences: the verdict, and what a reader must know before any figure.

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
# More of the ground than this is not flown over closed by the way.
HELD_SHARE = 0.01
# Of what a record lacks, so much is named above it.
LABELS_LISTED = 4
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


def verdict_of(figures: Figures, training: str | None, *, is_whole: bool = True) -> dict[str, Any]:
    """Return the figures of the flight, and the verdict in one sentence."""
    if figures.applied_by in (None, "nothing"):
        sentence = "Nothing was sprayed in this flight." if is_whole else UNKNOWN
    else:
        sentence = sentence_of(figures, training)
        sentence = sentence if is_whole else f"By what could be read: {sentence}"
    return {"sentence": sentence, **figures.as_json()}


def sentence_of(figures: Figures, training: str | None) -> str:
    """Return what was applied, what of it is known how, and what was missed."""
    what = {
        "water": "L of water applied",
        "dry": "L would have been applied",
        SIMULATED: "L applied in a simulation",
    }
    done = what.get(training or "", "L applied")
    how = "modelled, not metered"
    if figures.metered_l is not None and figures.modelled_l is not None:
        sure = meter_text(figures.metered_l, figures.modelled_l)
        how = f"by the flow meter{sure}; modelled {figures.modelled_l:.2f} L"
    parts = [f"{figures.applied_l:.2f} {done} ({how}) on {figures.area_ha:.2f} ha"]
    if figures.prescribed_l and figures.off_percent is not None:
        parts[0] += (
            f", where the map asked for {figures.prescribed_l:.2f} L ({figures.off_percent:+.1f} %)"
        )
    if figures.untreated_percent is not None:
        parts.append(
            f"not treated: {figures.untreated_m2:.0f} m2 ({figures.untreated_percent:.0f} %) of "
            f"the field, {figures.missed_m2:.0f} m2 of it under passes that were flown"
        )
    if figures.within_10_percent is not None:
        parts.append(
            f"{figures.within_10_percent:.1f} % of the ground under its passes got its rate "
            "within 10 %"
        )
    if figures.worst_m is not None:
        parts.append(
            f"{judged_text(figures)} lay within {figures.worst_m:.2f} m of their boundary "
            "(a bound, 95 %)"
        )
    parts.append(f"{figures.outside_ml:.1f} mL fell outside the field")
    return "; ".join(parts) + "."


WHY_NOT = {
    "small": "below 8 %",
    "close": "beside a strip too short for the valves",
    "saturated": "at the end of the valves' range",
    "border": "held by the border",
    "unknown": "not recorded",
    "missed": "that never happened",
}


def judged_text(figures: Figures) -> str:
    """Return which changes a bound is for: of what was left out it says nothing."""
    count, every = figures.lag_count, figures.change_count
    if count == every:
        return f"all {count} changes of rate"
    others = ", ".join(f"{number} {WHY_NOT[name]}" for name, number in figures.unjudged.items())
    return f"the {count} of {every} changes of rate that can be judged ({others})"


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
        *_simulated(flight),
        *_training(flight),
        *_journal(flight, clock),
        *(_warning("unread", f"Parts could not be read: {each}.") for each in unread),
        *_inhibited(flight, assessment, treated),
        *held_ground(assessment),
        *_wishes(flight, clock),
        *_wind(flight),
        *_receiver(flight),
        *_flow(assessment, why_not_evaluated, clock),
        *record_warnings(records),
    ]
    order = ("mark", "warning", "note")
    return sorted(found, key=lambda each: order.index(each.severity))


def _mark(code: str, text: str) -> Caution:
    return Caution(severity="mark", code=code, text=text)


def _warning(code: str, text: str) -> Caution:
    return Caution(severity="warning", code=code, text=text)


def _note(code: str, text: str) -> Caution:
    return Caution(severity="note", code=code, text=text)


def _simulated(flight: AppliedFlight) -> Iterator[Caution]:
    simulated = flight.simulated
    if simulated.is_simulated:
        yield _mark(
            "simulated",
            f"SIMULATED FLIGHT: nothing was flown, nothing was applied ({simulated.because})",
        )
    elif simulated.is_unmarked:
        yield _note("simulated-unknown", f"Not known whether simulated: {simulated.because}.")
    elif not simulated.is_known:
        yield _warning("simulated-unknown", f"Not known whether simulated: {simulated.because}.")


def _training(flight: AppliedFlight) -> Iterator[Caution]:
    if flight.training == "water":
        yield _mark("training", "TRAINING WITH WATER: no product was applied")
    elif flight.training == "dry":
        yield _mark("training", "DRY RUN: no valve was opened, nothing was applied")
    elif flight.training is None:
        yield _note(
            "training-unknown",
            "The journal does not say whether a product was sprayed: it is an old one.",
        )


def _journal(flight: AppliedFlight, clock: Clock) -> Iterator[Caution]:
    if not flight.is_closed:
        end = f"{CUT} (it ends {flight.duration_s:.0f} s after its start)."
        yield _warning("cut", end[0].upper() + end[1:])
    if flight.lost:
        yield _warning("rows-lost", f"{flight.lost} rows of the journal are lost.")
    if not clock.is_verified:
        yield _warning("clock", f"Times are by the {clock.source_text}.")


def _wind(flight: AppliedFlight) -> Iterator[Caution]:
    note = wind_note(flight)
    if note:
        fix = "Measure it on the ground and give it (application.wind_m_s)."
        yield _note("wind-unknown", f"{note[0].upper()}{note[1:]}. {fix}")


def _receiver(flight: AppliedFlight) -> Iterator[Caution]:
    if flight.receiver is not None:
        severity: Severity = "warning" if flight.receiver.is_unusual else "note"
        words = flight.receiver.words
        yield Caution(severity=severity, code="receiver", text=f"{words[0].upper()}{words[1:]}.")


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
    reasons = ", ".join(
        f"{area_m2:.0f} m2 ({reasons_in_words(name)})"
        for name, area_m2 in by_reason
        if name != UNREAD
    )
    if not reasons or not held_m2 > HELD_SHARE * causes.passed_m2:
        return
    yield _warning(
        "held-ground",
        f"{held_m2:.0f} m2 were flown over with the valves held closed: {reasons}.",
    )


def reasons_in_words(names: str) -> str:
    """Return a moment's reasons as the operator's screen calls them.

    >>> reasons_in_words("speed-below-min not-enabled")
    'too slow and not enabled'
    """
    known = {each.value: each.words for each in Inhibit}
    if not all(name in known for name in names.split()):
        return names
    return " and ".join(known[name] for name in names.split())


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


def _flow(assessment: Assessment | None, why_not: str, clock: Clock) -> Iterator[Caution]:
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
        yield _warning("missed", _never_happened(assessment, clock))
    if evaluation.off_target_ml > 1.0:
        yield _warning("outside", f"{evaluation.off_target_ml:.1f} mL fell outside the field.")
    if evaluation.off_line_ml > 1.0:
        yield _note(
            "off-line",
            f"{evaluation.off_line_ml:.1f} mL fell in the field, beside the planned lines.",
        )


def _never_happened(assessment: Assessment, clock: Clock) -> str:
    """Return what the journal has no change of flow for: how often, which valves, first where."""
    flight = assessment.flight
    steps = [each for each in assessment.evaluation.steps if each.verdict is Verdict.MISSED]
    first = min((each.change for each in steps), key=lambda change: change.time_s)
    at_border = sum(each.change.border for each in steps)
    many = f"{len(steps) - at_border} changes of rate, {at_border} on or off at the border"
    valves = sorted({each.change.valve for each in steps})
    names = ", ".join(flight.setup.boom.valves[valve].name for valve in valves)
    place = [
        float(np.interp(first.time_s, flight.time_s, each))
        for each in (flight.east_m, flight.north_m)
    ]
    latitude_deg, longitude_deg = flight.setup.frame.to_geographic(*place)
    return (
        f"Never happened, according to the journal: {many} (valves {names}; the first at "
        f"{clock.text(first.time_s) or 'a time not known'}, {latitude_deg:.6f}, "
        f"{longitude_deg:.6f})."
    )


def _labels(record: LegalRecord) -> Iterator[str]:
    """Yield what is missing in words; the record itself has the keys by which it is said."""
    for entry in record.entries:
        if entry.is_missing:
            yield entry.label[:1].lower() + entry.label[1:]
    yield from record.why_not


def _listed(labels: Sequence[str]) -> str:
    """Return some of the labels; all of them stand in the record.

    >>> _listed(["crop", "wind"]), _listed(list("abcdefgh"))
    ('crop, wind', 'a, b, c, d and 4 more')
    """
    if len(labels) <= LABELS_LISTED + 1:
        return ", ".join(labels)
    return f"{', '.join(labels[:LABELS_LISTED])} and {len(labels) - LABELS_LISTED} more"


def record_warnings(records: Sequence[LegalRecord]) -> Iterator[Caution]:
    """Yield which records are not complete."""
    for record in records:
        if not record.is_complete:
            yield _warning(
                "record",
                f"The {record.profile} record of the application is INCOMPLETE; missing: "
                f"{_listed(list(_labels(record)))}.",
            )


# What each figure means, in one line, with its unit; the whole is in docs/explanation/metrics.md.

DEFINITIONS: dict[str, tuple[str, str, str]] = {
    "lag_distance_m": (
        "Lag distance",
        "m",
        "from a boundary to where a sharp step would have delivered the same volume; + is too late",
    ),
    "settled_lag_distance_m": (
        "Settled lag distance",
        "m",
        "to where the flow stays within 10 % of the step at its new target, as Wang et al. 2024",
    ),
    "spraying_accuracy_percent": (
        "Spraying accuracy",
        "%",
        "mean of 1 - |applied - asked| / asked of the total flow, transitions included; samples "
        "where nothing is asked are left out and counted",
    ),
    "settled_accuracy_percent": (
        "Settled accuracy", "%", "the same, from 3 s after a change on",
    ),
    "starting_accuracy_percent": (
        "Starting accuracy", "%", "the same, in the first 3 s after a start",
    ),
    "misapplied_percent": (
        "Misapplied",
        "%",
        "too much and too little where a valve's strip lay wholly in the field, each pass by "
        "itself, over what was prescribed there; bare ground along the border is not in it",
    ),
    "border_margin_m": (
        "Border margin",
        "m",
        "from where the spray ended, or began, to the border; below 0: beyond it",
    ),
    "off_target_ml": ("Outside", "mL", "volume beyond the border or in exclusions"),
    "off_line_ml": ("Off the lines", "mL", "volume in the field, beside the planned lines"),
    "gap_m2": ("Gaps", "m\u00b2", "ground left out at switches on and off"),
    "overlap_m2": ("Overlap", "m\u00b2", "ground treated beyond the boundary at switches"),
    "volume_error_percent": (
        "Volume error", "%", "applied less prescribed volume over the prescribed, where was flown",
    ),
    "apart": (
        "Not measured",
        "changes",
        "below 8 %, too close together, at the end of the valves' range, or at the border",
    ),
    "missed": ("Missed", "changes", "never happened, on and off at borders included"),
}  # fmt: skip

CAUSES: dict[str, str] = {
    "operator": "rate changed by the operator",
    "inhibit": "held closed by the safety layer",
    "edge": "border rule: nothing may fall outside",
    "change": "boundary between two rates",
    "saturation": "rate out of the nozzles' range",
    "acceleration": "changing speed",
    "overlap": "treated twice",
    "skip": "left out",
    "unexplained": "unexplained",
}
