"""`vrspray make spots`: weeds to a prescription that hits them although errors add up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import shapely
import typer
from shapely import MultiPolygon
from shapely.geometry.base import BaseGeometry

from companion.cli.answer import (
    note,
    problem_object,
    progress,
)
from companion.config import Config
from companion.core.frame import LocalFrame
from companion.wording import counted
from missions.files.write import check_suffix, refuse_existing, remove_older, write_fleet
from missions.make.data import in_degrees, points_of
from missions.make.flown import (
    FlownField,
    Making,
    check_rate,
    limits_of,
    making,
    problems_of,
)
from missions.make.passes import passes_of
from missions.make.spots import Budget, Opening, Part, grounds, misses, openings, pieces
from missions.maps.assemble import crs_of, ground_of, zone_names
from missions.maps.crs import to_longitude_latitude
from missions.maps.csvfile import read_point_table
from missions.maps.local import places as local_places
from missions.maps.local import project_all
from missions.maps.model import Grid, MapFile, MapZone, digest, map_error, read_bytes
from missions.maps.registry import read_layer
from missions.plan import Plan
from missions.planner import plan_mission
from missions.remaining import Remaining
from missions.strips import Floats, lengths_m

BAR_AFTER_S = 2.0
# Positions, 1 sd along one axis, by the least fix that safety lets through: an RTK fix as simulated
# (docs/explanation/simulation.md), RTK float up to the limit on what the receiver says of itself,
# the others as receivers have it in the open.
POSITION_M = {"rtk-fixed": 0.02, "rtk-float": 0.3, "dgps": 0.6, "3d": 1.5}
# Of a lag, from one change to the next, and of a servo frame of 20 ms: as simulated.
LAG_SHARE, SERVO_S = 0.05, 0.020 / math.sqrt(12.0)
# What is left of the autopilot's clock once it is followed: the largest shift at 5 m/s, 5.8 mm
# (docs/measurements/performance.md, a clock of another rate).
CLOCK_S = 0.0012
# What corrected wind leaves: how far wind is known, 1 sd.
WIND_SD_M_S = 0.5
# A stretch begins so much before the way that the aircraft takes to its speed.
LEAD_M = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class _Weeds:
    """Weeds in metres east and north, and where they count as hit."""

    areas: tuple[BaseGeometry, ...]

    @property
    def middles(self) -> Floats:
        return shapely.get_coordinates([shapely.centroid(one) for one in self.areas])


class _OnSpots:
    """The rate on what is sprayed, and 0 elsewhere."""

    def __init__(self, treated: BaseGeometry, rate_l_ha: float) -> None:
        self._treated, self._rate = treated, rate_l_ha
        shapely.prepare(self._treated)

    def rates_at(self, east_m: Floats, north_m: Floats) -> Floats:
        """Return the rate at each place [L/ha]."""
        return np.where(shapely.contains_xy(self._treated, east_m, north_m), self._rate, 0.0)


@making
def spots(
    weeds: Annotated[Path, typer.Argument(metavar="WEEDS", help="Points or small polygons.")],
    making: Making,
    rate: Annotated[float, typer.Option(metavar="R", help="L/ha on the spots.", min=0.001)],
    weeds_m: Annotated[
        float,
        typer.Option(metavar="M", help="How exactly weeds are located, 1 sd.", min=0.0, max=10.0),
    ] = 0.1,
    radius_m: Annotated[
        float,
        typer.Option(metavar="M", help="Radius of a weed that is a point.", min=0.0, max=20.0),
    ] = 0.1,
    position_m: Annotated[
        float | None,
        typer.Option(
            metavar="M",
            help="Position error of the aircraft, 1 sd; default: by safety.fix.",
            min=0.0,
            max=10.0,
        ),
    ] = None,
    wind_m_s: Annotated[
        float, typer.Option(metavar="V", help="Wind to allow for.", min=0.0, max=20.0)
    ] = 2.0,
    miss_percent: Annotated[
        float,
        typer.Option(metavar="PCT", help="Largest chance of missing a weed.", min=0.01, max=50.0),
    ] = 2.0,
    mission: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Also write the quickest mission: .plan, .waypoints, ..."
        ),
    ] = None,
    crs: Annotated[
        str | None, typer.Option(metavar="C", help="CRS of WEEDS, where it does not say.")
    ] = None,
    layer: Annotated[
        str | None, typer.Option(metavar="L", help="Layer of WEEDS, where there are several.")
    ] = None,
) -> None:
    """Spray weeds alone, with ground around them.

    As much as the errors of this sprayer ask for. Says where the errors come from, what is saved,
    and how many weeds will be missed. Flies from spot to spot where that is quicker than the
    passes over the field.

    Exit 0: made; 1: made, and the check of the map found errors; 2: refused.
    """
    config = making.config(mission)
    if mission is not None:
        check_suffix(mission)
        if not making.force:
            refuse_existing(mission, option="--mission")
    with progress(after_s=BAR_AFTER_S) as tell:
        tell("planning the passes", 0, 4)
        field = making.field(config, "valve")
        limits = limits_of(config, field.sprayer, 1.0)
        check_rate(rate, limits, said=f"--rate {rate:g}")
        tell("reading the weeds", 1, 4)
        found, beyond = _inside(read_weeds(weeds, field.frame, radius_m, crs, layer), field, weeds)
        budget = Budget(
            parts=budget_parts(
                config, field, weeds_m=weeds_m, position_m=position_m, wind_m_s=wind_m_s
            ),
            miss_share=miss_percent / 100.0,
        )
        opened = openings(
            [shapely.transform(one, field.passes.turned) for one in found.areas],
            field.passes.edges_m, budget, least_m=limits.least_m,
            gap_m=_gap_m(config, field),
        )  # fmt: skip
        treated = shapely.intersection(
            shapely.union_all(grounds(opened, field.passes.edges_m)), field.turned()
        )
        chances = misses(field.passes.turned(found.middles), treated, budget)
        map_file = _map_file(field, treated, making.target, weeds, rate)
        problems = problems_of(map_file, config, field)
        tell("planning the mission", 2, 4)
        plans = _plans(field, opened, treated, rate)
        best = min(plans, key=lambda name: plans[name].flight_s)
        tell("writing", 3, 4)
        files = making.written(map_file, config, field, problems)
        if mission is not None:
            more, marks = write_fleet(plans[best], mission)
            remove_older(mission, [*more, *marks])
            files = [*files, *more, *marks]
    ground_m2 = field.turned().area
    is_exposed = chances > budget.miss_share + 1e-9
    result: dict[str, Any] = {
        "ok": not any(problem.severity == "error" for problem in problems),
        "files": [str(path) for path in files],
        "weeds": len(found.areas),
        "beyond": beyond,
        "budget": {
            "parts": [
                {"name": one.name, "along_m": one.along_m, "across_m": one.across_m,
                 "by_chance": one.by_chance}
                for one in budget.parts
            ],
            "along_m": budget.reach_m("along"),
            "across_m": budget.reach_m("across"),
            "miss_percent": miss_percent,
        },
        "gap_min_m": _gap_m(config, field),
        "least_m": limits.least_m,
        "course_deg": field.passes.angle_deg,
        "spots": len(shapely.get_parts(treated)),
        "openings": len(opened),
        "treated_ha": treated.area / 1e4,
        "treated_percent": 100.0 * treated.area / ground_m2,
        "litres": treated.area / 1e4 * rate,
        "saved_litres": (ground_m2 - treated.area) / 1e4 * rate,
        "saved_percent": 100.0 * (1.0 - treated.area / ground_m2),
        "exposed": int(is_exposed.sum()),
        "exposed_misses": float(chances[is_exposed].sum()),
        "expected_misses": float(chances.sum()),
        "expected_misses_percent": 100.0 * float(chances.mean()),
        "route": best,
        "flight_s": {name: plan.flight_s for name, plan in plans.items()},
        "warnings": list(plans[best].warnings),
        "problems": [problem_object(problem) for problem in problems],
    }  # fmt: skip
    for warning in result["warnings"]:
        note(f"warning: {warning}")
    making.answer(result, _lines(result))


# What is read.


def read_weeds(
    path: Path, frame: LocalFrame, radius_m: float, crs: str | None, layer: str | None
) -> _Weeds:
    """Return the weeds of a file; points are discs of a radius."""
    areas: list[BaseGeometry] = []
    table = read_point_table(path) if path.suffix.casefold() == ".csv" else None
    if table is not None:
        points, own, _ = table
        degrees = in_degrees(points, own, crs, path)
        areas += _discs(degrees, frame, radius_m)
    else:
        found = read_layer(path, layer=layer)
        if isinstance(found, Grid):
            raise map_error(
                path, "a raster holds no weeds", fix="export points or polygons", code="no-polygon"
            )
        native, _ = crs_of(found, path, crs)
        marks, _ = points_of(found)
        if len(marks):
            moved = to_longitude_latitude(marks, native, path=path)
            areas += _discs(shapely.get_coordinates(moved), frame, radius_m)
        if any(one is not None for one in found.geometries):
            ground, _ = ground_of(found, native, zone_names(found), path)
            kept = np.array([one for one in ground if one is not None], dtype=object)
            areas += list(project_all(kept, frame))
    if not areas:
        raise map_error(path, "it has no weeds", fix="export points or polygons", code="no-polygon")
    return _Weeds(areas=tuple(areas))


def _discs(degrees: Floats, frame: LocalFrame, radius_m: float) -> list[BaseGeometry]:
    points = local_places(list(zip(degrees[:, 1], degrees[:, 0], strict=True)), frame)
    return [shapely.Point(at).buffer(max(radius_m, 1e-3), quad_segs=4) for at in points]


def _inside(weeds: _Weeds, field: FlownField, path: Path) -> tuple[_Weeds, int]:
    """Return the weeds in the field, and how many are not."""
    ground = field.task.field.limit
    shapely.prepare(ground)
    inside = tuple(one for one in weeds.areas if ground.intersects(shapely.centroid(one)))
    if not inside:
        raise map_error(
            path, f"none of its {len(weeds.areas)} weeds is in the field",
            fix="check that it belongs to this boundary, and --crs if you gave it",
            code="no-data",
        )  # fmt: skip
    return _Weeds(areas=inside), len(weeds.areas) - len(inside)


# Where errors come from.


def budget_parts(
    config: Config, field: FlownField, *, weeds_m: float, position_m: float | None, wind_m_s: float
) -> tuple[Part, ...]:
    """Return the parts of the error budget, from what the configuration has measured."""
    lag, speed = config.lag, field.sprayer.speed_m_s
    here_m = POSITION_M[config.safety.fix] if position_m is None else position_m
    # A step of flow has its middle on the edge: half of it lies on either side.
    half_s = max(lag.on_s - lag.on_start_s, lag.off_end_s - lag.off_s, 0.0)
    servo_s = SERVO_S if config.output.kind == "servo" else 0.0
    jitter_s = math.hypot(LAG_SHARE * (max(lag.on_s, lag.off_s) + lag.output_s), servo_s)
    drift = config.model_copy(
        update={"drift": config.drift.model_copy(update={"enabled": True})}
    ).drift_law()
    assert drift is not None
    blown_m = drift.fall_s * (WIND_SD_M_S if config.drift.enabled else wind_m_s)
    carried_m = 0.0 if config.drift.enabled else drift.forward_carry_m

    def chance(name: str, along_m: float, across_m: float) -> Part:
        return Part(name=name, along_m=along_m, across_m=across_m, by_chance=True)

    def sure(name: str, along_m: float, across_m: float) -> Part:
        return Part(name=name, along_m=along_m, across_m=across_m, by_chance=False)

    return (
        chance("place of the weeds", weeds_m, weeds_m),
        chance("position of the aircraft", here_m, here_m),
        chance("scatter of the lags", speed * jitter_s, 0.0),
        sure("autopilot's clock", speed * CLOCK_S, 0.0),
        sure("rise and end of the flow", speed * half_s, 0.0),
        sure("half a PWM period", speed * field.sprayer.period_s / 2.0, 0.0),
        chance("wind that is left", blown_m, blown_m)
        if config.drift.enabled
        else sure(f"wind of {wind_m_s:g} m/s", blown_m, blown_m),
        *(() if config.drift.enabled else (sure("carried on", carried_m, 0.0),)),
    )


def _gap_m(config: Config, field: FlownField) -> float:
    """Return the shortest gap in which a valve closes and opens again."""
    lag = config.lag
    return field.sprayer.speed_m_s * (lag.off_s + lag.on_s + field.sprayer.period_s)


# What comes of it.


def _map_file(
    field: FlownField, treated: BaseGeometry, target: Path, weeds: Path, rate: float
) -> MapFile:
    around = shapely.difference(field.turned(), treated)
    zones = [
        MapZone(name="spots", geometry=field.degrees(treated), rate_l_ha=rate),
        MapZone(name="rest", geometry=field.degrees(around), rate_l_ha=0.0),
    ]
    return MapFile(
        path=target, format="made", crs="EPSG:4326", unit="L/ha", rate_field="rate",
        sha256=digest([read_bytes(weeds)]) if weeds.is_file() else "", boundary=field.boundary,
        zones=tuple(one for one in zones if not one.geometry.is_empty),
    )  # fmt: skip


def _plans(
    field: FlownField, opened: Sequence[Opening], treated: BaseGeometry, rate: float
) -> dict[str, Plan]:
    """Return plans over all passes, over passes with spots, and from spot to spot."""
    task, passes = field.task, field.passes
    local = shapely.transform(treated, passes.back)
    rates = _OnSpots(MultiPolygon([one for one in shapely.get_parts(local)
                                   if one.geom_type == "Polygon"]), rate)  # fmt: skip
    whole = passes_of(field.lines, passes.angle_deg, task.field.limit, field.swath_m)
    # At the planned speed over the first spot, and over the last one still.
    rows = pieces(opened, passes.edges_m, whole.edges_m, task.settings.lead_m + LEAD_M)
    spans: dict[float, tuple[float, float]] = {}
    for start, end, right in rows:
        low, high = spans.get(right, (start, end))
        spans[right] = (min(low, start), max(high, end))
    wanted = {
        "spot to spot": _lines_of(rows, field),
        "passes with spots": _lines_of(
            [(start, end, right) for right, (start, end) in spans.items()], field
        ),
    }

    def planned(left: Remaining | None) -> Plan:
        return plan_mission(
            task.field, task.settings, rates, depots=task.depots, left=left, around=task.around
        )

    none = np.zeros((0, 4))
    return {
        name: planned(Remaining(lines=lines, done=none, angle_deg=passes.angle_deg))
        for name, lines in wanted.items()
    } | {"all passes": planned(None)}


def _lines_of(rows: Sequence[tuple[float, float, float]], field: FlownField) -> Floats:
    """Return lines (both ends, east and north), cut at the field's border."""
    ground = field.turned()
    found = []
    for start, end, right in rows:
        line = shapely.LineString([(start, right), (end, right)])
        for part in shapely.get_parts(shapely.intersection(line, ground)):
            if part.geom_type == "LineString" and part.length > 0.1:
                found.append(field.passes.back(shapely.get_coordinates(part)).ravel())
    lines = np.array(found).reshape(-1, 4)
    return lines[lengths_m(lines) > 0.1]


