"""Sorties as somebody flies them who has no search, and what no order of sorties can do without.

Nothing of the planner is imported: plans are read from their `.geojson`, ways between places are
straight, and times are those of a rule written here. `naive` flies the passes in the order that a
plan with an endless tank has: home, straight, where the tank or the battery demands, and on from
there. `least_idle_m` is a lower bound of the ways without spraying.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from tests.mission_judge import Drawn

Floats = NDArray[np.float64]
Place = tuple[float, float]

# Take-off, climb, the return's height, landing: 3.5 m up, 15 m down, in the firmware's speeds.
UPRIGHT_S = 48.0
# A copter's waypoint radius, and how straight is straight on.
RADIUS_M, ON_DEG = 2.0, 1.0
# Corners of a field are known so well for its ferries, which may touch its border.
CORNER_M = 0.3
# So many places of a pass, and slopes, are looked at for the bound.
SAMPLES, SLOPES = 16, 41


@dataclass(frozen=True, kw_only=True)
class Flight:
    """How legs are flown: from rest to rest with a limited jerk, the next begun a little early."""

    speed_m_s: float = 6.0
    a_m_s2: float = 2.5
    jerk_m_s3: float = 1.0

    def reaching_s(self, speed_m_s: float) -> float:
        """Return how long a speed takes from rest."""
        if speed_m_s > self.a_m_s2**2 / self.jerk_m_s3:
            return speed_m_s / self.a_m_s2 + self.a_m_s2 / self.jerk_m_s3
        return 2.0 * math.sqrt(speed_m_s / self.jerk_m_s3)

    def leg_s(self, length_m: float) -> tuple[float, float]:
        """Return the time of a leg, and how long it speeds up."""
        reaching_s = self.reaching_s(self.speed_m_s)
        if length_m >= self.speed_m_s * reaching_s:
            return length_m / self.speed_m_s + reaching_s, reaching_s
        # Speeding up by a jerk and back, as far as the middle: length = 2 peak sqrt(peak / jerk).
        peak = min((length_m / 2.0) ** (2.0 / 3.0) * self.jerk_m_s3 ** (1.0 / 3.0), self.speed_m_s)
        reaching_s = length_m / peak if peak > 0.0 else 0.0
        return 2.0 * reaching_s, reaching_s

    def way_s(self, points: Sequence[Place]) -> float:
        """Return the time of a way: a leg begins when the last one is within the radius."""
        kept = _bends(points)
        legs = [self.leg_s(math.dist(a, b)) for a, b in pairwise(kept)]
        early_s = 2.0 * (6.0 * RADIUS_M / math.sqrt(2.0) / self.jerk_m_s3) ** (1.0 / 3.0)
        total_s = sum(seconds for seconds, _ in legs)
        for (one_s, one_up_s), (other_s, other_up_s) in pairwise(legs):
            total_s -= min(early_s, one_up_s, other_up_s, one_s / 2.0, other_s / 2.0)
        return total_s

    def sortie_s(self, points: Sequence[Place]) -> float:
        """Return the time of a sortie, whose last leg is the return's own."""
        return self.way_s(points[:-1]) + self.way_s(points[-2:]) + UPRIGHT_S


def _bends(points: Sequence[Place]) -> list[Place]:
    """Return the places of a way without those that it passes straight on."""
    kept: list[Place] = []
    for place in points:
        if kept and math.dist(kept[-1], place) < 0.01:
            continue
        while len(kept) > 1 and _bend_deg(kept[-2], kept[-1], place) < ON_DEG:
            kept.pop()
        kept.append(place)
    return kept


def _bend_deg(a: Place, b: Place, c: Place) -> float:
    one, two = math.atan2(b[1] - a[1], b[0] - a[0]), math.atan2(c[1] - b[1], c[0] - b[0])
    return abs((math.degrees(two - one) + 180.0) % 360.0 - 180.0)


@dataclass(frozen=True, kw_only=True)
class Figures:
    """What a set of sorties takes."""

    sorties: int
    hours: float
    spray_km: float
    idle_km: float
    most_l: float
    longest_s: float


@dataclass(frozen=True, kw_only=True)
class Pass:
    """A spray line, flown from start to end, and the way to it from the one before."""

    start: Place
    end: Place
    litres: float
    way: tuple[Place, ...] = ()

    @property
    def length_m(self) -> float:
        """Return its length."""
        return math.dist(self.start, self.end)

    def at(self, share: float) -> Place:
        """Return the place after a share of it."""
        (x, y), (u, v) = self.start, self.end
        return x + share * (u - x), y + share * (v - y)


Legs = list[tuple[str, list[Place], float]]


