"""The time from every end of a piece to every other, and to the depots."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from missions.corners import SHORT_KNOTS_M, Motion
from missions.demand import Pieces
from missions.free_space import Bools, FreeSpace
from missions.strips import Floats, directions, lengths_m

Ints = np.ndarray[tuple[int, ...], np.dtype[np.int64]]

# Ends are looked at in groups of so many: what is computed on the way stays small.
TOGETHER = 256
# So many pairs are looked at for free sight; where there are more, each end's nearest ones.
SIGHTS_MAX = 60_000
NEAR = 24
# Of more ends than these fewer are near, and times are kept to seven digits.
ENDS_MANY, NEAR_OF_MANY = 1500, 14
# Two lines of one border are flown without a stop where they meet this close and this straight:
# at 15 degrees an arc of 23 m leaves the corner by 0.2 m, and a copter of 2.5 m/s2 flies it at
# 7.6 m/s.
JOIN_M, JOIN_DEG = 0.6, 15.0
# ArduCopter begins the next leg before the end of the last one: up to such a bend as early as if it
# were none, for its waypoint's radius of 2 m lets both be 2.6 m from their common end.
SOFT_DEG = 45.0
SOFT = math.cos(math.radians((JOIN_DEG + SOFT_DEG) / 2.0))
# A way around a corner has a waypoint there: measured on plans with trees, 2.5 to 4 s for each.
BENT_S = 3.0
# Parts of one line on both sides of ground that is not sprayed, flown on without a turn.
ACROSS_M, STRAIGHT_M, ONWARD = 60.0, 0.05, 1.0 - 1e-6
# Ways as long as the straight one, but for rounding.
SAME_M = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class Network:
    """Ends 2 i and 2 i + 1 are start and end of piece i.

    `between_s` has a last row and column for the depot that is nearest to the other end, with
    half of a refill: one more landing costs the search, too, not only its ferry. `ring_s` has the
    depot twice, as the two ends of a piece.
    """

    ring_s: Floats
    near: Ints
    litres: Floats

    @property
    def between_s(self) -> Floats:
        """Return the time between ends, the depot's last."""
        return self.ring_s[:-1, :-1]

    @property
    def depot(self) -> int:
        """Return the index of the depot in `between_s`."""
        return len(self.ring_s) - 2

    @property
    def rows(self) -> list[Sequence[float]]:
        """Return the rows of `between_s` to look up one time after the other."""
        return rows_of(self.between_s)

    def put_depot_anywhere(self) -> None:
        """Leave the ways from and to the depot out: it is put where the tour begins and ends."""
        self.ring_s[self.depot :, :] = self.ring_s[:, self.depot :] = 0.0


def build_network(
    pieces: Pieces,
    space: FreeSpace,
    motion: Motion,
    *,
    home_m: Floats | None = None,
    refill_s: float = 0.0,
) -> Network:
    """Return the network; of pairs far apart that do not see each other, a lower bound.

    `home_m` are the ways from every depot to every end, shape (depots, 2 n); without them the
    depot is anywhere.
    """
    ends = pieces.ends.reshape(-1, 2)
    count = len(ends)
    # Distances become times in place: of a thousand lines 32 MB, of more half as much.
    is_large = count > ENDS_MANY
    between = np.zeros((count + 2, count + 2), dtype=np.float32 if is_large else np.float64)
    far_m = between[:count, :count]
    near = _measured(far_m, ends)
    hidden = None if space.is_convex else _bend(far_m, ends, near, space)
    near_m = np.take_along_axis(far_m, near, axis=1)
    length_m = lengths_m(pieces.ends)
    short = np.flatnonzero(np.repeat(length_m, 2) < SHORT_KNOTS_M[-1])
    short = short[:0] if is_large else short
    more_s = motion.short_s(np.repeat(length_m, 2)[short, None], far_m[short])
    for first in range(0, count, TOGETHER):
        far_m[first : first + TOGETHER] = motion.ways_s(far_m[first : first + TOGETHER])
    far_m[short] += more_s
    far_m[:, short] += more_s.T
    if hidden is not None and motion.corners != "stop":
        far_m[hidden] += BENT_S
    bend = math.cos(math.radians(soft_bend_deg(motion)))
    rows, columns = _flown_through(pieces.ends, near_m, near, bend)
    spared_s = motion.spared_straight_s(length_m[rows >> 1], length_m[columns >> 1])
    between[rows, columns] = between[columns, rows] = -spared_s
    rows, columns = _flown_on(pieces)
    across = _flown_across(ends, pieces.ends, near_m, near, bend)
    rows, columns = np.append(rows, across[0]), np.append(columns, across[1])
    along_m = np.hypot(*(ends[rows] - ends[columns]).T)
    onward_s = _onward_s(motion, length_m[rows >> 1], along_m, length_m[columns >> 1])
    between[rows, columns] = between[columns, rows] = onward_s
    _know(near, rows, columns)
    if home_m is not None:
        home_s = motion.legs_s(home_m).min(axis=0) + refill_s / 2.0
        between[count:, :count] = home_s
        between[:count, count:] = home_s[:, None]
    return Network(ring_s=between, near=near, litres=pieces.litres)


