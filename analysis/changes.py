"""Where the prescription changes under a strip: runs of one zone, stretches of one rate, changes.

Found on the true path, not on what the controller believed.

Zones are looked up under very many points, and where along a path nothing can change, as
`Prescription.zones_at` has it but without a set for every point.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import STRtree

from analysis.track import PIECE, Bools, Floats, Places, Track, in_field
from companion.core.cells import NO_RATE

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from companion.core.prescription import Prescription

Ints = NDArray[np.int64]
# Numbers of points or lines, and of parts of zones: each time one of either.
Pairs = tuple[Ints, Ints]

# Points this near to an edge are looked at one by one: arithmetic is not exact.
NEAR_M = 0.002


class ZoneLookup:
    """Numbers for the sets of zones that occur: 0 for none, then each zone, then several."""

    def __init__(self, prescription: Prescription) -> None:
        self._cells = prescription.cells
        self._edges = prescription.edges
        self._count = prescription.zone_count
        self._several: dict[frozenset[int], int] = {}
        zones = () if self._cells is not None else prescription.zones
        # A list of no polygons would be one of numbers.
        polygons = np.empty(len(zones), dtype=object)
        polygons[:] = [zone.polygon for zone in zones]
        self._parts, self._owner = shapely.get_parts(polygons, return_index=True)
        shapely.prepare(self._parts)
        self._tree = STRtree(self._parts)
        ends = self._edges.ends
        along = ends[:, 2:] - ends[:, :2]
        length_m = np.sqrt((along**2).sum(axis=1))
        self._along = along / np.maximum(length_m, 1e-9)[:, np.newaxis]
        self._length_m = length_m

    def pairs(self, shapes: shapely.Geometry | NDArray[np.object_]) -> Pairs:
        """Return the numbers of shapes, and of the parts of zones that their boxes meet."""
        number, parts = self._tree.query(np.asarray(shapes, dtype=object))
        return number, parts

    def keys(self, east_m: Floats, north_m: Floats, pairs: Pairs | None = None) -> Ints:
        """Return the number of the zones at each point.

        `pairs` are numbers of points, in order, and each time of a part that it may lie in.
        """
        if self._cells is not None:
            kinds = self._cells.classes_at(east_m, north_m)
            return np.where(kinds == NO_RATE, 0, kinds + 1)
        found = np.zeros(len(east_m), dtype=np.int64)
        if pairs is None:
            pairs = self.pairs(shapely.points(np.column_stack((east_m, north_m))))
        points, parts = pairs
        within = shapely.contains_xy(self._parts[parts], east_m[points], north_m[points])
        points, zones = points[within], self._owner[parts[within]]
        found[points] = zones + 1
        times = np.bincount(points, minlength=len(east_m))
        for point in np.flatnonzero(times > 1).tolist():
            its = frozenset(zones[points == point].tolist())
            found[point] = self._number(its)
        return found

    def _number(self, zones: frozenset[int]) -> int:
        if len(zones) == 1:
            return next(iter(zones)) + 1
        return self._several.setdefault(zones, self._count + 1 + len(self._several))

    def zones(self, key: int) -> frozenset[int]:
        """Return the zones that a number stands for."""
        if key == 0:
            return frozenset()
        if key <= self._count:
            return frozenset({key - 1})
        return list(self._several)[key - self._count - 1]

    def constant(self, east_m: Floats, north_m: Floats) -> Bools:
        """Return which whole pieces (of `PIECE` + 1 points) of a path keep clear of every edge."""
        pieces = (len(east_m) - 1) // PIECE
        if self._cells is not None or pieces < 1:
            return np.zeros(max(pieces, 0), dtype=np.bool_)
        moved_m = np.sqrt(np.diff(east_m) ** 2 + np.diff(north_m) ** 2)
        length_m = moved_m[: pieces * PIECE].reshape(pieces, PIECE).sum(axis=1)
        chords = np.column_stack((east_m, north_m))[: pieces * PIECE + 1 : PIECE]
        starts, ends = chords[:-1], chords[1:]
        chord_m = np.sqrt(((ends - starts) ** 2).sum(axis=1))
        # A point of a piece is no farther from its chord than at the top of the tightest arch.
        aside_m = 0.5 * np.sqrt(np.maximum(length_m**2 - chord_m**2, 0.0)) + NEAR_M
        margin = aside_m[:, np.newaxis]
        corners = np.minimum(starts, ends) - margin, np.maximum(starts, ends) + margin
        # A line from corner to corner has the box that is asked for, and is made sooner.
        piece, edge = self._edges.tree.query(shapely.linestrings(np.stack(corners, axis=1)))
        near = piece[self._are_near(starts[piece], ends[piece], edge, aside_m[piece])]
        clear = np.ones(pieces, dtype=np.bool_)
        clear[near] = False
        return clear

    def _are_near(self, starts: Floats, ends: Floats, edge: Ints, aside_m: Floats) -> Bools:
        """Return which chords may be so near to an edge each: of no direction it is known better.

        Seen along the edge, across it, or across the chord, what is apart is apart.
        """
        along, first = self._along[edge], self._edges.ends[edge, :2]
        from_m, to_m = (((each - first) * along).sum(axis=1) for each in (starts, ends))
        far = np.minimum(from_m, to_m) > self._length_m[edge] + aside_m
        far |= np.maximum(from_m, to_m) < -aside_m
        left_m, right_m = (_cross(along, each - first) for each in (starts, ends))
        far |= np.minimum(left_m, right_m) > aside_m
        far |= np.maximum(left_m, right_m) < -aside_m
        chord = ends - starts
        reach = aside_m * np.sqrt((chord**2).sum(axis=1))
        left, right = (_cross(chord, each - starts) for each in (first, self._edges.ends[edge, 2:]))
        far |= np.minimum(left, right) > reach
        far |= np.maximum(left, right) < -reach
        near: Bools = ~far
        return near


def _cross(one: Floats, other: Floats) -> Floats:
    """Return how far each vector lies to the left of another, times the length of that."""
    found: Floats = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]
    return found


_KNOWN: WeakKeyDictionary[Prescription, ZoneLookup] = WeakKeyDictionary()


def lookup_of(prescription: Prescription) -> ZoneLookup:
    """Return the look-up of a prescription, made once."""
    found = _KNOWN.get(prescription)
    if found is None:
        found = _KNOWN[prescription] = ZoneLookup(prescription)
    return found


# The prescribed rate of ground itself, whatever strip comes over it: points, and whole cells.


def ground_rates(prescription: Prescription, east_m: Floats, north_m: Floats) -> Floats:
    """Return the rate at each point [L/ha]; NaN outside the field or without a rate."""
    found = np.full(len(east_m), np.nan)
    index = np.flatnonzero(in_field(prescription, east_m, north_m))
    lookup = lookup_of(prescription)
    keys, place = np.unique(lookup.keys(east_m[index], north_m[index]), return_inverse=True)
    rates = [prescription.rate_of(lookup.zones(key)) for key in keys.tolist()]
    found[index] = np.array([np.nan if rate is None else rate for rate in rates])[place]
    return found


def rates_of_squares(
    prescription: Prescription, west_m: Floats, south_m: Floats, size_m: float
) -> tuple[Bools, Floats]:
    """Return which squares no edge of zones or field comes near, and the rate of each of those.

    0 where nothing is prescribed. A map of cells has no edges to ask: no square is sure.
    """
    sure = np.full(len(west_m), prescription.cells is None)
    if prescription.cells is None and len(west_m):
        squares = shapely.box(west_m, south_m, west_m + size_m, south_m + size_m)
        met, _ = prescription.edges.tree.query(squares, predicate="intersects")
        sure[met] = False
    rates = np.full(len(west_m), np.nan)
    half_m = 0.5 * size_m
    middle = ground_rates(prescription, west_m[sure] + half_m, south_m[sure] + half_m)
    rates[sure] = np.nan_to_num(middle)
    return sure, rates


# The state outside the field; zones there are nobody's business.
OUTSIDE = -1
# From 0.1 m to 0.01 mm.
BISECTIONS = 14
# Below this speed nothing is a change: the aircraft turns or hovers.
SPEED_MIN_M_S = 0.5
# What is shorter is a digitising error between two zones, not a zone.
SLIVER_M = 0.05
SLIVER_S = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """A part of the track with one state under the strip's centre.

    `rate_l_ha` is 0 where nothing is prescribed. `inside` says whether the field is there.
    """

    start_s: float
    end_s: float
    start_m: float
    end_m: float
    inside: bool
    rate_l_ha: float
    zones: frozenset[int]

    @property
    def dwell_s(self) -> float:
        """Return how long the strip is over it."""
        return self.end_s - self.start_s


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """One change of rate under one valve's strip; `border` where the field begins or ends."""

    valve: int
    time_s: float
    distance_m: float
    before_l_ha: float
    after_l_ha: float
    speed_m_s: float
    border: bool

    @property
    def relative(self) -> float:
        """Return |new - old| / old; infinite from 0."""
        if not self.before_l_ha > 0.0:
            return float("inf")
        return abs(self.after_l_ha - self.before_l_ha) / self.before_l_ha


