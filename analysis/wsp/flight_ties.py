"""Ties cards to a flight: what was prescribed, planned and applied where each of them lay."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.csv_rows import read_rows
from analysis.flown.applied_flight import AppliedFlight
from analysis.flown.applied_record import heading_deg
from analysis.flown.modelled_flow import pumped_ml
from analysis.wsp.results import Numbered
from companion.core.boom import Boom
from companion.core.prescription import Prescription

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
    main, better = each.card.main, each.card.better
    found = {
        "prescribed_l_ha": row["prescribed_l_ha"],
        "applied_l_ha": over.applied_l_ha,
        "deposit_l_ha": main.l_ha,
        "coverage_percent": main.coverage_percent,
        "deposits_per_cm2": main.deposits_per_cm2,
        "covered_percent": better.covered_percent,
        "drops_per_cm2": better.drops_per_cm2,
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
            "card  distance m  prescribed  on paper L/ha  cover* %  drops*/cm2",
        ]
        lines += [
            f"{row['card']:4d}  {row['distance_m']:+10.2f}  {_text(row['prescribed_l_ha'], 1):>10}"
            f"  {row['deposit_l_ha']:13.2f}  {row['covered_percent']:8.2f}"
            f"  {_text(row['drops_per_cm2'], 1):>10}"
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


# How far a place lies from the nearest change of the prescription along the track.
#
# With two or more cards about one change this shows where the deposit changed.

# Looked for so far, in such steps; a zone that is crossed in less is not noticed.
REACH_M, STEP_M = 40.0, 0.1
# The change is then halved in on to a millimetre.
_HALVINGS = 8
# Cards belong to one boundary when the boom went over it at the same time, give or take; a
# boundary that is crossed aslant lies elsewhere for each valve.
SAME_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class NearestChange:
    """The nearest change of rate; `distance_m` is how far behind it the place lies, < 0 before it.

    `before_l_ha` and `after_l_ha` are the rates on both sides in the direction of flight, None
    where nothing is prescribed.
    """

    distance_m: float
    before_l_ha: float | None
    after_l_ha: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class CardAtChange:
    """A card near a change: what was found on it, and when the boom passed."""

    card: int
    change: NearestChange
    time_s: float
    speed_m_s: float
    found: dict[str, Any]

    @property
    def crossed_s(self) -> float:
        """Return when the boom was over the change itself."""
        return self.time_s - self.change.distance_m / self.speed_m_s


def nearest_change(
    prescription: Prescription, east_m: float, north_m: float, *, course_deg: float
) -> NearestChange | None:
    """Return the nearest change of rate on the line of flight; None within 40 m."""
    course = math.radians(course_deg)
    sin, cos = math.sin(course), math.cos(course)
    along_m = np.arange(-REACH_M, REACH_M + STEP_M / 2, STEP_M)
    rates = prescription.rates_at(east_m + along_m * sin, north_m + along_m * cos)
    left, right = rates[:-1], rates[1:]
    changes = np.flatnonzero((left != right) & ~(np.isnan(left) & np.isnan(right)))
    if not len(changes):
        return None
    middle_m = (along_m[changes] + along_m[changes + 1]) / 2.0
    i = int(changes[np.argmin(np.abs(middle_m))])
    low, high = float(along_m[i]), float(along_m[i + 1])
    before = _rate(float(rates[i]))
    for _ in range(_HALVINGS):
        middle = (low + high) / 2.0
        rate = prescription.rate_at(east_m + middle * sin, north_m + middle * cos)
        low, high = (middle, high) if rate == before else (low, middle)
    return NearestChange(
        distance_m=-(low + high) / 2.0, before_l_ha=before, after_l_ha=_rate(float(rates[i + 1]))
    )


def tables(cards: Sequence[CardAtChange]) -> list[dict[str, Any]]:
    """Return, for each change with two cards or more, deposit against distance."""
    groups: list[list[CardAtChange]] = []
    for card in sorted(cards, key=lambda each: each.crossed_s):
        same = [group for group in groups if _is_same(group[-1], card)]
        if same:
            same[-1].append(card)
        else:
            groups.append([card])
    return [
        {
            "before_l_ha": group[0].change.before_l_ha,
            "after_l_ha": group[0].change.after_l_ha,
            "cards": [
                {"card": each.card, "distance_m": each.change.distance_m} | each.found
                for each in sorted(group, key=lambda each: each.change.distance_m)
            ],
        }
        for group in groups
        if len(group) > 1
    ]


def _is_same(a: CardAtChange, b: CardAtChange) -> bool:
    return (
        a.change.before_l_ha == b.change.before_l_ha
        and a.change.after_l_ha == b.change.after_l_ha
        and abs(a.crossed_s - b.crossed_s) <= SAME_S
    )


def _rate(rate: float) -> float | None:
    return rate if math.isfinite(rate) else None


# Which pass of a flight went over a place, and what was ordered and given there.
#
# All of it is from the journal: the place is the autopilot's, the applied rate what the executed
# changes of the valve stand for, after the lags of the configuration. No drift is in it.

Floats = NDArray[np.float64]

# Samples further apart than this are a gap in the record, not a piece of the path.
LONGEST_STEP_S = 1.0
# A rate of a vehicle that hardly moves is no figure.
LEAST_SPEED_M_S = 0.3
_ML_FACTOR = 60.0 / 10_000.0
# A pump's flow is followed from so long before, many of its time constants, in such steps.
PUMP_BEFORE_S, PUMP_STEP_S = 10.0, 0.01
_L_MIN_PER_ML_S = 60.0 / 1000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Passing:
    """The boom's way over a place; `valve` is the one whose strip held it, None beside the boom.

    `beside_m` is how far the place lay beside the end of the boom, 0 under it. `passes` counts
    how often the boom went over it at all, `applied_all_passes_l_ha` what all of them gave.
    """

    time_s: float
    course_deg: float
    speed_m_s: float
    height_m: float
    right_m: float
    beside_m: float
    valve: int | None
    passes: int
    planned_l_ha: float | None
    applied_l_ha: float | None
    applied_all_passes_l_ha: float | None
    inhibits: str


def passing(flight: AppliedFlight, east_m: float, north_m: float) -> Passing | None:
    """Return the pass that counts for a place; None where the boom's line never crossed it.

    A pass is where the line of the boom goes over the place from behind to before or the other
    way; of several that covered it, one that sprayed, and of those the one with the middle of the
    boom nearest to it.
    """
    at, part, right_m = _crossings(flight, east_m, north_m)
    boom = flight.setup.boom
    if not len(at):
        return None
    beside_m = np.maximum(_beyond_m(boom, right_m), 0.0)
    order = np.lexsort((np.abs(right_m), beside_m))
    covering = [each for each in order.tolist() if beside_m[each] <= 0.0]
    if not beside_m[order[0]] <= boom.width_m:
        return None
    found = [
        _passing_at(
            flight,
            int(at[each]),
            float(part[each]),
            right_m=float(right_m[each]),
            beside_m=float(beside_m[each]),
            passes=len(covering),
        )
        for each in covering or order[:1].tolist()
    ]
    best = next((each for each in found if each.applied_l_ha), found[0])
    given = [each.applied_l_ha for each in found if each.applied_l_ha is not None]
    return replace(best, applied_all_passes_l_ha=sum(given) if given else None)


def _crossings(
    flight: AppliedFlight, east_m: float, north_m: float
) -> tuple[NDArray[np.intp], Floats, Floats]:
    """Return samples before a crossing, the share of the step to it, and the offset there."""
    heading = np.deg2rad(_nose_deg(flight))
    de, dn = east_m - flight.east_m, north_m - flight.north_m
    middle_m = float(np.mean(flight.setup.boom.forward_m))
    ahead_m = de * np.sin(heading) + dn * np.cos(heading) - middle_m
    right_m = de * np.cos(heading) - dn * np.sin(heading)
    with np.errstate(invalid="ignore"):
        is_crossing = (np.sign(ahead_m[:-1]) != np.sign(ahead_m[1:])) & (
            np.diff(flight.time_s) <= LONGEST_STEP_S
        )
    # NaN (no heading) has no sign equal to another; such steps are no crossing.
    is_crossing &= np.isfinite(ahead_m[:-1]) & np.isfinite(ahead_m[1:])
    at = np.flatnonzero(is_crossing)
    # A turn on the spot sweeps the boom over far places: the path itself must go by.
    step_m = np.hypot(np.diff(flight.east_m), np.diff(flight.north_m))[at]
    at = at[step_m >= 0.5 * np.abs(ahead_m[at + 1] - ahead_m[at])]
    part = ahead_m[at] / (ahead_m[at] - ahead_m[at + 1])
    return at, part, right_m[at] + part * (right_m[at + 1] - right_m[at])


def _nose_deg(flight: AppliedFlight) -> Floats:
    """Return the nose's direction at the samples; the course stands for a heading not known."""
    known = np.isfinite(flight.heading_deg) | np.isfinite(flight.course_deg)
    return heading_deg(flight, flight.time_s) if known.any() else flight.heading_deg


