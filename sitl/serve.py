"""`vrspray sitl serve`: the stub autopilot in real time, with the twin behind its outputs.

Brings the field, the mission, the sprayer and the friendly operator together, and writes down
what truly happened.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from analysis.evaluation import Evaluation, FlightMeta, FlightRecord, evaluate
from companion.config import Config, load
from companion.core.setup import Setup
from companion.core.types import TimedChange
from companion.errors import ConfigError
from missions.maps.compiling import compiled_setup
from sitl.airframes import airframe_of
from sitl.anyang import EXAMPLE
from sitl.earth import Earth
from sitl.follow import Along, Told, along
from sitl.profile import FlowLaw, load_profile
from sitl.recorded import COLUMNS, held, read_flight
from sitl.scenario_file import load_scenario
from sitl.serve_mission import (
    MissionWatch,
    first_course_deg,
    home_of,
    mission_items,
    waiting_place,
)
from sitl.stub.autopilot import Autopilot
from sitl.stub.firmware import Firmware
from sitl.stub.mission_items import AUTO, LAND, LOITER, MODE_NAMES, MissionItem, Phase
from sitl.stub.parameters import OUTPUT_COUNT
from sitl.stub.protocol import (
    AUTOPILOT_SYSTEM,
    COMPANION_COMPONENT,
    GROUND_COMPONENT,
    GROUND_SYSTEM,
    Message,
    SigningKey,
    Speaker,
    dialect,
    sender,
)
from sitl.stub.px4 import px4_parameters
from sitl.stub.scenario import Scenario
from sitl.stub.server import StubOptions, StubServer, TruthLog, build_autopilot, firmware_of
from sitl.stub.sprayer import TAKE_OFF, BoardKind, LiquidOptions, Sprayer, SprayerOptions, words_of
from sitl.stub.watchdog import Watched
from sitl.vehicle import Corners

# The friendly operator: waits for mission and companion, flies, enables spraying, lands.
#
# It holds the stub's transmitter (arming, modes) and a ground station (255/190), from which
# MAV_CMD_DO_SPRAYER goes to the companion over the same link.

# After the first heartbeat: time to ask for streams and to decide that all is well.
_SETTLE_S = 3.0
_RETRY_S = 0.5
_RETRY_ARMING_S = 5.0


class Step(Enum):
    """How far the operator has come."""

    NO_MISSION = "waiting for a mission"
    WAITING = "waiting for a companion"
    SETTLING = "companion heard"
    FLYING = "flying"
    LANDING = "landing"
    DONE = "landed"


class Operator:
    """Acts at each `tick`; `enabled` says whether the companion has taken the enable.

    With `mission_is_there` it waits for that first, and then for a companion that beats afterwards:
    what was on the link before may have gone. `since_s` is when it began to wait. Where the link is
    signed, so is what its ground station sends.
    """

    def __init__(
        self,
        autopilot: Autopilot,
        *,
        enable: bool = True,
        mission_is_there: Callable[[], bool] | None = None,
        key: SigningKey | None = None,
        start_s: float = 0.0,
    ) -> None:
        self._start_s = start_s
        self.step = Step.WAITING if mission_is_there is None else Step.NO_MISSION
        self.since_s = start_s
        self.enabled = False
        self.companion_texts: list[str] = []
        self._autopilot = autopilot
        self._enable = enable
        self._mission_is_there = mission_is_there
        self._ground = Speaker(GROUND_SYSTEM, GROUND_COMPONENT, key=key)
        self._heard_s: float | None = None
        self._due_s = 0.0
        autopilot.hears = self.hear

    def hear(self, message: Message, now_s: float) -> None:
        """Listen to what the companion sends."""
        if sender(message)[1] != COMPANION_COMPONENT:
            return
        kind = message.get_type()
        if kind == "HEARTBEAT" and self._heard_s is None:
            self._heard_s = now_s
        elif kind == "STATUSTEXT":
            self.companion_texts.append(str(message.text))
        elif kind == "COMMAND_ACK" and message.command == dialect.MAV_CMD_DO_SPRAYER:
            self.enabled = message.result == dialect.MAV_RESULT_ACCEPTED

    def tick(self, now_s: float) -> None:
        """Take the step that is due."""
        flight = self._autopilot.flight
        if self.step is Step.NO_MISSION:
            self._look_for_mission(now_s)
        elif self.step is Step.WAITING and self._heard_s is not None:
            self.step = Step.SETTLING
        elif self.step is Step.SETTLING and now_s - (self._heard_s or now_s) >= _SETTLE_S:
            self._take_off(now_s)
        elif self.step is Step.FLYING:
            self._attend(now_s)
        elif self.step is Step.LANDING and flight.phase is Phase.GROUND:
            self.step = Step.DONE

    def _look_for_mission(self, now_s: float) -> None:
        if self._mission_is_there is None or self._mission_is_there():
            self.step, self.since_s, self._heard_s = Step.WAITING, now_s, None

    def _take_off(self, now_s: float) -> None:
        """Arm and start the mission; a refusal is tried again, but not at every tick."""
        if now_s < self._due_s:
            return
        self._due_s = now_s + _RETRY_ARMING_S
        flight = self._autopilot.flight
        ready = flight.set_mode(LOITER, now_s) and flight.arm(now_s)
        if ready and flight.start_mission(now_s):
            self.step, self._due_s = Step.FLYING, now_s

    def _attend(self, now_s: float) -> None:
        """Enable once in the air, and see to the landing."""
        flight = self._autopilot.flight
        if flight.phase is Phase.DESCEND or not flight.in_air:
            self.step = Step.LANDING
        elif flight.mission_complete and flight.phase is Phase.HOVER and not flight.will_land:
            if flight.mode == AUTO:
                flight.set_mode(LAND, now_s)
        elif flight.phase is Phase.ROUTE and self._enable and not self.enabled:
            self._send_enable(now_s)

    def _send_enable(self, now_s: float) -> None:
        if now_s < self._due_s:
            return
        self._due_s = now_s + _RETRY_S
        self._ground.keep_time(now_s - self._start_s)
        command = dialect.MAVLink_command_long_message(
            AUTOPILOT_SYSTEM,
            COMPANION_COMPONENT,
            dialect.MAV_CMD_DO_SPRAYER,
            0,
            *(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        )
        self._autopilot.relay(self._ground.frame(command))


_NUMBERS = {"MISSION": AUTO} | {name: number for number, name in MODE_NAMES.items()}


class Following(Operator):
    """The operator of a flight that was flown: arms and changes modes as it was done then."""

    def __init__(self, autopilot: Autopilot, motions: tuple[Along, Along], **more: Any) -> None:
        super().__init__(autopilot, **more)
        self._motions = motions

    def _take_off(self, now_s: float) -> None:
        flight, (truth, told) = self._autopilot.flight, self._motions
        truth.start_s = told.start_s = now_s
        flight.world.begin(truth, now_s=now_s)
        flight.armed, flight.phase, flight.will_land = True, Phase.ROUTE, False
        self.step = Step.FLYING

    def _attend(self, now_s: float) -> None:
        flight, (truth, _) = self._autopilot.flight, self._motions
        log, at_s = truth.flight, truth.log_s(now_s)
        if flight.phase is Phase.ROUTE:
            flight.mode = _NUMBERS.get(held(log.modes, at_s, ""), LOITER)
            flight.armed = bool(held(log.armed, at_s, default=True))
        flight.will_land = flight.phase is Phase.HOVER
        super()._attend(now_s)


DEFAULT_LINK = "udpout:127.0.0.1:14550"
_SAY_EVERY_S = 5.0
_AFTER_LANDING_S = 1.0
_EPOCH_2015_S = 1_420_070_400  # MAVLink's time stamps count from there, in 10 us

Say = Callable[[str], None]


# Where nothing came within --wait-s, the state says what.
WAITS = {Step.NO_MISSION: "no mission", Step.WAITING: "no companion"}

# How the example is wired: PX4 counts actuators where ArduPilot counts outputs.
FIELD_CONFIGS = {"ardupilot": "config.toml", "px4": "px4.toml"}
_OTHER = {"ardupilot": "px4", "px4": "ardupilot"}


@dataclass(frozen=True, slots=True, kw_only=True)
class ServeOptions:
    """What the command line says."""

    link: str = DEFAULT_LINK
    stations: tuple[str, ...] = ()
    autopilot: str = "ardupilot"
    mission: Path | None = None
    along: Path | None = None
    wait_mission: bool = False
    place_deg: tuple[float, float] | None = None
    lines: Path | None = None
    scenario: Path | None = None
    field_config: Path | None = None
    profile: str = "wang-2024"
    board: BoardKind = "restarting"
    flow_law: FlowLaw | None = None
    speed_m_s: float = 5.0
    gust_m_s: float | None = None
    vehicle: str = "drawn"
    corners: Corners | None = None
    seed: int = 0
    out: Path | None = None
    sensors: Path | None = None
    enable: bool = True
    ground: bool = False
    script: bool = True
    wait_s: float | None = None


async def serve(options: ServeOptions, say: Say) -> dict[str, Any]:
    """Run the stub until its mission is flown and return what happened."""
    run = _Run(options, say)
    cancelled = False
    try:
        async with StubServer(run.autopilot, [options.link, *options.stations]) as server:
            run.late_s = server.late_s
            say(f"{options.link}: {run.operator.step.value}")
            server.ticked = run.tick
            await run.finished(server)
    except asyncio.CancelledError:
        cancelled = True
    return run.result(cancelled=cancelled)


class _Run:
    """One flight: the parts, what is said of it, and how it ends.

    It begins now, or at `start_s` of a clock of its own.
    """

    def __init__(self, options: ServeOptions, say: Say, *, start_s: float | None = None) -> None:
        if not 0.0 <= (options.gust_m_s or 0.0) <= 10.0:
            raise ConfigError(f"--gust {options.gust_m_s:g}: give 0 to 10 m/s")
        if options.wait_s is not None and not options.wait_s >= 0.0:
            raise ConfigError(f"--wait-s {options.wait_s:g}: give 0 or more seconds")
        if not 0.5 <= options.speed_m_s <= 20.0:
            raise ConfigError(f"--speed {options.speed_m_s}: give 0.5 to 20 m/s")
        if sum(map(bool, (options.wait_mission, options.mission, options.along))) > 1:
            raise ConfigError("--wait-mission, --mission and --along exclude each other")
        if options.place_deg is not None and not options.wait_mission:
            raise ConfigError("--home is for --wait-mission; a mission file has its own home")
        config = self._config = _config(options)
        scenario = load_scenario(options.scenario) if options.scenario else Scenario()
        # Read before the flight: lines or a map that cannot be used are told now, not after it.
        self._setup = compiled_setup(config) if options.wait_mission or options.lines else None
        home, items, motions = _start(options, scenario, config, self._setup)
        start_s = time.monotonic() if start_s is None else start_s
        self.sprayer = Sprayer(sprayer_options(options, config, scenario), start_s=start_s)
        self.autopilot = build_autopilot(
            StubOptions(
                home=home,
                autopilot=options.autopilot,
                items=items,
                heading_deg=first_course_deg(items, home),
                speed_m_s=options.speed_m_s,
                airframe=airframe_of(options.vehicle),
                gust_m_s=options.gust_m_s,
                corners=options.corners or ("px4" if options.autopilot == "px4" else "ardupilot"),
                scenario=scenario,
                signing_time=round((time.time() - _EPOCH_2015_S) * 1e5),
                seed=options.seed,
                watched=_watched(config) if options.script else None,
                believed=None if motions is None else Told(motions[1]),
            ),
            start_s=start_s,
            written=self.sprayer.take,
        )
        self.autopilot.utc_offset_s = time.time() - start_s
        self.autopilot.batteries = self.sprayer.batteries
        self.mission = MissionWatch(self.autopilot, say)
        acts = Operator if motions is None else partial(Following, motions=motions)
        self.operator = acts(
            self.autopilot,
            enable=options.enable,
            key=self.autopilot.key,
            mission_is_there=(lambda: self.mission.is_there) if options.wait_mission else None,
            start_s=start_s,
        )
        self.truth = TruthLog(self.autopilot.flight.world, self.sprayer, home)
        self._options = options
        self._say = say
        self._start_s = self._ticked_s = start_s
        self._say_due_s = 0.0
        self._step = self.operator.step
        self._done = asyncio.Event()
        self._gave_up = False
        self._texts = self._faults = 0
        self.late_s: list[float] = []
        self.autopilot.says = lambda text: say(f"autopilot: {text}")

    async def finished(self, server: StubServer) -> None:
        """Wait for the landing, or for an error of the server."""
        done = asyncio.create_task(self._done.wait())
        failed = asyncio.create_task(server.wait())
        try:
            await asyncio.wait({done, failed}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            done.cancel()
            failed.cancel()
        if failed.done() and not failed.cancelled():
            failed.result()

    def tick(self, now_s: float) -> None:
        """Let operator, sprayer and log go on; called after each tick of the stub."""
        self._ticked_s = now_s
        self.mission.tick()
        if not self._options.ground:
            self.operator.tick(now_s)
        take_off_s = self.autopilot.faults.take_off_s
        if take_off_s is not None:
            self.sprayer.begins(TAKE_OFF, take_off_s)
        self.sprayer.advance(now_s)
        self.truth.tick(now_s, flying=self.operator.step in (Step.FLYING, Step.LANDING))
        self._tell(now_s)
        if self.operator.step is Step.DONE and now_s >= self.truth.until_s + _AFTER_LANDING_S:
            self._done.set()
        wait_s = self._options.wait_s
        waiting = self.operator.step in WAITS and not self._options.ground
        if waiting and wait_s is not None and now_s - self.operator.since_s > wait_s:
            self._gave_up = True
            self._done.set()

    def result(self, *, cancelled: bool) -> dict[str, Any]:
        """Return the summary, and write the truth if there is a folder for it."""
        state = "stopped" if cancelled else self.operator.step.value
        summary = {
            "state": WAITS.get(self.operator.step, state) if self._gave_up else state,
            "enabled": self.operator.enabled,
            "seed": self._options.seed,
            **self._of_mission(),
            "late_ms": _spread_ms(self.late_s),
            **self.truth.summary(),
        }
        if self.sprayer.liquid is not None:
            begun = self.sprayer.liquid.begun(self._ticked_s)
            summary["liquid"] = [
                {"fault": words_of(fault), "from_s": round(fault.from_s, 3)} for fault in begun
            ]
        if self._options.out is not None:
            self.truth.write(self._options.out, summary)
            if summary["state"] == Step.DONE.value:
                summary["metrics"] = self._judge(self._options.out)
            summary["out"] = str(self._options.out)
        return summary

    def _of_mission(self) -> dict[str, Any]:
        """Return the speed of the flight, and how long the mission is that was uploaded."""
        speed_m_s = self._options.speed_m_s
        if not self._options.wait_mission:
            return {"speed_m_s": speed_m_s}
        return {
            "speed_m_s": round(self.mission.speed_m_s(speed_m_s), 3),
            "uploaded_items": self.mission.count,
        }

    def _judge(self, folder: Path) -> dict[str, object]:
        """Return how well the map of the configuration was put on the ground."""
        output = self._config.output
        return judge(
            folder,
            self._setup if self._setup is not None else compiled_setup(self._config),
            closed_us=output.closed_us,
            full_us=output.full_us,
        )

    def _tell(self, now_s: float) -> None:
        """Say each step, each text of the companion, and the state every few seconds."""
        texts = self.operator.companion_texts
        for text in texts[self._texts :]:
            self._say(f"companion: {text}")
        self._texts = len(texts)
        begun = [] if self.sprayer.liquid is None else self.sprayer.liquid.begun(now_s)
        for fault in begun[self._faults :]:
            self._say(f"liquid: {words_of(fault)}")
        self._faults = len(begun)
        flying = self.operator.step in (Step.FLYING, Step.LANDING)
        if self.operator.step is self._step and not (flying and now_s >= self._say_due_s):
            return
        self._step = self.operator.step
        self._say_due_s = now_s + _SAY_EVERY_S
        if self._step in WAITS:
            self._say(self._step.value)
            return
        pose = self.autopilot.flight.world.pose_at(now_s)
        self._say(
            f"{self._step.value}: {self.truth.distance_m:.0f} m flown, {pose.speed_m_s:.1f} m/s, "
            f"{pose.height_m:.1f} m high, {self.sprayer.volume_l(now_s):.2f} L sprayed"
        )


def _spread_ms(late_s: list[float]) -> dict[str, float]:
    """Return how late the ticks of the stub were, in the 99th percentile and at worst."""
    ordered = sorted(late_s) or [0.0]
    p99 = ordered[int(0.99 * (len(ordered) - 1))]
    return {"p99": round(1000.0 * p99, 2), "max": round(1000.0 * ordered[-1], 2)}


def _firmware(autopilot: str, scenario: Scenario) -> Firmware:
    """Return the personality; where only the other one fits the scenario, name the option."""
    try:
        return firmware_of(autopilot, scenario)
    except ConfigError as error:
        other = _OTHER.get(autopilot)
        if other is None or not _can_be(other, scenario):
            raise
        raise ConfigError(f"{error}; for this scenario give --autopilot {other}") from error


def _can_be(autopilot: str, scenario: Scenario) -> bool:
    try:
        firmware_of(autopilot, scenario)
    except ConfigError:
        return False
    return True


def _config(options: ServeOptions) -> Config:
    """Return the companion's configuration, with the lines that are to be judged by."""
    path = options.field_config or EXAMPLE / FIELD_CONFIGS.get(options.autopilot, "config.toml")
    if options.lines is None:
        return load(path)
    return load(path, overrides=[f"mission.lines={json.dumps(str(options.lines.resolve()))}"])


