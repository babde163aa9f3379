"""What label and permit ask for, as data: whether a state keeps it. `safety.py` closes if not.

Checks are written positively: NaN, missing and stale values keep nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from companion.core.types import Inhibit, VehicleState, WindReport

# Never more margin than this share of the room between two limits.
MARGIN_SHARE_MAX = 0.1
DAY_S = 86_400.0
Span = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelLimits:
    """What label and permit ask for, as far as a flight can keep it; None: no such limit.

    Spans are from least to most. `wind_from_deg` are the directions that the wind may come from,
    clockwise; `hours_s` are spans of the day (UTC), over midnight where the first is the later.
    `observed_s` is how long the weather counts that the operator observed, from when to when.
    `broken` is what the operator declared otherwise, or did not declare, before the start; what is
    declared later takes its place. `is_observed` is whether weather has to be observed at all.
    """

    speed_m_s: Span | None = None
    height_m: Span | None = None
    wind_m_s: Span | None = None
    wind_required: bool = True  # False: the operator measures it; what is heard must agree
    wind_from_deg: tuple[Span, ...] = ()
    hours_s: tuple[Span, ...] = ()
    days_s: Span | None = None  # seconds since 1970, from the first to the end of the last
    observed_s: Span | None = None  # seconds since 1970
    is_observed: bool = False
    broken: frozenset[Inhibit] = frozenset()

    @property
    def needs_utc(self) -> bool:
        """Whether the time of day has to be known."""
        return bool(self.hours_s) or self.days_s is not None or self.is_observed


def label_broken(
    state: VehicleState,
    label: LabelLimits,
    margins: Mapping[Inhibit, float],
    *,
    wind_age_max_s: float,
    now_s: float,
) -> list[Inhibit]:
    """Return which limits are not kept; those in `margins` must be kept by so much."""
    said = state.declared
    found = list(label.broken) if said is None else _named(said.broken)

    def check(reason: Inhibit, value: float | None, span: Span | None) -> None:
        if span is not None and not _is_inside(value, span, margins.get(reason, 0.0)):
            found.append(reason)

    speed_m_s = math.hypot(state.velocity_east_m_s, state.velocity_north_m_s)
    check(Inhibit.LABEL_SPEED, speed_m_s, label.speed_m_s)
    check(Inhibit.LABEL_HEIGHT, state.height_m, label.height_m)
    heard_s = state.wind_received_s
    is_young = heard_s is not None and -0.1 <= now_s - heard_s <= wind_age_max_s
    # Where the operator measures the wind, what is heard of it must agree, however old.
    counts = is_young or not label.wind_required
    if label.wind_required or state.wind_m_s is not None:
        check(Inhibit.LABEL_WIND, state.wind_m_s if counts else None, label.wind_m_s)
    if label.wind_from_deg and (label.wind_required or state.wind is not None):
        where_deg = wind_from_deg(state.wind) if counts else None
        if not is_from(where_deg, label.wind_from_deg):
            found.append(Inhibit.LABEL_WIND_DIRECTION)
    if label.needs_utc:
        utc_s = math.nan if state.utc_offset_s is None else now_s + state.utc_offset_s
        found += [] if is_hour(label, utc_s) else [Inhibit.LABEL_TIME]
        observed_s = label.observed_s if said is None else said.observed_s
        found += [] if _is_recent(observed_s, utc_s) else [Inhibit.LABEL_WEATHER_AGE]
    return found


def _named(codes: tuple[str, ...]) -> list[Inhibit]:
    """Return the reasons that are named; where none of the names is known, nothing opens either.

    >>> _named(("label-wind",)), _named(("no such",)), _named(())
    ([<Inhibit.LABEL_WIND: 'label-wind'>], [<Inhibit.LABEL_WEATHER_AGE: 'label-weather-age'>], [])
    """
    found = [reason for reason in Inhibit if reason in codes]
    return found or ([Inhibit.LABEL_WEATHER_AGE] if codes else [])


def _is_inside(value: float | None, span: Span, margin: float) -> bool:
    """Return whether a value lies a margin inside; a least of 0 is none, and has no margin."""
    low, high = span
    margin = min(margin, MARGIN_SHARE_MAX * max(high - low, 0.0))
    return value is not None and low + (margin if low > 0.0 else 0.0) <= value <= high - margin


def wind_from_deg(wind: WindReport | None) -> float | None:
    """Return where the wind comes from; None without a direction."""
    return None if wind is None else from_deg(wind.east_m_s, wind.north_m_s)


def from_deg(east_m_s: float | None, north_m_s: float | None) -> float | None:
    """Return where a wind comes from that blows there; None without a direction.

    >>> from_deg(3.0, 0.0), from_deg(0.0, 0.0)
    (270.0, None)
    """
    if east_m_s is None or north_m_s is None:
        return None
    if not 0.0 < math.hypot(east_m_s, north_m_s) < math.inf:
        return None
    return math.degrees(math.atan2(-east_m_s, -north_m_s)) % 360.0


def is_from(angle_deg: float | None, sectors: tuple[Span, ...]) -> bool:
    """Return whether a direction lies in one of the sectors, clockwise from first to last.

    >>> is_from(350.0, ((270.0, 10.0),)), is_from(11.0, ((270.0, 10.0),))
    (True, False)
    >>> is_from(11.0, ((0.0, 360.0),)), is_from(11.0, ((10.0, 10.0),))
    (True, False)
    """
    return angle_deg is not None and any(
        (angle_deg - first) % 360.0 <= (360.0 if last - first == 360.0 else (last - first) % 360.0)
        for first, last in sectors
    )


def _is_recent(span: Span | None, utc_s: float) -> bool:
    """Return whether the weather that the operator observed still counts."""
    return span is None or span[0] <= utc_s < span[1]


def is_hour(label: LabelLimits, utc_s: float) -> bool:
    """Return whether a time, in seconds since 1970, is in the label's days and hours; NaN is not.

    >>> is_hour(LabelLimits(hours_s=((3600.0, 7200.0),)), 3600.0), is_hour(LabelLimits(), math.nan)
    (True, True)
    """
    if not label.hours_s and label.days_s is None:
        return True
    if not 0.0 <= utc_s < math.inf:
        return False
    if label.days_s is not None and not label.days_s[0] <= utc_s < label.days_s[1]:
        return False
    return not label.hours_s or any(
        (utc_s - first) % DAY_S < (last - first) % DAY_S for first, last in label.hours_s
    )
