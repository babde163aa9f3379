"""The flight over the field of Wang et al. 2024: four passes through the centres of the plots.

The field's place and direction come from `examples/anyang/boundary.geojson`; the paper gives
its size (120 x 24 m, plots of 12 x 6 m), the height of 3.5 m and the four passes.

And what the demo's flights have in common: the field, the rates of a speed, the path, the lags.
"""

from __future__ import annotations

import json
import math
import tomllib
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Literal

from companion.config import Config, load
from companion.core.frame import LocalFrame
from companion.core.prescription import Prescription
from companion.core.schedule import LagModel
from companion.core.setup import Setup
from companion.errors import ConfigError
from missions.maps.compiling import compiled_setup
from sitl.profile import PROFILES
from sitl.stub.mission_items import MissionItem, landing, speed, waypoint
from sitl.stub.protocol import dialect
from sitl.trajectory import Leg, Route, Trajectory
from sitl.vehicle import Vehicle

# Part of the package: what is installed without the source tree has it too.
EXAMPLE = Path(str(files("sitl").joinpath("examples", "anyang")))
PASS_COUNT = 4
PASS_SPACING_M = 6.0
RUN_OUT_M = 15.0  # so that no turn happens over the field
HEIGHT_M = 3.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Pass:
    """One straight pass, from its start to its end, outside the field on both sides."""

    start_east_m: float
    start_north_m: float
    end_east_m: float
    end_north_m: float


def anyang_outline(path: Path = EXAMPLE / "boundary.geojson") -> list[tuple[float, float]]:
    """Return the (longitude_deg, latitude_deg) of the field's outline."""
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        geometry = table["features"][0]["geometry"] if "features" in table else table["geometry"]
        ring = geometry["coordinates"][0]
        return [(float(point[0]), float(point[1])) for point in ring]
    except (OSError, ValueError, KeyError, IndexError, TypeError) as error:
        raise ConfigError(f"{path}: no outline of the example field ({error!r})") from error


def anyang_passes(frame: LocalFrame, path: Path = EXAMPLE / "boundary.geojson") -> list[Pass]:
    """Return the passes in `frame`, back and forth, the first one northwards in the west."""
    corners = [
        frame.to_local(latitude_deg, longitude_deg)
        for longitude_deg, latitude_deg in anyang_outline(path)[:-1]
    ]
    east_m = sum(corner[0] for corner in corners) / len(corners)
    north_m = sum(corner[1] for corner in corners) / len(corners)
    along_e, along_n, half_m = _long_side(corners)
    reach_m = half_m + RUN_OUT_M
    passes = []
    for number in range(PASS_COUNT):
        right_m = (number - (PASS_COUNT - 1) / 2.0) * PASS_SPACING_M
        middle_e, middle_n = east_m + along_n * right_m, north_m - along_e * right_m
        sign = 1.0 if number % 2 == 0 else -1.0
        passes.append(
            Pass(
                start_east_m=middle_e - sign * along_e * reach_m,
                start_north_m=middle_n - sign * along_n * reach_m,
                end_east_m=middle_e + sign * along_e * reach_m,
                end_north_m=middle_n + sign * along_n * reach_m,
            )
        )
    return passes


def _long_side(corners: list[tuple[float, float]]) -> tuple[float, float, float]:
    """Return the unit vector (east, north) of the long side, northwards, and half its length."""
    sides = zip(corners, corners[1:] + corners[:1], strict=True)
    side_e, side_n = max(
        ((b[0] - a[0], b[1] - a[1]) for a, b in sides), key=lambda side: math.hypot(*side)
    )
    length_m = math.copysign(math.hypot(side_e, side_n), side_n)
    return side_e / length_m, side_n / length_m, 0.5 * abs(length_m)


def anyang_route(speed_m_s: float, frame: LocalFrame) -> Route:
    """Return the route of the twin over the field at one speed."""
    passes = anyang_passes(frame)
    legs: list[Leg] = []
    for number, line in enumerate(passes):
        if number:
            legs.append(_leg(line.start_east_m, line.start_north_m, speed_m_s, "transit"))
        legs.append(_leg(line.end_east_m, line.end_north_m, speed_m_s, "spray"))
    return Route(
        start_east_m=passes[0].start_east_m,
        start_north_m=passes[0].start_north_m,
        legs=tuple(legs),
        height_m=HEIGHT_M,
    )


def _leg(east_m: float, north_m: float, speed_m_s: float, kind: Literal["spray", "transit"]) -> Leg:
    return Leg(east_m=east_m, north_m=north_m, speed_m_s=speed_m_s, kind=kind)