def _start(
    options: ServeOptions, scenario: Scenario, config: Config, setup: Setup | None
) -> tuple[Earth, tuple[MissionItem, ...], tuple[Along, Along] | None]:
    """Return where the vehicle stands, its mission if it has one, or how it flies without."""
    firmware = _firmware(options.autopilot, scenario)
    if options.along is not None:
        flight = read_flight(options.along)
        home = Earth(*(float(flight.states[name][0]) for name in COLUMNS[1:3]))
        return home, (), along(flight, home)
    if setup is not None and options.wait_mission:
        is_example = options.field_config is None
        return waiting_place(options.place_deg, config, setup, is_example=is_example), (), None
    items = mission_items(options.mission, options.speed_m_s, firmware)
    return home_of(items), items, None


# The sprayer behind a simulated autopilot, as configuration and scenario wire it.


def _drive_channels(config: Config) -> tuple[int, ...]:
    """Return the channels of the motors, as the configuration has them."""
    pump = () if config.pump is None else (config.pump,)
    motors = (*pump, *config.atomiser)
    if any(motor.output != "autopilot" for motor in motors):
        raise ConfigError(
            f'{config.path}: a motor with output = "pwm" hangs on this computer, where the '
            "simulated autopilot does not see it; fly it with `vrspray sitl fly`"
        )
    return tuple(motor.channel for motor in motors)


