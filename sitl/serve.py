"""`vrspray sitl serve`: the stub autopilot in real time, with the twin behind its outputs.

Brings the field, the mission, the sprayer and the friendly operator together, and writes down
what truly happened.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.assembly import build_setup
from companion.config import Config, load
from companion.core.frame import LocalFrame, course_deg
from companion.errors import ConfigError
from sitl.anyang import EXAMPLE, anyang_items
from sitl.stub.build import StubOptions, build_autopilot, firmware_of
from sitl.stub.firmware import Firmware
from sitl.stub.flight_plan import starts_with_take_off
from sitl.stub.liquid import LiquidOptions, words_of
from sitl.stub.liquid_entries import TAKE_OFF
from sitl.stub.mission_file import read_mission
from sitl.stub.mission_items import MissionItem, item_message
from sitl.stub.operator import Operator, Step
from sitl.stub.parameters import OUTPUT_COUNT
from sitl.stub.px4 import px4_parameters
from sitl.stub.scenario import Scenario, load_scenario
from sitl.stub.server import StubServer
from sitl.stub.sprayer import BoardKind, Sprayer, SprayerOptions
from sitl.stub.truth import TruthLog
from sitl.wire_truth import judge

DEFAULT_LINK = "udpout:127.0.0.1:14550"
_SAY_EVERY_S = 5.0
_AFTER_LANDING_S = 1.0
_EPOCH_2015_S = 1_420_070_400  # MAVLink's time stamps count from there, in 10 us

Say = Callable[[str], None]


# How the example is wired: PX4 counts actuators where ArduPilot counts outputs.
FIELD_CONFIGS = {"ardupilot": "config.toml", "px4": "px4.toml"}
_OTHER = {"ardupilot": "px4", "px4": "ardupilot"}


@dataclass(frozen=True, slots=True, kw_only=True)
class ServeOptions:
    """What the command line says."""

    link: str = DEFAULT_LINK
    autopilot: str = "ardupilot"
    mission: Path | None = None
    scenario: Path | None = None
    field_config: Path | None = None
    profile: str = "wang-2024"
    board: BoardKind = "restarting"
    speed_m_s: float = 5.0
    gust_m_s: float = 1.0
    seed: int = 0
    out: Path | None = None
    sensors: Path | None = None
    enable: bool = True
    ground: bool = False
    wait_s: float | None = None


async def serve(options: ServeOptions, say: Say) -> dict[str, Any]:
    """Run the stub until its mission is flown and return what happened."""
    run = _Run(options, say)
    cancelled = False
    try:
        async with StubServer(run.autopilot, [options.link]) as server:
            run.late_s = server.late_s
            say(f"{options.link}: {run.operator.step.value}")
            server.ticked = run.tick
            await run.finished(server)
    except asyncio.CancelledError:
        cancelled = True
    return run.result(cancelled=cancelled)


class _Run:
    """One flight: the parts, what is said of it, and how it ends."""

    def __init__(self, options: ServeOptions, say: Say) -> None:
        if not 0.0 <= options.gust_m_s <= 10.0:
            raise ConfigError(f"--gust {options.gust_m_s:g}: give 0 to 10 m/s")
        if options.wait_s is not None and not options.wait_s >= 0.0:
            raise ConfigError(f"--wait-s {options.wait_s:g}: give 0 or more seconds")
        if not 0.5 <= options.speed_m_s <= 20.0:
            raise ConfigError(f"--speed {options.speed_m_s}: give 0.5 to 20 m/s")
        config = self._config = load(
            options.field_config or EXAMPLE / FIELD_CONFIGS.get(options.autopilot, "config.toml")
        )
        scenario = load_scenario(options.scenario) if options.scenario else Scenario()
        items = _items(options, _firmware(options.autopilot, scenario))
        start_s = time.monotonic()
        home = LocalFrame(items[0].latitude_deg, items[0].longitude_deg)
        self.sprayer = Sprayer(_sprayer_options(options, config, scenario), start_s=start_s)
        self.autopilot = build_autopilot(
            StubOptions(
                home=home,
                autopilot=options.autopilot,
                items=items,
                heading_deg=_first_course_deg(items, home),
                speed_m_s=options.speed_m_s,
                gust_m_s=options.gust_m_s,
                scenario=scenario,
                signing_time=round((time.time() - _EPOCH_2015_S) * 1e5),
                seed=options.seed,
            ),
            start_s=start_s,
            written=self.sprayer.take,
        )
        if self.sprayer.liquid is not None:
            self.autopilot.batteries = self.sprayer.liquid.batteries
        self.operator = Operator(self.autopilot, enable=options.enable)
        self.truth = TruthLog(self.autopilot.flight.world, self.sprayer, home)
        self._options = options
        self._say = say
        self._start_s = start_s
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
        waiting = self.operator.step is Step.WAITING and not self._options.ground
        if waiting and wait_s is not None and now_s - self._start_s > wait_s:
            self._gave_up = True
            self._done.set()

    def result(self, *, cancelled: bool) -> dict[str, Any]:
        """Return the summary, and write the truth if there is a folder for it."""
        state = "stopped" if cancelled else self.operator.step.value
        summary = {
            "state": "no companion" if self._gave_up else state,
            "enabled": self.operator.enabled,
            "seed": self._options.seed,
            "speed_m_s": self._options.speed_m_s,
            "late_ms": _spread_ms(self.late_s),
            **self.truth.summary(),
        }
        if self.sprayer.liquid is not None:
            begun = self.sprayer.liquid.begun(time.monotonic())
            summary["liquid"] = [
                {"fault": words_of(fault), "from_s": round(fault.from_s, 3)} for fault in begun
            ]
        if self._options.out is not None:
            self.truth.write(self._options.out, summary)
            if summary["state"] == Step.DONE.value:
                summary["metrics"] = self._judge(self._options.out)
            summary["out"] = str(self._options.out)
        return summary

    def _judge(self, folder: Path) -> dict[str, object]:
        """Return how well the map of the configuration was put on the ground."""
        output = self._config.output
        return judge(
            folder,
            build_setup(self._config),
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


def _items(options: ServeOptions, firmware: Firmware) -> tuple[MissionItem, ...]:
    """Return the mission of the file, or the passes over the example field.

    What the firmware would refuse at an upload is refused here too.
    """
    items = _items_of_file(options)
    for number, item in enumerate(items[1:], start=1):
        message = item_message(item, number, current=False, to=(0, 0))
        if firmware.refuses_item(message) is not None:
            raise ConfigError(
                f"{options.mission}: item {number}: {firmware.name} takes no command "
                f"{item.command} in frame {item.frame}"
            )
    return items


def _items_of_file(options: ServeOptions) -> tuple[MissionItem, ...]:
    if options.mission is None:
        return anyang_items(options.speed_m_s)
    items = read_mission(options.mission)
    if not starts_with_take_off(items):
        raise ConfigError(f"{options.mission}: the first item must be a take-off")
    if items[0].has_place:
        return items
    places = [item for item in items if item.has_place]
    if not places:
        raise ConfigError(f"{options.mission}: no item has a place; plan at least one waypoint")
    return (places[0], *items[1:])


def _first_course_deg(items: tuple[MissionItem, ...], home: LocalFrame) -> float:
    """Return the direction of the first leg, so that the vehicle stands ready for it."""
    for item in items[1:]:
        if item.has_place:
            east_m, north_m = home.to_local(item.latitude_deg, item.longitude_deg)
            if math.hypot(east_m, north_m) > 1.0:
                return course_deg(east_m, north_m)
    return 0.0


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


def _sprayer_options(options: ServeOptions, config: Config, scenario: Scenario) -> SprayerOptions:
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
    )
