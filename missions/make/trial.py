"""Where the plots of a field trial lie: blocks with every treatment once, in random order.

A plot is whole passes wide. Along them it begins and ends with ground on which the rate settles,
flown from either side; only what lies between counts (the inner part, which is harvested). As
strips the plots run as far as the field goes, side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from shapely import Polygon
from shapely.geometry.base import BaseGeometry

from companion.wording import counted
from missions.errors import PlanError
from missions.maps.local import polygons_of
from missions.strips import Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class Design:
    """What the trial compares, and how large its plots are.

    Args:
        rates_l_ha: of the treatments; no two alike.
        plot_m: length of a plot along the passes; None for strips as long as the field.
        wide: passes a plot.
        settle_m: on which the rate settles, at both ends of each plot.
        guard_m: beside the inner part, where the next plot's deposit reaches over.
    """

    rates_l_ha: tuple[float, ...]
    blocks: int
    plot_m: float | None
    wide: int
    settle_m: float
    guard_m: float
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Plot:
    """One plot, by along and right of the passes."""

    block: int
    number: int
    treatment: int
    start_m: float
    end_m: float
    left_m: float
    right_m: float

    def area(self) -> Polygon:
        """Return the whole plot."""
        return shapely.box(self.start_m, self.left_m, self.end_m, self.right_m)

    def inner(self, design: Design) -> Polygon:
        """Return what counts of it."""
        return shapely.box(
            self.start_m + design.settle_m, self.left_m + design.guard_m,
            self.end_m - design.settle_m, self.right_m - design.guard_m,
        )  # fmt: skip


def lay_out(ground: BaseGeometry, edges_m: Floats, design: Design) -> list[Plot]:
    """Return the plots on ground (along, right) whose passes lie between edges.

    Raises:
        PlanError: where they do not fit, with how many would.
    """
    slots = max((_slots(ground, edges_m[first:], design) for first in range(design.wide)), key=len)
    if len(slots) < design.blocks:
        length = "" if design.plot_m is None else f" {design.plot_m:g} m long and"
        raise PlanError(
            f"{design.blocks} blocks of {len(design.rates_l_ha)} plots,{length} "
            f"{counted(design.wide, 'pass')} wide, do not fit into the field: {len(slots)} would; "
            "lower --blocks, --plot-m, --passes or --headland-m"
        )
    draw = np.random.default_rng(design.seed)
    found: list[Plot] = []
    for block, places in enumerate(slots[: design.blocks], 1):
        order = draw.permutation(len(design.rates_l_ha)).tolist()
        for (start, end, left, right), treatment in zip(places, order, strict=True):
            found.append(
                Plot(
                    block=block, number=len(found) + 1, treatment=treatment, start_m=start,
                    end_m=end, left_m=left, right_m=right,
                )
            )  # fmt: skip
    return found


Place = tuple[float, float, float, float]


def _slots(ground: BaseGeometry, edges_m: Floats, design: Design) -> list[list[Place]]:
    """Return room for blocks, each with the places of its plots; next to the middle first."""
    count = len(design.rates_l_ha)
    groups = [
        (float(edges_m[at]), float(edges_m[at + design.wide]))
        for at in range(0, len(edges_m) - design.wide, design.wide)
    ]
    free = [_free(ground, left, right) for left, right in groups]
    found: list[list[Place]] = []
    if design.plot_m is None:
        longest = [max(one, key=lambda span: span[1] - span[0], default=None) for one in free]
        row: list[Place] = []
        for (left, right), span in zip(groups, longest, strict=True):
            if span is None or span[1] - span[0] < 3.0 * design.settle_m:
                row = []
                continue
            row.append((*span, left, right))
            if len(row) == count:
                found.append(row)
                row = []
    else:
        whole_m = count * design.plot_m
        for (left, right), spans in zip(groups, free, strict=True):
            for start, end in spans:
                room = int((end - start + 1e-9) // whole_m)
                first = start + (end - start - room * whole_m) / 2.0
                found += [
                    [
                        (first + (block * count + at) * design.plot_m,
                         first + (block * count + at + 1) * design.plot_m, left, right)
                        for at in range(count)
                    ]
                    for block in range(room)
                ]  # fmt: skip
    centre = shapely.centroid(ground)

    def away(block: Sequence[Place]) -> float:
        places = np.array(block)
        along = 0.5 * (places[:, 0].min() + places[:, 1].max()) - centre.x
        right = 0.5 * (places[:, 2].min() + places[:, 3].max()) - centre.y
        return float(np.hypot(along, right))

    return sorted(found, key=away)


def _free(ground: BaseGeometry, left_m: float, right_m: float) -> list[tuple[float, float]]:
    """Return from where to where a band lies in the ground with its whole width.

    >>> _free(shapely.Polygon([(0, 0), (10, 0), (8, 2), (0, 2)]), 0.0, 2.0)
    [(0.0, 8.0)]
    """
    start, _, end, _ = ground.bounds
    band = shapely.box(start, left_m, end, right_m)
    blocked = sorted(
        (one.bounds[0], one.bounds[2])
        for one in polygons_of(shapely.difference(band, ground))
        if one.area > 1e-6
    )
    found, at = [], start
    for low, high in [*blocked, (end, end)]:
        if low > at:
            found.append((at, low))
        at = max(at, high)
    return found
