"""From files and a configuration to what is planned: field, rates, settings, depots."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely import MultiPolygon
from shapely.geometry.base import BaseGeometry

from companion.assembly import above_label, flow_range
from companion.config import Config
from companion.config.rules import mismatches
from companion.config.tables import MissionTable, PrescriptionTable, out_of_bounds
from companion.core.frame import LocalFrame
from companion.core.prescription import Prescription
from missions.demand import Rates, Uniform
from missions.errors import PlanError
from missions.field import OUTLINE_TOLERANCE_M, Field, build_field, frame_of
from missions.maps.build import build_prescription, frame_for
from missions.maps.compiling import read_configured_map
from missions.maps.local import Area
from missions.maps.model import MapFile
from missions.maps.registry import read_map
from missions.plan import Settings
from missions.reading_fleet import NO_BREAK, BreakAsked, fleet_settings, left_of, untreated
from missions.reading_ground import (
    NOTHING_ASKED,
    GroundAsked,
    autopilot_of,
    buffered,
    check_label,
    no_spray_buffer_m,
    run_in_of,
    spacing_m,
    terrain_of,
    wind_of,
)
from missions.reading_outline import (
    Obstacle,
    apart_warnings,
    check_near,
    near_area,
    outline_of,
    read_obstacles,
    told,
)
from missions.remaining import Remaining, untreated_rates
from missions.strips import Floats
from missions.surroundings import NOTHING_AROUND, Surroundings

# Where no configuration is given.
DEFAULTS = Settings(swath_width_m=6.0, speed_m_s=6.0)
RATE_L_HA = 20.0
FERRY_CLEARANCE_M = 5.0
# Options that are not called as their keys are.
OPTIONS = {"swath_width_m": "swath_m"}
SPEED_MAX_M_S = 50.0
# So far an aircraft may be off its line: above the 0.09 m of the twin's flights in gusts.
SWAY_M = 0.1
# What a configuration says of its own map, and so of others of the same farm.
OF_ALL_MAPS = ("unit", "crs", "density_kg_l", "flow_width_m", "flow_speed_m_s")


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """What is planned."""

    field: Field
    settings: Settings
    rates: Rates
    depots: tuple[tuple[float, float], ...]
    around: Surroundings = NOTHING_AROUND
    left: Remaining | None = None
    said: tuple[str, ...] = ()
    wind: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """What the command line asks for; None leaves it to the configuration or the defaults.

    `answers` are what prescriptions leave open, by the arguments of `read_map`; `crs` is for each
    file that does not say its own.
    """

    field: Path
    prescription: Path | None = None
    obstacles: tuple[Path, ...] = ()
    no_spray: tuple[Path, ...] = ()
    obstacle_radius_m: float | None = None
    corridor_m: float | None = None
    depots: tuple[tuple[float, float], ...] = ()
    rate_l_ha: float | None = None
    crs: str | None = None
    answers: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    border_m: float | None = None
    over_holes: bool = False
    ends_over: bool = False
    with_sprayer: bool = False
    ground: GroundAsked = NOTHING_ASKED
    pause: BreakAsked = NO_BREAK

    @property
    def opens(self) -> dict[str, str | None]:
        """Return what is answered for each file that leaves it open."""
        return {"crs": self.crs, "layer": self.answers.get("layer")}


def read_task(asked: Asked, config: Config | None, changes: dict[str, float | int | None]) -> Task:
    """Return the task; `changes` are settings that the command line gives.

    Raises:
        PlanError, MapError, ConfigError: in one line, what is wrong and what to do.
    """
    settings = _spaced(_settings(config, changes), asked, config, changes)
    check_label(config, settings, asked.ground)
    if asked.with_sprayer:
        # The autopilot's own sprayer knows no treated ground.
        settings = replace(settings, switch_off_percent=None)
    map_file = _map(asked, config)
    said: list[str] = []
    boundary = outline_of(asked.field, map_file, said, asked.opens)
    frame = frame_of(boundary)
    table = None if config is None else config.prescription
    mission = None if config is None else config.mission
    offset_m = (0.0, 0.0) if table is None else (table.offset_east_m, table.offset_north_m)
    _check_places(asked, mission, map_file, frame)
    keeps_m = no_spray_buffer_m(asked.ground, config)
    closed = _no_spray_areas(asked, config, frame, keeps_m)
    ground = build_field(
        boundary,
        obstacles=_obstacles(asked, frame),
        no_spray=closed,
        obstacle_buffer_m=2.0 if mission is None else mission.obstacle_buffer_m,
        over_holes=asked.over_holes,
        no_spray_buffer_m=keeps_m,
        wind=wind_of(asked.ground, config, has_areas=bool(closed)),
        swath_width_m=settings.swath_width_m,
        frame=frame,
        offset_m=offset_m,
        kept_m=_inset_m(asked, settings),
        tolerance_m=OUTLINE_TOLERANCE_M if mission is None else mission.outline_tolerance_m,
        ferry_over_m=_ferry_over_m(settings, mission),
    )
    rates = _rates(asked, config, map_file, boundary, frame)
    if isinstance(rates, MapRates) and _is_flown(asked, config):
        ground = replace(ground, closes=rates.field)
    if asked.ends_over:
        settings = _with_ends_over(asked, settings, ground)
    whole = ground
    if asked.pause.resume is None and asked.pause.done is not None:
        ground = untreated(
            ground, asked.pause.done, settings.swath_width_m, offset_m, opens=asked.opens
        )
    return Task(
        field=ground,
        settings=settings,
        rates=untreated_rates(rates, asked.pause.ground, whole, offset_m, opens=asked.opens),
        depots=asked.depots or (() if mission is None else tuple(mission.depots)),
        around=Surroundings(
            terrain=terrain_of(asked.ground, config, frame),
            run_in=run_in_of(asked.ground, config, ground, offset_m, opens=asked.opens),
        ),
        left=left_of(
            asked.pause,
            mission,
            frame,
            width_m=settings.swath_width_m,
            offset_m=offset_m,
            opens=asked.opens,
        ),
        said=(*said, *_apart(whole, rates)),
        wind=asked.ground.wind or (None if mission is None else mission.wind),
    )


def _apart(field: Field, rates: Rates) -> list[str]:
    """Warn where a map is not of the field."""
    if not isinstance(rates, MapRates):
        return []
    return apart_warnings(field.outline, rates.prescription)


def _no_spray_areas(
    asked: Asked, config: Config | None, frame: LocalFrame, keeps_m: float
) -> list[MultiPolygon]:
    """Return what is not sprayed: of the command line, of the map, of label and permit."""
    closed = [near_area(path, frame, asked.opens) for path in asked.no_spray]
    if config is None:
        return closed
    if config.prescription is not None:
        closed += _exclusions(asked, config, config.prescription, frame)
    return closed + buffered(config, keeps_m, frame, asked.opens)


def _with_ends_over(asked: Asked, settings: Settings, ground: Field) -> Settings:
    """Return settings that let ends of the boom be beyond the border, where valves close there."""
    if asked.pause.done is not None:
        raise PlanError("--ends-over knows no treated ground; leave it out with --done")
    if ground.closes is None or settings.border_buffer_m is None or len(settings.valves) < 2:
        raise PlanError(
            "--ends-over needs valves that close at the border: a configuration with two valves or "
            'more whose own prescription is planned for, and border = "inside"'
        )
    return replace(settings, ends_over=True)


def _ferry_over_m(settings: Settings, mission: MissionTable | None) -> float | None:
    """Return how high an obstacle may be that ferries cross; None where they cross none."""
    clearance_m = FERRY_CLEARANCE_M if mission is None else mission.ferry_clearance_m
    height_m = settings.ferry_height_m
    return None if height_m is None else height_m - clearance_m


def _obstacles(asked: Asked, frame: LocalFrame) -> list[Obstacle]:
    """Return the obstacles of all files."""
    return [
        obstacle
        for path in asked.obstacles
        for obstacle in read_obstacles(
            path,
            frame,
            radius_m=asked.obstacle_radius_m,
            corridor_m=asked.corridor_m,
            opens=asked.opens,
        )
    ]


def _check_places(
    asked: Asked, mission: MissionTable | None, map_file: MapFile | None, frame: LocalFrame
) -> None:
    """Refuse depots and a prescription that lie on another continent."""
    depots = asked.depots or (() if mission is None else mission.depots)
    for number, (latitude_deg, longitude_deg) in enumerate(depots, start=1):
        check_near(f"depot {number}", latitude_deg, longitude_deg, frame)
    if map_file is not None:
        middle = frame_for(map_file)
        name = f"{map_file.path}: the prescription"
        check_near(name, middle.latitude_deg, middle.longitude_deg, frame)


def _spaced(
    settings: Settings,
    asked: Asked,
    config: Config | None,
    changes: dict[str, float | int | None],
) -> Settings:
    """Return the settings with the measured swath as spacing, unless one is given."""
    autopilot = autopilot_of(asked.ground, config)
    settings = replace(settings, autopilot=autopilot)
    if changes.get("swath_width_m") is not None:
        return settings
    width_m = spacing_m(
        config,
        height_m=settings.height_m,
        speed_m_s=settings.speed_m_s,
        boom_m=None if config is None else config.boom_table.width_m,
    )
    return settings if width_m is None else replace(settings, swath_width_m=width_m)


def _settings(config: Config | None, changes: dict[str, float | int | None]) -> Settings:
    settings = DEFAULTS
    if config is not None:
        mission = config.mission
        if mission is None:
            raise PlanError(
                f"{config.path}: there is no [mission]; write at least swath_width_m and speed_m_s"
            )
        settings = Settings(
            swath_width_m=mission.swath_width_m,
            speed_m_s=mission.speed_m_s,
            height_m=mission.height_m,
            acceleration_m_s2=mission.acceleration_m_s2,
            jerk_m_s3=mission.jerk_m_s3,
            return_height_m=mission.return_height_m,
            turn=mission.turn,
            angle_deg=None if mission.angle_deg == "auto" else float(mission.angle_deg),
            tank_l=mission.tank_l,
            reserve_l=mission.reserve_l,
            valves=tuple((valve.right_m, valve.width_m) for valve in config.boom().valves),
            flow_l_min=_flows(config),
            speeds_m_s=(config.safety.speed_min_m_s, 0.0),
            settle_s=_settle_s(config),
            border_buffer_m=_kept_m(config),
            # What is planned are lines, and named as such they alone are sprayed.
            switch_off_percent=config.switch_off_percent(on_lines=True),
            lines_aside_m=mission.lines_aside_m,
            lines_course_deg=mission.lines_course_deg,
            **_acts_s(config),
            **fleet_settings(mission),
        )
    given: dict[str, Any] = {name: each for name, each in changes.items() if each is not None}
    if config is not None and config.mission is not None:
        given.setdefault("ferry_height_m", config.mission.ferry_height_m)
    highest = given.pop("speed_max_m_s", None)
    for name, value in given.items():
        _check_bounds(name, value)
    try:
        settings = replace(settings, **given)
    except ValueError as error:
        raise PlanError(f"this cannot be flown: {error}") from error
    _refuse_unsprayed(config, settings, changes)
    if highest is None:
        return settings
    limit = SPEED_MAX_M_S if config is None else config.safety.speed_max_m_s
    if not settings.speed_m_s <= highest <= limit:
        source = "" if config is None else " (safety.speed_max_m_s)"
        raise PlanError(
            f"--speed-max-m-s {highest:g}: write at least the speed of the passes, "
            f"{settings.speed_m_s:g} m/s, and at most {limit:g} m/s{source}"
        )
    return replace(settings, speeds_m_s=(settings.speeds_m_s[0], highest))


def _refuse_unsprayed(
    config: Config | None, settings: Settings, changes: Mapping[str, float | int | None]
) -> None:
    """Refuse what `config check` would, were the options of the plan its keys."""
    if config is None or config.mission is None:
        return
    planned = {"swath_width_m": settings.swath_width_m, "speed_m_s": settings.speed_m_s}
    mission = config.mission.model_copy(update=planned)
    for found in mismatches(config.model_copy(update={"mission": mission})):
        name = found.key.removeprefix("mission.")
        said = f"{config.path}: {found.key}"
        if changes.get(name) is not None:
            said = f"--{OPTIONS.get(name, name).replace('_', '-')} {changes[name]:g}"
        raise PlanError(f"{said}: {found.text}")


def assumed(
    task: Task, asked: Asked, config: Config | None, changes: Mapping[str, float | int | None]
) -> dict[str, str]:
    """Return what nobody has given, by its key, in words with its value."""
    origins = {} if config is None else config.settings()
    settings = task.settings

    def is_open(key: str) -> bool:
        return origins.get(f"mission.{key}", (None, "default"))[1] == "default"

    found = {
        "swath_width_m": f"swath {settings.swath_width_m:g} m",
        "speed_m_s": f"speed {settings.speed_m_s:g} m/s",
        "height_m": f"height {settings.height_m:g} m",
        "tank_l": f"tank {settings.tank_l:g} L",
        "reserve_l": f"reserve {settings.reserve_l:g} L",
    }
    found = {key: text for key, text in found.items() if changes.get(key) is None and is_open(key)}
    has_map = asked.prescription is not None or (
        config is not None and config.prescription is not None
    )
    if not has_map and asked.rate_l_ha is None and is_open("rate_l_ha"):
        found["rate_l_ha"] = f"rate {RATE_L_HA:g} L/ha"
    return found


def _check_bounds(name: str, value: float) -> None:
    """Refuse an option with a number that its key of the configuration could not have."""
    reason = out_of_bounds(MissionTable, name, value)
    if reason is not None:
        option = OPTIONS.get(name, name).replace("_", "-")
        raise PlanError(f"--{option} {value:g}: write a number {reason}")


def _map(asked: Asked, config: Config | None) -> MapFile | None:
    """Return the prescription that is asked for, or the configuration's."""
    table = None if config is None else config.prescription
    path = asked.prescription
    if config is None or table is None:
        return None if path is None else told(partial(read_map, path, **asked.answers), asked.opens)
    if path is None and asked.rate_l_ha is not None:
        return None

    def own(**answers: str) -> MapFile:
        changed = table.model_copy(update={**asked.answers, **answers})
        return read_configured_map(config.model_copy(update={"prescription": changed}))

    if path is None or path.resolve() == config.resolve(table.file).resolve():
        return told(own, asked.opens)
    # Which column and which layer a configuration names, it says of its own map alone.
    said = {name: getattr(table, name) for name in OF_ALL_MAPS}
    return told(partial(read_map, path, **{**said, **asked.answers}), {"crs": asked.crs})


