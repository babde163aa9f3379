"""Puts a stub together from its parts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from companion.core.frame import LocalFrame
from sitl.stub.autopilot import Autopilot
from sitl.stub.estimator import Estimator, EstimatorNoise
from sitl.stub.faults import Fault, FaultClock
from sitl.stub.flight import Flight
from sitl.stub.mission_items import MissionItem
from sitl.stub.outputs import ServoOrder, ServoOutputs
from sitl.stub.parameters import Parameters
from sitl.stub.world import Pose, World


@dataclass(frozen=True, slots=True, kw_only=True)
class StubOptions:
    """What a stub is made of; home is where it stands and the origin of its frame."""

    home: LocalFrame
    home_altitude_m: float = 60.0
    heading_deg: float = 0.0
    items: tuple[MissionItem, ...] = ()
    speed_m_s: float = 5.0
    gust_m_s: float = 1.0
    noise: EstimatorNoise = field(default_factory=EstimatorNoise)
    faults: tuple[Fault, ...] = ()
    seed: int = 0


def build_autopilot(
    options: StubOptions,
    *,
    start_s: float,
    written: Callable[[ServoOrder], None] = lambda _order: None,
) -> Autopilot:
    """Return a stub that stands at home; `written` hears every servo order."""
    world = World(Pose(time_s=start_s, east_m=0.0, north_m=0.0, heading_deg=options.heading_deg))
    parameters = Parameters()
    parameters.put("WPNAV_SPEED", options.speed_m_s * 100.0)
    flight = Flight(
        world,
        options.home,
        parameters,
        home_altitude_m=options.home_altitude_m,
        gust_m_s=options.gust_m_s,
        seed=options.seed,
    )
    flight.set_items(options.items, start_s)
    return Autopilot(
        flight,
        Estimator(world, options.noise, seed=options.seed),
        ServoOutputs(parameters, written),
        parameters,
        faults=FaultClock(options.faults, start_s=start_s),
        start_s=start_s,
        seed=options.seed,
    )
