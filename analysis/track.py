"""The true path of one valve's strip over the ground, and what it dropped along it.

All arrays are sampled at even steps; a period need not be a whole number of steps. Beyond its
ends an array keeps its last value.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import shapely
from numpy.typing import NDArray

from companion.core.options.lines import MOVING_M_S

if TYPE_CHECKING:
    from collections.abc import Iterator

    from analysis.flight_record import FlightRecord
    from companion.core.options.lines import Lines
    from companion.core.prescription import Prescription

# --------------------------------------------------------------------------- means over PWM periods

Floats = NDArray[np.float64]


def shifted(values: Floats, steps: float) -> Floats:
    """Return `values` as they are `steps` later (earlier if negative), between samples linear.

    >>> shifted(np.array([0.0, 1.0, 2.0, 3.0]), 0.5).tolist()
    [0.5, 1.5, 2.5, 3.0]
    """
    whole = math.floor(steps)
    part = steps - whole
    last = len(values) - 1
    moved = np.empty(len(values) + 1)
    # What lies beyond an end, then the array itself: slices are quicker than an index of each.
    before = min(max(-whole, 0), len(moved))
    moved[:before] = values[0]
    kept = values[max(whole, 0) : max(whole, 0) + len(moved) - before]
    moved[before : before + len(kept)] = kept
    moved[before + len(kept) :] = values[last]
    mixed: Floats = moved[:-1] * (1.0 - part)
    moved *= part
    mixed += moved[1:]
    return mixed


def rise_over(values: Floats, steps: float) -> Floats:
    """Return by how much `values` rise over `steps` centred at each sample."""
    found = shifted(values, steps / 2)
    found -= shifted(values, -steps / 2)
    return found


def boxed(values: Floats, steps: float) -> Floats:
    """Return the centred mean of `values` over `steps`, exact for lines and short of the ends."""
    half = math.ceil(steps / 2) + 1
    padded = np.concatenate((np.full(half, values[0]), values, np.full(half, values[-1])))
    padded -= values[0]
    pairs = padded[1:] + padded[:-1]
    pairs *= 0.5
    integral = np.zeros(len(padded))
    np.cumsum(pairs, out=integral[1:])
    smooth: Floats = rise_over(integral, steps)[half:-half] / steps
    smooth += values[0]
    return smooth


def smoothed(values: Floats, steps: float) -> Floats:
    """Return the mean over a triangle of two periods: twice the mean over one.

    Once is enough when the pulses keep the nominal period. After a restart the period is up to
    10 % off until the stagger is back; one mean then leaves 10 % of the ripple, two leave 1 %.
    """
    return boxed(boxed(values, steps), steps)


# ---------------------------------------------------------------------------------------- the track

# When a true path flew a planned line: from one of its ends to the other, or to a stop.
#
# What is off the lines was not to be sprayed: nothing is missed there, and what falls is off
# target. The controller has to tell at once; here the whole path is known. A visit of a line
# comes by the end behind it and goes by the one ahead, or by a stop. An autopilot that cuts
# corners is on the line some metres late and leaves it as much early; who drifts across, ever so
# slowly, does not fly it.

# The path is looked at so often: every 0.1 m at 10 m/s.
LOOK_S = 0.01
# The true speed is a mean over this time: it has no noise, but steps of rounding.
SPEED_OVER_S = 0.05
# A visit that begins and ends this near to the line's ends, or so slowly, is a whole one.
END_M = 1.0
STOPPED_M_S = 1.0
# Who turns off sooner has followed the line until then. Autopilots turn within this of a waypoint
# (ArduPilot's WPNAV_RADIUS is at most 10 m, PX4's NAV_ACC_RAD is 10 m), but not for most of a line.
TURN_M = 10.0
TURN_SHARE = 0.25
# Following it is to be as far aside after three quarters of the visit as after one, or nearly: who
# drifts from one edge of the tolerance to the other moves by a whole tolerance in between.
# Of a line that was to be sprayed a part may have no rate.
FERRY_SHARE = 0.9
FOLLOWS_SHARE = 0.75


class Visit(NamedTuple):
    """A piece of a line, by its number, and from when until when it is flown."""

    piece: int
    start_s: float
    end_s: float


class PlannedLines:
    """A true path and the lines that it was to spray on."""

    def __init__(self, record: FlightRecord, lines: Lines) -> None:
        self._pieces = np.array(lines.pieces)
        self._reach_m = lines.aside_m + max(
            abs(valve.right_m) + 0.5 * valve.width_m for valve in record.boom.valves
        )
        visits = _visits(record, lines, self._pieces)
        self.visits = [each for each in visits if not _is_ferry(each, record)]

    def flown(self, time_s: Floats, east_m: Floats, north_m: Floats) -> Bools:
        """Return when a line is flown, and a point of the boom is between that line's ends."""
        found = np.zeros(len(time_s), dtype=np.bool_)
        for visit in self.visits:
            at = np.flatnonzero((visit.start_s <= time_s) & (time_s <= visit.end_s))
            _, x0, y0, ue, un, length, before, after = self._pieces[visit.piece]
            along = ue * (east_m[at] - x0) + un * (north_m[at] - y0)
            found[at[(-before <= along) & (along <= length + after)]] = True
        return found

    def ways(self, record: FlightRecord) -> Iterator[shapely.LineString]:
        """Yield each visit's part of its line: all of it, but for what it stopped short of.

        An autopilot cuts corners, and leaves the end of a line to be flown: it was to be treated.
        """
        for visit in self.visits:
            _, x0, y0, ue, un, length, _, _ = self._pieces[visit.piece]
            ends_s = (visit.start_s, visit.end_s)
            x, y = (
                np.interp(ends_s, record.time_s, each) for each in (record.east_m, record.north_m)
            )
            low, high = sorted((ue * (x - x0) + un * (y - y0)).tolist())
            low, high = low if low > TURN_M else 0.0, high if high < length - TURN_M else length
            yield shapely.LineString([(x0 + ue * m, y0 + un * m) for m in (low, high)])

    @property
    def ground(self) -> shapely.Geometry:
        """Return the ground of all lines, flown or not, as far aside as one counts as flown."""
        _, x0, y0, ue, un, length, _, _ = self._pieces.T
        ends = np.column_stack([x0, y0, x0 + ue * length, y0 + un * length]).reshape(-1, 2, 2)
        strips = shapely.buffer(shapely.linestrings(ends), self._reach_m, cap_style="flat")
        return shapely.union_all(strips)