def _default_rate(config: Config, map_file: MapFile) -> float | None:
    table = config.prescription
    if table is not None and table.default_rate_l_ha is not None:
        return table.default_rate_l_ha
    return map_file.default_rate_l_ha


def _rates(
    asked: Asked,
    config: Config | None,
    map_file: MapFile | None,
    boundary: Area,
    frame: LocalFrame,
) -> Rates:
    mission = None if config is None else config.mission
    if map_file is None:
        rate = asked.rate_l_ha
        if rate is None:
            rate = RATE_L_HA if mission is None else mission.rate_l_ha
        _check_bounds("rate_l_ha", rate)
        if config is not None:
            label = above_label(config, "the plan", rates_l_ha=(rate,), default_rate_l_ha=None)
            if label is not None:
                raise PlanError(f"{label.text}; plan for a rate that the label allows")
        return Uniform(rate_l_ha=rate)
    if config is not None:
        label = above_label(
            config,
            map_file.path,
            rates_l_ha=map_file.rates_l_ha,
            default_rate_l_ha=_default_rate(config, map_file),
        )
        if label is not None:
            raise PlanError(f"{label.text}; {label.fix}")
    is_own = _is_flown(asked, config)
    table = None if config is None else config.prescription
    if config is None or table is None:
        built = build_prescription(map_file, frame, boundary=_many(boundary))
    else:
        built = build_prescription(
            map_file,
            frame,
            overlap=table.overlap,
            # As the companion does it: where it closes the valves there is no demand.
            boundary=_own_boundary(asked, config, table, frame) if is_own else _many(boundary),
            exclusions=_exclusions(asked, config, table, frame),
            default_rate_l_ha=table.default_rate_l_ha,
            offset_east_m=table.offset_east_m,
            offset_north_m=table.offset_north_m,
        )
    return MapRates(built)


