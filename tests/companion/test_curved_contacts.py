"""In a turn a strip is closed on the whole arc that it is foretold, not only on its chords."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
import shapely.affinity

from companion.core.crossings import find_routes
from companion.core.prescription import Prescription, Zone
from tests.builders import boom, flying

BOOM, AHEAD_S = boom(2), 1.2


@pytest.mark.parametrize("seed", range(40))
def test_who_touches_the_outside_on_an_arc_is_closed_there_without_any_buffer(seed: int) -> None:
    rng = np.random.default_rng(seed)
    gain, aside = rng.uniform(-2.0, 2.0), rng.uniform(2.0, 5.0) * rng.choice([-1.0, 1.0])
    yaw = rng.uniform(40.0, 120.0) * math.copysign(1.0, aside)
    edge = shapely.affinity.rotate(
        shapely.box(-50.0, -50.0, 50.0, rng.uniform(2.6, 5.0)), rng.uniform(-90, 90), origin=(0, 0)
    )
    state = flying(
        10.0, 0.0, 0.0, velocity_east_m_s=0.0, velocity_north_m_s=5.0, heading_deg=0.0,
        acceleration_east_m_s2=aside, acceleration_north_m_s2=gain, acceleration_fade_s=1000.0,
        yaw_rate_deg_s=yaw,
    )  # fmt: skip
    routes = find_routes(
        Prescription([Zone(name="a", polygon=edge, rate_l_ha=20.0)]), state, BOOM, back_s=0.1,
        ahead_s=AHEAD_S, border="inside", border_buffer_m=0.0, across="centre", leads_s=(0.12,),
    )  # fmt: skip
    field = edge.buffer(2e-3)
    for after_s in np.arange(0.0, AHEAD_S - 0.01, 0.004).tolist():
        east, north = 0.5 * aside * after_s**2, 5.0 * after_s + 0.5 * gain * after_s**2
        nose = math.radians(yaw * after_s)
        for valve, route in zip(BOOM.valves, routes, strict=True):
            ends = [
                (east + side * math.cos(nose), north - side * math.sin(nose))
                for side in (valve.right_m - valve.width_m / 2, valve.right_m + valve.width_m / 2)
            ]
            if not field.covers(shapely.LineString(ends)):
                here = [each for each in route if each.at_s <= 10.0 + after_s][-1]
                assert here.rate_l_ha is None, (valve.name, after_s)