def rows_of(table: Floats) -> list[Sequence[float]]:
    """Return the rows of a table whose numbers are looked up one by one.

    Lists of lists would take four times the memory, and longer to look up.
    """
    return [memoryview(row) for row in table]


def _measured(far_m: Floats, ends: Floats) -> Ints:
    """Put in the distances between all ends; return the nearest ones of each, nearest first."""
    count = len(ends)
    own = np.arange(count)
    kept = min(NEAR if count <= ENDS_MANY else NEAR_OF_MANY, max(count - 2, 1))
    near = np.empty((count, kept), dtype=np.int64)
    for first in range(0, count, TOGETHER):
        some = own[first : first + TOGETHER]
        here = np.square(ends[some, 0][:, None] - ends[:, 0][None, :])
        here += np.square(ends[some, 1][:, None] - ends[:, 1][None, :])
        np.sqrt(here, out=here)
        far_m[some] = here
        here[some - first, some] = here[some - first, some ^ 1] = np.inf
        if count <= 2:
            near[some] = some[:, None] ^ 1
            continue
        nearest = np.argpartition(here, kept - 1, axis=1)[:, :kept]
        order = np.argsort(np.take_along_axis(here, nearest, axis=1), axis=1, kind="stable")
        near[some] = np.take_along_axis(nearest, order, axis=1)
    return near


def soft_bend_deg(motion: Motion) -> float:
    """Return up to which bend short legs are timed as if they went straight on."""
    return SOFT_DEG if motion.corners == "ardupilot" else JOIN_DEG


def _flown_through(lines: Floats, near_m: Floats, near: Ints, bend: float) -> tuple[Ints, Ints]:
    """Return pairs of ends at which a line goes on in the next so straight that none stops.

    `bend` is the cosine of what is as good as straight.
    """
    away = np.repeat(directions(lines), 2, axis=0)
    away[::2] *= -1.0  # how the line leaves at each of its ends
    rows, columns = np.repeat(np.arange(len(near)), near.shape[1]), near.ravel()
    straight = -(away[rows] * away[columns]).sum(axis=1)
    through = (near_m.ravel() < JOIN_M) & (straight > bend)
    through &= (rows >> 1) != (columns >> 1)
    return rows[through], columns[through]


def _onward_s(motion: Motion, before_m: Floats, gap_m: Floats, after_m: Floats) -> Floats:
    """Return what a gap adds between two parts of a line, both counted from rest to rest."""
    one = -motion.spared_straight_s(before_m, after_m)
    legs = motion.legs_s(gap_m) - motion.spared_straight_s(before_m, gap_m)
    two: Floats = legs - motion.spared_straight_s(gap_m, after_m)
    return np.where(gap_m < JOIN_M, one, two)