def _pins(options: ServeOptions, scenario: Scenario, channels: tuple[int, ...]) -> tuple[int, ...]:
    """Return the output of each channel; PX4's are actuators, which parameters place."""
    if options.autopilot != "px4":
        return channels
    parameters = px4_parameters()
    for name, value in scenario.parameters.items():
        if name in parameters:
            parameters.put(name, value)
    actuators = {
        int(parameters[f"PWM_MAIN_FUNC{pin}"]) - 300: pin for pin in range(OUTPUT_COUNT, 0, -1)
    }
    # An actuator that no output shows is a valve that nobody opens.
    return tuple(actuators.get(channel, -channel) for channel in channels)


def _liquid(options: ServeOptions, scenario: Scenario) -> LiquidOptions | None:
    """Return what goes wrong with the liquid and who sees it; None where nothing is asked for."""
    batteries = (scenario.meter_battery, scenario.tank_battery)
    if options.autopilot == "px4" and batteries != (None, None):
        raise ConfigError(
            f"{scenario.source}: sensors: PX4 has no fuel flow meter; leave meter_battery and "
            "tank_battery out, or give --autopilot ardupilot"
        )
    found = LiquidOptions(
        entries=scenario.liquid,
        meter_battery=scenario.meter_battery,
        tank_battery=scenario.tank_battery,
        tank_l=scenario.tank_l,
        pressure_folder=options.sensors,
    )
    return None if found == LiquidOptions() else found