def legs_of(drawn: Drawn, plan: dict[str, Any]) -> dict[int, Legs]:
    """Return kind, places and litres of the legs of each sortie of a `.geojson`."""
    found: dict[int, list[tuple[int, str, list[Place], float]]] = {}
    for each in plan["features"]:
        if each["geometry"]["type"] == "LineString":
            known = each["properties"]
            metres = drawn.plane.metres(np.array(each["geometry"]["coordinates"]))
            found.setdefault(known["sortie"], []).append(
                (
                    known["sequence"], known["kind"],
                    [(float(x), float(y)) for x, y in metres], known["volume_l"],
                )
            )  # fmt: skip
    return {number: [leg[1:] for leg in sorted(legs)] for number, legs in sorted(found.items())}


def passes_of(legs: Legs) -> list[Pass]:
    """Return the spray lines of a sortie in its order, one at several speeds as one."""
    found: list[Pass] = []
    way: list[Place] = []
    for kind, points, litres in legs:
        if kind != "spray":
            way += points
            continue
        last = found[-1] if found else None
        if (
            last is not None
            and math.dist(last.end, points[0]) < 0.01
            and _bend_deg(last.start, last.end, points[-1]) < ON_DEG
        ):
            found[-1] = Pass(
                start=last.start, end=points[-1], litres=last.litres + litres, way=last.way
            )
        else:
            found.append(Pass(start=points[0], end=points[-1], litres=litres, way=tuple(way[1:-1])))
        way = []
    return found


def figures(sorties: dict[int, Legs], flight: Flight, *, refill_s: float) -> Figures:
    """Return what the sorties of a plan take, by the rule of this file."""
    times, sprayed_m, idle_m, litres = [], 0.0, 0.0, [0.0]
    for legs in sorties.values():
        times.append(flight.sortie_s([place for _, points, _ in legs for place in points]))
        litres.append(sum(volume for _, _, volume in legs))
        for kind, points, _ in legs:
            length_m = sum(math.dist(a, b) for a, b in pairwise(points))
            sprayed_m += length_m if kind == "spray" else 0.0
            idle_m += length_m if kind != "spray" else 0.0
    return Figures(
        sorties=len(times), hours=(sum(times) + refill_s * (len(times) - 1)) / 3600.0,
        spray_km=sprayed_m / 1e3, idle_km=idle_m / 1e3, most_l=max(litres),
        longest_s=max(times),
    )  # fmt: skip


Ferry = Callable[[Place], list[Place]]


def ferries_inside(drawn: Drawn, depot: Place) -> Ferry:
    """Return what finds the shortest way home over the field, by its corners (Dijkstra 1959)."""
    ground = drawn.flown().simplify(CORNER_M).buffer(2.0 * CORNER_M, join_style="mitre")
    corners = shapely.get_coordinates(ground.buffer(-CORNER_M, join_style="mitre"))
    stations = [depot, *((float(x), float(y)) for x, y in np.unique(corners, axis=0))]
    shapely.prepare(ground)
    known_m = [math.inf] * len(stations)
    known_m[0], following, left = 0.0, [0] * len(stations), set(range(len(stations)))
    while left:
        here = min(left, key=lambda each: known_m[each])
        left.discard(here)
        nearer = [
            each
            for each in left
            if known_m[here] + math.dist(stations[here], stations[each]) < known_m[each]
        ]
        ways = [shapely.LineString([stations[here], stations[each]]) for each in nearer]
        for each in np.array(nearer, dtype=np.int64)[shapely.covers(ground, ways)].tolist():
            known_m[each] = known_m[here] + math.dist(stations[here], stations[each])
            following[each] = here

    def home(place: Place) -> list[Place]:
        order = sorted(
            range(len(stations)), key=lambda each: known_m[each] + math.dist(stations[each], place)
        )
        for each in order:
            if shapely.covers(ground, shapely.LineString([place, stations[each]])):
                way = [each]
                while way[-1]:
                    way.append(following[way[-1]])
                return [stations[station] for station in way]
        return [depot]

    return home


def naive(
    passes: Sequence[Pass],
    depot: Place,
    flight: Flight,
    *,
    usable_l: float,
    limit_s: float = math.inf,
    ferry: Ferry | None = None,
) -> dict[int, Legs]:
    """Return the passes one after the other, cut where the tank or the battery demands it.

    Ferries are straight, whatever lies in their way, or those of `ferry`.
    """
    if ferry is None:
        ferry = lambda _: [depot]  # noqa: E731
    sorties: list[Legs] = []
    legs: Legs = []
    left_l = usable_l
    for each in passes:
        done = 0.0
        while done < 1.0 - 1e-9:
            to: tuple[str, list[Place], float] = (
                ("transit", [legs[-1][1][-1], *each.way, each.at(done)], 0.0)
                if legs
                else ("ferry", [*ferry(each.at(done))[::-1], each.at(done)], 0.0)
            )
            most = min(1.0, done + left_l / each.litres) if each.litres > 0.0 else 1.0
            share = _lasts([*legs, to], each, (done, most), ferry, flight, limit_s)
            if share > done + 1e-9:
                litres = each.litres * (share - done)
                legs += [to, ("spray", [each.at(done), each.at(share)], litres)]
                left_l -= litres
                done = share
            elif not legs:
                raise ValueError("the battery does not last for any of a pass")
            if done < 1.0 - 1e-9:
                sorties.append([*legs, _home(legs, ferry)])
                legs, left_l = [], usable_l
    if legs:
        sorties.append([*legs, _home(legs, ferry)])
    return dict(enumerate(sorties, start=1))


