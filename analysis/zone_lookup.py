"""Which zones lie under very many points, and where along a path nothing can change.

As `Prescription.zones_at` has it, without a set for every point.
"""

from __future__ import annotations

from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import STRtree

from analysis.track import in_field
from companion.core.cells import NO_RATE

if TYPE_CHECKING:
    from analysis.track import Bools, Floats
    from companion.core.prescription import Prescription


Ints = NDArray[np.int64]

# A path is looked at in pieces of so many points: 1.4 m, where they are 0.09 m apart.
PIECE = 16
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

    def keys(self, east_m: Floats, north_m: Floats) -> Ints:
        """Return the number of the zones at each point."""
        if self._cells is not None:
            kinds = self._cells.classes_at(east_m, north_m)
            return np.where(kinds == NO_RATE, 0, kinds + 1)
        found = np.zeros(len(east_m), dtype=np.int64)
        points, parts = self._tree.query(shapely.points(np.column_stack((east_m, north_m))))
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
        ends = np.arange(pieces + 1) * PIECE
        way_m = np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(east_m), np.diff(north_m)))))
        chords = np.column_stack((east_m, north_m))[ends]
        chord_m = np.hypot(*(chords[1:] - chords[:-1]).T)
        length_m = np.diff(way_m[ends])
        # A point of a piece is no farther from its chord than at the top of the tightest arch.
        aside_m = 0.5 * np.sqrt(np.maximum(length_m**2 - chord_m**2, 0.0)) + NEAR_M
        lines = shapely.linestrings(np.stack((chords[:-1], chords[1:]), axis=1))
        near, _ = self._edges.tree.query(lines, predicate="dwithin", distance=aside_m)
        clear = np.ones(pieces, dtype=np.bool_)
        clear[near] = False
        return clear


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