def _is_flown(asked: Asked, config: Config | None) -> bool:
    """Return whether the map is that of the configuration, which then says where it ends."""
    if config is None or config.prescription is None:
        return False
    own = config.resolve(config.prescription.file)
    return asked.prescription is None or asked.prescription.resolve() == own.resolve()


def _own_boundary(
    asked: Asked, config: Config, table: PrescriptionTable, frame: LocalFrame
) -> MultiPolygon | None:
    name = table.boundary
    if name is None:
        return None
    return near_area(config.resolve(name), frame, asked.opens, nested=False)


def _exclusions(
    asked: Asked, config: Config, table: PrescriptionTable, frame: LocalFrame
) -> list[MultiPolygon]:
    names = [config.resolve(name) for name in table.exclusions]
    return [near_area(path, frame, asked.opens) for path in names]


def _many(area: Area) -> MultiPolygon:
    return area if isinstance(area, MultiPolygon) else MultiPolygon([area])


def _flows(config: Config) -> tuple[float, float]:
    """Return what the nozzle sets deliver over the swath, which may be a little off the boom."""
    low, high = flow_range(config.nozzle_sets(), config.pwm_limits())
    return low, high


def _inset_m(asked: Asked, settings: Settings) -> float:
    """Return how far passes keep from every border: so far that no outer valve closes on them.

    That is the companion's own distance and what an aircraft sways about its line.
    """
    if asked.border_m is not None:
        return asked.border_m
    closes = settings.border_buffer_m is not None and not asked.with_sprayer
    return (settings.border_buffer_m or 0.0) + SWAY_M if closes and not asked.ends_over else 0.0


