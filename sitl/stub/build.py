"""Puts a stub together from its parts."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.errors import ConfigError
from sitl.earth import Earth
from sitl.stub.ardupilot import ardupilot
from sitl.stub.autopilot import Autopilot
from sitl.stub.faults import Fault, FaultClock
from sitl.stub.firmware import Firmware, Parts
from sitl.stub.flight import Flight
from sitl.stub.mission_items import MissionItem
from sitl.stub.outputs import ActuatorOutputs, Outputs, ServoOrder, ServoOutputs
from sitl.stub.parameters import Parameters
from sitl.stub.protocol import SigningKey
from sitl.stub.px4 import COMMANDS_PER_S, nan_keeps, px4, px4_parameters
from sitl.stub.scenario import Scenario
from sitl.stub.sprayer import Sprayer
from sitl.stub.world import ARDUPILOT_NOISE, PX4_NOISE, Estimator, EstimatorNoise, Pose, World
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


# The log of the truth: path, volumes and orders of one flight, as arrays and a summary.
#
# `truth.npz` holds time_s, east_m, north_m, height_m, heading_deg (unwrapped), velocity_east_m_s,
# velocity_north_m_s (n), volume_ml (n, valves; cumulative), and of the servo orders order_time_s,
# order_valve, order_pulse_us (m). Times are seconds on the machine's monotonic clock, metres are
# in the frame whose origin `truth.json` names.

Floats = NDArray[np.float64]

SPACING_S = 0.002
_PATH_S = 0.01  # the vehicle's own step; between two of them the path is as good as straight


class TruthLog:
    """Notes from when to when was flown; everything else is worked out at the end."""

    def __init__(self, world: World, sprayer: Sprayer, home: Earth) -> None:
        self.from_s: float | None = None
        self.until_s = 0.0
        self.distance_m = 0.0
        self._world = world
        self._sprayer = sprayer
        self._home = home
        self._last: Pose | None = None

    def tick(self, now_s: float, *, flying: bool) -> None:
        """Note that the flight goes on."""
        if not flying:
            return
        if self.from_s is None:
            self.from_s = now_s
        self.until_s = now_s
        pose, last = self._world.pose_at(now_s), self._last
        if last is not None:
            self.distance_m += math.hypot(pose.east_m - last.east_m, pose.north_m - last.north_m)
        self._last = pose

    def summary(self) -> dict[str, Any]:
        """Return the figures of the flight so far."""
        volume_ml = self._volume_ml(np.array([self.until_s]))[0] if self.from_s else np.zeros(0)
        return {
            "flight_s": round(self.until_s - self.from_s, 3) if self.from_s else 0.0,
            "distance_m": round(self.distance_m, 2),
            "volume_l": round(float(volume_ml.sum()) / 1000.0, 6),
            "volume_ml": [round(float(value), 3) for value in volume_ml],
            "orders": len(self._sprayer.orders),
            "origin": {
                "latitude_deg": self._home.latitude_deg,
                "longitude_deg": self._home.longitude_deg,
            },
            "channels": list(self._sprayer.options.channels),
            "profile": self._sprayer.options.profile,
            "board": self._sprayer.options.board,
        }

    def write(self, folder: Path, summary: dict[str, Any]) -> None:
        """Write `truth.npz` and `truth.json`."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
            np.savez_compressed(folder / "truth.npz", **self._arrays())
            text = json.dumps(summary, indent=1) + "\n"
            (folder / "truth.json").write_text(text, encoding="utf-8")
        except OSError as error:
            reason = error.strerror or str(error)
            raise ConfigError(f"{folder}: the truth cannot be written ({reason})") from error

    def _arrays(self) -> dict[str, Any]:
        from_s = self.from_s if self.from_s is not None else 0.0
        time_s = np.arange(from_s, max(self.until_s, from_s), SPACING_S)
        arrays: dict[str, Any] = {"time_s": time_s, "volume_ml": self._volume_ml(time_s)}
        arrays.update(self._path(time_s))
        orders = self._sprayer.orders
        valves = {channel: i for i, channel in enumerate(self._sprayer.options.channels)}
        arrays["order_time_s"] = np.array([order.at_s for order in orders], dtype=np.float64)
        arrays["order_valve"] = np.array([valves[order.channel] for order in orders], dtype=int)
        arrays["order_pulse_us"] = np.array([order.pulse_us for order in orders], dtype=int)
        return arrays

    def _path(self, time_s: Floats) -> dict[str, Floats]:
        """Return the path at `time_s`, straight between steps of the vehicle."""
        if len(time_s) == 0:
            return {}
        knots_s = np.arange(time_s[0], self.until_s, _PATH_S)
        poses = [self._world.pose_at(float(knot_s)) for knot_s in knots_s]

        def along(name: str) -> Floats:
            values = np.array([getattr(pose, name) for pose in poses], dtype=np.float64)
            if name == "heading_deg":
                values = np.degrees(np.unwrap(np.radians(values)))
            return np.interp(time_s, knots_s, values)

        names = ("east_m", "north_m", "height_m", "velocity_east_m_s", "velocity_north_m_s")
        path = {name: along(name) for name in names}
        path["heading_deg"] = along("heading_deg")
        return path

    def _volume_ml(self, time_s: Floats) -> Floats:
        return self._sprayer.volume_ml(time_s)
