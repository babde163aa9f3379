"""What the other tests of the configuration let pass."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.cli.run import build_executor, component_options
from companion.config import load
from companion.core.types import Method
from companion.link.vehicle_link import VehicleLink
from companion.output.servo import ServoExecutor

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "anyang" / "config.toml"


@pytest.mark.parametrize("method", list(Method))
def test_the_method_that_is_configured_is_the_one_that_flies(method: Method) -> None:
    assert load(EXAMPLE, overrides=[f"lag.method={method.value}"]).method() is method


def servo_executor(*overrides: str) -> tuple[ServoExecutor, VehicleLink]:
    config = load(EXAMPLE, overrides=overrides)
    link = VehicleLink(config.link.url, component_options(config))
    executor = build_executor(config, link)
    assert isinstance(executor, ServoExecutor)
    return executor, link


def test_a_refused_order_is_a_fault_of_the_executor_that_is_flown() -> None:
    executor, link = servo_executor()
    assert executor.fault is None
    assert link.component.on_order_ack is not None
    link.component.on_order_ack(4)  # MAV_RESULT_FAILED
    assert "failed" in str(executor.fault)


def test_the_pulses_that_are_configured_are_the_ones_that_are_sent() -> None:
    executor, _ = servo_executor("output.closed_us=1100", "output.full_us=1900")
    assert [executor._options.pulse_us(duty) for duty in (0.0, 0.5, 1.0)] == [1100, 1500, 1900]
