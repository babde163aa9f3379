"""From a flight to the facts that a legal record is made of."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.report.legal_fields import Facts

if TYPE_CHECKING:
    from analysis.flown.applied_flight import AppliedFlight, Floats
    from analysis.report.treated import Clock, Treated

# Valves that were open this shortly before the journal ends were open when it was cut.
CUT_WITHIN_S = 1.5


def facts_of(
    flight: AppliedFlight,
    treated: Treated,
    clock: Clock,
    *,
    volume_l: float,
    volume_by: str,
    prescribed_l: float | None,
    unread: int = 0,
) -> Facts:
    """Return the facts; `volume_by` says in words what measured `volume_l`.

    `unread` is how many parts of the journal could not be read; they count as lost rows.
    """
    first = clock.at(treated.first_s)
    spraying = while_spraying(flight)
    latitude_deg, longitude_deg = _place(flight, treated)
    area_ha = treated.area_ha
    return Facts(
        date=None if first is None else first.date().isoformat(),
        start_time=clock.text(treated.first_s),
        end_time=clock.text(treated.last_s),
        time_zone=clock.zone_name,
        time_said=clock.source_text,
        clock_source=clock.source,
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
        area_ha=area_ha,
        volume_l=volume_l,
        volume_by=volume_by,
        mean_rate_l_ha=volume_l / area_ha if area_ha > 0.0 else None,
        asked_rate_l_ha=None
        if prescribed_l is None or not area_ha > 0.0
        else prescribed_l / area_ha,
        boom_width_m=flight.setup.boom.width_m,
        height_m=_mean(flight.height_m[spraying]),
        speed_m_s=_mean(flight.speed_m_s[spraying]),
        wind_m_s=_wind(flight, treated),
        wind_note=wind_note(flight),
        training=flight.training,
        simulated=flight.simulated,
        is_closed=flight.is_closed,
        lost_rows=flight.lost + unread,
        ends_spraying=ends_spraying(flight, treated),
        map_sha256=flight.setup.prescription.sha256,
        treated_area=treated.as_geojson(flight.setup.frame),
    )


def while_spraying(flight: AppliedFlight) -> np.ndarray:
    """Return which samples lie in spraying, by the flow that is ordered."""
    return np.asarray(flight.flow_l_min > 0.0)


def ends_spraying(flight: AppliedFlight, treated: Treated) -> bool:
    """Return whether the journal was cut while valves were open."""
    if flight.is_closed or treated.last_s is None or not len(flight.time_s):
        return False
    return bool(flight.time_s[-1] - treated.last_s <= CUT_WITHIN_S)


def _place(flight: AppliedFlight, treated: Treated) -> tuple[float | None, float | None]:
    """Return a place on the treated ground."""
    if treated.area.is_empty:
        return None, None
    point = treated.area.representative_point()
    return flight.setup.frame.to_geographic(float(point.x), float(point.y))


def _wind(flight: AppliedFlight, treated: Treated) -> float | None:
    series = flight.wind_m_s
    if series is None or treated.first_s is None or treated.last_s is None:
        return None
    inside = (series.time_s >= treated.first_s) & (series.time_s <= treated.last_s)
    return _mean(series.value[inside & is_estimate(series.value)])


def is_estimate(wind_m_s: Floats) -> NDArray[np.bool_]:
    """Return which winds are estimates: not exactly 0, and not the same as the one before.

    The companion says so itself now; journals of before hold what the autopilot told.
    """
    moves = np.concatenate(([False], wind_m_s[1:] != wind_m_s[:-1]))
    return np.asarray(np.isfinite(wind_m_s) & (wind_m_s != 0.0) & moves)


def wind_note(flight: AppliedFlight) -> str:
    """Return that the autopilot told winds and knew none; empty where it told none, or knew it."""
    series = flight.wind_m_s
    if series is None or is_estimate(series.value).any():
        return ""
    return "the wind in flight is not known: the autopilot told exactly 0, or always the same"


def _mean(values: Floats) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else None