def bisect(holds: Callable[[Floats], Bools], low_s: Floats, high_s: Floats) -> Floats:
    """Return when `holds`, true at `low_s` and false at `high_s`, ends; `low_s` may be later."""
    low, high = low_s.copy(), high_s.copy()
    if not len(low):
        return low
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        still = holds(middle)
        low, high = np.where(still, middle, low), np.where(still, high, middle)
    return 0.5 * (low + high)


class _States:
    """Numbers for what is under tracks of one flight: in the field or not, and which zones."""

    def __init__(self, tracks: Sequence[Track], prescription: Prescription) -> None:
        self.tracks = tracks
        self.prescription = prescription
        self.lookup = lookup_of(prescription)
        self._time_s = tracks[0].time_s
        self._east_m = np.stack([track.east_m for track in tracks])
        self._north_m = np.stack([track.north_m for track in tracks])

    def at(self, time_s: Floats, east_m: Floats, north_m: Floats) -> Ints:
        """Return the number of the state at places where the middles of strips are at a time."""
        inside = self._inside(time_s, east_m, north_m)
        index = np.flatnonzero(inside)
        states = np.full(len(inside), OUTSIDE)
        states[index] = self.lookup.keys(east_m[index], north_m[index])
        return states

    def _inside(self, time_s: Floats, east_m: Floats, north_m: Floats) -> Bools:
        inside = in_field(self.prescription, east_m, north_m)
        planned = self.tracks[0].planned
        return inside if planned is None else inside & planned.flown(time_s, east_m, north_m)

    def around(self, number: Ints, time_s: Floats, way_m: Floats) -> Pairs:
        """Return which parts of zones lie so near to where tracks by their numbers are."""
        places = np.column_stack(self._places(number, time_s))
        reach_m = way_m[:, np.newaxis] + NEAR_M
        corners = np.stack((places - reach_m, places + reach_m), axis=1)
        return self.lookup.pairs(shapely.linestrings(corners))

    def under(self, number: Ints, time_s: Floats, around: Pairs) -> Ints:
        """Return the states under tracks by their numbers, each at a time of its own.

        No zones are looked at but those of `around`.
        """
        places = self._places(number, time_s)
        inside = self._inside(time_s, *places)
        return np.where(inside, self.lookup.keys(*places, around), OUTSIDE)

    def _places(self, number: Ints, time_s: Floats) -> tuple[Floats, Floats]:
        """Return where tracks by their numbers are, each at a time of its own."""
        # As `Track.at` of each track, for all of them at once.
        before = np.searchsorted(self._time_s, time_s, "right") - 1
        before = np.clip(before, 0, len(self._time_s) - 2)
        whole_s = self._time_s[before + 1] - self._time_s[before]
        after_s = time_s - self._time_s[before]
        is_past = time_s >= self._time_s[-1]

        def place_m(values: Floats) -> Floats:
            low, high = values[number, before], values[number, before + 1]
            place = (high - low) / whole_s * after_s + low
            return np.where(is_past, values[number, -1], place)

        return place_m(self._east_m), place_m(self._north_m)

    def along(self) -> list[Ints]:
        """Return the states at all marks; where no edge is near, one of a piece says all."""
        marked = [track.marked() for track in self.tracks]
        asked = [self._asked(each) for each in marked]
        some = [each.some(np.flatnonzero(its)) for each, its in zip(marked, asked, strict=True)]
        every = self.at(
            np.concatenate([each.time_s for each in some]),
            np.concatenate([each.east_m for each in some]),
            np.concatenate([each.north_m for each in some]),
        )
        ends = np.cumsum([len(each.time_s) for each in some])
        return [
            states[np.cumsum(its) - 1]
            for its, states in zip(asked, np.split(every, ends[:-1]), strict=True)
        ]

    def _asked(self, marked: Places) -> Bools:
        """Return at which marks the state is looked up; at the others it is that of before."""
        asked = np.ones(len(marked.time_s), dtype=np.bool_)
        if self.tracks[0].planned is None:
            clear = np.flatnonzero(self.lookup.constant(marked.east_m, marked.north_m)) * PIECE
            # The last point of a piece is the first of the next one.
            asked[(clear[:, np.newaxis] + np.arange(1, PIECE + 1)).ravel()] = False
        return asked

    def runs(self, track: Track, states: Sequence[int], ends_s: Floats) -> list[Run]:
        """Return the runs of states, one after the other between these times."""
        ends_m = track.each_value(track.distance_m, ends_s).tolist()
        found = []
        for state, span_s, span_m in zip(
            states, pairwise(ends_s.tolist()), pairwise(ends_m), strict=True
        ):
            inside = state != OUTSIDE
            zones = self.lookup.zones(state) if inside else frozenset()
            rate = self.prescription.rate_of(zones) if inside else None
            found.append(
                Run(
                    start_s=span_s[0],
                    end_s=span_s[1],
                    start_m=span_m[0],
                    end_m=span_m[1],
                    inside=inside,
                    rate_l_ha=0.0 if rate is None else rate,
                    zones=zones,
                )
            )
        return found