def _home(legs: Legs, ferry: Ferry) -> tuple[str, list[Place], float]:
    last = legs[-1][1][-1]
    return ("ferry", [last, *ferry(last)], 0.0)


def _lasts(
    legs: Legs, each: Pass, range_of: tuple[float, float], ferry: Ferry, flight: Flight,
    limit_s: float,
) -> float:  # fmt: skip
    """Return up to which share of a pass the battery lasts, and for the way home."""
    low, high = range_of
    if not math.isfinite(limit_s):
        return high
    before = [place for _, points, _ in legs for place in points]

    def lasts(share: float) -> bool:
        return flight.sortie_s([*before, each.at(share), *ferry(each.at(share))]) <= limit_s

    if lasts(high):
        return high
    if not lasts(low):
        return low
    for _ in range(30):
        middle = (low + high) / 2.0
        low, high = (middle, high) if lasts(middle) else (low, middle)
    return low


def least_idle_m(
    passes: Sequence[Pass], depots: Sequence[Place], *, usable_l: float, longest_m: float = math.inf
) -> float:
    """Return how far any sorties of these passes must fly without spraying.

    Let h be a height that is 0 at every depot, rises by 1 a metre at most, and by s at most along
    the passes. Somewhere on a sortie that sprays S metres and flies I without, h is at most what
    it climbed from its depot, and at most what it will climb down to it: of the two, which add up
    to I + s S at most, the lesser. In the mean over S that is I / 2 + s S / 4 at most. So
    I >= 2 (mean of h) - s S / 2, and all sorties together, none of which sprays more than a tank
    or a battery lets it, fly 2 / (most of S) * (integral of h) - s / 2 * (all passes) at least.
    With s = 1 and h the distance this allows for sorties out and back; with s = 0 it is the bound
    of Haimovich and Rinnooy Kan (1985) across the passes. Passes in other courses than most of
    them count as ways that cost nothing.
    """
    course = _main_course(passes)
    along = np.array([math.cos(course), math.sin(course)])
    rows = np.array([[*each.start, *each.end] for each in passes])
    step = rows[:, 2:] - rows[:, :2]
    length_m = np.hypot(*step.T)
    aside = np.abs(step[:, 0] * along[1] - step[:, 1] * along[0]) / length_m
    parallel = aside < math.sin(math.radians(ON_DEG))
    litres = np.array([each.litres for each in passes])
    thinnest = float((litres / length_m)[parallel & (litres > 0.0)].min())
    most_m = min(usable_l / thinnest, longest_m)
    shares = (np.arange(SAMPLES) + 0.5) / SAMPLES
    main = rows[parallel]
    places = main[:, None, :2] + shares[None, :, None] * step[parallel][:, None, :]
    away = np.stack([places - np.array(depot) for depot in depots])
    u = np.abs(away @ along)
    v = np.abs(away @ np.array([-along[1], along[0]]))
    best = 0.0
    for s in np.linspace(0.0, 1.0, SLOPES):
        steep = math.sqrt(1.0 - s * s)
        far = np.hypot(u, v)
        height = np.where(u <= s * far, far, s * u + steep * v).min(axis=0)
        bends = np.arcsin(np.clip(aside[~parallel], 0.0, 1.0))
        slopes = np.where(bends >= math.acos(s), 1.0, np.cos(math.acos(s) - bends))
        climbed_m = s / 2.0 * float(length_m[parallel].sum())
        climbed_m += float((slopes * length_m[~parallel]).sum())
        weight_m = length_m[parallel][:, None] / SAMPLES
        best = max(best, 2.0 / most_m * float((height * weight_m).sum()) - climbed_m)
    return best


def _main_course(passes: Sequence[Pass]) -> float:
    """Return the course of most metres [rad], to a tenth of a degree."""
    metres: dict[int, float] = {}
    course = {}
    for each in passes:
        (x, y), (u, v) = each.start, each.end
        angle = math.atan2(v - y, u - x) % math.pi
        key = round(math.degrees(angle) * 2.0) % 360
        metres[key] = metres.get(key, 0.0) + each.length_m
        course[key] = angle
    return course[max(metres, key=lambda key: metres[key])]