def _kept_m(config: Config) -> float | None:
    """Return how far valves are kept off the border; None where the configuration lets them be."""
    table = config.prescription
    return table.border_buffer_m if table is not None and table.border == "inside" else None


def _settle_s(config: Config) -> float:
    """Return how long a rate must last to be there: the slowest change and one PWM period."""
    lag = config.lag
    slowest_s = max(lag.on_s, lag.off_s, lag.up_s, lag.down_s) + lag.output_s
    return slowest_s + config.pwm_limits().period_s


def _acts_s(config: Config) -> dict[str, Any]:
    """Return how long after the aircraft's state valves are open, or closed, as volumes count.

    Half of the time between two positions is how late a state is heard of in the mean.
    """
    lag = config.lag
    heard_s = lag.position_s + 0.5 / config.link.position_rate_hz + lag.output_s
    return {
        "opens_s": heard_s + lag.on_s,
        "closes_s": heard_s + lag.off_s,
        "ends_s": lag.off_end_s + lag.output_s,
    }


# The rates of a prescription at hundreds of thousands of places at once.


class MapRates:
    """What `Prescription.rates_at` says, for places inside the field.

    Zone by zone instead of place by place; where zones overlap, or there is none, the prescription
    itself is asked.
    """

    def __init__(self, prescription: Prescription) -> None:
        self.prescription = prescription
        zones = [] if prescription.cells is not None else list(prescription.zones)
        polygons = np.array([zone.polygon for zone in zones], dtype=object)
        self._parts, owner = shapely.get_parts(polygons, return_index=True)
        self._rates = np.array([zones[at].rate_l_ha for at in owner.tolist()])
        self._bounds = shapely.bounds(self._parts)
        shapely.prepare(self._parts)

    @property
    def field(self) -> BaseGeometry:
        """Return the ground outside of which nothing is sprayed."""
        return self.prescription.field

    def rates_at(self, east_m: Floats, north_m: Floats) -> Floats:
        """Return the rate at each place [L/ha]; NaN where there is none."""
        rates = np.full(len(east_m), np.nan)
        found = np.zeros(len(east_m), dtype=np.int64)
        order = np.argsort(east_m, kind="stable")
        sorted_m = east_m[order]
        for part, rate, bounds in zip(self._parts, self._rates, self._bounds, strict=True):
            first, last = np.searchsorted(sorted_m, (bounds[0], bounds[2]))
            some = order[first : last + 1]
            some = some[(north_m[some] >= bounds[1]) & (north_m[some] <= bounds[3])]
            inside = some[shapely.contains_xy(part, east_m[some], north_m[some])]
            rates[inside] = rate
            found[inside] += 1
        has_default = self.prescription.default_rate_l_ha is not None
        ask = (found > 1) | ((found == 0) & (has_default or self.prescription.cells is not None))
        if ask.any():
            rates[ask] = self.prescription.rates_at(east_m[ask], north_m[ask])
        return rates
