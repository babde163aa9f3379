"""From the configuration to what the valve engine must know."""

from __future__ import annotations

from companion.config import Config
from companion.output.engine.setup import EngineSetup
from companion.output.engine.wiring import Wiring
from companion.output.gpio import GpioExecutor


def engine_setup(config: Config) -> EngineSetup:
    """Return the wiring and limits of a configuration with `output.kind = "gpio"`."""
    output, gpio = config.output, config.gpio
    wiring = Wiring(
        valves=tuple(valve.channel or 0 for valve in config.valve),
        return_line=output.return_channel,
        alive_line=gpio.alive_line,
        normally_open=config.pwm.valve == "normally-open",
        return_normally_open=gpio.return_valve == "normally-open",
        active_low=gpio.active_low,
    )
    is_register = gpio.driver == "spi595"
    return EngineSetup(
        wiring=wiring,
        pwm=config.pwm_limits(),
        backend="spi595" if is_register else "gpiod",
        device=gpio.spi_device if is_register else output.chip,
        realtime=gpio.realtime,
        spi_hz=1000 * gpio.spi_khz,
    )


def build_gpio(config: Config) -> GpioExecutor:
    """Return the executor of a configuration with `output.kind = "gpio"`."""
    return GpioExecutor(engine_setup(config))