def find_runs(track: Track, prescription: Prescription) -> list[Run]:
    """Return the runs along a track, without gaps between them."""
    return find_all_runs([track], prescription)[0]


def find_all_runs(tracks: Sequence[Track], prescription: Prescription) -> list[list[Run]]:
    """Return the runs along each track of a flight: what is asked of the map is asked at once."""
    states = _States(tracks, prescription)
    found = states.along()
    turns = [np.flatnonzero(each[1:] != each[:-1]) for each in found]
    number = np.repeat(np.arange(len(tracks)), [len(each) for each in turns])
    marks_s = [track.time_s[track.marks] for track in tracks]
    marks_m = [track.distance_m[track.marks] for track in tracks]
    before, low_s, high_s, from_m, to_m = (
        np.concatenate([each[at + ahead] for each, at in zip(values, turns, strict=True)])
        for values, ahead in ((found, 0), (marks_s, 0), (marks_s, 1), (marks_m, 0), (marks_m, 1))
    )
    # What lies around each way from one mark to the next is sought once.
    around = states.around(number, low_s, to_m - from_m)
    edges_s = bisect(lambda t: states.under(number, t, around) == before, low_s, high_s)
    runs = []
    for i, track in enumerate(tracks):
        its = number == i
        ends_s = np.concatenate((marks_s[i][:1], edges_s[its], marks_s[i][-1:]))
        own = states.runs(track, [*before[its].tolist(), int(found[i][-1])], ends_s)
        runs.append(_merged(_without_slivers(own), key=lambda run: (run.inside, run.zones)))
    return runs


