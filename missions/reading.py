"""From files and a configuration to what is planned: field, rates, settings, depots."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely import MultiPolygon

from companion.assembly import above_label, flow_range, read_configured_map
from companion.config import Config
from companion.core.frame import LocalFrame
from companion.errors import MapError
from companion.maps.build import build_prescription, frame_for
from companion.maps.cells import grid_of
from companion.maps.local import Area, as_area, polygons_of
from companion.maps.model import MapFile
from companion.maps.registry import read_area, read_map
from missions.demand import Rates, Uniform
from missions.errors import PlanError
from missions.field import Field, build_field, frame_of
from missions.map_rates import MapRates
from missions.plan import Settings
from missions.strips import Floats

# Where no configuration is given.
DEFAULTS = Settings(swath_width_m=6.0, speed_m_s=6.0)
RATE_L_HA = 20.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """What is planned."""

    field: Field
    settings: Settings
    rates: Rates
    depots: tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """What the command line asks for; None leaves it to the configuration or the defaults."""

    field: Path
    prescription: Path | None = None
    obstacles: tuple[Path, ...] = ()
    no_spray: tuple[Path, ...] = ()
    no_spray_buffer_m: float = 0.0
    depots: tuple[tuple[float, float], ...] = ()
    rate_l_ha: float | None = None
    crs: str | None = None


def read_task(asked: Asked, config: Config | None, changes: dict[str, float | int | None]) -> Task:
    """Return the task; `changes` are settings that the command line gives.

    Raises:
        PlanError, MapError, ConfigError: in one line, what is wrong and what to do.
    """
    settings = _settings(config, changes)
    map_file = _map(asked, config)
    boundary = _outline(asked, map_file)
    frame = frame_of(boundary)
    table = None if config is None else config.prescription
    mission = None if config is None else config.mission
    offset_m = (0.0, 0.0) if table is None else (table.offset_east_m, table.offset_north_m)
    closed = [read_area(path) for path in asked.no_spray]
    if config is not None and table is not None:
        closed += [read_area(config.resolve(name)) for name in table.exclusions]
    field = build_field(
        boundary,
        obstacles=[read_area(path) for path in asked.obstacles],
        no_spray=closed,
        obstacle_buffer_m=2.0 if mission is None else mission.obstacle_buffer_m,
        no_spray_buffer_m=asked.no_spray_buffer_m,
        swath_width_m=settings.swath_width_m,
        frame=frame,
        offset_m=offset_m,
    )
    configured = () if mission is None else mission.depots
    return Task(
        field=field,
        settings=settings,
        rates=_rates(asked, config, map_file, boundary, frame),
        depots=asked.depots or tuple(configured),
    )


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
            turn=mission.turn,
            angle_deg=None if mission.angle_deg == "auto" else float(mission.angle_deg),
            tank_l=mission.tank_l,
            reserve_l=mission.reserve_l,
            valves=tuple((valve.right_m, valve.width_m) for valve in config.boom().valves),
            flow_l_min=_flows(config),
            speeds_m_s=(config.safety.speed_min_m_s, 0.0),
            settle_s=_settle_s(config),
            border_buffer_m=_kept_m(config),
        )
    given: dict[str, Any] = {name: each for name, each in changes.items() if each is not None}
    highest = given.pop("speed_max_m_s", None)
    if highest is not None:
        limit = math.inf if config is None else config.safety.speed_max_m_s
        if not 0.0 < highest <= limit:
            raise PlanError(f"--speed-max-m-s {highest:g}: safety.speed_max_m_s is {limit:g}")
        given["speeds_m_s"] = (settings.speeds_m_s[0], highest)
    try:
        return replace(settings, **given)
    except ValueError as error:
        raise PlanError(f"this cannot be flown: {error}") from error


def _map(asked: Asked, config: Config | None) -> MapFile | None:
    """Return the prescription that is asked for, or the configuration's."""
    table = None if config is None else config.prescription
    if asked.prescription is None:
        if config is None or table is None or asked.rate_l_ha is not None:
            return None
        return read_configured_map(config)
    if config is None or table is None:
        return read_map(asked.prescription)
    own = asked.prescription.resolve() == config.resolve(table.file).resolve()
    if own:
        return read_configured_map(config)
    return read_map(asked.prescription, unit=table.unit, crs=table.crs)


def _outline(asked: Asked, map_file: MapFile | None) -> Area:
    """Return the field's outline; of a prescription in cells, that of its cells with a rate."""
    try:
        return read_area(asked.field, crs=asked.crs)
    except MapError as error:
        if error.code != "no-polygon":
            raise
        same = map_file is not None and map_file.path.resolve() == asked.field.resolve()
        cells = map_file if same else read_map(asked.field)
        if cells is None or cells.cells is None:
            raise
        return _of_cells(cells)


def _of_cells(map_file: MapFile) -> MultiPolygon | Area:
    """Return the ground of all cells with a rate, in longitude and latitude."""
    if map_file.cells is None:
        raise PlanError(f"{map_file.path}: there are no cells")
    frame = frame_for(map_file)

    def back(points: Floats) -> Floats:
        lat, lon = frame.to_geographic_all(points[:, 0].tolist(), points[:, 1].tolist())
        return np.column_stack([lon, lat])

    local = grid_of(map_file.cells, frame, map_file.path).outline
    found = as_area(polygons_of(shapely.transform(local, back)))
    if found is None:
        raise PlanError(f"{map_file.path}: no cell has a rate")
    return found


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
        return Uniform(rate_l_ha=rate)
    if config is not None:
        label = above_label(config, map_file)
        if label is not None:
            raise PlanError(f"{label.text}; {label.fix}")
    table = None if config is None else config.prescription
    if table is None:
        built = build_prescription(map_file, frame, boundary=_many(boundary))
    else:
        built = build_prescription(
            map_file,
            frame,
            overlap=table.overlap,
            boundary=_many(boundary),
            default_rate_l_ha=table.default_rate_l_ha,
            offset_east_m=table.offset_east_m,
            offset_north_m=table.offset_north_m,
        )
    return MapRates(built)


def _many(area: Area) -> MultiPolygon:
    return area if isinstance(area, MultiPolygon) else MultiPolygon([area])


def _flows(config: Config) -> tuple[float, float]:
    """Return what the nozzle sets deliver over the swath, which may be a little off the boom."""
    low, high = flow_range(config.nozzle_sets(), config.pwm_limits())
    return low, high


def _kept_m(config: Config) -> float | None:
    """Return how far valves are kept off the border; None where the configuration lets them be."""
    table = config.prescription
    return table.border_buffer_m if table is not None and table.border == "inside" else None


def _settle_s(config: Config) -> float:
    """Return how long a rate must last to be there: the slowest change and one PWM period."""
    lag = config.lag
    slowest_s = max(lag.on_s, lag.off_s, lag.up_s, lag.down_s) + lag.output_s
    return slowest_s + config.pwm_limits().period_s


def names_of(paths: Sequence[Path]) -> str:
    """Return the names of files for a line of text.

    >>> names_of([Path("a/m.plan"), Path("a/m-2.plan"), Path("a/m-3.plan")])
    'm.plan, m-2.plan, m-3.plan'
    """
    names = [path.name for path in paths]
    return ", ".join(names if len(names) <= 3 else [names[0], names[1], "...", names[-1]])
