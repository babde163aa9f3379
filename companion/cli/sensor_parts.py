"""The sensors of a run: what the configuration names, not yet open."""

from __future__ import annotations

from collections.abc import Sequence

from companion.config import Config
from companion.config.sensor_rules import tank_capacity_l
from companion.config.sensor_tables import ConverterTable
from companion.link.vehicle_link import VehicleLink
from companion.ports import Sensor
from companion.sensors.current_loop import CurrentLoop
from companion.sensors.estop import EstopSwitch
from companion.sensors.flow_meter import FlowMeter
from companion.sensors.gauge import Gauge
from companion.sensors.gpiod_edges import GpiodEdges
from companion.sensors.gpiod_level import GpiodLevel
from companion.sensors.pressure import PressureSensor
from companion.sensors.pulses import Meter
from companion.sensors.tank import TankSensor
from companion.sensors.voltage import I2cVoltage, IioVoltage, VoltageSource

# The nozzle sets' largest flow is measured; a burst hose gives more, a broken wire far more.
FLOW_MAX_FACTOR = 2.0
LEVEL_HZ = 5.0
PRESSURE_PERIODS = 3


def build_sensors(config: Config) -> list[Sensor]:
    """Return the sensors that this computer reads, in the order in which they are read."""
    sensors: list[Sensor] = []
    if config.safety.estop_line is not None:
        line = GpiodLevel(config.output.chip, config.safety.estop_line, key="safety.estop_line")
        sensors.append(EstopSwitch(line))
    meter = _flow_meter(config)
    if meter is not None:
        sensors.append(meter)
    pressure = _pressure(config)
    if pressure is not None:
        sensors.append(pressure)
    tank = _tank(config, meter)
    if tank is not None:
        sensors.append(tank)
    return sensors


def follow_refills(sensors: Sequence[Sensor], link: VehicleLink) -> None:
    """Have the tank's sensor learn of what the operator fills in."""
    for sensor in sensors:
        if isinstance(sensor, TankSensor):
            link.on_refilled(sensor.refilled)


def _flow_meter(config: Config) -> FlowMeter | None:
    table = config.flow_meter
    if table.source != "gpio" or table.line is None or table.pulses_per_l is None:
        return None
    largest_l_min = max(nozzles.flow_max_l_min for nozzles in config.nozzle_sets())
    meter = Meter(
        pulses_per_l=table.pulses_per_l,
        flow_max_l_min=table.flow_max_l_min or FLOW_MAX_FACTOR * largest_l_min,
        pwm_period_s=config.pwm_limits().period_s,
    )
    return FlowMeter(meter, GpiodEdges(table.chip, table.line, pull=table.pull))


def _voltage(table: ConverterTable, source: str) -> VoltageSource:
    if source == "i2c":
        return I2cVoltage(table.i2c_bus, table.i2c_address, table.channel)
    return IioVoltage(table.device, table.channel)


def _pressure(config: Config) -> PressureSensor | None:
    table = config.pressure
    if table.source == "none":
        return None
    loop = CurrentLoop(
        name="pressure",
        shunt_ohm=table.shunt_ohm,
        at_4_ma=table.at_4_ma_kpa,
        at_20_ma=table.at_20_ma_kpa,
    )
    window_s = PRESSURE_PERIODS * config.pwm_limits().period_s
    voltage = _voltage(table, table.source)
    return PressureSensor(Gauge(loop, voltage, rate_hz=table.rate_hz, window_s=window_s))


def _tank(config: Config, meter: FlowMeter | None) -> TankSensor | None:
    table, capacity_l = config.tank, tank_capacity_l(config)
    if table.source in ("none", "autopilot") or capacity_l is None:
        return None
    gauge = None
    if table.source in ("iio", "i2c"):
        loop = CurrentLoop(
            name="tank",
            shunt_ohm=table.shunt_ohm,
            at_4_ma=table.at_4_ma_l,
            at_20_ma=table.at_20_ma_l,
        )
        voltage = _voltage(table, table.source)
        gauge = Gauge(loop, voltage, rate_hz=LEVEL_HZ, window_s=1.0)
    return TankSensor(
        meter,
        gauge,
        capacity_l=capacity_l,
        filled_l=table.filled_l,
        tolerance_l=table.tolerance_l,
    )