def _is_ferry(visit: Visit, record: FlightRecord) -> bool:
    """Return whether the way led along a line that it was not to spray, as of another sortie."""
    start_s, end_s = visit.start_s, visit.end_s
    idle_s = sum(max(min(b, end_s) - max(a, start_s), 0.0) for a, b in record.ferried)
    return idle_s > FERRY_SHARE * (end_s - start_s)


def _visits(record: FlightRecord, lines: Lines, pieces: Floats) -> list[Visit]:
    """Return all visits of pieces that were whole ones."""
    every = max(round(LOOK_S / record.step_s), 1)
    steps = max(SPEED_OVER_S / record.step_s, 1.0)
    place = np.column_stack([record.east_m, record.north_m])
    velocity = np.column_stack(
        [rise_over(values, steps) / (steps * record.step_s) for values in place.T]
    )[::every]
    place, time_s = place[::every], record.time_s[::every]
    speed = np.hypot(*velocity.T)
    _, x0, y0, ue, un, length, _, _ = pieces.T
    ends = np.column_stack([x0, y0, x0 + ue * length, y0 + un * length]).reshape(-1, 2, 2)
    tree = shapely.STRtree(np.asarray(shapely.linestrings(ends)))
    reach_m = lines.aside_m + record.boom.reach_m
    row, number = tree.query(shapely.points(place), predicate="dwithin", distance=reach_m)
    _, x0, y0, ue, un, length, _, _ = pieces[number].T
    x, y = place[row, 0] - x0, place[row, 1] - y0
    across = ue * y - un * x
    pace = ue * velocity[row, 0] + un * velocity[row, 1]
    holds = (
        (speed[row] > MOVING_M_S)
        & (np.abs(pace) >= speed[row] * np.cos(np.radians(lines.course_deg)))
        & (np.abs(across) <= lines.aside_m)
    )
    # From the end that lies behind, in the direction of flight.
    along = ue * x + un * y
    along = np.where(pace > 0.0, along, length - along)
    # The record's own ends are as good as stops.
    is_stop = (speed[row] <= STOPPED_M_S) | (row == 0) | (row == len(time_s) - 1)
    found = []
    row, number, across, along, length, is_stop = (
        each[holds] for each in (row, number, across, along, length, is_stop)
    )
    order = np.lexsort((row, number))
    row, number, across, along, length, is_stop = (
        each[order] for each in (row, number, across, along, length, is_stop)
    )
    cuts = np.flatnonzero((np.diff(number) != 0) | (np.diff(row) != 1)) + 1
    for first, last in zip([0, *cuts], [*(cuts - 1), len(row) - 1], strict=True):
        if not len(row):
            break
        quarter = (last - first) // 4
        aside_m = abs(float(across[last - quarter] - across[first + quarter]))
        end_m = END_M
        if aside_m <= FOLLOWS_SHARE * lines.aside_m:
            end_m = max(END_M, min(TURN_M, TURN_SHARE * length[first]))
        comes = is_stop[first] or along[first] <= end_m
        goes = is_stop[last] or along[last] >= length[last] - end_m
        if comes and goes:
            found.append(
                Visit(int(number[first]), float(time_s[row[first]]), float(time_s[row[last]]))
            )
    return found


Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