def _beyond_m(boom: Boom, right_m: Floats) -> Floats:
    """Return how far places lie beyond the ends of the boom; negative under it."""
    low = float((boom.right_m - boom.half_width_m).min())
    high = float((boom.right_m + boom.half_width_m).max())
    return np.maximum(low - right_m, right_m - high)


def _passing_at(
    flight: AppliedFlight, i: int, share: float, *, right_m: float, beside_m: float, passes: int
) -> Passing:
    def between(values: Floats) -> float:
        return float(values[i] + share * (values[i + 1] - values[i]))

    near = i if share < 0.5 else i + 1
    boom = flight.setup.boom
    off_m = np.abs(right_m - boom.right_m) - boom.half_width_m
    valve = int(np.argmin(off_m))
    is_under = bool(off_m[valve] <= 1e-9)
    time_s, speed_m_s = between(flight.time_s), between(flight.speed_m_s)
    planned = float(flight.rate_l_ha[near, valve]) if is_under else float("nan")
    return Passing(
        time_s=time_s,
        course_deg=float(flight.course_deg[near]),
        speed_m_s=speed_m_s,
        height_m=between(flight.height_m),
        right_m=right_m,
        beside_m=beside_m,
        valve=valve if is_under else None,
        passes=passes,
        planned_l_ha=planned if np.isfinite(planned) else None,
        applied_l_ha=_applied_l_ha(flight, valve, time_s, speed_m_s) if is_under else None,
        applied_all_passes_l_ha=None,
        inhibits=flight.inhibits[near],
    )


