"""The real `gpiod` on a simulated chip: request, levels, release, refusals, and the closer."""

from __future__ import annotations

import time
from typing import Any

import pytest

from companion.core.types import PwmLimits
from companion.errors import ActuatorError
from companion.output.engine import closer
from companion.output.engine.lines import GpiodLines, Lines, find_chip, load_gpiod, open_lines
from companion.output.engine.wire import EngineSetup, Wiring
from tests.gpio.sim import SimChip

pytestmark = pytest.mark.needs_gpiosim

PWM = PwmLimits(frequency_hz=11.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01)
LINES = (17, 27, 22, 4)


def setup(chip: SimChip, **given: Any) -> EngineSetup:
    """Two normally open valves, a return valve, ALIVE."""
    usual: dict[str, Any] = {"valves": (17, 27), "return_line": 22, "alive_line": 4}
    wiring = Wiring(**(usual | {"normally_open": True} | given))
    return EngineSetup(wiring=wiring, pwm=PWM, device=chip.label)


def test_lines_are_safe_from_the_request_on_and_follow_it(chip: SimChip) -> None:
    held = open_lines(setup(chip))
    assert chip.levels(*LINES) == [1, 1, 0, 0]
    held.write(0b0110)
    assert chip.levels(*LINES) == [0, 1, 1, 0]
    assert held.read() == 0b0110
    held.release()
    assert chip.levels(*LINES) == [0, 0, 0, 0]


def test_polarity_is_the_wirings(chip: SimChip) -> None:
    held = open_lines(setup(chip, active_low=True))
    assert chip.levels(*LINES) == [0, 0, 1, 0]
    held.release()
    held = open_lines(setup(chip, normally_open=False, return_normally_open=False))
    assert chip.levels(*LINES) == [0, 0, 1, 0]
    held.release()


def test_a_line_that_is_pulled_up_is_driven_low_and_goes_back_up(chip: SimChip) -> None:
    chip.pull(17, up=True)
    assert chip.level(17) == 1
    held = GpiodLines(load_gpiod(), chip.name, (17,), levels=0)
    assert chip.level(17) == 0
    held.write(1)
    held.write(0)
    assert (chip.level(17), held.read()) == (0, 0)
    held.release()
    assert chip.level(17) == 1


def test_all_lines_of_24_valves_return_and_alive_move_in_one_call(chip: SimChip) -> None:
    wiring = Wiring(valves=tuple(range(24)), return_line=24, alive_line=25)
    held = open_lines(EngineSetup(wiring=wiring, pwm=PWM, device=chip.label))
    assert held.read() == wiring.safe_levels
    for levels in (0x3FFFFFF, 0x1555555, 0x2AAAAAA, 0):
        held.write(levels)
        assert held.read() == levels
        assert chip.levels(*wiring.lines) == [levels >> n & 1 for n in range(26)]
    held.release()


def test_as_many_lines_as_one_request_can_hold(chip: SimChip) -> None:
    large = SimChip("vrspray-large", count=64)
    try:
        held = GpiodLines(load_gpiod(), large.label, range(64), levels=1 << 63)
        assert (large.level(63), large.level(62), held.read()) == (1, 0, 1 << 63)
        held.release()
    finally:
        large.remove()


def test_a_second_request_is_refused_in_one_line(chip: SimChip) -> None:
    held = open_lines(setup(chip))
    with pytest.raises(ActuatorError, match=f"{chip.label}: Device or resource busy; is it free"):
        open_lines(setup(chip, valves=(17, 18), return_line=None, alive_line=None))
    # The line that was free is free still, the others keep their levels.
    assert chip.levels(*LINES) == [1, 1, 0, 0]
    GpiodLines(load_gpiod(), chip.label, (18,), levels=1).release()
    held.release()
    open_lines(setup(chip)).release()


def test_a_line_that_the_chip_does_not_have_is_refused(chip: SimChip) -> None:
    with pytest.raises(ActuatorError, match=f"{chip.label}: "):
        open_lines(setup(chip, valves=(99,)))


def test_a_chip_is_found_by_name_path_and_label(chip: SimChip) -> None:
    gpiod = load_gpiod()
    path = f"/dev/{chip.name}"
    assert [find_chip(gpiod, name) for name in (chip.name, path, chip.label)] == [path] * 3
    with pytest.raises(ActuatorError, match=rf"no GPIO chip pinctrl-rp1; .*\({chip.label}\)"):
        find_chip(gpiod, "pinctrl-rp1")


def test_the_label_finds_the_chip_beside_others(chip: SimChip) -> None:
    other = SimChip("vrspray-other")
    try:
        held = GpiodLines(load_gpiod(), other.label, (5,), levels=1)
        assert (other.level(5), chip.level(5)) == (1, 0)
        held.release()
    finally:
        other.remove()


def test_a_chip_that_is_taken_out_is_an_os_error(chip: SimChip) -> None:
    held = open_lines(setup(chip))
    chip.remove()
    for use in (lambda: held.write(0), held.read):
        with pytest.raises(OSError, match="No such device"):
            use()
    held.release()


def test_the_closer_drives_the_lines_and_lets_go(
    chip: SimChip, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[list[int]] = []
    released: list[Lines] = []
    release = GpiodLines.release

    def note(self: GpiodLines) -> None:
        # This kernel gives a released line back to its pull: what was driven shows before.
        asked.append(chip.levels(*LINES))
        released.append(self)
        release(self)

    monkeypatch.setattr(GpiodLines, "release", note)
    arguments = closer.closer_arguments(setup(chip))
    assert arguments == ["--chip", chip.label, "--low", "22", "4", "--high", "17", "27"]
    assert closer.main(arguments) == 0
    assert asked == [[1, 1, 0, 0]]
    assert len(released) == 1
    open_lines(setup(chip)).release()


def test_the_closer_waits_for_lines_that_are_held_and_then_gives_up(
    chip: SimChip, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    held = open_lines(setup(chip))
    monkeypatch.setattr(closer, "PATIENCE_S", 0.1)
    assert closer.main(["--chip", chip.label, "--low", "17"]) == 1
    assert capsys.readouterr().err == "closer: [Errno 16] Device or resource busy\n"
    monkeypatch.setattr(closer, "PATIENCE_S", 60.0)
    monkeypatch.setattr(time, "sleep", lambda _: held.release())
    assert closer.main(["--chip", chip.label, "--low", "17"]) == 0