def _flown_on(pieces: Pieces) -> tuple[Ints, Ints]:
    """Return pairs of ends at which one piece of a line follows another, a gap between or not."""
    follows = np.flatnonzero(np.diff(pieces.line) == 0)
    return 2 * follows + 1, 2 * follows + 2


def _flown_across(
    ends: Floats, lines: Floats, near_m: Floats, near: Ints, bend: float
) -> tuple[Ints, Ints]:
    """Return pairs of ends at which a line goes on behind a gap.

    A low tree is a gap in its lines: straight on over it with closed valves, or other lines first.
    So is what a pass around an obstacle leaves to others, where the bends at both ends are small.
    """
    away = np.repeat(directions(lines), 2, axis=0)
    away[::2] *= -1.0
    rows, columns = np.repeat(np.arange(len(near)), near.shape[1]), near.ravel()
    way = ends[columns] - ends[rows]
    gap_m = np.hypot(*way.T)
    aside_m = np.abs(way[:, 0] * away[rows, 1] - way[:, 1] * away[rows, 0])
    ahead_m, onward_m = (way * away[rows]).sum(axis=1), -(way * away[columns]).sum(axis=1)
    across = (aside_m <= STRAIGHT_M) & (ahead_m > 0.0)
    across &= -(away[rows] * away[columns]).sum(axis=1) > ONWARD
    if bend < SOFT:
        across |= (ahead_m > bend * gap_m) & (onward_m > bend * gap_m)
    across &= (gap_m >= JOIN_M) & (gap_m <= ACROSS_M)
    across &= ((rows >> 1) != (columns >> 1)) & (near_m.ravel() < gap_m + SAME_M)
    return rows[across], columns[across]


def _know(near: Ints, rows: Ints, columns: Ints) -> None:
    """Have each of these pairs among the near ends of both, in place of the farthest."""
    for one, other in (*zip(rows, columns, strict=True), *zip(columns, rows, strict=True)):
        if other not in near[one]:
            near[one, -1] = other


def _bend(far_m: Floats, ends: Floats, near: Ints, space: FreeSpace) -> tuple[Ints, Ints] | None:
    """Put the length of the bent way where two ends do not see each other; return those pairs."""
    count = len(ends)
    if count * count <= SIGHTS_MAX:
        rows, columns = np.triu_indices(count, 1)
    else:
        rows, columns = np.repeat(np.arange(count), near.shape[1]), near.ravel()
    hidden = ~_see_each_other(ends, rows, columns, space)
    rows, columns = rows[hidden], columns[hidden]
    if not len(rows) or not len(space.corners):
        return None
    to_corners = space.to_corners_m(ends)
    bent = np.empty(len(rows))
    ordered = np.argsort(rows, kind="stable")
    for group in np.split(ordered, np.flatnonzero(np.diff(rows[ordered])) + 1):
        reach = to_corners[rows[group[0]]]
        seen = np.flatnonzero(np.isfinite(reach))
        over = np.min(reach[seen, None] + space.between_m[seen], axis=0, initial=np.inf)
        bent[group] = np.min(over + to_corners[columns[group]], axis=1)
    # No way through: far apart for the search, whatever the ferry around will cost.
    bent = np.where(np.isfinite(bent), bent, 3.0 * far_m[rows, columns] + 1000.0)
    far_m[rows, columns] = far_m[columns, rows] = bent
    pairs = np.unique(np.concatenate([rows * count + columns, columns * count + rows]))
    return pairs // count, pairs % count


def _see_each_other(ends: Floats, rows: Ints, columns: Ints, space: FreeSpace) -> Bools:
    """Return, for each pair, whether the way between is free; pairs may come both ways round."""
    low, high = np.minimum(rows, columns), np.maximum(rows, columns)
    pairs, which = np.unique(low * len(ends) + high, return_inverse=True)
    return space.sees(ends[pairs // len(ends)], ends[pairs % len(ends)])[which]