def _applied_l_ha(
    flight: AppliedFlight, valve: int, time_s: float, speed_m_s: float
) -> float | None:
    """Return the rate by the valve's duty that had taken effect, the law of rate controllers."""
    if not speed_m_s >= LEAST_SPEED_M_S:
        return None
    boom = flight.setup.boom
    if flight.setup.pumping is not None:
        steps = round(PUMP_BEFORE_S / PUMP_STEP_S) + 1
        before_s = np.linspace(time_s - PUMP_BEFORE_S, time_s, steps, dtype=np.float64)
        volume_ml = pumped_ml(flight, before_s)[:, valve]
        pumped_l_min = (volume_ml[-1] - volume_ml[-2]) / PUMP_STEP_S * _L_MIN_PER_ML_S
        return float(pumped_l_min / (_ML_FACTOR * speed_m_s * boom.valves[valve].width_m))
    duties = [duty_at(flight, each, time_s) for each in range(len(boom.valves))]
    if duties[valve] <= 0.0:
        return 0.0
    open_valves = {each for each, duty in enumerate(duties) if duty > 0.0}
    sets = [each for each in flight.setup.nozzle_sets if open_valves <= set(each.valves)]
    if not sets:
        return None
    nozzles = min(sets, key=lambda each: len(each.valves))
    flow = nozzles.curve.flow_for(duties[valve]) * nozzles.share(valve) / len(nozzles.valves)
    return flow / (_ML_FACTOR * speed_m_s * boom.valves[valve].width_m)


def duty_at(flight: AppliedFlight, valve: int, time_s: float) -> float:
    """Return the duty that the liquid of a valve followed: each change after its lag."""
    changes = flight.changes
    lag = flight.setup.lag.of_valve(flight.setup.boom.valves[valve])
    own = changes.valve == valve
    planned_s, actual_s = changes.planned_s[own], changes.actual_s[own]
    ordered_s = np.where(np.isfinite(actual_s), actual_s, planned_s)
    duty = changes.duty[own]
    before = np.concatenate([[0.0], duty[:-1]])
    lag_s = np.select(
        [before <= 0.0, duty <= 0.0, duty > before], [lag.on_s, lag.off_s, lag.up_s], lag.down_s
    )
    came = np.flatnonzero(ordered_s + lag.output_s + lag_s <= time_s)
    return float(duty[came[-1]]) if len(came) else 0.0


# Where the cards lay: a table that a person wrote.


@dataclass(frozen=True, slots=True, kw_only=True)
class Position:
    """Where a card lay (WGS84), how high above the ground if that was written down, and a note."""

    card: str
    latitude_deg: float
    longitude_deg: float
    height_m: float | None = None
    note: str = ""


def read_positions(path: Path) -> list[Position]:
    """Return the rows of `card, latitude, longitude[, height][, note]`."""
    found: dict[str, Position] = {}
    for row in read_rows(path, ["card", "latitude", "longitude"]):
        card = row.text("card")
        if card is None:
            raise row.error("card is blank; give its number or the name of its file")
        if card in found:
            raise row.error(f"card {card} stands twice; each card lies in one place")
        found[card] = Position(
            card=card,
            latitude_deg=row.needed("latitude", low=-90.0, high=90.0),
            longitude_deg=row.needed("longitude", low=-180.0, high=180.0),
            height_m=row.number("height", low=-100.0, high=100.0),
            note=row.text("note") or "",
        )
    return list(found.values())


def placed(
    cards: Sequence[Numbered], positions: Sequence[Position]
) -> tuple[dict[int, Position], list[str]]:
    """Return the position of each card by its number, and what does not fit.

    A card goes by its number or by one of its names; the first position that names it holds.
    """
    names = {name: each.number for each in cards for name in reversed(each.names)}
    # Two files of one name in two folders: their common name means neither.
    for name in [name for each in cards for name in each.names[1:]]:
        if sum(name in each.names for each in cards) > 1:
            names.pop(name, None)
    places: dict[int, Position] = {}
    notes = []
    for position in positions:
        number = names.get(position.card)
        if number is None:
            notes.append(f"positions: there is no card {position.card}")
        elif number in places:
            notes.append(f"positions: {position.card} is card {number}, which has a place already")
        else:
            places[number] = position
    without = [str(each.number) for each in cards if each.number not in places]
    if without:
        notes.append(f"positions: none for card {', '.join(without)}")
    return places, notes
