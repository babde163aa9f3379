"""When a true path flew a planned line: from one of its ends to the other, or to a stop.

What is off the lines was not to be sprayed: nothing is missed there, and what falls is off target.
The controller has to tell at once; here the whole path is known. A visit of a line comes by the end
behind it and goes by the one ahead, or by a stop. An autopilot that cuts corners is on the line
some metres late and leaves it as much early; who drifts across, ever so slowly, does not fly it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from analysis.smoothing import rise_over
from companion.core.lines import MOVING_M_S

if TYPE_CHECKING:
    from analysis.flight_record import FlightRecord
    from companion.core.lines import Lines

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

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
        self.visits = _visits(record, lines, self._pieces)

    def flown(self, time_s: Floats, east_m: Floats, north_m: Floats) -> Bools:
        """Return when a line is flown, and a point of the boom is between that line's ends."""
        found = np.zeros(len(time_s), dtype=np.bool_)
        for visit in self.visits:
            at = np.flatnonzero((visit.start_s <= time_s) & (time_s <= visit.end_s))
            _, x0, y0, ue, un, length, before, after = self._pieces[visit.piece]
            along = ue * (east_m[at] - x0) + un * (north_m[at] - y0)
            found[at[(-before <= along) & (along <= length + after)]] = True
        return found


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
