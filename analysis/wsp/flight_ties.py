"""Ties cards to a flight: what was prescribed, planned and applied where each of them lay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from analysis.flown.applied_flight import AppliedFlight
from analysis.wsp.boundaries import CardAtChange, nearest_change, tables
from analysis.wsp.passing import LEAST_SPEED_M_S, passing
from analysis.wsp.positions import Position
from analysis.wsp.results import Numbered

Row = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Ties:
    """What the flight says of each card by its number, and deposit against distance."""

    rows: dict[int, Row]
    boundaries: list[Row]


def tie(flight: AppliedFlight, cards: Sequence[Numbered], places: Mapping[int, Position]) -> Ties:
    """Return the ties of all cards that have a place."""
    rows: dict[int, Row] = {}
    near: list[CardAtChange] = []
    for each in cards:
        place = places.get(each.number)
        if place is None:
            continue
        rows[each.number], at_change = _tie(flight, each, place)
        if at_change is not None:
            near.append(at_change)
    return Ties(rows=rows, boundaries=tables(near))


def _tie(flight: AppliedFlight, each: Numbered, place: Position) -> tuple[Row, CardAtChange | None]:
    setup = flight.setup
    east_m, north_m = setup.frame.to_local(place.latitude_deg, place.longitude_deg)
    row: Row = {"prescribed_l_ha": setup.prescription.rate_at(east_m, north_m)}
    over = passing(flight, east_m, north_m)
    if over is None:
        return row | {"passed": False}, None
    change = nearest_change(setup.prescription, east_m, north_m, course_deg=over.course_deg)
    row |= {
        "passed": over.valve is not None,
        "passes": over.passes,
        "time_s": over.time_s,
        "time": utc_text(over.time_s + flight.utc_offset_s),
        "utc_source": flight.utc_source,
        "valve": None if over.valve is None else setup.boom.valves[over.valve].name,
        "right_m": over.right_m,
        "beside_m": over.beside_m,
        "planned_l_ha": over.planned_l_ha,
        "applied_l_ha": over.applied_l_ha,
        "applied_all_passes_l_ha": over.applied_all_passes_l_ha,
        "speed_m_s": over.speed_m_s,
        "course_deg": over.course_deg,
        "height_m": over.height_m,
        "inhibits": over.inhibits,
        "boundary_m": None if change is None else change.distance_m,
        "before_l_ha": None if change is None else change.before_l_ha,
        "after_l_ha": None if change is None else change.after_l_ha,
    }
    if change is None or not over.speed_m_s >= LEAST_SPEED_M_S:
        return row, None
    main = each.card.main
    found = {
        "prescribed_l_ha": row["prescribed_l_ha"],
        "applied_l_ha": over.applied_l_ha,
        "deposit_l_ha": main.l_ha,
        "coverage_percent": main.coverage_percent,
        "deposits_per_cm2": main.deposits_per_cm2,
        "drops_per_cm2": each.card.better.drops_per_cm2,
    }
    return row, CardAtChange(
        card=each.number,
        change=change,
        time_s=over.time_s,
        speed_m_s=over.speed_m_s,
        found=found,
    )


def utc_text(since_1970_s: float) -> str:
    """Return a time as ISO 8601 in UTC, to the millisecond.

    >>> utc_text(0.25)
    '1970-01-01T00:00:00.250Z'
    """
    at = datetime.fromtimestamp(since_1970_s, UTC)
    return at.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def tie_lines(ties: Ties) -> list[str]:
    """Return the ties for a person."""
    lines = ["", "card  prescribed  planned  applied  speed  height  boundary  passed at (UTC)"]
    lines += [_line(number, row) for number, row in ties.rows.items()]
    for table in ties.boundaries:
        before, after = _text(table["before_l_ha"], 1), _text(table["after_l_ha"], 1)
        lines += [
            "",
            f"deposit against distance from the change {before} -> {after} L/ha "
            "(negative: before it)",
            "card  distance m  prescribed  on paper L/ha  cover %  depos./cm2",
        ]
        lines += [
            f"{row['card']:4d}  {row['distance_m']:+10.2f}  {_text(row['prescribed_l_ha'], 1):>10}"
            f"  {row['deposit_l_ha']:13.2f}  {row['coverage_percent']:7.2f}"
            f"  {row['deposits_per_cm2']:10.1f}"
            for row in table["cards"]
        ]
    return lines


def _line(number: int, row: Row) -> str:
    if "time" not in row:
        return f"{number:4d}  {_text(row['prescribed_l_ha'], 1):>10}  no pass of the flight is near"
    where = row["time"] if row["passed"] else f"{row['time']}, {row['beside_m']:.1f} m beside"
    return (
        f"{number:4d}  {_text(row['prescribed_l_ha'], 1):>10}  {_text(row['planned_l_ha'], 1):>7}"
        f"  {_text(row['applied_l_ha'], 1):>7}  {row['speed_m_s']:5.2f}  {row['height_m']:6.1f}"
        f"  {_text(row['boundary_m'], 2):>8}  {where}"
    )


def _text(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
