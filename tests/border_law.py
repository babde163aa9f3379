"""How much more falls outside than a causal reference lets fall: the judge of the border's law.

The reference has the true state, takes its acceleration for constant, and is told as often as we.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
import shapely

from companion.core.prescription import Prescription, Zone
from companion.core.schedule import LagModel
from companion.core.setup import Setup
from companion.core.types import Decision
from sitl.flight import FlightOptions, fly
from sitl.profile import load_profile
from sitl.trajectory import Trajectory
from tests.border_flight import flows
from tests.builders import boom, setup
from tests.moving_flight import STEP_S, Strip, by_reference, executed

MOST_M_S2 = 5.0
MORE_M = 0.05
PLANT = load_profile("wang-2024")


class Flight(NamedTuple):
    """A way with its field, and how long its valves take."""

    flown: Trajectory
    field: shapely.Geometry
    lag: LagModel


def made_of(flight: Flight) -> Setup:
    parts = [part for part in shapely.get_parts(flight.field) if part.area > 0.01]
    zones = [Zone(name=str(n), polygon=shapely.Polygon(part.exterior), rate_l_ha=20.0)
             for n, part in enumerate(parts)]  # fmt: skip
    return setup(
        prescription=Prescription(zones, boundary=flight.field), boom=boom(6), lag=flight.lag,
        most_m_s2=MOST_M_S2,
    )  # fmt: skip


def worse_than_reference_m(
    flight: Flight, *, noisy: bool = False, believed_s: float = STEP_S, decisions: int = 0
) -> float:
    """Return by how much more any valve sprayed outside than the reference's.

    Or than one's whose acceleration is a mean over `believed_s`, or who closes `decisions` later.
    """
    options = FlightOptions(fidelity="averaged", noise=noisy)
    told_late_s = options.estimator_lag_s if noisy else 0.0
    lag = replace(flight.lag, position_s=told_late_s)
    made = made_of(flight._replace(lag=lag))
    said: list[Decision] = []
    fly(made, flight.flown, PLANT, options, speed_m_s=5.0, observer=said.append)
    steps_s = np.array([each.now_s for each in said])
    worst_m = 0.0
    for valve, orders in zip(made.boom.valves, executed(said, 6), strict=True):
        first_s, last_s = lag.on_start_s + lag.output_s, lag.off_end_s + lag.output_s
        strip = Strip(valve.right_m, valve.forward_m, valve.width_m, first_s, last_s)
        here = flows(orders, first_s=first_s, last_s=last_s)
        own_m = strip.beyond_m(flight.field, flight.flown, here)
        if own_m <= worst_m:
            continue
        theirs_m = 0.0
        for over_s, late in product({STEP_S, believed_s}, {0, decisions}):
            theirs = by_reference(
                flight.field, strip, flight.flown, steps_s, believed_s=over_s, decisions=late
            )
            spans = flows(theirs, first_s=first_s, last_s=last_s)
            theirs_m = max(theirs_m, strip.beyond_m(flight.field, flight.flown, spans))
        worst_m = max(worst_m, own_m - theirs_m)
    return worst_m
