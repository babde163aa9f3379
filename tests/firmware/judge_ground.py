"""Judges the ground below a flight beside a real firmware: left, twice, sprayed before.

Like `judge` it imports nothing of the program: ground is cells, wet from the moment that its own
sprayer's flow first falls there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from tests.firmware.judge import (
    CELL_M,
    OFF_TARGET_ELEMENT_M,
    REACH_M,
    STEP_S,
    Change,
    Floats,
    Path2d,
    Plane,
    Sprayer,
    Zone,
    flows_ml_s,
    rates_at,
    true_path,
    vehicle_times,
)
from tests.firmware.station import Place, Pulses


@dataclass(frozen=True, slots=True)
class Ground:
    """What a pass over zones did to a band of ground as wide as the boom, in square metres."""

    left_m2: float  # with less than half of the rate
    twice_m2: float  # with more than one and a half of it
    whole_m2: float

    def __str__(self) -> str:
        return f"left {self.left_m2:.1f} m2, twice {self.twice_m2:.1f} m2 of {self.whole_m2:.0f} m2"


def treated_share(
    places: Sequence[Place],
    pulses: Sequence[Pulses],
    zones: Sequence[Zone],
    lines: Sequence[shapely.LineString],
    *,
    sprayer: Sprayer | None = None,
) -> float:
    """Return the share of the ground under the strips of lines that got half its rate or more.

    In cells of CELL_M that lie wholly under the strips, from the first to the last centimetre of
    each line.
    """
    sprayer = sprayer or Sprayer()
    middle = shapely.union_all([zone.outline for zone in zones]).centroid
    plane = Plane(middle.y, middle.x)
    path = true_path(places, vehicle_times(places, pulses), plane)
    flows = flows_ml_s(pulses, path.at_s, sprayer, seed=1)
    boom_m = sprayer.width_m * len(sprayer.right_m)
    strips = [plane.of(line).buffer(boom_m / 2.0, cap_style="flat") for line in lines]
    whole = shapely.union_all(strips)
    west_m, south_m, east_m, north_m = whole.bounds
    columns = int(np.ceil((east_m - west_m) / CELL_M))
    rows = int(np.ceil((north_m - south_m) / CELL_M))
    ml = np.zeros((rows, columns))
    parts = round(sprayer.width_m / OFF_TARGET_ELEMENT_M)
    for valve, right_m in enumerate(sprayer.right_m):
        is_open = np.flatnonzero(flows[valve] > 0.0)
        for part in range(parts):
            aside_m = right_m + sprayer.width_m * ((part + 0.5) / parts - 0.5)
            x = path.east_m[is_open] + aside_m * np.cos(path.yaw_rad[is_open])
            y = path.north_m[is_open] - aside_m * np.sin(path.yaw_rad[is_open])
            column = np.floor((x - west_m) / CELL_M).astype(int)
            row = np.floor((y - south_m) / CELL_M).astype(int)
            hits = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
            dose = flows[valve][is_open[hits]] * STEP_S / parts
            np.add.at(ml, (row[hits], column[hits]), dose)
    across, up = np.meshgrid(np.arange(columns), np.arange(rows))
    x, y = west_m + (across + 0.5) * CELL_M, south_m + (up + 0.5) * CELL_M
    core = whole.buffer(-CELL_M / np.sqrt(2.0))
    flat = [Zone(plane.of(zone.outline), zone.rate_l_ha) for zone in zones]
    wanted = rates_at(flat, x.ravel(), y.ravel()) * 0.1 * CELL_M**2
    counts = shapely.contains_xy(core, x.ravel(), y.ravel()) & ~np.isnan(wanted)
    return float(np.mean(ml.ravel()[counts] >= 0.5 * wanted[counts]))


def treated_ground(
    places: Sequence[Place],
    pulses: Sequence[Pulses],
    zones: Sequence[Zone],
    *,
    ends: tuple[tuple[float, float], tuple[float, float]],
    by_valve: bool = False,
    sprayer: Sprayer | None = None,
) -> Ground:
    """Return how much of a pass was left, and how much treated twice.

    `ends` are latitude and longitude of where the pass is judged from and to: a band as wide as
    the boom, in cells of one strip by CELL_M. All that was flown counts, there and back. With
    `by_valve` each valve has a strip of its own, wherever beside the line it was flown: two ways
    that are less than half a strip apart leave a sliver by rule, and no valve can help it.
    """
    sprayer = sprayer or Sprayer()
    plane = Plane(*ends[0])
    path = true_path(places, vehicle_times(places, pulses), plane)
    flows = flows_ml_s(pulses, path.at_s, sprayer, seed=1)
    (far_east_m,), (far_north_m,) = plane.metres([ends[1][1]], [ends[1][0]])
    length_m = float(np.hypot(far_east_m, far_north_m))
    east, north = far_east_m / length_m, far_north_m / length_m
    strips = len(sprayer.right_m)
    ml = np.zeros((int(length_m / CELL_M), strips))
    for valve, right_m in enumerate(sprayer.right_m):
        east_m = path.east_m + right_m * np.cos(path.yaw_rad)
        north_m = path.north_m - right_m * np.sin(path.yaw_rad)
        row = np.floor((east_m * east + north_m * north) / CELL_M).astype(int)
        aside_m = east_m * north - north_m * east
        column = np.floor(aside_m / sprayer.width_m + strips / 2).astype(int)
        if by_valve:
            column[:] = valve
        hits = (row >= 0) & (row < ml.shape[0]) & (column >= 0) & (column < strips)
        np.add.at(ml, (row[hits], column[hits]), flows[valve][hits] * STEP_S)
    along_m = (np.arange(ml.shape[0]) + 0.5) * CELL_M
    flat = [Zone(plane.of(zone.outline), zone.rate_l_ha) for zone in zones]
    wanted = rates_at(flat, along_m * east, along_m * north) * 0.1 * sprayer.width_m * CELL_M
    share = ml / wanted[:, None]
    cell_m2 = CELL_M * sprayer.width_m
    return Ground(
        left_m2=float((share < 0.5).sum()) * cell_m2,
        twice_m2=float((share > 1.5).sum()) * cell_m2,
        whole_m2=share.size * cell_m2,
    )


# Ground is dry again for the same overflight: the drops of one strip fall within this time.
SAME_S = 5.0
WET_CELL_M = 0.25
# A valve counts as open on ground from this flow on.
OPEN_ML_S = 0.3
HALF = 0.5


def sprayed_before(
    places: Sequence[Place],
    pulses: Sequence[Pulses],
    zones: Sequence[Zone],
    changes: Sequence[Change],
    *,
    sprayer: Sprayer | None = None,
) -> list[bool]:
    """Return of each change whether ground sprayed before lies in the stretch it is measured on.

    That is where at least half of the valve's strip got liquid on an earlier overflight, within
    REACH_M of the change. A valve is rightly closed there, and the change has no place.
    """
    sprayer = sprayer or Sprayer()
    middle = shapely.union_all([zone.outline for zone in zones]).centroid
    path = true_path(places, vehicle_times(places, pulses), Plane(middle.y, middle.x))
    flows = flows_ml_s(pulses, path.at_s, sprayer, seed=1)
    is_wet = _is_wet(path, flows, sprayer)
    found = []
    for change in changes:
        here = int(np.searchsorted(path.at_s, change.at_s))
        is_near = np.abs(path.along_m - path.along_m[here]) <= REACH_M
        found.append(bool(is_wet[change.valve - 1][is_near].any()))
    return found


def _is_wet(path: Path2d, flows: Floats, sprayer: Sprayer) -> NDArray[np.bool_]:
    """Return when half of each valve's strip or more had been sprayed before: valves are rows."""
    count = round(sprayer.width_m / WET_CELL_M)
    reach_m = max(map(abs, sprayer.right_m)) + sprayer.width_m
    low_m = path.east_m.min() - reach_m, path.north_m.min() - reach_m
    cells: dict[tuple[int, int], tuple[NDArray[np.int64], NDArray[np.int64]]] = {}
    for valve, right_m in enumerate(sprayer.right_m):
        for part in range(count):
            aside_m = right_m + sprayer.width_m * ((part + 0.5) / count - 0.5)
            east_m = path.east_m + aside_m * np.cos(path.yaw_rad) - low_m[0]
            north_m = path.north_m - aside_m * np.sin(path.yaw_rad) - low_m[1]
            columns = np.floor(east_m / WET_CELL_M).astype(np.int64)
            cells[valve, part] = columns, np.floor(north_m / WET_CELL_M).astype(np.int64)
    shape = (
        max(int(columns.max()) for columns, _ in cells.values()) + 1,
        max(int(rows.max()) for _, rows in cells.values()) + 1,
    )
    since_s = np.full(shape, np.inf)
    for (valve, _), at in cells.items():
        is_open = flows[valve] >= OPEN_ML_S
        np.minimum.at(since_s, (at[0][is_open], at[1][is_open]), path.at_s[is_open])
    return np.array(
        [
            sum(since_s[cells[valve, part]] < path.at_s - SAME_S for part in range(count))
            >= HALF * count
            for valve in range(len(sprayer.right_m))
        ]
    )
