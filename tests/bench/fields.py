"""Where it is measured: the demo's field, grids of plots of any size, flights over them."""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass, replace

import numpy as np
import shapely

from companion.core.boom import Boom, Valve
from companion.core.estimator import Track, estimate, observe
from companion.core.frame import LocalFrame
from companion.core.nozzle import FlowCurve, NozzleSet
from companion.core.prescription import Prescription, Zone
from companion.core.setup import Setup
from companion.core.types import (
    EstimatorReport,
    Fix,
    GnssReport,
    HeartbeatReport,
    Input,
    LandedReport,
    OperatorCommand,
    Telemetry,
    VehicleState,
)
from sitl.anyang import HEIGHT_M, MAP_SPEED_M_S, START_S, demo_lags, demo_setup
from sitl.navigation import Navigation
from sitl.vehicle import Leg, Route, Vehicle

PROFILE = "wang-2024"
RATES_L_HA = (14.5, 15.4, 16.6, 17.7, 19.4, 20.5, 22.7, 23.8, 25.5, 27.8)  # P1
PLOT_LENGTH_M, PLOT_WIDTH_M = 12.0, 6.0


def example(speed_m_s: float = MAP_SPEED_M_S, output: str = "gpio") -> Setup:
    """Return the example with the demo's lags and its rates scaled by 5/V."""
    lag = demo_lags(output)
    return replace(demo_setup(speed_m_s), lag=lag)


def grid_zones(rows: int, columns: int, *, seed: int) -> list[Zone]:
    """Return plots of 12 x 6 m with P1's ten rates at random, around north 0, from east 0 on."""
    rates = np.random.default_rng(seed).choice(RATES_L_HA, size=(rows, columns))
    south = -0.5 * rows * PLOT_WIDTH_M
    return [
        Zone(
            name=f"{row}-{column}",
            polygon=shapely.box(
                column * PLOT_LENGTH_M,
                south + row * PLOT_WIDTH_M,
                (column + 1) * PLOT_LENGTH_M,
                south + (row + 1) * PLOT_WIDTH_M,
            ),
            rate_l_ha=float(rates[row, column]),
        )
        for row in range(rows)
        for column in range(columns)
    ]


def grid_setup(rows: int, columns: int, *, valve_count: int, seed: int) -> Setup:
    """Return the example's sprayer with more valves, 0.5 m each, over a grid of plots."""
    width_m = 0.5 * valve_count
    zones = grid_zones(rows, columns, seed=seed)
    reach_m = 0.5 * rows * PLOT_WIDTH_M
    base = example()
    nozzles = base.nozzle_sets[-1]
    flows = tuple(flow * width_m / base.boom.width_m for flow in nozzles.curve.flow_l_min)
    valves = tuple(
        Valve(name=str(k + 1), right_m=0.5 * (k + 0.5) - 0.5 * width_m, forward_m=0.0, width_m=0.5)
        for k in range(valve_count)
    )
    return replace(
        base,
        frame=LocalFrame(36.0, 114.5),
        prescription=Prescription(
            zones, boundary=shapely.box(0.0, -reach_m, columns * PLOT_LENGTH_M, reach_m)
        ),
        boom=Boom(width_m=width_m, valves=valves),
        nozzle_sets=(
            NozzleSet(
                valves=tuple(range(valve_count)),
                curve=FlowCurve(duty=nozzles.curve.duty, flow_l_min=flows),
            ),
        ),
    )


def straight_route(east_m: float, length_m: float, north_m: float, speed_m_s: float) -> Route:
    """Return one pass eastwards."""
    leg = Leg(east_m=east_m + length_m, north_m=north_m, speed_m_s=speed_m_s, kind="spray")
    return Route(start_east_m=east_m, start_north_m=north_m, legs=(leg,), height_m=HEIGHT_M)


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """What the core is asked at one time."""

    now_s: float
    state: VehicleState


def moments(setup: Setup, route: Route, *, seed: int, rate_hz: float = 20.0) -> list[Moment]:
    """Return the states, one at each position message, that a noisy flight leads to."""
    vehicle = Vehicle(route, start_s=START_S, seed=seed)
    trajectory = vehicle.fly_to_end()
    navigation = Navigation(
        trajectory, setup.frame, seed=seed, start_s=START_S, position_rate_hz=rate_hz
    )
    end_s = float(trajectory.time_s[-1])
    heard: list[Input] = [OperatorCommand(received_s=START_S, enable=True, source="command")]
    for second in range(math.ceil(end_s - START_S)):
        heard += _healthy(START_S + second)
    track, found = Track(), []
    everything = heapq.merge(heard, navigation.advance(end_s), key=lambda item: item.received_s)
    for item in everything:
        track = observe(track, item, setup)
        if isinstance(item, Telemetry):
            state = estimate(track, item.received_s)
            if state is not None:
                found.append(Moment(now_s=item.received_s, state=state))
    return found


def _healthy(at_s: float) -> list[Input]:
    return [
        HeartbeatReport(received_s=at_s, autopilot="ardupilot", armed=True, mode="AUTO"),
        GnssReport(received_s=at_s, fix=Fix.RTK_FIXED),
        EstimatorReport(received_s=at_s, healthy=True),
        LandedReport(received_s=at_s, in_air=True),
    ]
