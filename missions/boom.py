"""What a boom sprays along lines: all of its swath, or only the valves whose strips lie inside.

With `border = "inside"` the companion closes each valve before its strip leaves the field. A line
may then have an end of its boom beyond the border: nothing falls there, and less falls twice.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from companion.wording import counted
from missions.demand import valve_places
from missions.field import Field
from missions.plan import Settings
from missions.strips import (
    LINE_MIN_M,
    Floats,
    Objects,
    axes,
    count_across,
    directions,
    joined,
    lengths_m,
    no_lines,
    rectangles,
    whole,
)

# An edge that is a hair off a line's course must not cut it short, nor close a valve. The ground
# keeps a larger margin from what may be sprayed (`field.MARGIN_M`).
SLACK_M = 0.001
# The aircraft itself stays so far inside of borders beside it.
INSIDE_M = 0.5
# Ground on which a valve would be open that may not be sprayed, and is no rounding.
WRONG_M2 = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class Boom:
    """Valves as rows (right_m, width_m); they close at the border of `ground`, where it is given.

    On `unguarded` ground they would be open though it may not be sprayed: no end goes there.
    """

    width_m: float
    places: Floats = field(default_factory=lambda: np.empty((0, 2)))
    ground: BaseGeometry | None = None
    unguarded: BaseGeometry | None = None

    @property
    def closes(self) -> bool:
        """Return whether lines may have an end of the boom beyond the border."""
        return self.ground is not None

    @property
    def over_m(self) -> list[float]:
        """Return by how much an end of the boom may be beyond an edge: whole valves, or none.

        Less than half of the swath: the aircraft stays inside.
        """
        if self.ground is None:
            return [0.0]
        inner = np.cumsum(self.places[:, 1])[:-1]
        return [0.0, *inner[inner <= self.width_m / 2.0 - INSIDE_M].tolist()]

    def spans(self, lines: Floats) -> Floats:
        """Return rows (line, left_m, right_m, from_m, to_m) of what is sprayed along each line."""
        half_m, length_m = self.width_m / 2.0, lengths_m(lines)
        count = len(lines)
        found = np.column_stack(
            [
                np.arange(count), np.full(count, -half_m), np.full(count, half_m),
                np.zeros(count), length_m,
            ]
        )  # fmt: skip
        if self.ground is None or not count:
            return found
        shapely.prepare(self.ground)
        is_inside = shapely.covers(self.ground, rectangles(lines, self.width_m - 2.0 * SLACK_M))
        over = np.flatnonzero(~is_inside)
        parts = [found[is_inside]]
        for right_m, width_m in self.places.tolist():
            along = directions(lines[over])
            aside = np.column_stack([along[:, 1], -along[:, 0]]) * right_m
            row_of, start_m, end_m = _inside(
                lines[over] + np.column_stack([aside, aside]), self.ground, width_m
            )
            ends = (np.full(len(row_of), right_m + side * width_m / 2.0) for side in (-1, 1))
            parts.append(np.column_stack([over[row_of], *ends, start_m, end_m]))
        rows = np.concatenate(parts)
        ordered: Floats = rows[np.argsort(rows[:, 0], kind="stable")]
        return ordered

    def strips(self, lines: Floats) -> Objects:
        """Return the ground that is sprayed along every line."""
        strips = rectangles(lines, self.width_m)
        if self.ground is None or not len(lines):
            return strips
        spans = self.spans(lines)
        line_of = spans[:, 0].astype(np.int64)
        half_m, length_m = self.width_m / 2.0, lengths_m(lines)
        is_whole = (spans[:, 2] - spans[:, 1] >= 2.0 * half_m) & (
            spans[:, 4] - spans[:, 3] >= length_m[line_of]
        )
        parts = _parts(lines[line_of], spans)
        for number in sorted(set(range(len(lines))) - set(line_of[is_whole].tolist())):
            strips[number] = whole(parts[line_of == number])
        return strips

    def united(self, lines: Floats) -> BaseGeometry:
        """Return the ground of all lines together."""
        return whole(self.strips(lines))

    def where_open(self, lines: Floats) -> Floats:
        """Return the parts of lines on which the aircraft is inside and some valve is open."""
        if self.ground is None or not len(lines):
            return no_lines()
        inside = where_inside(lines, self.ground, 2.0 * INSIDE_M)
        spans = self.spans(inside)
        line_of = spans[:, 0].astype(np.int64)
        some = np.unique(line_of)
        start_m, end_m = np.full(len(inside), np.inf), np.zeros(len(inside))
        np.minimum.at(start_m, line_of, spans[:, 3])
        np.maximum.at(end_m, line_of, spans[:, 4])
        along, start = directions(inside)[some], inside[some, :2]
        open_ = np.column_stack(
            [start + along * start_m[some, None], start + along * end_m[some, None]]
        )
        if self.unguarded is None or self.unguarded.is_empty:
            return open_
        wrong = shapely.intersection(rectangles(open_, self.width_m), self.unguarded)
        kept: Floats = open_[shapely.area(wrong) < WRONG_M2]
        return kept


def boom_of(settings: Settings, ground: Field) -> Boom:
    """Return the boom of a plan."""
    if not settings.ends_over:
        return Boom(width_m=settings.swath_width_m)
    places = valve_places(settings.swath_width_m, settings.valves)
    places = places[np.argsort(places[:, 0])]
    guarded = ground.kept_in.buffer(-(settings.border_buffer_m or 0.0))
    return Boom(
        width_m=settings.swath_width_m, places=places, ground=ground.spray,
        unguarded=guarded.difference(ground.limit),
    )  # fmt: skip


def where_inside(lines: Floats, ground: BaseGeometry, width_m: float) -> Floats:
    """Return the parts of lines whose strips lie on the ground."""
    if not len(lines):
        return no_lines()
    line_of, start_m, end_m = _inside(lines, ground, width_m)
    along, start = directions(lines)[line_of], lines[line_of, :2]
    return np.column_stack([start + along * start_m[:, None], start + along * end_m[:, None]])


def _inside(
    lines: Floats, ground: BaseGeometry, width_m: float
) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.int64]], Floats, Floats]:
    """Return line, from and to [m] of all parts of lines whose strips lie on the ground."""
    shapely.prepare(ground)
    bands = rectangles(lines, width_m - 2.0 * SLACK_M)
    crossing = np.flatnonzero(~shapely.covers(ground, bands))
    outside, band_of = shapely.get_parts(
        shapely.difference(bands[crossing], ground), return_index=True
    )
    along, length_m = directions(lines), lengths_m(lines)
    beyond: list[list[tuple[float, float]]] = [[] for _ in lines]
    for piece, number in zip(outside, crossing[band_of].tolist(), strict=True):
        places = (shapely.get_coordinates(piece) - lines[number, :2]) @ along[number]
        if len(places):
            beyond[number].append((float(places.min()), float(places.max())))
    rows = []
    for number, some in enumerate(beyond):
        reached = 0.0
        for start, end in [*sorted(some), (float(length_m[number]), np.inf)]:
            if start - reached > LINE_MIN_M:
                rows.append((number, reached, start))
            reached = max(reached, end)
    found = np.array(rows).reshape(-1, 3)
    return found[:, 0].astype(np.int64), found[:, 1], found[:, 2]


def _parts(lines: Floats, spans: Floats) -> Objects:
    """Return the ground of each span, along the line of the same row."""
    along = directions(lines)
    right = np.column_stack([along[:, 1], -along[:, 0]])
    start, (left_m, right_m, from_m, to_m) = lines[:, :2], (spans[:, [at]] for at in range(1, 5))
    corners = [
        start + right * aside_m + along * along_m
        for aside_m, along_m in (
            (right_m, from_m),
            (right_m, to_m),
            (left_m, to_m),
            (left_m, from_m),
        )
    ]
    return np.asarray(shapely.polygons(np.stack(corners, axis=1)), dtype=object)


# Lines with an end of the boom beyond the border, where the valves of that end are closed.
#
# Ground that is no whole number of swaths wide is then covered by whole swaths all the same: what
# is too much lies outside, not on what was sprayed before.

# What may be missing to a whole valve is a gap that nobody can see.
ROUND_M = 0.01
# What margins and rounding leave beyond the border.
BEYOND_M2 = 0.1


def over_warnings(lines: Floats, ground: BaseGeometry, boom: Boom) -> tuple[str, ...]:
    """Return what whole booms would spray off the ground, where ends are beyond its border."""
    if not boom.closes:
        return ()
    strips = rectangles(lines, boom.width_m)
    beyond_m2 = shapely.area(shapely.difference(strips, ground))
    count = int(np.count_nonzero(beyond_m2 > BEYOND_M2))
    if not count:
        return ()
    off_m2 = float(whole(strips).difference(ground).area)
    return (
        f"{counted(count, 'line')} with an end of the boom beyond the border: fly them only "
        f'with the companion and border = "inside"; whole booms would spray {off_m2:.0f} m2 '
        "outside the field",
    )


def lines_over(ground: BaseGeometry, boom: Boom, angle_deg: float) -> Floats:
    """Return lines side by side, with ends of the boom beyond the border on both sides."""
    turned_by = axes(angle_deg)
    turned = shapely.transform(ground, lambda points: points @ turned_by.T)
    rows = []
    for part in shapely.get_parts(turned):
        west, low, east, high = part.bounds
        rows += [
            [west - 1.0, middle, east + 1.0, middle] for middle in side_by_side(low, high, boom)
        ]
    lines = np.array(rows)
    return boom.where_open(np.column_stack([lines[:, :2] @ turned_by, lines[:, 2:] @ turned_by]))


def side_by_side(low: float, high: float, boom: Boom) -> list[float]:
    """Return the middles of strips that cover from `low` to `high`, with ends beyond both.

    What whole valves beyond the edges do not take up falls twice, in one place.
    """
    width_m = boom.width_m
    count = count_across(high - low, width_m)
    if count == 1:
        return [(low + high) / 2.0]
    spare_m = count * width_m - (high - low)
    pairs = [(a, b) for a in boom.over_m for b in boom.over_m if a + b <= spare_m + ROUND_M]
    first_m, last_m = max(pairs, key=lambda pair: (sum(pair), -abs(pair[0] - pair[1])))
    first, last = low + width_m / 2.0 - first_m, high - width_m / 2.0 + last_m
    return [min(first + width_m * number, last) for number in range(count)]


def passes_over(ground: BaseGeometry, boom: Boom) -> Floats:
    """Return lines along every long edge, with whole valves of the boom beyond it."""
    half_m, found = boom.width_m / 2.0, []
    for part in shapely.get_parts(shapely.orient_polygons(ground)):
        for ring in (part.exterior, *part.interiors):
            points = shapely.get_coordinates(ring)
            edges = np.column_stack([points[:-1], points[1:]])
            edges = edges[lengths_m(edges) > boom.width_m]
            if not len(edges):
                continue
            along = directions(edges)
            inwards = np.column_stack([-along[:, 1], along[:, 0]])
            for over_m in boom.over_m[1:]:
                aside, longer = inwards * (half_m - over_m), along * boom.width_m
                found.append(
                    np.column_stack([edges[:, :2] + aside - longer, edges[:, 2:] + aside + longer])
                )
    return boom.where_open(joined(found))
