"""Whether a flight kept each limit of its label and permit, from its journal alone.

`kept` is true, false, or None where the journal does not tell. What the operator declared before
the flight counts as declared; what was said afterwards is marked where the record is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from analysis.report.legal_fields import is_estimate, while_spraying
from companion.config.limits import WATCH_S, LimitsFile, limits_of
from companion.core.label import DAY_S, LabelLimits, is_from

if TYPE_CHECKING:
    from analysis.assess.ground import Treated
    from analysis.flown.applied_flight import AppliedFlight, Floats, Series
    from analysis.report.clock import Clock
    from analysis.report.legal_fields import Told

# Less of the spraying than this outside is noise of a filter, not a limit that was broken.
OUTSIDE_MAX_S = 0.2
# A wind is reported at 1 Hz and more, and closes the valves once it is too old.
UNKNOWN_MAX_S = 1.0


def label_of(
    flight: AppliedFlight, treated: Treated, clock: Clock, told: Told
) -> dict[str, Any] | None:
    """Return each limit of the journal's label, kept or broken; None where it has none."""
    label = limits_of(flight.meta)
    if label is None:
        return None
    rows = [
        *_flown(label, flight),
        *_wind(label, flight),
        *_times(label, flight, treated, told),
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


def _wind(label: LimitsFile, flight: AppliedFlight) -> Iterator[dict[str, Any]]:
    """Yield the wind as it was known while spraying; what the operator measured is declared.

    A wind outside that closed the valves was kept, so only samples with flow count.
    """
    span, by_autopilot = label.span("wind_m_s"), label.wind_by == "autopilot"
    if span is not None:
        known = _while_open(flight, flight.wind_m_s)
        outside = ~((known >= span[0]) & (known <= span[1])) & np.isfinite(known)
        yield from _blown(
            "wind", label.words("wind_m_s", "m/s"), "m/s", known, outside,
            flight=flight, must=by_autopilot,
        )  # fmt: skip
    if label.wind_from_deg:
        known = _while_open(flight, flight.wind_from_deg)
        outside = np.array([
            math.isfinite(each) and not is_from(each, label.wind_from_deg)
            for each in known.tolist()
        ], dtype=bool)  # fmt: skip
        yield from _blown(
            "wind direction", label.wind_words(), "deg", known, outside,
            flight=flight, must=by_autopilot,
        )  # fmt: skip


def _while_open(flight: AppliedFlight, series: Series | None) -> Floats:
    """Return what was known of a wind at each sample with flow; NaN where nothing was.

    A change closes the valves a step later, and the samples show that; what the autopilot repeats
    is no estimate, except shortly after one.
    """
    at_s = flight.time_s[while_spraying(flight)]
    if series is None or flight.wind_m_s is None:
        return np.full(len(at_s), np.nan)
    sound = is_estimate(flight.wind_m_s.value) & np.isfinite(series.value)
    time_s, value = series.time_s[sound], series.value[sound]
    if not len(time_s):
        return np.full(len(at_s), np.nan)
    index = np.searchsorted(time_s, at_s - OUTSIDE_MAX_S, side="right") - 1
    age_s = at_s - time_s[np.maximum(index, 0)]
    age_max_s = flight.setup.limits.wind_age_max_s + OUTSIDE_MAX_S
    found: Floats = np.where((index >= 0) & (age_s <= age_max_s), value[index], np.nan)
    return found


def _blown(
    name: str,
    limit: str,
    unit: str,
    known: Floats,
    outside: NDArray[np.bool_],
    *,
    flight: AppliedFlight,
    must: bool,
) -> Iterator[dict[str, Any]]:
    heard = known[np.isfinite(known)]
    if not len(heard):
        if must:
            yield _row(name, limit, "not known", None)
        return
    text = f"{heard.min():.1f} to {heard.max():.1f} {unit}"
    if outside.sum() * _step_s(flight) > OUTSIDE_MAX_S:
        yield _row(name, limit, text, kept=False)
    elif must and (~np.isfinite(known)).sum() * _step_s(flight) > UNKNOWN_MAX_S:
        yield _row(name, limit, f"{text}, not known all the time", None)
    else:
        yield _row(name, limit, text, kept=True)


def _times(
    label: LimitsFile, flight: AppliedFlight, treated: Treated, told: Told
) -> Iterator[dict[str, Any]]:
    """Yield whether all spraying lay in the permitted days and hours, by the autopilot's clock."""
    limits = label.flown(told.values)
    ends: tuple[float, float] | None = None
    is_dated = treated.first_s is not None and flight.utc_source == "autopilot"
    if is_dated and treated.first_s is not None and treated.last_s is not None:
        ends = treated.first_s + flight.utc_offset_s, treated.last_s + flight.utc_offset_s
    unknown = "not known by the autopilot's clock"
    if limits.hours_s or limits.days_s is not None:
        if ends is None:
            yield _row("hours", label.when(), unknown, None)
        else:
            text = f"{ends[1] - ends[0]:.0f} s from {_clock_text(ends[0])} UTC"
            yield _row("hours", label.when(), text, _in_hours(limits, ends))
    words = f"at most {label.observed_max_h:g} h before spraying"
    for begin_s, end_s, values in _periods(told):
        observed_s = label.flown(values).observed_s
        sprayed = ends and _sprayed(flight, begin_s, end_s)
        if observed_s is not None and ends is None:
            yield _row("age of the weather", words, unknown, None)
        elif observed_s is not None and sprayed:
            age_h = (sprayed[1] - observed_s[0] - WATCH_S) / 3600.0
            kept = observed_s[0] <= sprayed[0] <= sprayed[1] < observed_s[1]
            yield _row("age of the weather", words, f"{age_h:.1f} h at the end", kept)


def _periods(told: Told) -> Iterator[tuple[float, float, Mapping[str, Any]]]:
    """Yield from when to when which values were declared."""
    begins = [at_s for at_s, _ in told.periods]
    for (begin_s, values), end_s in zip(told.periods, [*begins[1:], math.inf], strict=True):
        yield begin_s, end_s, values


def _sprayed(flight: AppliedFlight, begin_s: float, end_s: float) -> tuple[float, float] | None:
    """Return first and last of the spraying between two times, in seconds since 1970."""
    open_s = flight.time_s[while_spraying(flight)]
    within = open_s[(open_s >= begin_s) & (open_s < end_s)]
    if not len(within):
        return None
    return float(within[0]) + flight.utc_offset_s, float(within[-1]) + flight.utc_offset_s


def _clock_text(utc_s: float) -> str:
    return datetime.fromtimestamp(utc_s, tz=UTC).strftime("%Y-%m-%d %H:%M")


def _in_hours(limits: LabelLimits, ends: tuple[float, float]) -> bool:
    """Return whether a flight from one end to the other lay in the days, and in one span of hours.

    A flight is shorter than what lies between two spans of a day.
    """
    kept = limits.days_s is None or limits.days_s[0] <= ends[0] <= ends[1] < limits.days_s[1]
    return kept and (
        not limits.hours_s
        or any(
            (ends[0] - first) % DAY_S <= (ends[1] - first) % DAY_S < (last - first) % DAY_S
            for first, last in limits.hours_s
        )
    )


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
