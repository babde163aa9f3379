"""All that a report says, as one JSON object: page, PDF and `report.json` are made of it alone."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from analysis.published import P1_RESULTS
from analysis.report.definitions import DEFINITIONS
from analysis.report.words import verdict_of, warnings_of
from companion.record.content_hash import content_sha256

if TYPE_CHECKING:
    from analysis.assess.assessment import Assessment
    from analysis.assess.breakdowns import AccuracyGroup
    from analysis.flown.applied_flight import AppliedFlight
    from analysis.report.clock import Clock
    from analysis.report.legal import LegalRecord
    from analysis.report.told import Told
    from analysis.report.treated import Treated

REPORT_VERSION = 1
# Keys of the contract that stand in every report, and are null where nothing could be evaluated.
METRICS = (
    "lag_distance_m", "settled_lag_distance_m", "spraying_accuracy_percent", "misapplied_percent",
    "limit_ratio", "settled_accuracy_percent", "starting_accuracy_percent", "border_margin_m",
    "off_target_ml", "missed", "apart", "gap_m2", "overlap_m2", "volume_error_percent",
)  # fmt: skip
# Of the journal's meta, what is not shown as such.
_LONG = ("setup", "config_toml", "application_json")


def contents_of(
    flight: AppliedFlight,
    assessment: Assessment | None,
    *,
    treated: Treated,
    clock: Clock,
    told: Told,
    records: Sequence[LegalRecord],
    unread: Sequence[str] = (),
    why_not_evaluated: str = "",
) -> dict[str, Any]:
    """Return the whole content of a report."""
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
        "verdict": verdict_of(assessment, treated, is_whole=is_whole),
        "warnings": [warning.as_json() for warning in warnings],
        **(metrics if assessment is None else assessment.as_json()),
        "table_5": None if assessment is None else table_5(assessment.breakdowns.accuracy),
        "published": P1_RESULTS,
        "events": [
            {"time": clock.text(event.at_s), "time_s": event.at_s, "kind": event.kind,
             "text": event.text}
            for event in flight.events
        ],
        "application": {record.profile: record.as_json() for record in records},
        "setup": _setup(flight),
        "definitions": {
            key: {"name": name, "unit": unit, "text": text}
            for key, (name, unit, text) in DEFINITIONS.items()
        },
    }  # fmt: skip
    cleaned: dict[str, Any] = finite(contents)
    return cleaned


def finite(value: Any) -> Any:
    """Return a value as JSON has it: what is no finite number is missing.

    >>> finite({"a": [float("nan"), 1.0]})
    {'a': [None, 1.0]}
    """
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return value


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
            "valves": [asdict(valve) for valve in setup.boom.valves],
        },
        "nozzle_sets": [
            {
                "valves": [setup.boom.valves[valve].name for valve in nozzles.valves],
                "duty": list(nozzles.curve.duty),
                "flow_l_min": list(nozzles.curve.flow_l_min),
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


def _text_sha256(meta: Mapping[str, str]) -> str | None:
    text = meta.get("config_toml")
    return None if text is None else hashlib.sha256(text.encode()).hexdigest()