def _lines(result: dict[str, Any]) -> list[str]:
    budget = result["budget"]
    lines = [f"{counted(result['weeds'], 'weed')}; errors [m]       along  across"]
    lines += [
        f"  {one['name']:26} {one['along_m']:6.2f}  {one['across_m']:6.2f}"
        + ("  (1 sd)" if one["by_chance"] else "")
        for one in budget["parts"]
    ]
    lines += [
        f"  {'around each weed':26} {budget['along_m']:6.2f}  {budget['across_m']:6.2f}"
        "  whole valves across",
        f"gaps below {result['gap_min_m']:.2f} m stay open, openings last "
        f"{result['least_m']:.2f} m",
        f"{counted(result['spots'], 'spot')}, {result['treated_ha']:.4f} ha or "
        f"{result['treated_percent']:.1f} % of the field, {result['litres']:.2f} L; saved: "
        f"{result['saved_litres']:.2f} L, {result['saved_percent']:.1f} %",
        _misses(result),
        *(
            f"{name}: {seconds / 60.0:.1f} min of flight"
            + ("  <- quickest" if name == result["route"] else "")
            for name, seconds in result["flight_s"].items()
        ),
    ]
    if result["beyond"]:
        lines.append(f"{counted(result['beyond'], 'weed')} outside of the field left out")
    return [*lines, *(f"written: {name}" for name in result["files"])]


def _misses(result: dict[str, Any]) -> str:
    """Return how many weeds will be missed, and why more than asked for."""
    of_all, weeds, exposed = result["expected_misses"], result["weeds"], result["exposed"]
    line = f"misses to expect: {of_all:.2f} of {counted(weeds, 'weed')}"
    line += f", {result['expected_misses_percent']:.2f} %"
    if not exposed:
        return line
    near = result["exposed_misses"]
    others = f"{of_all - near:.2f} of the others" if weeds > exposed else "no others"
    return (
        f"{line}: {near:.2f} of {counted(exposed, 'weed')} close to ground that is not sprayed, "
        f"where {result['budget']['miss_percent']:g} % cannot be kept, and {others}"
    )
