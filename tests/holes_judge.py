"""Flown logs over fields with holes: how early valves close, beside a causal reference.

The path is the log's, smoothed; the holes lie on it and beside it. The reference has the true
state, keeps the same buffer, and closes when a strip would be in it by its last flow at the
acceleration of now. Ours hears what the log's autopilot told. What is lost is ground inside the
field that is sprayed on the same flight where there is no hole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from companion.core.prescription import Prescription
from companion.core.types import Decision
from sitl.along import Bed, heard
from sitl.flight import FlightOptions, fly
from sitl.trajectory import Trajectory
from tests.border_flight import flows
from tests.moving_flight import Spans, Strip, by_reference, executed

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# A closing is looked at this finely: 2.5 cm at 5 m/s. The reference decides so often.
LOOKED_S = 0.005
# The bars: so much earlier than the reference, and so many times the ground that it loses.
EARLIER_MAX_M, LOST_MAX = 0.15, 1.3
# Holes as trees and ponds: radius, how far beside the path, and the way between two.
RADII_M, BESIDE_M, APART_M = (0.5, 1.5, 4.0), 3.0, (10.0, 20.0)
# A strip that has been inside for so long before a contact, and open, was to be sprayed up to it.
INSIDE_S, OPEN_S = 0.5, 0.2
# Told and smoothed places differ by 2 to 6 cm: a strip that is no farther outside only grazes.
GRAZE_M = 0.1


@dataclass(frozen=True)
class Early:
    """How far before the border flow ends, how far outside it falls [m]; ground lost [%]."""

    closings: int
    mean_m: float | None
    median_m: float | None
    beyond_m: float
    lost_percent: float


def holes(path: Trajectory, seed: int) -> list[shapely.Polygon]:
    """Return holes along a path."""
    rng = np.random.default_rng((seed, 43))
    way = shapely.LineString(np.column_stack((path.east_m, path.north_m)))
    found, at_m = [], float(rng.uniform(*APART_M))
    while at_m < way.length:
        x, y = shapely.get_coordinates(way.interpolate(at_m))[0] + rng.uniform(
            -BESIDE_M, BESIDE_M, 2
        )
        found.append(shapely.Point(x, y).buffer(float(rng.choice(RADII_M)), quad_segs=3))
        at_m += float(rng.uniform(*APART_M))
    return found


def flown(bed: Bed, prescription: Prescription, seed: int) -> list[Decision]:
    """Return what is decided on a flight over this ground."""
    said: list[Decision] = []
    options = FlightOptions(fidelity="averaged", output=bed.output, seed=seed)
    fly(
        replace(bed.setup, prescription=prescription), bed.path, bed.profile, options,
        speed_m_s=5.0, heard=heard(bed, seed), observer=said.append,
    )  # fmt: skip
    return said


def judged(beds: Sequence[Bed], seeds: Sequence[int]) -> tuple[Early, Early]:
    """Return ours, and the reference's, of flights over holes of their own."""
    both = [_rows(*each) for each in zip(beds, seeds, strict=True)]
    ours, theirs = (summed(np.concatenate(rows)) for rows in zip(*both, strict=True))
    return ours, theirs


def _rows(bed: Bed, seed: int) -> tuple[Floats, Floats]:
    ground, buffer_m = bed.setup.prescription, bed.setup.border_buffer_m
    cut = Prescription(ground.zones, exclusions=holes(bed.path, seed))
    kept = cut.field.buffer(-buffer_m)
    whole, said = (flown(bed, each, seed) for each in (ground, cut))
    count = len(bed.setup.boom.valves)
    looks_s = np.arange(said[0].now_s, said[-1].now_s, LOOKED_S)
    rows: tuple[list[Floats], list[Floats]] = [], []
    for valve, timing, open_orders, orders in zip(
        bed.setup.boom.valves, bed.setup.timings, executed(whole, count), executed(said, count),
        strict=True,
    ):  # fmt: skip
        strip = Strip(
            valve.right_m, valve.forward_m, valve.width_m, timing.border_on_s, timing.border_off_s
        )
        looked = Looked.of(strip, cut.field, bed.path)
        could, own, theirs = (
            looked.wet(flows(each, first_s=strip.first_s, last_s=strip.last_s))
            for each in (open_orders, orders, by_reference(kept, strip, bed.path, looks_s))
        )
        for row, wet in zip(rows, (own, could & theirs), strict=True):
            row.append(looked.early(could, could & theirs, wet, cut.field))
    return np.concatenate(rows[0]), np.concatenate(rows[1])