MARK_SPACING_M = 0.09
# A path is looked at in pieces of so many points: 1.4 m, where they are `MARK_SPACING_M` apart. Far
# from the border one says it for all, as far as they are this near to the middle one.
PIECE = 16
PIECE_REACH_M = 1.0
# For fewer pieces it takes longer than to ask for every point.
PIECES_FROM = 64
# A strip's ends may touch the border: tiled strips do, and arithmetic is not exact.
TOUCH_M = 0.001


class Places(NamedTuple):
    """Where a strip's centre is at some times, and how the strip lies there."""

    time_s: Floats
    east_m: Floats
    north_m: Floats
    heading_rad: Floats

    def beside(self, right_m: float) -> tuple[Floats, Floats]:
        """Return east and north of the strip's point `right_m` of its centre."""
        return (
            self.east_m + np.cos(self.heading_rad) * right_m,
            self.north_m - np.sin(self.heading_rad) * right_m,
        )

    def some(self, which: Ints) -> Places:
        """Return some of the places."""
        return Places(*(values[which] for values in self))


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """One strip: its centre's path, the along-track distance, its volume.

    `across_m` is the strip's width across the motion. `marks` are samples between which no point
    of the strip moves by more than about 0.1 m (or one step, where a step is longer).
    """

    valve: int
    width_m: float
    step_s: float
    period_s: float
    time_s: Floats
    east_m: Floats
    north_m: Floats
    heading_rad: Floats
    distance_m: Floats
    speed_m_s: Floats
    across_m: Floats
    volume_ml: Floats
    marks: Ints
    planned: PlannedLines | None = None

    @property
    def period_steps(self) -> float:
        """Return the PWM period in samples."""
        return self.period_s / self.step_s

    def at(self, values: Floats, time_s: Floats) -> Floats:
        """Return one of the arrays at any times."""
        return np.interp(time_s, self.time_s, values)

    def value(self, values: Floats, time_s: float) -> float:
        """Return one of the arrays at one time."""
        last = len(values) - 1
        where = min(max((time_s - self.time_s.item(0)) / self.step_s, 0.0), float(last))
        i = min(int(where), last - 1)
        low = values.item(i)
        return low + (values.item(i + 1) - low) * (where - i)

    def each_value(self, values: Floats, time_s: Floats) -> Floats:
        """Return `value` at each of many times, to the bit."""
        last = len(values) - 1
        where = np.minimum(np.maximum((time_s - self.time_s[0]) / self.step_s, 0.0), float(last))
        i = np.minimum(where.astype(np.int64), last - 1)
        low = values[i]
        found: Floats = low + (values[i + 1] - low) * (where - i)
        return found

    def sample(self, time_s: float) -> int:
        """Return the sample at or just before a time."""
        where = (time_s - self.time_s.item(0)) / self.step_s
        return int(min(max(where, 0.0), len(self.time_s) - 1.0))

    def samples(self, time_s: Floats) -> Ints:
        """Return `sample` of each of many times."""
        where = (time_s - self.time_s[0]) / self.step_s
        found: Ints = np.minimum(np.maximum(where, 0.0), len(self.time_s) - 1.0).astype(np.int64)
        return found

    def places(self, time_s: Floats) -> Places:
        """Return the places at any times."""
        values = (self.at(each, time_s) for each in (self.east_m, self.north_m, self.heading_rad))
        return Places(time_s, *values)

    def marked(self) -> Places:
        """Return the places at all marks."""
        return self.sampled(self.marks)

    def sampled(self, which: Ints) -> Places:
        """Return the places at samples: nothing is to be sought."""
        values = (self.time_s, self.east_m, self.north_m, self.heading_rad)
        return Places(*(each[which] for each in values))

    def wholly_inside(
        self, prescription: Prescription, places: Places, *, widen_m: float = -TOUCH_M
    ) -> Bools:
        """Return where the whole strip, widened at both ends, lies in the field."""
        half_m = max(0.5 * self.width_m + widen_m, 0.25 * self.width_m)
        if len(places.time_s) < PIECES_FROM * PIECE:
            inside = np.zeros(len(places.time_s), dtype=np.bool_)
            asked = np.arange(len(inside))
        else:
            inside, asked = _inside_by_pieces(prescription, places, half_m)
        deep = sure_field(prescription, half_m)
        inside[asked] = shapely.contains_xy(deep, places.east_m[asked], places.north_m[asked])
        doubtful = asked[~inside[asked]]
        # Of a strip whose middle is outside nobody has to look at the ends: half of a flight turns.
        near = places.some(doubtful)
        middle_inside = in_field(prescription, near.east_m, near.north_m)
        doubtful, near = doubtful[middle_inside], near.some(np.flatnonzero(middle_inside))
        if len(doubtful):
            left, right = near.beside(-half_m), near.beside(half_m)
            ends = np.stack((np.stack(left, axis=-1), np.stack(right, axis=-1)), axis=1)
            shapely.prepare(prescription.field)
            inside[doubtful] = shapely.contains_properly(
                prescription.field, shapely.linestrings(ends)
            )
        return inside & self.on_line(places)

    def on_line(self, places: Places) -> Bools:
        """Return where the strip's centre is on a planned line; always, where there are none."""
        if self.planned is None:
            return np.ones(len(places.time_s), dtype=np.bool_)
        return self.planned.flown(places.time_s, places.east_m, places.north_m)


