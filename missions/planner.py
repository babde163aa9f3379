"""The whole of planning: field and rates in, mission out. No file, no clock."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from shapely.errors import ShapelyError

from companion.core.frame import LocalFrame
from missions.angle import LAYOUT_WEIGHT, cost_s, ranked
from missions.coverage import measure
from missions.demand import Demand, Rates, demands
from missions.errors import PlanError
from missions.extents import extents_of
from missions.field import Field, local_points
from missions.fitted_lines import fitted_lines, has_edges_along
from missions.fleet import fleet_sorties
from missions.flown import flown
from missions.open_lines import needed_passes, open_lines
from missions.paced import Paced, range_warnings
from missions.patches import patches
from missions.plan import Plan, Settings, Sortie
from missions.remaining import Remaining
from missions.schedule import scheduled
from missions.short import short_warnings
from missions.strips import Floats, joined
from missions.surroundings import NOTHING_AROUND, Surroundings
from missions.swaths import border_passes, inner_ground, inner_lines
from missions.turns import Motion
from missions.ways import Ways, build_ways, suggested_depot

# Of the best courses so many are drawn in full.
ANGLES_TRIED = 2


def plan_mission(
    field: Field,
    settings: Settings,
    rates: Rates,
    *,
    depots: tuple[tuple[float, float], ...] = (),
    left: Remaining | None = None,
    around: Surroundings = NOTHING_AROUND,
) -> Plan:
    """Return the mission for a field; depots are (latitude, longitude).

    With `left` its lines are flown, and no others. `around` is the ground that the plan follows,
    and the room that passes get beyond their ends.

    Raises:
        PlanError: where there is none, in one line with what to change.
    """
    try:
        return _planned(field, settings, rates, depots, left, around)
    except ShapelyError as error:
        raise PlanError(
            f"the field's geometry cannot be used ({str(error)[:120]}); simplify its outline"
        ) from error


def _planned(
    field: Field,
    settings: Settings,
    rates: Rates,
    depots: tuple[tuple[float, float], ...],
    left: Remaining | None,
    around: Surroundings,
) -> Plan:
    width_m = settings.swath_width_m
    motion = Motion(
        speed_m_s=settings.speed_m_s,
        acceleration_m_s2=settings.acceleration_m_s2,
        turn=settings.turn,
    )
    if left is None:
        lines, angle_deg = spray_lines(field, settings, motion)
        sprayed = lines
    else:
        lines, angle_deg = left.lines, left.angle_deg
        sprayed = joined([left.done, lines])
    kept_m = settings.border_buffer_m
    extents = None
    if kept_m is not None:
        extents = extents_of(field.limit, width_m=width_m, buffer_m=kept_m)
    demand = demands(lines, rates, width_m=width_m, valves=settings.valves, extents=extents)
    litres = np.array([need.total_l for need in demand])
    if not float(litres.sum()) > 0.0:
        raise PlanError("nothing of the field has a rate above zero; check the prescription")
    given = _depots(field.frame, depots)

    def one(some: Floats, needs: list[Demand], ways: Ways) -> Paced:
        def pace(sorties: Sequence[Sortie]) -> Paced:
            return around.paced(sorties, rates, field, settings)

        around.check(field, ways.depots)
        return flown(some, needs, ways, settings, motion=motion, rates=rates, pace=pace)

    if settings.aircraft > 1:
        fleet = fleet_sorties(
            field, lines, demand, settings, angle_deg=angle_deg, depots=given, one=one
        )
        sorties, places = fleet.paced, fleet.depots
    else:
        places = given if len(given) else suggested_depot(field, lines, litres)
        sorties = one(lines, demand, build_ways(field, places))
    plan = Plan(
        field=field,
        settings=settings,
        angle_deg=angle_deg,
        lines=lines,
        coverage=measure(sprayed, field.limit, width_m),
        depots=tuple((float(east_m), float(north_m)) for east_m, north_m in places),
        suggested_depot=not len(given),
        sorties=sorties.sorties,
        warnings=(
            *range_warnings(sorties.misses, field.frame, settings),
            *short_warnings(sorties.sorties, rates, field.frame, settings),
            *around.warnings(sorties.sorties, places, field.frame, settings),
        ),
        terrain=around.terrain,
    )
    return scheduled(plan)


def spray_lines(field: Field, settings: Settings, motion: Motion) -> tuple[Floats, float]:
    """Return the lines that cover the field, and the course of the parallel ones.

    Two ways are tried for the best courses: a pass along the whole border with lines inside, and
    lines from border to border with passes only where they are needed.
    """
    width_m, ground = settings.swath_width_m, field.spray
    inner, passes = inner_ground(ground, width_m), border_passes(ground, width_m)
    if settings.angle_deg is None:
        angles = [angle for _, angle in ranked(inner, ground, width_m=width_m, motion=motion)]
        angles = angles[:ANGLES_TRIED]
    else:
        angles = [settings.angle_deg]
    tried: list[tuple[float, float, Floats]] = []
    for number, angle_deg in enumerate(angles):
        choices = []
        if number == 0:
            choices.append(joined([passes, inner_lines(inner, width_m, angle_deg)]))
        straights = [open_lines(ground, width_m, angle_deg)]
        if number == 0 and has_edges_along(ground, width_m, angle_deg):
            straights.append(fitted_lines(ground, width_m, angle_deg, motion))
        for straight in straights:
            if len(straight):
                more = needed_passes(straight, passes, ground, width_m)
                choices.append(joined([more, straight]))
        for lines in choices:
            whole = joined([lines, patches(lines, ground, width_m)])
            cost = cost_s(whole, motion, width_m, ground.area, weight=LAYOUT_WEIGHT)
            tried.append((cost, angle_deg, whole))
    _, best_deg, best = min(tried, key=lambda each: each[0])
    return best, best_deg


def _depots(frame: LocalFrame, depots: tuple[tuple[float, float], ...]) -> Floats:
    if not depots:
        return np.empty((0, 2))
    return local_points(depots, frame)