def anyang_items(speed_m_s: float) -> tuple[MissionItem, ...]:
    """Return the same flight as a mission: home, take-off, speed, the passes, landing."""
    longitude_deg, latitude_deg = anyang_outline()[0]
    frame = LocalFrame(latitude_deg, longitude_deg)
    route = anyang_route(speed_m_s, frame)
    start = frame.to_geographic(route.start_east_m, route.start_north_m)
    ends = [frame.to_geographic(leg.east_m, leg.north_m) for leg in route.legs]
    return (
        waypoint(dialect.MAV_CMD_NAV_WAYPOINT, *start, height_m=0.0),
        waypoint(dialect.MAV_CMD_NAV_TAKEOFF, *start, height_m=HEIGHT_M),
        speed(speed_m_s),
        *(waypoint(dialect.MAV_CMD_NAV_WAYPOINT, *end, height_m=HEIGHT_M) for end in ends),
        landing(*ends[-1]),
    )


def anyang_lag(output: str, folder: Path = EXAMPLE / "lags") -> LagModel:
    """Return the lags measured beforehand for an output path: `gpio` or `servo`.

    Made by `tools/studies/measure_lags.py`, on other sprayers of the make than any flight's.
    """
    path = folder / f"{output}.toml"
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))["lag"]
        return LagModel(**table)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path}: no lags of the example's sprayer ({error!r})") from error


# The example's sprayer, and lags of others on its boom.
PLANT = "wang-2024"
LAGS = PROFILES / "lags"
# P1 flew its rates at 5 m/s; the example's map is for this speed.
MAP_SPEED_M_S = 5.0
START_S = 100.0
ACCELERATION_M_S2 = 2.5
# On the run-out, beyond what accelerating takes: the speed is steady where the field begins.
STEADY_M = 5.0


@cache
def example() -> Config:
    """Return the configuration of the example field."""
    return load(EXAMPLE / "config.toml")


@cache
def demo_setup(speed_m_s: float) -> Setup:
    """Return the example's set-up with its rates for one speed, and limits that allow the speed."""
    return at_speed(compiled_setup(example()), speed_m_s)


def at_speed(setup: Setup, speed_m_s: float, *, scale: bool = True) -> Setup:
    """Return a set-up whose limits allow the speed, and whose rates are for it where they scale."""
    limits = replace(
        setup.limits,
        speed_min_m_s=min(setup.limits.speed_min_m_s, 0.5 * speed_m_s),
        speed_max_m_s=max(setup.limits.speed_max_m_s, 1.5 * speed_m_s),
    )
    if not scale:
        return replace(setup, limits=limits)
    prescription = scaled(setup.prescription, MAP_SPEED_M_S / speed_m_s)
    return replace(setup, limits=limits, prescription=prescription)


def scaled(prescription: Prescription, factor: float) -> Prescription:
    """Return the same map with every rate times `factor`."""
    default = prescription.default_rate_l_ha
    return Prescription(
        [replace(zone, rate_l_ha=zone.rate_l_ha * factor) for zone in prescription.zones],
        boundary=prescription.field,
        overlap=prescription.overlap,
        default_rate_l_ha=None if default is None else default * factor,
        sha256=prescription.sha256,
    )


def demo_lags(output: str, plant: str = PLANT) -> LagModel:
    """Return the lags measured beforehand, on another sprayer of the make.

    Raises:
        ConfigError: no sprayer of this make was measured.
    """
    return anyang_lag(output) if plant == PLANT else anyang_lag(f"{plant}-{output}", LAGS)


@cache
def demo_trajectory(speed_m_s: float, seed: int) -> Trajectory:
    """Return the path of a speed and a seed, the same for all methods."""
    route = demo_route(speed_m_s)
    vehicle = Vehicle(route, start_s=START_S, seed=seed, acceleration_m_s2=ACCELERATION_M_S2)
    return vehicle.fly_to_end()


def demo_route(
    speed_m_s: float,
    frame: LocalFrame | None = None,
    *,
    acceleration_m_s2: float = ACCELERATION_M_S2,
) -> Route:
    """Return the passes over the field, longer where the speed needs more room to be reached."""
    route = anyang_route(speed_m_s, demo_setup(speed_m_s).frame if frame is None else frame)
    more_m = speed_m_s**2 / (2.0 * acceleration_m_s2) + STEADY_M - RUN_OUT_M
    if not more_m > 0.0:
        return route
    first = route.legs[0]
    east_m, north_m = first.east_m - route.start_east_m, first.north_m - route.start_north_m
    stretch = more_m / (east_m**2 + north_m**2) ** 0.5
    east_m, north_m = east_m * stretch, north_m * stretch
    # Two ends in the north, two in the south: where a pass ends, and where the next one begins.
    legs = []
    for number, leg in enumerate(route.legs):
        sign = 1.0 if number % 4 < 2 else -1.0
        legs.append(
            replace(leg, east_m=leg.east_m + sign * east_m, north_m=leg.north_m + sign * north_m)
        )
    return replace(
        route,
        start_east_m=route.start_east_m - east_m,
        start_north_m=route.start_north_m - north_m,
        legs=tuple(legs),
    )
