"""What lies around a plan: the ground below it, and the room beyond its passes for run-in, run-out.

From rest to a speed takes the way that the autopilot's acceleration and jerk need. Where the
ground beyond the end of a line may be flown over, the aircraft starts that far before it and brakes
that far behind it; where it may not, the pass begins as fast as the room allows, and that is said.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from companion.core.frame import LocalFrame
from missions.corners import Course
from missions.demand import Rates
from missions.field import Field
from missions.heights import return_warnings, slowed
from missions.paced import Paced, paced
from missions.plan import Leg, Place, Settings, Sortie, at_ferry_height
from missions.spacing import Spacing
from missions.speeds import Miss
from missions.stops import RUN_M, timed
from missions.strips import Floats
from missions.terrain import Terrain

# ------------------------------------------------------------------------------- run-in and run-out

# Less room is not worth a waypoint: half a metre a second is reached on it.
ROOM_MIN_M = 0.5
# Ways outside the field go no farther from it, where they are allowed.
OVERRUN_M = 500.0
TOUCH_M = 1e-6
# A pass that begins at so much of its speed is not worth a word.
NEARLY = 0.95
# Cosine of what counts as straight into a line.
STRAIGHT = 1.0 - 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class RunIn:
    """How much way passes get beyond their ends, at most; None takes what the speed needs.

    `ground` is where it may lie; None is the field that may be flown over.
    """

    run_m: float | None = None
    ground: BaseGeometry | None = None

    def wanted_m(self, course: Course) -> float:
        """Return the way from rest to a speed, or what is asked for.

        No more than needs no waypoint of its own, which would slow the aircraft down again.

        >>> course = Course(speed_m_s=6.0, acceleration_m_s2=2.5, jerk_m_s3=None)
        >>> round(RunIn().wanted_m(course), 1), RunIn(run_m=4.0).wanted_m(course)
        (7.2, 4.0)
        """
        needed_m = min(course.reaching_m, RUN_M)
        return needed_m if self.run_m is None else min(self.run_m, needed_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class _End:
    """One end of a pass with its room: `beyond` is where the run begins or ends."""

    at: Place
    beyond: Place


def with_run_ins(
    sorties: Sequence[Sortie], field: Field, settings: Settings, run_in: RunIn
) -> tuple[Sortie, ...]:
    """Return the sorties with run-ins and run-outs, as far as there is room for them."""
    ground = field.fly if run_in.ground is None else run_in.ground
    space = ground.buffer(TOUCH_M, join_style="mitre")
    shapely.prepare(space)
    drawn = _Drawn(space=space, settings=settings, run_in=run_in)
    return tuple(replace(sortie, legs=drawn.legs(sortie.legs)) for sortie in sorties)


def slow_starts(
    sorties: Sequence[Sortie], frame: LocalFrame, settings: Settings
) -> tuple[str, ...]:
    """Return how many passes begin below their speed, and where the slowest does."""
    starts = [
        (_start_m_s(before, line, settings), line.speed_m_s, line.points[0])
        for sortie in sorties
        for before, line in pairwise(sortie.legs)
        if line.kind == "spray" and before.kind != "spray" and not before.through
    ]
    slow = [each for each in starts if each[0] < NEARLY * each[1]]
    if not slow:
        return ()
    speed, wanted, at = min(slow, key=lambda each: (each[0] - each[1], each[2]))
    latitude_deg, longitude_deg = frame.to_geographic(*at)
    return (
        f"{len(slow)} of {len(starts)} passes begin below their speed for want of room, the "
        f"slowest at {speed:.1f} instead of {wanted:g} m/s near {latitude_deg:.6f}, "
        f"{longitude_deg:.6f}; allow ways outside the field (mission.overrun)",
    )


def _start_m_s(before: Leg, line: Leg, settings: Settings) -> float:
    """Return how fast a line can be begun from the straight part of the way before it."""
    straight = np.subtract(before.points[-1], before.points[-2])
    along = np.subtract(line.points[-1], line.points[0])
    room_m = float(np.hypot(*straight))
    if not float(straight @ along) > STRAIGHT * room_m * float(np.hypot(*along)):
        return 0.0
    return settings.motion.at(line.speed_m_s).reached_m_s(room_m)


class _Drawn:
    """Legs with more way at the ends of the passes."""

    def __init__(self, *, space: BaseGeometry, settings: Settings, run_in: RunIn) -> None:
        self._space = space
        self._settings = settings
        self._run_in = run_in

    def legs(self, legs: Sequence[Leg]) -> tuple[Leg, ...]:
        """Return the legs of a sortie; a way that is flown through without a stop stays."""
        found = list(legs)
        for number, leg in enumerate(legs):
            if leg.kind == "spray" or leg.through:
                continue
            before = legs[number - 1] if number else None
            after = legs[number + 1] if number + 1 < len(legs) else None
            out = None if before is None else self._end(before.points[-1], before, onward=True)
            into = None if after is None else self._end(after.points[0], after, onward=False)
            found[number] = replace(leg, points=tuple(self._way(leg, out, into)))
        return tuple(found)

    def _end(self, at: Place, line: Leg, *, onward: bool) -> _End | None:
        """Return how far the ground beyond an end of a pass is free, None without room."""
        (x0, y0), (x1, y1) = line.points[0], line.points[-1]
        length_m = math.hypot(x1 - x0, y1 - y0)
        sign = 1.0 if onward else -1.0
        along = (sign * (x1 - x0) / length_m, sign * (y1 - y0) / length_m)
        course = self._settings.motion.at(line.speed_m_s)
        room_m = self._room_m(at, along, self._run_in.wanted_m(course))
        if not room_m >= ROOM_MIN_M:
            return None
        return _End(
            at=at,
            beyond=(at[0] + along[0] * room_m, at[1] + along[1] * room_m),
        )

    def _room_m(self, at: Place, along: Place, wanted_m: float) -> float:
        ray = shapely.LineString([at, (at[0] + along[0] * wanted_m, at[1] + along[1] * wanted_m)])
        if shapely.covers(self._space, ray):
            return wanted_m
        for part in shapely.get_parts(shapely.intersection(ray, self._space)).tolist():
            if part.distance(shapely.Point(at)) < 1e-3:
                return float(part.length) - 2.0 * TOUCH_M
        return 0.0

    def _way(self, leg: Leg, out: _End | None, into: _End | None) -> list[Place]:
        """Return the way with as much of both runs as leaves it on free ground."""
        for one, other in ((out, into), (None, into), (out, None)):
            way = list(leg.points)
            if one is not None:
                way.insert(1, one.beyond)
            if other is not None:
                way.insert(len(way) - 1, other.beyond)
            new = [pair for pair in pairwise(way) if pair not in set(pairwise(leg.points))]
            if new and bool(shapely.covers(self._space, shapely.linestrings(new)).all()):
                return way
        return list(leg.points)


# --------------------------------------------------------------------------------- what lies around


@dataclass(frozen=True, slots=True, kw_only=True)
class Surroundings:
    """The ground that is followed and the run-ins that are wanted; None is neither."""

    terrain: Terrain | None = None
    run_in: RunIn | None = None

    def check(self, field: Field, depots: Floats) -> None:
        """Refuse an elevation model that does not know all of the field and its depots."""
        if self.terrain is not None:
            self.terrain.check_field(field, depots)

    def paced(
        self, sorties: Sequence[Sortie], rates: Rates, spacing: Spacing, settings: Settings
    ) -> Paced:
        """Return the sorties with the speeds of rates and slopes, their run-ins and times."""
        found = paced(sorties, rates, settings, self.terrain)
        longer, run_in_m = found.sorties, 0.0
        if self.run_in is not None:
            longer = with_run_ins(longer, spacing.ways.field, settings, self.run_in)
            run_in_m = self.run_in.wanted_m(settings.motion.at(settings.speed_m_s))
        longer = spacing.spaced(longer)
        if self.terrain is not None:
            longer = tuple(self._slowed(sortie, settings) for sortie in longer)
        raised = at_ferry_height(longer, settings, run_in_m=run_in_m)
        return replace(found, sorties=timed(raised, settings))

    def _slowed(self, sortie: Sortie, settings: Settings) -> Sortie:
        """Return a sortie whose new ways keep to the slopes as well."""
        if self.terrain is None:
            return sortie
        legs = [
            leg if leg.kind == "spray" else slowed(leg, self.terrain, settings)
            for leg in sortie.legs
        ]
        return replace(sortie, legs=tuple(legs))

    def warnings(
        self, sorties: Sequence[Sortie], depots: Floats, frame: LocalFrame, settings: Settings
    ) -> tuple[str, ...]:
        """Return what to say of the way back over hills, and of passes without room."""
        said: tuple[str, ...] = ()
        if self.terrain is not None:
            places = [(float(east_m), float(north_m)) for east_m, north_m in depots]
            said += return_warnings(sorties, self.terrain, places, settings.height_m)
        if self.run_in is not None:
            said += slow_starts(sorties, frame, settings)
        return said


NOTHING_AROUND = Surroundings()


@dataclass(frozen=True, kw_only=True)
class Pacing:
    """Paces each sortie once: most come again when others are laid out anew or cut."""

    around: Surroundings
    rates: Rates
    spacing: Spacing
    settings: Settings
    _known: dict[tuple[Leg, ...], tuple[tuple[Leg, ...], list[Miss]]] = field(
        default_factory=dict, repr=False, compare=False
    )

    def paced(self, sorties: Sequence[Sortie]) -> Paced:
        """Return what `Surroundings.paced` does."""
        new = [each for each in sorties if each.legs not in self._known]
        if new:
            found = self.around.paced(new, self.rates, self.spacing, self.settings)
            for given, made in zip(new, found.sorties, strict=True):
                misses = [miss for number, miss in found.misses if number == given.number]
                self._known[given.legs] = made.legs, misses
        known = [self._known[each.legs] for each in sorties]
        return Paced(
            sorties=tuple(
                replace(each, legs=legs) for each, (legs, _) in zip(sorties, known, strict=True)
            ),
            misses=tuple(
                (each.number, miss)
                for each, (_, misses) in zip(sorties, known, strict=True)
                for miss in misses
            ),
        )
