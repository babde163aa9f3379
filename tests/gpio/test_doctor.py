"""`vrspray doctor` looks at a simulated chip: free, held, missing."""

from __future__ import annotations

import pytest

from companion.cli.sensor_parts import GpiodEdges
from companion.doctor.check import Check
from companion.doctor.gpio import gpio_checks, read_chip
from companion.output.engine.lines import GpiodLines, load_gpiod
from companion.output.engine.wire import Wiring
from tests.gpio.sim import SimChip

pytestmark = pytest.mark.needs_gpiosim

WIRING = Wiring(valves=(17, 18, 19), return_line=22, alive_line=4)


def checks(name: str, wiring: Wiring = WIRING) -> dict[str, Check]:
    return {check.name: check for check in gpio_checks(read_chip(name, wiring.lines), wiring)}


def test_free_lines_are_all_right_and_stay_free(chip: SimChip) -> None:
    found = checks(chip.label)
    assert {name: check.status for name, check in found.items()} == {
        "gpio-chip": "ok",
        "gpio-lines": "ok",
        "gpio-wiring": "ok",
    }
    assert found["gpio-lines"].text == "5 lines are free"
    GpiodLines(load_gpiod(), chip.label, WIRING.lines, levels=0).release()


def test_lines_of_a_running_vrspray_are_a_warning(chip: SimChip) -> None:
    held = GpiodLines(load_gpiod(), chip.label, WIRING.lines, levels=0)
    line = checks(chip.name)["gpio-lines"]
    assert (line.status, line.text) == ("warn", "line 17 is held by vrspray")
    held.release()


def test_a_line_that_another_holds_is_a_failure_with_its_name(chip: SimChip) -> None:
    meter = GpiodEdges(chip.name, 18)
    meter.open()
    line = checks(chip.name)["gpio-lines"]
    assert (line.status, line.text) == ("fail", "line 18 is held by vrspray flow meter")
    meter.close()


def test_a_line_that_the_chip_does_not_have_is_a_failure(chip: SimChip) -> None:
    found = checks(chip.name, Wiring(valves=(17, 99)))
    assert found["gpio-chip"].status == "fail"
    assert "gpioinfo" in (found["gpio-chip"].fix or "")


def test_a_chip_that_is_not_there_is_a_failure_that_names_those_that_are(chip: SimChip) -> None:
    missing = checks("pinctrl-rp1")["gpio-chip"]
    assert missing.status == "fail"
    assert chip.label in missing.text
