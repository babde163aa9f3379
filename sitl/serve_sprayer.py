"""The sprayer behind a simulated autopilot, as configuration and scenario wire it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from companion.config import Config
from companion.errors import ConfigError
from sitl.stub.liquid import LiquidOptions
from sitl.stub.parameters import OUTPUT_COUNT
from sitl.stub.px4 import px4_parameters
from sitl.stub.scenario import Scenario
from sitl.stub.sprayer import SprayerOptions

if TYPE_CHECKING:
    from sitl.serve import ServeOptions


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
