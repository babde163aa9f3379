"""Puts a stub together from its parts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from companion.errors import ConfigError
from sitl.earth import Earth
from sitl.stub.ardupilot import ardupilot
from sitl.stub.autopilot import Autopilot
from sitl.stub.estimator import ARDUPILOT_NOISE, PX4_NOISE, Estimator, EstimatorNoise
from sitl.stub.faults import Fault, FaultClock
from sitl.stub.firmware import Firmware
from sitl.stub.flight import Flight
from sitl.stub.mission_items import MissionItem
from sitl.stub.outputs import Outputs, ServoOrder, ServoOutputs
from sitl.stub.parameters import Parameters
from sitl.stub.parts import Parts
from sitl.stub.protocol import SigningKey
from sitl.stub.px4 import COMMANDS_PER_S, nan_keeps, px4, px4_parameters
from sitl.stub.px4_outputs import ActuatorOutputs
from sitl.stub.scenario import Scenario
from sitl.stub.world import Pose, World
from sitl.vehicle import Corners

AUTOPILOTS = ("ardupilot", "px4")


@dataclass(frozen=True, slots=True, kw_only=True)
class StubOptions:
    """What a stub is made of; home is where it stands and the origin of its frame.

    `faults` come on top of those of the scenario; `noise` takes the place of the firmware's and
    of the scenario's. `signing_time` is the time stamp that a signed link begins with.
    """

    home: Earth
    autopilot: str = "ardupilot"
    home_altitude_m: float = 60.0
    heading_deg: float = 0.0
    items: tuple[MissionItem, ...] = ()
    speed_m_s: float = 5.0
    gust_m_s: float = 1.0
    corners: Corners = "stop"
    noise: EstimatorNoise | None = None
    scenario: Scenario = field(default_factory=Scenario)
    faults: tuple[Fault, ...] = ()
    signing_time: int = 0
    seed: int = 0


def build_autopilot(
    options: StubOptions,
    *,
    start_s: float,
    written: Callable[[ServoOrder], None] = lambda _order: None,
) -> Autopilot:
    """Return a stub that stands at home; `written` hears every servo order."""
    scenario = options.scenario
    firmware = firmware_of(options.autopilot, scenario)
    parameters = parameters_of(options, scenario)
    world = World(Pose(time_s=start_s, east_m=0.0, north_m=0.0, heading_deg=options.heading_deg))
    flight = Flight(
        world,
        options.home,
        parameters,
        home_altitude_m=options.home_altitude_m,
        gust_m_s=options.gust_m_s,
        seed=options.seed,
        zero_is_a_place=firmware.zero_is_a_place,
        corners=options.corners,
    )
    flight.set_items(options.items, start_s)
    faults = FaultClock((*scenario.faults, *options.faults), start_s=start_s)
    return Autopilot(
        Parts(
            firmware=firmware,
            flight=flight,
            estimator=Estimator(world, noise_of(options), seed=options.seed),
            outputs=_outputs(firmware, parameters, written),
            parameters=parameters,
            faults=faults,
            wind_towards_m_s=scenario.wind_towards_m_s,
            drift_ppm=scenario.drift_ppm,
            uptime_s=scenario.uptime_s,
            key=_key(options),
            seed=options.seed,
        ),
        start_s=start_s,
    )


def firmware_of(autopilot: str, scenario: Scenario) -> Firmware:
    """Return the personality, in the version that the scenario wants."""
    if autopilot not in AUTOPILOTS:
        raise ConfigError(f"--autopilot {autopilot}: choose one of {', '.join(AUTOPILOTS)}")
    version, where = scenario.version, scenario.source
    if autopilot == "ardupilot":
        if version is not None and not (4, 0, 0) <= version < (5, 0, 0):
            raise ConfigError(f"{where}: firmware.version: ArduPilot is known from 4.0.0 on")
        if scenario.commands_per_s is not None:
            raise ConfigError(
                f"{where}: firmware.commands_per_s: ArduPilot has no queue of commands"
            )
        return ardupilot() if version is None else ardupilot(version)
    if version is not None and not (1, 14, 0) <= version < (2, 0, 0):
        raise ConfigError(f"{where}: firmware.version: PX4 is known from 1.14.0 on")
    per_s = scenario.commands_per_s or COMMANDS_PER_S
    return px4(commands_per_s=per_s) if version is None else px4(version, commands_per_s=per_s)


def parameters_of(options: StubOptions, scenario: Scenario) -> Parameters:
    """Return the firmware's parameters as the scenario sets them."""
    parameters = px4_parameters() if options.autopilot == "px4" else Parameters()
    parameters.put_speed("cruise", options.speed_m_s)
    for name, value in scenario.parameters.items():
        if name not in parameters:
            raise ConfigError(
                f"{scenario.source}: parameters.{name}: the stub of {options.autopilot} has no "
                "such parameter"
            )
        parameters.put(name, value)
    return parameters


def noise_of(options: StubOptions) -> EstimatorNoise:
    """Return how far the position is from the truth."""
    if options.noise is not None:
        return options.noise
    own = PX4_NOISE if options.autopilot == "px4" else ARDUPILOT_NOISE
    return replace(own, **options.scenario.position)


def _outputs(
    firmware: Firmware, parameters: Parameters, written: Callable[[ServoOrder], None]
) -> Outputs:
    if firmware.name == "px4":
        return ActuatorOutputs(parameters, written, nan_keeps=nan_keeps(firmware.version))
    return ServoOutputs(parameters, written)


def _key(options: StubOptions) -> SigningKey | None:
    secret = options.scenario.signing_key
    if secret is None:
        return None
    return SigningKey(secret=secret, timestamp=options.signing_time)
