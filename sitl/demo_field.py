"""What the demo's flights have in common: the field, the rates of a speed, the path, the lags."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from companion.config import Config, load
from companion.core.frame import LocalFrame
from companion.core.prescription import Prescription
from companion.core.schedule import LagModel
from companion.core.setup import Setup
from missions.maps.compiling import compiled_setup
from sitl.anyang import EXAMPLE, RUN_OUT_M, anyang_lag, anyang_route
from sitl.profile import PROFILES
from sitl.trajectory import Route, Trajectory
from sitl.vehicle import Vehicle

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
