"""How much faster than the flight itself the closed loop is simulated."""

from __future__ import annotations

from time import perf_counter
from typing import TYPE_CHECKING

from sitl.anyang import START_S, demo_route
from sitl.flight import FlightOptions, fly
from sitl.profile import load_profile
from sitl.vehicle import Vehicle
from tests.bench.fields import PROFILE, example
from tests.bench.figures import Figure, collector_as_in_flight

if TYPE_CHECKING:
    from analysis.flight_record import Fidelity

SPEED_M_S = 5.0


def times_real_time(*, seed: int, repeats: int = 3) -> Figure:
    """Measure averaged flights over the example's field, journal off; pulsed ones beside them."""
    with collector_as_in_flight():
        _flight("averaged", seed)
        averaged = [_flight("averaged", seed + i) for i in range(repeats)]
        pulsed = [_flight("pulsed", seed + i) for i in range(repeats)]
    return Figure(
        key="times_real_time",
        what="closed loop, averaged, 6 valves, 20 steps a second",
        value=sum(found[0] for found in averaged) / sum(found[1] for found in averaged),
        unit="x",
        n=repeats,
        target=300.0,
        is_at_least=True,
        alternative={"pulsed": sum(f[0] for f in pulsed) / sum(f[1] for f in pulsed)},
        details={
            "simulated_s": sum(found[0] for found in averaged),
            "best": max(found[0] / found[1] for found in averaged),
            "steps_a_second": sum(f[2] for f in averaged) / sum(f[0] for f in averaged),
        },
    )


def _flight(fidelity: Fidelity, seed: int) -> tuple[float, float, int]:
    """Return simulated seconds, seconds, steps; the vehicle's path is part of the work."""
    setup, profile = example(SPEED_M_S), load_profile(PROFILE)
    route = demo_route(SPEED_M_S)
    begin = perf_counter()
    path = Vehicle(route, start_s=START_S, seed=seed).fly_to_end()
    options = FlightOptions(seed=seed, fidelity=fidelity)
    result = fly(setup, path, profile, options, speed_m_s=SPEED_M_S)
    return result.simulated_s, perf_counter() - begin, result.steps
