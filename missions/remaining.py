"""What is left after a break: the rest of an earlier plan's lines, and the rates still to spray."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely import LineString, Point
from shapely.affinity import translate
from shapely.geometry.base import BaseGeometry

from companion.core.frame import LocalFrame
from companion.core.options.coverage import Coverage
from companion.journal.continuing import is_journal, read_treated_ground
from companion.journal.coverage import moved
from missions.demand import Demand, Rates, demands
from missions.errors import PlanError
from missions.field import Field, local_area
from missions.maps.registry import read_area
from missions.reading_outline import told
from missions.strips import LINE_MIN_M, Floats, directions, lengths_m, rectangles

# Legs of one line at several speeds: they touch, and go on straight.
TOUCH_M, STRAIGHT_DEG = 0.01, 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Remaining:
    """The lines still to be flown, the course of most of them, and those that are done."""

    lines: Floats
    done: Floats
    angle_deg: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Break:
    """Where the flight stopped (east, north) and in which sortie, and what ground is treated.

    `overlap_m` is how much before the place the line is begun again.
    """

    stop: tuple[float, float] | None = None
    sortie: int | None = None
    overlap_m: float = 3.0
    treated: BaseGeometry | None = None


def read_lines(path: Path, frame: LocalFrame) -> list[tuple[int, Floats]]:
    """Return the spray lines of a plan as `vrspray plan --out plan.geojson` writes it, in order.

    Raises:
        PlanError: where the file is none.
    """
    try:
        features = json.loads(path.read_text(encoding="utf-8"))["features"]
        found = [
            (int(known["sortie"]), int(known["sequence"]), each["geometry"]["coordinates"])
            for each in features
            if (known := each["properties"]).get("kind") == "spray"
        ]
        rows = [(sortie, _local(points, frame)) for sortie, _, points in sorted(found)]
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise PlanError(
            f"{path}: this is not a plan to go on with ({error}); take the .geojson of vrspray plan"
        ) from error
    if not rows or not np.isfinite(np.array([row for _, row in rows])).all():
        raise PlanError(f"{path}: there is no spray line in it; take the .geojson of vrspray plan")
    return _merged(rows)


def _local(points: list[Any], frame: LocalFrame) -> Floats:
    (first_lon, first_lat), (last_lon, last_lat) = points[0][:2], points[-1][:2]
    start = frame.to_local(float(first_lat), float(first_lon))
    end = frame.to_local(float(last_lat), float(last_lon))
    return np.array([*start, *end])


def _merged(rows: list[tuple[int, Floats]]) -> list[tuple[int, Floats]]:
    """Return lines; legs that follow each other straight on are one."""
    found: list[tuple[int, Floats]] = []
    for sortie, row in rows:
        if lengths_m(row[None, :])[0] < 1e-3:
            continue
        if found and found[-1][0] == sortie and _goes_on(found[-1][1], row):
            found[-1] = (sortie, np.concatenate([found[-1][1][:2], row[2:]]))
        else:
            found.append((sortie, row))
    return found


def _goes_on(first: Floats, second: Floats) -> bool:
    if math.dist(first[2:].tolist(), second[:2].tolist()) > TOUCH_M:
        return False
    one, other = directions(np.array([first, second]))
    return float(one @ other) > math.cos(math.radians(STRAIGHT_DEG))


def remaining(
    rows: list[tuple[int, Floats]], since: Break, *, width_m: float, frame: LocalFrame
) -> Remaining:
    """Return what is left of the lines of a plan.

    Raises:
        PlanError: where the stop is not on a line of the plan, or nothing is left.
    """
    done: list[Floats] = []
    left = rows
    if since.stop is not None:
        done, left = _from_stop(rows, since, since.stop, width_m=width_m, frame=frame)
    lines = [row for _, row in left]
    if since.treated is not None:
        parts = [_untreated(row, since.treated) for row in lines]
        done += [row for row in lines if since.treated.intersects(_line(row))]
        lines = [row for some in parts for row in some]
    if not lines:
        raise PlanError("nothing of the plan is left: all of its lines are done")
    known = np.array(lines)
    return Remaining(
        lines=known,
        done=np.array(done) if done else np.empty((0, 4)),
        angle_deg=course_deg(np.array([row for _, row in rows])),
    )


def _from_stop(
    rows: list[tuple[int, Floats]],
    since: Break,
    stop: tuple[float, float],
    *,
    width_m: float,
    frame: LocalFrame,
) -> tuple[list[Floats], list[tuple[int, Floats]]]:
    place = Point(stop)
    far_m = [
        _line(row).distance(place) if since.sortie in (None, sortie) else math.inf
        for sortie, row in rows
    ]
    at = int(np.argmin(far_m))
    if not far_m[at] <= width_m / 2.0:
        where = frame.to_geographic(*stop)
        which = "the plan" if since.sortie is None else f"sortie {since.sortie}"
        raise PlanError(
            f"--from {where[0]:.6f},{where[1]:.6f} lies {far_m[at]:.3g} m from the next line of "
            f"{which}; give the place where the spraying stopped, and --sortie"
        )
    sortie, row = rows[at]
    line = _line(row)
    again_m = max(line.project(place) - since.overlap_m, 0.0)
    begin = line.interpolate(again_m)
    rest = np.array([begin.x, begin.y, *row[2:]])
    flown = np.array([*row[:2], begin.x, begin.y])
    done = [each for _, each in rows[:at]] + ([flown] if again_m > 0.0 else [])
    left = [(sortie, rest)] if line.length - again_m >= LINE_MIN_M else []
    return done, left + rows[at + 1 :]


def _untreated(row: Floats, treated: BaseGeometry) -> list[Floats]:
    """Return the parts of a line whose middle lies off the treated ground."""
    parts = shapely.get_parts(_line(row).difference(treated))
    return [
        np.array([*part.coords[0], *part.coords[-1]]) for part in parts if part.length >= LINE_MIN_M
    ]


def _line(row: Floats) -> LineString:
    return LineString([row[:2], row[2:]])


def course_deg(lines: Floats) -> float:
    """Return the course of most metres of lines, 0 to 180.

    >>> course_deg(np.array([[0.0, 0.0, 0.0, 9.0], [0.0, 9.0, 3.0, 9.0], [3.0, 9.0, 3.0, 0.0]]))
    0.0
    """
    courses = np.degrees(np.arctan2(lines[:, 2] - lines[:, 0], lines[:, 3] - lines[:, 1])) % 180.0
    keys = np.round(courses, 1) % 180.0
    each, which = np.unique(keys, return_inverse=True)
    best = int(np.argmax(np.bincount(which.ravel(), weights=lengths_m(lines))))
    longest = np.flatnonzero(keys == each[best])
    return float(courses[longest[int(np.argmax(lengths_m(lines)[longest]))]])


# ---------------------------------------------------------------------------- what a flight treated


@dataclass(frozen=True, slots=True, kw_only=True)
class UntreatedRates:
    """The rates of a map, and 0 on ground that is treated: cells of a journal, or an area.

    Asked at the middle of a valve's strip that is what a guard at half a strip's width does.
    `limit` is the border that the flight keeps to: treated ground is none.
    """

    rates: Rates
    treated: Coverage | BaseGeometry
    limit: BaseGeometry

    def rates_at(self, east_m: Floats, north_m: Floats) -> Floats:
        """Return the rate at each place [L/ha]."""
        rates = self.rates.rates_at(east_m, north_m)
        if isinstance(self.treated, Coverage):
            done = self.treated.covered_at(east_m, north_m)
        else:
            done = shapely.contains_xy(self.treated, east_m, north_m)
        return np.where(done, 0.0, rates)


def untreated_rates(
    rates: Rates,
    done: Path | None,
    field: Field,
    offset_m: tuple[float, float],
    *,
    opens: Mapping[str, str | None],
) -> Rates:
    """Return the rates without what the file says is treated; as they are without one.

    A journal's places are the receiver's, as the plan's are; an area is moved as the map.
    """
    if done is None:
        return rates
    if is_journal(done):
        found = read_treated_ground(done)
        cells = moved(found.coverage, found.frame, field.frame)
        return UntreatedRates(rates=rates, treated=cells, limit=field.kept_in)
    area = translate(
        local_area(told(partial(read_area, done, nested=True), opens), field.frame), *offset_m
    )
    shapely.prepare(area)
    return UntreatedRates(rates=rates, treated=area, limit=field.kept_in)


def demands_once(
    lines: Floats, rates: UntreatedRates, *, width_m: float, **how: Any
) -> list[Demand]:
    """Return the demand along every line as `demands`, ground under two lines with the first."""
    found: list[Demand] = []
    flown: BaseGeometry = shapely.MultiPolygon()
    for row, strip in zip(lines, rectangles(lines, width_m), strict=True):
        shapely.prepare(flown)
        left = replace(rates, rates=rates, treated=flown)
        found += demands(row[None, :], left, width_m=width_m, **how)
        flown = flown.union(strip)
    return found