def _inside_by_pieces(
    prescription: Prescription, places: Places, half_m: float
) -> tuple[Bools, Ints]:
    """Return which places are `half_m` inside the field, and those that are to be asked for.

    Far from the border one place says it for a whole piece of a path.
    """
    count = len(places.time_s) // PIECE
    inside = np.zeros(len(places.time_s), dtype=np.bool_)
    east_m, north_m = (
        each[: count * PIECE].reshape(count, PIECE) for each in (places.east_m, places.north_m)
    )
    middle_e, middle_n = east_m[:, PIECE // 2], north_m[:, PIECE // 2]
    away = (east_m - middle_e[:, np.newaxis]) ** 2 + (north_m - middle_n[:, np.newaxis]) ** 2
    is_short = away.max(axis=1, initial=0.0) <= PIECE_REACH_M**2
    within = shapely.contains_xy(
        sure_field(prescription, half_m + PIECE_REACH_M), middle_e, middle_n
    )
    beyond = ~shapely.contains_xy(sure_field(prescription, -PIECE_REACH_M), middle_e, middle_n)
    inside[: count * PIECE] = np.repeat(is_short & within, PIECE)
    asked = np.ones(len(inside), dtype=np.bool_)
    asked[: count * PIECE] = np.repeat(~(is_short & (within | beyond)), PIECE)
    return inside, np.flatnonzero(asked)


_SURE: WeakKeyDictionary[Prescription, dict[float, shapely.Geometry]] = WeakKeyDictionary()


def sure_field(prescription: Prescription, half_m: float) -> shapely.Geometry:
    """Return ground on which a strip of half that width lies in the field, however it is turned.

    Somewhat less than all of it: arcs are made of chords. Of less than 0 it is all ground that is
    so near to the field, and somewhat more.
    """
    known = _SURE.setdefault(prescription, {})
    found = known.get(half_m)
    if found is None:
        by_m = -1.01 * half_m - (0.005 if half_m >= 0.0 else -0.005)
        found = known[half_m] = shapely.buffer(prescription.field, by_m)
        shapely.prepare(found)
    return found


def in_field(prescription: Prescription, east_m: Floats, north_m: Floats) -> Bools:
    """Return which points lie in the field; fast on very many."""
    shapely.prepare(prescription.field)
    return np.asarray(shapely.contains_xy(prescription.field, east_m, north_m), dtype=np.bool_)


def tracks_of(record: FlightRecord) -> list[Track]:
    """Return the tracks of all valves, left to right."""
    planned = None if record.lines is None else PlannedLines(record, record.lines)
    heading = np.unwrap(np.radians(record.heading_deg))
    axes = (heading, np.sin(heading), np.cos(heading))
    return [_track(record, valve, axes, planned) for valve in range(len(record.boom.valves))]


def _track(
    record: FlightRecord,
    number: int,
    axes: tuple[Floats, Floats, Floats],
    planned: PlannedLines | None,
) -> Track:
    valve = record.boom.valves[number]
    heading, sin, cos = axes
    east_m = record.east_m + sin * valve.forward_m + cos * valve.right_m
    north_m = record.north_m + cos * valve.forward_m - sin * valve.right_m
    move_e, move_n = np.diff(east_m), np.diff(north_m)
    moved_m = np.hypot(move_e, move_n)
    distance_m = np.concatenate(([0.0], np.cumsum(moved_m)))
    steps = record.pwm_period_s / record.step_s
    run_e, run_n = rise_over(east_m, steps), rise_over(north_m, steps)
    run_m = np.hypot(run_e, run_n)
    along = np.divide(
        np.abs(run_e * sin + run_n * cos), run_m, out=np.ones_like(run_m), where=run_m > 1e-6
    )
    turned_m = 0.5 * valve.width_m * np.abs(np.diff(heading))
    travel_m = np.concatenate(([0.0], np.cumsum(moved_m + turned_m)))
    return Track(
        valve=number,
        width_m=valve.width_m,
        step_s=record.step_s,
        period_s=record.pwm_period_s,
        time_s=record.time_s,
        east_m=east_m,
        north_m=north_m,
        heading_rad=heading,
        distance_m=distance_m,
        speed_m_s=rise_over(distance_m, steps) / record.pwm_period_s,
        across_m=valve.width_m * along,
        volume_ml=np.ascontiguousarray(record.volume_ml[:, number]),
        marks=_marks(travel_m),
        planned=planned,
    )


def _marks(travel_m: Floats) -> Ints:
    """Return samples at most `MARK_SPACING_M` and one step apart, both ends among them."""
    marks = np.flatnonzero(np.diff(np.floor(travel_m / MARK_SPACING_M))) + 1
    both = np.concatenate(([0], marks, [len(travel_m) - 1]))
    return both[np.diff(both, prepend=-1) > 0].astype(np.int64)
