"""Whether a flight kept each limit of its label and permit, from its journal alone.

`kept` is true, false, or None where the journal does not tell. What the operator declared before
the flight counts as declared; what was said afterwards is marked where the record is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from datetime import timedelta
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.report.facts import is_estimate, while_spraying
from companion.config.limits import LimitsFile, limits_of
from companion.core.label import DAY_S

if TYPE_CHECKING:
    from analysis.flown.applied_flight import AppliedFlight, Floats
    from analysis.report.legal_fields import Told
    from analysis.report.treated import Clock, Treated

# Less of the spraying than this outside is noise of a filter, not a limit that was broken.
OUTSIDE_MAX_S = 0.2


def label_of(
    flight: AppliedFlight, treated: Treated, clock: Clock, told: Told
) -> dict[str, Any] | None:
    """Return each limit of the journal's label, kept or broken; None where it has none."""
    label = limits_of(flight.meta)
    if label is None:
        return None
    rows = [
        *_flown(label, flight),
        *_wind(label, flight, treated),
        *_times(label, flight, treated),
        *_declared(label, told),
        *_buffers(label, flight),
    ]
    return {
        "title": label.title,
        "limits": rows,
        "kept": all(row["kept"] is True for row in rows),
        "reentry_from": _reentry(label, treated, clock),
    }


def _row(name: str, limit: str, found: str, kept: bool | None) -> dict[str, Any]:
    return {"name": name, "limit": limit, "found": found, "kept": kept}


def _flown(label: LimitsFile, flight: AppliedFlight) -> Iterator[dict[str, Any]]:
    """Yield rate, speed and height while spraying."""
    spraying = while_spraying(flight)
    rates = flight.rate_l_ha[spraying]
    asked = rates[np.isfinite(rates) & (rates > 0.0)]
    width_m = flight.setup.boom.width_m
    # Of samples in which the whole boom sprays one rate the flow tells the rate that was ordered.
    even = spraying & (np.nanmin(_filled(flight.rate_l_ha), axis=1) > 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ordered = flight.flow_l_min * 1e4 / 60.0 / (flight.speed_m_s * width_m)
    for name, title, unit, values in (
        ("rate_l_ha", "prescribed rate", "L/ha", asked),
        ("rate_l_ha", "applied rate, median of full-width samples", "L/ha", _median(ordered[even])),
        ("speed_m_s", "ground speed", "m/s", flight.speed_m_s[spraying]),
        ("height_m", "height", "m", flight.height_m[spraying]),
    ):
        span = label.span(name)
        if span is None:
            continue
        known = values[np.isfinite(values)]
        limit = label.words(name, unit)
        if not len(known):
            yield _row(title, limit, "not known", None)
            continue
        outside = (known < span[0]) | (known > span[1])
        step_s = _step_s(flight) if name in ("speed_m_s", "height_m") else math.inf
        broken = bool(outside.any()) and outside.sum() * step_s > OUTSIDE_MAX_S
        text = f"{known.min():.2f} to {known.max():.2f} {unit}"
        yield _row(title, limit, text, not broken)


def _filled(rates: Floats) -> Floats:
    filled: Floats = np.where(np.isfinite(rates), rates, 0.0)
    return filled


def _median(values: Floats) -> Floats:
    known = values[np.isfinite(values)]
    return np.array([float(np.median(known))] if len(known) else [])


def _step_s(flight: AppliedFlight) -> float:
    return float(np.median(np.diff(flight.time_s))) if len(flight.time_s) > 1 else 0.0


def _wind(label: LimitsFile, flight: AppliedFlight, treated: Treated) -> Iterator[dict[str, Any]]:
    """Yield the wind that was heard while spraying; what the operator measured is declared."""
    span, series = label.span("wind_m_s"), flight.wind_m_s
    if span is None or treated.first_s is None or treated.last_s is None:
        return
    limit = label.words("wind_m_s", "m/s")
    known = np.array([])
    if series is not None:
        inside = (series.time_s >= treated.first_s) & (series.time_s <= treated.last_s)
        known = series.value[inside & is_estimate(series.value)]
    if not len(known):
        if label.wind_by == "autopilot":
            yield _row("wind", limit, "not known", None)
        return
    kept = bool(np.all((known >= span[0]) & (known <= span[1])))
    yield _row("wind", limit, f"{known.min():.1f} to {known.max():.1f} m/s", kept)
    if label.wind_by == "autopilot" and label.wind_from_deg:
        # The safety stage closes on it; the journal's samples hold no direction.
        yield _row("wind direction", "by sectors", "checked in flight", _was_checked(flight))


def _was_checked(flight: AppliedFlight) -> bool | None:
    return True if flight.setup.limits.label is not None else None


def _times(label: LimitsFile, flight: AppliedFlight, treated: Treated) -> Iterator[dict[str, Any]]:
    """Yield whether all spraying lay in the permitted days and hours, by the autopilot's clock."""
    limits = label.flown({})
    if not limits.needs_utc:
        return
    limit = label.when()
    if treated.first_s is None or treated.last_s is None or flight.utc_source != "autopilot":
        yield _row("hours", limit, "not known by the autopilot's clock", None)
        return
    ends = [each + flight.utc_offset_s for each in (treated.first_s, treated.last_s)]
    kept = limits.days_s is None or limits.days_s[0] <= ends[0] <= ends[1] < limits.days_s[1]
    if limits.hours_s:
        # Both ends in one span: a flight is shorter than what lies between two spans of a day.
        kept &= any(
            (ends[0] - first) % DAY_S <= (ends[1] - first) % DAY_S < (last - first) % DAY_S
            for first, last in limits.hours_s
        )
    yield _row("hours", limit, f"{ends[1] - ends[0]:.0f} s of spraying", kept)


def _declared(label: LimitsFile, told: Told) -> Iterator[dict[str, Any]]:
    for each in label.declared(told.values):
        if each.value is None:
            yield _row(each.name, each.words, "not declared", None)
        else:
            after = ", said after the flight" if each.key in told.after else ""
            yield _row(each.name, each.words, f"declared: {each.value}{after}", each.is_kept)


def _buffers(label: LimitsFile, flight: AppliedFlight) -> Iterator[dict[str, Any]]:
    """Yield the buffers: they are cut out of the flight map, where nothing opens."""
    is_flown = "limits.buffer" in flight.meta.get("flight_map_json", "")
    for each in label.buffer:
        text = "cut out of the flight map" if is_flown else "not in the journal"
        limit = f"{each.distance_m:g} m from {each.kind}"
        yield _row("buffer", limit, text, True if is_flown else None)


def _reentry(label: LimitsFile, treated: Treated, clock: Clock) -> str | None:
    """Return when the field may be entered again; None without a limit, or a time."""
    end = clock.at(treated.last_s)
    if label.reentry_h is None or end is None:
        return None
    return (end + timedelta(hours=label.reentry_h)).isoformat(timespec="seconds")
