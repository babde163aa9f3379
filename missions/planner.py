"""The whole of planning: field and rates in, mission out. No file, no clock."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np
import shapely
from shapely.errors import ShapelyError
from shapely.geometry.base import BaseGeometry

from companion.core.frame import LocalFrame
from missions.boom import Boom, boom_of, over_warnings
from missions.corners import Motion
from missions.coverage import measure, narrow_patches, narrow_warnings, of_rated_ground
from missions.demand import M2_PER_HA, Demand, Rates, Uniform, demands, valve_places
from missions.depots import DEPOTS_MAX, DepotChoice
from missions.errors import OutOfReachError, PlanError
from missions.field import Field, local_points
from missions.files.fence import Fences
from missions.files.items import ITEMS_MAX, count_of, stops_of
from missions.fleet import fleet_sorties
from missions.free_space import free_space
from missions.layouts import covers_first, crowded, flyable, is_small, spray_lines
from missions.paced import Paced, in_room, range_warnings, room_warnings
from missions.plan import Leg, Plan, Settings, Sortie, flown_lines, nose_s, sortie_wh
from missions.remaining import Remaining, UntreatedRates, demands_once
from missions.searching import is_stopped, lines_are_drawn
from missions.sheet import fleet_warnings, overlap_by_sortie_l, scheduled
from missions.sorties import Flying, SortieSearch
from missions.spacing import Spacing
from missions.speeds import choices, chosen, crawl_warnings, short_warnings, stretches_of
from missions.stops import near_warnings
from missions.strips import (
    Bools,
    Extents,
    Floats,
    Objects,
    directions,
    extents_of,
    joined,
    lengths_m,
    no_lines,
)
from missions.surroundings import NOTHING_AROUND, Pacing, Surroundings
from missions.ways import Ways, build_ways, edge_places, far_warnings

# One sortie may begin and end anywhere: its depot is chosen among so many places of the edge.
EDGE_STEP_M, EDGE_PLACES = 25.0, 24


class One(Protocol):
    """Plans the sorties of some lines from the depots of some ways."""

    def __call__(
        self, some: Floats, needs: list[Demand], ways: Ways, *, any_depot: bool = False
    ) -> Paced:
        """Return the sorties; with `any_depot`, one from the best of the depots."""
        ...


def plan_mission(
    field: Field,
    settings: Settings,
    rates: Rates,
    *,
    depots: tuple[tuple[float, float], ...] = (),
    left: Remaining | None = None,
    around: Surroundings = NOTHING_AROUND,
    with_sprayer: bool = False,
    fences: Fences | None = None,
) -> Plan:
    """Return the mission for a field; depots are (latitude, longitude).

    No sortie has more items than its autopilot has room for; `with_sprayer` they are more.
    With `fences` those for which it has no room for one are flown as several, too.
    With `left` its lines are flown, and no others. `around` is the ground that the plan follows,
    and the room that passes get beyond their ends.

    Raises:
        PlanError: where there is none, in one line with what to change.
    """
    planned = partial(
        _planned, field, rates=rates, depots=depots, left=left, around=around,
        with_sprayer=with_sprayer, fences=fences,
    )  # fmt: skip
    try:
        if settings.overlap_max_percent is None or left or not is_small(field, settings):
            return planned(settings)
        return _within_overlap(planned, settings)
    except ShapelyError as error:
        raise PlanError(
            f"the field's geometry cannot be used ({str(error)[:120]}); simplify its outline"
        ) from error


# What falls twice is known for certain only of a plan: how often valves that close save it depends
# on which pass comes first. So often it is planned anew, for a cap that much lower than is missing.
OVERLAP_TRIES, OVERLAP_LESS = 4, 0.9


def _within_overlap(planned: Callable[[Settings], Plan], settings: Settings) -> Plan:
    """Return the first plan within the cap of overlap; where there is none, that of the least."""
    cap = settings.overlap_max_percent
    assert cap is not None
    aimed = cap
    found: list[tuple[float, int, Plan]] = []
    for _ in range(OVERLAP_TRIES):
        plan = planned(replace(settings, overlap_max_percent=aimed))
        twice = sum(overlap_by_sortie_l(plan).values())
        is_known = any(np.array_equal(plan.lines, other.lines) for _, _, other in found)
        found.append((100.0 * twice / plan.volume_l, len(found), plan))
        # A cap that changes no line will not change any when it is lower, or hardly.
        if found[-1][0] <= cap or is_known or is_stopped():
            break
        aimed *= OVERLAP_LESS * cap / found[-1][0]
    _, _, best = min(found, key=lambda each: each[:2])
    return replace(best, settings=replace(best.settings, overlap_max_percent=cap))


def _planned(
    field: Field,
    settings: Settings,
    *,
    rates: Rates,
    depots: tuple[tuple[float, float], ...],
    left: Remaining | None,
    around: Surroundings,
    with_sprayer: bool,
    fences: Fences | None,
) -> Plan:
    width_m = settings.swath_width_m
    settings = _of_its_size(settings, field)
    boom, motion = boom_of(settings, field), settings.motion
    if left is None:
        lines, angle_deg = _lines(field, settings)
        sprayed = lines
    else:
        lines, angle_deg = left.lines, left.angle_deg
        sprayed = joined([left.done, lines])
    demand = _demand(lines, rates, field, settings)
    counted_before = isinstance(rates, UntreatedRates)
    if isinstance(rates, UntreatedRates):
        rates = rates.rates
    if not sum(need.total_l for need in demand) > 0.0:
        raise PlanError(
            "no part of the field has a rate above zero where a pass goes; check that the "
            "prescription is of this field"
        )
    given = _depots(field.frame, depots)
    crowding = crowded(lines, field, settings, apart=with_sprayer) if left is None else None
    lines_are_drawn()

    def one(some: Floats, needs: list[Demand], ways: Ways, *, any_depot: bool = False) -> Paced:
        spacing = Spacing(ways=ways, settings=settings, apart=with_sprayer)
        pacing = Pacing(around=around, rates=rates, spacing=spacing, settings=settings)

        def count(sortie: Sortie) -> int:
            home = ways.depots[sortie.depot].tolist()
            stops = stops_of(
                sortie, settings, around.terrain, home=(home[0], home[1]), with_sprayer=with_sprayer
            )
            return count_of(stops, settings, with_sprayer=with_sprayer)

        share = float(lengths_m(some).sum() / lengths_m(lines).sum())

        def pace(
            sorties: Sequence[Sortie], fenced: Callable[[Sortie], bool] | None = None
        ) -> Paced:
            bare = partial(
                in_room, ways=ways, pace=pacing.paced, items=count,
                room=ITEMS_MAX[settings.autopilot], fenced=fenced,
            )  # fmt: skip
            return (
                bare(sorties)
                if crowding is None
                else crowding.paced(sorties, bare, ways, share=share)
            )

        around.check(field, ways.depots)
        return flown(
            some, needs, ways, settings, motion=motion, rates=rates, pace=pace, fences=fences,
            any_depot=any_depot,
        )  # fmt: skip

    if settings.aircraft > 1:
        fleet = fleet_sorties(
            field, lines, demand, settings, angle_deg=angle_deg, depots=given, one=one
        )
        sorties, places = fleet.paced, fleet.depots
    else:
        sorties, places = _from_depots(field, lines, demand, settings, given, one)
    if crowding is not None:
        lines = sprayed = crowding.flown(sorties.sorties)
    done = no_lines() if left is None else left.done
    covered = measure(sprayed, field.limit, width_m, strips=boom.strips(sprayed))
    strips = boom.strips(joined([done, flown_lines(sorties.sorties)]))
    coverage = of_rated_ground(covered, strips, field.limit, rates=rates)
    flights = sorties.sorties
    if not counted_before:
        flights = counted(flights, rates, settings, field.kept_in, boom)
    plan = Plan(
        field=field,
        settings=settings,
        angle_deg=angle_deg,
        lines=lines,
        coverage=coverage,
        depots=tuple((float(east_m), float(north_m)) for east_m, north_m in places),
        suggested_depot=not len(given),
        sorties=flights,
        warnings=(
            *range_warnings(sorties.misses, field.frame, settings),
            *short_warnings(sorties.sorties, rates, field.frame, settings, course_deg=angle_deg),
            *crawl_warnings(flights, field.frame, settings),
            *far_warnings(sorties.sorties, places, field, has_battery=settings.battery is not None),
            *near_warnings(sorties.sorties, field.frame, apart=with_sprayer),
            *over_warnings(lines, field.limit, boom),
            *narrow_warnings(covered, field.frame, width_m),
            *around.warnings(sorties.sorties, places, field.frame, settings),
            *room_warnings(sorties),
        ),
        terrain=around.terrain,
    )
    plan = scheduled(plan)
    return replace(plan, warnings=(*plan.warnings, *fleet_warnings(plan)))


def _lines(field: Field, settings: Settings) -> tuple[Floats, float]:
    """Return the lines that are flown over a whole field, and the course of the parallel ones."""
    width_m = settings.swath_width_m
    lines, angle_deg = spray_lines(field, settings, settings.motion)
    if covers_first(settings) or not is_small(field, settings):
        lines = joined([lines, narrow_patches(lines, field.spray, field.limit, width_m)])
    return flyable(lines, field, settings), angle_deg


def _from_depots(
    field: Field,
    lines: Floats,
    demand: list[Demand],
    settings: Settings,
    given: Floats,
    one: One,
) -> tuple[Paced, Floats]:
    """Return the sorties of one aircraft and their depots: those given, else the best ones."""
    if len(given):
        return one(lines, demand, build_ways(field, given)), given
    litres = np.array([need.total_l for need in demand])
    if _is_one(settings, litres):
        edge = edge_places(field, step_m=EDGE_STEP_M, count_max=EDGE_PLACES)
        found = one(lines, demand, build_ways(field, edge), any_depot=True)
        used = sorted({sortie.depot for sortie in found.sorties})
        sorties = [replace(each, depot=used.index(each.depot)) for each in found.sorties]
        return replace(found, sorties=tuple(sorties)), edge[used]
    choice = DepotChoice(
        field=field, lines=lines, litres=litres, inside=free_space(field.fly), settings=settings
    )
    ways = choice.ways()
    while True:
        try:
            return one(lines, demand, ways), ways.depots
        except OutOfReachError:
            if len(ways.depots) >= DEPOTS_MAX:
                raise
        ways = choice.ways(len(ways.depots) + 1)


def _of_its_size(settings: Settings, field: Field) -> Settings:
    """Return settings whose boom stays whole on large fields, where little falls twice."""
    ends_over = settings.ends_over and is_small(field, settings)
    return replace(settings, ends_over=ends_over)


def _demand(lines: Floats, rates: Rates, field: Field, settings: Settings) -> list[Demand]:
    """Return what each line needs; of a field that is gone on with, what a guard leaves to it."""
    kept_m, width_m = settings.border_buffer_m, settings.swath_width_m
    limit = rates.limit if isinstance(rates, UntreatedRates) else field.kept_in
    extents = None
    if kept_m is not None:
        extents = extents_of(limit, width_m=width_m, buffer_m=kept_m)
    if isinstance(rates, UntreatedRates):
        return demands_once(lines, rates, width_m=width_m, valves=settings.valves, extents=extents)
    return demands(lines, rates, width_m=width_m, valves=settings.valves, extents=extents)


def _is_one(settings: Settings, litres: Floats) -> bool:
    """Return whether one sortie is enough for the field, whatever the way to it."""
    battery = settings.battery
    lasts = battery is None or battery.capacity_wh is None
    return lasts and float(litres.sum()) <= settings.usable_l


def _depots(frame: LocalFrame, depots: tuple[tuple[float, float], ...]) -> Floats:
    if not depots:
        return np.empty((0, 2))
    return local_points(depots, frame)


# Litres where the companion closes valves over treated ground (`coverage.switch_off_percent`).
#
# A valve needs none where a line flown before has treated its strip; what still falls twice is less
# than one valve's width of each overlap. Only what the same sortie has sprayed counts: whether the
# next one knows of it is the pilot's `--continue`.

# Treated ground is looked at so often along a line, and in so many places across a valve's strip.
ALONG_M, ACROSS = 0.5, 5
# Ground of strips that is put together lies no farther from theirs than this.
BESIDE_M = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class _Closing:
    """The boom, and its valves' strips as (right_m, width_m).

    They close from this share of treated ground on.
    """

    flown: Boom
    places: Floats
    closes_from: float
    extents: Extents | None


def counted(
    sorties: Sequence[Sortie], rates: Rates, settings: Settings, limit: BaseGeometry, flown: Boom
) -> tuple[Sortie, ...]:
    """Return the sorties with what each leg needs, and what of it falls on treated ground.

    As they are where no valve closes.
    """
    share = settings.switch_off_percent
    if share is None or not settings.valves:
        return tuple(sorties)
    kept_m = settings.border_buffer_m
    boom = _Closing(
        flown=flown,
        places=valve_places(settings.swath_width_m, settings.valves),
        closes_from=share / 100.0,
        extents=None
        if kept_m is None
        else extents_of(limit, width_m=settings.swath_width_m, buffer_m=kept_m),
    )
    return tuple(_counted(sortie, rates, boom) for sortie in sorties)


def _counted(sortie: Sortie, rates: Rates, boom: _Closing) -> Sortie:
    flown = [number for number, leg in enumerate(sortie.legs) if leg.kind == "spray"]
    if not flown:
        return sortie
    legs = list(sortie.legs)
    lines = np.array([[*legs[at].points[0], *legs[at].points[-1]] for at in flown])
    strips = boom.flown.strips(lines)
    earlier = _earlier(strips)
    for row, at in enumerate(flown):
        litres_l, twice_l = legs[at].volume_l, 0.0
        if earlier[row]:
            litres_l, twice_l = _litres(lines[row], strips[earlier[row]], rates, boom)
        legs[at] = replace(legs[at], volume_l=litres_l, overlap_l=twice_l)
    return replace(sortie, legs=tuple(legs))


def _earlier(strips: Objects) -> list[list[int]]:
    """Return which strips, flown before, lie under each."""
    found: list[list[int]] = [[] for _ in strips]
    one, other = shapely.STRtree(strips).query(strips, predicate="intersects")
    for at, before in zip(one.tolist(), other.tolist(), strict=True):
        if before < at:
            found[at].append(before)
    return found


def _litres(line: Floats, treated: Objects, rates: Rates, boom: _Closing) -> tuple[float, float]:
    """Return what a line needs, and what of it falls on treated ground."""
    length_m = float(lengths_m(line[None])[0])
    along = directions(line[None])[0]
    right = np.array([along[1], -along[0]])
    count = max(1, round(length_m / ALONG_M))
    along_m = (np.arange(count) + 0.5) * length_m / count
    places = line[:2] + along * ((np.arange(count) + 0.5) * length_m / count)[:, None]
    middle_m = boom.places[:, :1]
    aside_m = ((np.arange(ACROSS) + 0.5) / ACROSS - 0.5) * boom.places[:, 1:]
    is_done = _is_near(treated, line[:2], along, along_m, middle_m + aside_m)
    if is_done.any():
        points = places[:, None, None] + right * middle_m[..., None] + right * aside_m[..., None]
        is_done[is_done] = _are_in(treated, points[is_done])
    share = is_done.mean(axis=2).T
    middle = places + right * boom.places[:, :1, None]
    rate = rates.rates_at(middle[..., 0].ravel(), middle[..., 1].ravel()).reshape(share.shape)
    rate = np.nan_to_num(rate, nan=0.0)
    if boom.extents is not None:
        to_right = np.broadcast_to(right, places.shape)
        for row, (right_m, width_m) in zip(rate, boom.places.tolist(), strict=True):
            row *= boom.extents.is_open(places, to_right, (right_m, width_m))
    rate = np.where(share >= boom.closes_from - 1e-9, 0.0, rate)
    each_l = rate * boom.places[:, 1:] * length_m / count / M2_PER_HA
    return sum(each_l.sum(axis=1).tolist()), sum((each_l * share).sum(axis=1).tolist())


def _are_in(strips: Objects, points: Floats) -> Bools:
    """Return which points lie in any of some strips: putting these together takes far longer."""
    shapely.prepare(strips)
    found = np.zeros(len(points), dtype=np.bool_)
    for strip in strips:
        left = np.flatnonzero(~found)
        found[left] = shapely.intersects_xy(strip, points[left])
    return found


def _is_near(
    strips: Objects, start: Floats, along: Floats, along_m: Floats, across_m: Floats
) -> Bools:
    """Return which places beside a line may lie in strips: those in the box of one along the line.

    Passes beside each other share a hair, and headlands the ends: most places need no closer look.
    """
    points, strip_of = shapely.get_coordinates(strips, return_index=True)
    first = np.flatnonzero(np.diff(strip_of, prepend=-1))
    found: Bools = np.zeros((len(along_m), *across_m.shape), dtype=np.bool_)
    is_within = []
    for unit, at_m in ((along, along_m), (np.array([along[1], -along[0]]), across_m)):
        corners_m = (points - start) @ unit
        low_m = np.minimum.reduceat(corners_m, first) - BESIDE_M
        high_m = np.maximum.reduceat(corners_m, first) + BESIDE_M
        is_within.append(
            [(at_m >= low) & (at_m <= high) for low, high in zip(low_m, high_m, strict=True)]
        )
    for on_along, on_across in zip(*is_within, strict=True):
        found |= on_along[:, None, None] & on_across
    return found


# Sorties with their speeds, each within a tank and, as it is flown in the end, a battery.

# What the search does not know, bends and turns of the nose, is so much that it needs no more.
ROUNDS = 8
LESS = 0.995
# As they are flown in the end, sorties take so much less than as they are drawn first, or more.
ROUGHLY = 1.01
# Flights take up to 0.8 % more of a battery than they are planned with: 383 ha, 230 sorties.
MARGIN = 0.991


class Pace(Protocol):
    """Gives sorties the speeds that rates and ground need, and cuts those without room."""

    def __call__(
        self, sorties: Sequence[Sortie], fenced: Callable[[Sortie], bool] | None = None
    ) -> Paced:
        """Return the sorties; with `fenced` each has a fence, as far as cutting helps."""
        ...


def flown(
    lines: Floats,
    demand: list[Demand],
    ways: Ways,
    settings: Settings,
    *,
    motion: Motion,
    rates: Rates,
    pace: Pace,
    fences: Fences | None = None,
    any_depot: bool = False,
) -> Paced:
    """Return the sorties, with `fences` such that each has room for one.

    With `any_depot` one sortie is to be flown from the best of the depots.

    Raises:
        PlanError: where a tank or a battery does not last for any.
    """
    battery = settings.battery
    usable_wh = math.inf if battery is None else MARGIN * battery.usable_wh
    pace_s_m = line_pace(lines, rates, settings) if math.isfinite(usable_wh) else None
    flying = Flying(motion=motion, pace_s_m=pace_s_m, any_depot=any_depot)
    search = SortieSearch(lines=lines, demand=demand, ways=ways, settings=settings, flying=flying)
    sorties, found = _lasting(search, pace, usable_wh)
    lack = 0 if fences is None else sum(not fences.has_room(each) for each in found.sorties)
    if fences is None or not lack:
        return found
    cut = partial(pace, fenced=fences.has_room)
    more = cut(sorties)
    if max(each_wh(more.sorties, settings)) > usable_wh:
        _, more = _lasting(search, cut, usable_wh)
    return replace(more, unfenced=lack, uncut=len(found.sorties))


def _lasting(
    search: SortieSearch, pace: Callable[[Sequence[Sortie]], Paced], usable_wh: float
) -> tuple[tuple[Sortie, ...], Paced]:
    """Return sorties as they were found and as they are flown: the battery lasts for each."""
    settings = search.settings
    one = search.in_one()
    if one is not None:
        found = pace(one)
        if max(each_wh(found.sorties, settings)) <= usable_wh:
            return one, found
    share = 1.0
    parts, sorties = search.several()
    for _ in range(ROUNDS):
        # Most of what the search does not know shows before speeds and ways are made as they are
        # flown, which takes far longer.
        used_wh = [wh / ROUGHLY for wh in each_wh(search.timed(sorties), settings)]
        if max(used_wh) <= usable_wh:
            found = pace(sorties)
            used_wh = each_wh(found.sorties, settings)
        worst_wh = max(used_wh)
        if worst_wh <= usable_wh:
            return sorties, found
        better = None
        # Those with more items than an autopilot has room for are flown as several.
        if len(used_wh) == len(parts):
            better = search.with_less(parts, used_wh, usable_wh)
        if better is None:
            share *= LESS * usable_wh / worst_wh
            better = search.several(share, before=parts)
        parts, sorties = better
    raise PlanError(
        f"a sortie takes {worst_wh:.4g} Wh, and may take {usable_wh:.4g} Wh of what the battery "
        "has above its reserve; see mission.battery_wh"
    )


def each_wh(sorties: Sequence[Sortie], settings: Settings) -> list[float]:
    """Return what each sortie takes; 0 where no power is given."""
    battery = settings.battery
    if battery is None:
        return [0.0] * len(sorties)
    return [
        sortie_wh(
            sortie, battery, vertical=settings.vertical, height_m=settings.height_m,
            reserve_l=settings.reserve_l,
            nose_turn_s=nose_s(
                sortie.legs, turn=settings.turn, rate_deg_s=settings.nose_rate_deg_s
            ),
        )
        for sortie in sorties
    ]  # fmt: skip


def line_pace(lines: Floats, rates: Rates, settings: Settings) -> Floats:
    """Return the time of a metre of each line, at the speeds that its rates need."""
    if settings.flow_l_min is None:
        return np.full(len(lines), 1.0 / settings.speed_m_s)
    if isinstance(rates, Uniform):
        # All lines are flown at one speed.
        return np.full(len(lines), _pace_s_m(lines[0].tolist(), rates, settings))
    return np.array([_pace_s_m(row, rates, settings) for row in lines.tolist()])


def _pace_s_m(row: list[float], rates: Rates, settings: Settings) -> float:
    leg = Leg(
        kind="spray", points=((row[0], row[1]), (row[2], row[3])), speed_m_s=settings.speed_m_s
    )
    parts = stretches_of(leg, rates, settings)
    taken = chosen(parts, choices(parts, settings), settings.acceleration_m_s2)
    return float(np.sum(np.diff(parts.ends_m, prepend=0.0) / taken)) / leg.length_m