def _watched(config: Config) -> Watched:
    """Return what the watchdog script of the stub guards: all that the configuration wires."""
    valves = (valve.channel for valve in config.boom().valves)
    return Watched(
        channels=[channel for channel in (*valves, *_drive_channels(config)) if channel],
        closed_us=config.output.closed_us,
        return_channel=config.output.return_channel or 0,
        return_us=config.output.full_us,
    )


def sprayer_options(options: ServeOptions, config: Config, scenario: Scenario) -> SprayerOptions:
    """Return the sprayer as the configuration wires it."""
    return SprayerOptions(
        profile=options.profile,
        board=options.board,
        channels=_pins(options, scenario, tuple(valve.channel for valve in config.boom().valves)),
        closed_us=config.output.closed_us,
        full_us=config.output.full_us,
        box_closed_s=scenario.box_closed_s,
        liquid=_liquid(options, scenario),
        seed=options.seed,
        drive_channels=_pins(options, scenario, _drive_channels(config)),
        flow_law=options.flow_law,
    )


# The stub's truth judged as any flight: from `truth.npz` to the metrics of the demo.


def evaluate_truth(folder: Path, setup: Setup, *, closed_us: float, full_us: float) -> Evaluation:
    """Return every metric of a flight of the stub, from what it wrote into `folder`."""
    summary: dict[str, Any] = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    profile = load_profile(summary["profile"])
    with np.load(folder / "truth.npz") as arrays:
        flat = Earth(setup.frame.latitude_deg, setup.frame.longitude_deg)
        east_m, north_m = _in_frame(arrays, summary["origin"], flat)
        record = FlightRecord(
            time_s=arrays["time_s"],
            east_m=east_m,
            north_m=north_m,
            heading_deg=arrays["heading_deg"],
            volume_ml=arrays["volume_ml"],
            boom=setup.boom,
            prescription=setup.prescription,
            lines=setup.lines,
            guard=setup.overlap,
            treated=setup.treated,
            pwm_period_s=profile.pwm.period_s,
            duty_limits=(profile.pwm.duty_min, profile.pwm.duty_max),
            nozzle_sets=setup.nozzle_sets,
            orders=_orders(arrays, closed_us, full_us),
            meta=FlightMeta(
                speed_m_s=summary["speed_m_s"],
                method=setup.method.value,
                fidelity="pulsed",
                output="servo",
                seed=summary["seed"],
            ),
        )
    return evaluate(record)