def bars(ours: Early, theirs: Early) -> list[tuple[str, float, float]]:
    """Return what is barred: its name, what it is and what it may be."""
    found = [("ground lost at holes", ours.lost_percent, LOST_MAX * theirs.lost_percent)]
    if ours.mean_m is not None and theirs.mean_m is not None:
        found.append(("closings before holes", ours.mean_m, theirs.mean_m + EARLIER_MAX_M))
    return found


def summed(rows: Floats) -> Early:
    """Return the figures of rows (kind, value, value)."""
    margins, grounds = rows[rows[:, 0] == 0.0, 1], rows[rows[:, 0] == 1.0]
    beyond = rows[rows[:, 0] == 2.0, 1]
    some = len(margins) > 0
    return Early(
        len(margins),
        float(margins.mean()) if some else None,
        float(np.median(margins)) if some else None,
        float(beyond.max()),
        100.0 * float(grounds[:, 1].sum() / grounds[:, 2].sum()),
    )


@dataclass(frozen=True)
class Looked:
    """A strip on its true way: when it is inside, how far it has gone, how fast across."""

    time_s: Floats
    inside: Bools
    way_m: Floats
    across_m_s: Floats
    ends: Floats

    @classmethod
    def of(cls, strip: Strip, field: shapely.Geometry, path: Trajectory) -> Looked:
        time_s = np.arange(path.time_s[0], path.time_s[-1], LOOKED_S)
        at = path.at(time_s)
        ends = strip.ends(at.east_m, at.north_m, at.heading_deg)
        shapely.prepare(field)
        inside = shapely.covers(field, shapely.linestrings(ends))
        moves = np.gradient(ends.mean(axis=1), LOOKED_S, axis=0)
        nose = np.radians(at.heading_deg)
        across = np.abs(moves[:, 0] * np.sin(nose) + moves[:, 1] * np.cos(nose))
        way_m = np.cumsum(np.hypot(*moves.T)) * LOOKED_S
        return cls(time_s, inside, way_m, across, ends)

    def wet(self, spans: Spans) -> Bools:
        found = np.zeros(len(self.time_s), dtype=np.bool_)
        for since_s, until_s in spans:
            found |= (self.time_s >= since_s) & (self.time_s < until_s)
        return found

    def early(self, could: Bools, theirs: Bools, wet: Bools, field: shapely.Geometry) -> Floats:
        """Return rows (0, margin), (1, ground lost, ground) and (2, farthest outside)."""
        rows = []
        leaves = np.flatnonzero(self.inside[:-1] & ~self.inside[1:]) + 1
        for row in leaves.tolist():
            begins = row - 1 - int(np.argmin(self.inside[row - 1 :: -1]))
            open_rows = round(OPEN_S / LOOKED_S)
            is_long = row - begins > INSIDE_S / LOOKED_S and could[row - open_rows : row].all()
            if not (is_long and theirs[begins:row].sum() > open_rows):
                continue
            comes = np.flatnonzero(self.inside[row:])
            until = row + (int(comes[0]) if len(comes) else len(self.inside) - row)
            if not self.depth_m(slice(row, until), field) > GRAZE_M:
                continue
            flowing = np.flatnonzero(wet[begins:until])
            last = begins + (int(flowing[-1]) if len(flowing) else 0)
            rows.append((0.0, self.way_m[row] - self.way_m[last], 0.0))
        ground = self.across_m_s * (could & self.inside)
        rows.append((1.0, float((ground * ~wet).sum()), float(ground.sum())))
        rows.append((2.0, self.depth_m(wet & ~self.inside, field), 0.0))
        return np.array(rows)

    def depth_m(self, which: slice | Bools, field: shapely.Geometry) -> float:
        """Return how far outside the strip is at most."""
        beyond = shapely.difference(shapely.linestrings(self.ends[which]), field)
        points = shapely.points(shapely.get_coordinates(beyond))
        return float(shapely.distance(points, field).max(initial=0.0))