def stretches_of(runs: Sequence[Run]) -> list[Run]:
    """Return the runs with neighbours of one rate made one."""
    return _merged(runs, key=lambda run: (run.inside, run.rate_l_ha))


def changes_of(track: Track, stretches: Sequence[Run]) -> list[Change | None]:
    """Return the change at the end of each stretch but the last; None where there is none.

    None stands for a border without a rate on its inner side, and for a standing aircraft.
    """
    starts_s = np.array([each.start_s for each in stretches[1:]])
    speeds_m_s = track.each_value(track.speed_m_s, starts_s).tolist()
    return [
        _change(track, before, after, speed_m_s)
        for (before, after), speed_m_s in zip(pairwise(stretches), speeds_m_s, strict=True)
    ]


def _change(track: Track, before: Run, after: Run, speed_m_s: float) -> Change | None:
    if before.rate_l_ha == after.rate_l_ha or not speed_m_s > SPEED_MIN_M_S:
        return None
    return Change(
        valve=track.valve,
        time_s=after.start_s,
        distance_m=after.start_m,
        before_l_ha=before.rate_l_ha,
        after_l_ha=after.rate_l_ha,
        speed_m_s=speed_m_s,
        border=before.inside != after.inside,
    )


def _without_slivers(runs: Sequence[Run]) -> list[Run]:
    """Return the runs with those too short for a zone given to the run before them."""
    kept: list[Run] = []
    for i, run in enumerate(runs):
        short = run.end_m - run.start_m < SLIVER_M and run.dwell_s < SLIVER_S
        if short and kept and i < len(runs) - 1:
            kept[-1] = replace(kept[-1], end_s=run.end_s, end_m=run.end_m)
        else:
            kept.append(run)
    return kept


def _merged(runs: Iterable[Run], *, key: Callable[[Run], object]) -> list[Run]:
    """Return the runs with neighbours of one key made one."""
    merged: list[Run] = []
    for run in runs:
        if merged and key(merged[-1]) == key(run):
            merged[-1] = replace(merged[-1], end_s=run.end_s, end_m=run.end_m)
        else:
            merged.append(run)
    return merged