def _in_frame(
    arrays: Any, origin: dict[str, float], frame: Earth
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return the path in the frame of the map; the stub's own begins at its home."""
    home = Earth(origin["latitude_deg"], origin["longitude_deg"])
    latitudes, longitudes = home.to_geographic_all(arrays["east_m"], arrays["north_m"])
    return frame.to_local_all(latitudes, longitudes)


def _orders(arrays: Any, closed_us: float, full_us: float) -> tuple[TimedChange, ...]:
    """Return the orders that changed a valve, as duties."""
    times, valves = arrays["order_time_s"].tolist(), arrays["order_valve"].tolist()
    duties = np.clip((arrays["order_pulse_us"] - closed_us) / (full_us - closed_us), 0.0, 1.0)
    changed: list[TimedChange] = []
    last: dict[int, float] = {}
    for at_s, valve, duty in zip(times, valves, duties.tolist(), strict=True):
        if last.get(valve, 0.0) != duty:
            changed.append(TimedChange(at_s=at_s, valve=valve, duty=duty))
            last[valve] = duty
    return tuple(sorted(changed, key=lambda change: change.at_s))


def judge(folder: Path, setup: Setup, *, closed_us: float, full_us: float) -> dict[str, object]:
    """Add the flight's metrics to its `truth.json`, and return them."""
    found = evaluate_truth(folder, setup, closed_us=closed_us, full_us=full_us)
    found = replace(found, zone_volume_error_percent={})
    metrics = found.as_json()
    path = folder / "truth.json"
    summary = json.loads(path.read_text(encoding="utf-8")) | {"metrics": metrics}
    path.write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    return metrics
