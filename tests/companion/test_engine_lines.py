"""The lines of a chip and the outputs of a register, on fakes; the closer on both."""

from __future__ import annotations

import importlib
import inspect
from pathlib import Path
from typing import Any

import pytest

from companion.core.types import PwmLimits
from companion.errors import ActuatorError
from companion.output.engine import closer, lines
from companion.output.engine.lines import (
    GpiodLines,
    SpiRegister,
    find_chip,
    keeps_levels,
    load_gpiod,
    open_lines,
)
from companion.output.engine.wire import EngineSetup, Wiring
from tests.fake_gpiod import FakeChip, FakeGpiod

PWM = PwmLimits(frequency_hz=11.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01)


@pytest.fixture
def chip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeChip:
    """Return the only chip of a computer whose `gpiod` is a fake."""
    chip = FakeChip()
    path = tmp_path / "gpiochip0"
    path.touch()
    fake = FakeGpiod({str(path): chip})
    monkeypatch.setattr(lines, "DEV", tmp_path)
    monkeypatch.setattr(importlib, "import_module", lambda name: fake)
    return chip


def setup(**given: Any) -> EngineSetup:
    usual: dict[str, Any] = {"valves": (17, 27), "return_line": 22, "alive_line": 4}
    return EngineSetup(wiring=Wiring(**(usual | {"normally_open": True} | given)), pwm=PWM)


def test_lines_are_safe_from_the_request_on_and_move_in_one_call(chip: FakeChip) -> None:
    held = open_lines(setup())
    assert chip.levels(17, 27, 22, 4) == [1, 1, 0, 0]
    assert chip.requests == [{"consumer": "vrspray", "offsets": [17, 27, 22, 4]}]
    held.write(0b0110)
    assert chip.calls == [{17: 0, 27: 1, 22: 1, 4: 0}]
    assert held.read() == 0b0110
    held.release()
    assert chip.levels(17, 27, 22, 4) == [0, 0, 0, 0]


def test_a_kernel_that_keeps_levels_keeps_them(chip: FakeChip) -> None:
    chip.keeps_levels = True
    open_lines(setup()).release()
    assert chip.levels(17, 27) == [1, 1]


def test_the_bias_and_direction_asked_for_make_outputs(chip: FakeChip) -> None:
    held = open_lines(setup(active_low=True))
    assert chip.levels(17, 27, 22, 4) == [0, 0, 1, 0]
    chip.stuck.add(27)
    held.write(0b1111)
    assert held.read() == 0b1101


def test_lines_that_another_program_holds_are_refused_in_one_line(chip: FakeChip) -> None:
    open_lines(setup())
    with pytest.raises(ActuatorError, match="gpiochip0: Device or resource busy; is it free"):
        open_lines(setup())


def test_a_line_that_the_chip_does_not_have_is_refused(chip: FakeChip) -> None:
    with pytest.raises(ActuatorError, match="gpiochip0: lines"):
        open_lines(setup(valves=(99,)))


def test_a_chip_is_found_by_its_label_and_missed_by_name(chip: FakeChip, tmp_path: Path) -> None:
    path = str(tmp_path / "gpiochip0")
    assert find_chip(load_gpiod(), "pinctrl-bcm2711") == path
    assert find_chip(load_gpiod(), path) == path
    with pytest.raises(ActuatorError, match=r"no GPIO chip pinctrl-rp1; there are: gpiochip0 \(p"):
        find_chip(load_gpiod(), "pinctrl-rp1")


def test_a_device_that_is_gone_is_an_os_error(chip: FakeChip) -> None:
    held = open_lines(setup())
    chip.is_gone = True
    for use in (lambda: held.write(0), held.read):
        with pytest.raises(OSError, match="No such device"):
            use()


def test_the_real_gpiod_has_what_is_used_of_it(tmp_path: Path) -> None:
    gpiod = pytest.importorskip("gpiod")
    assert load_gpiod() is gpiod
    settings = gpiod.LineSettings(direction=gpiod.line.Direction.OUTPUT)
    assert settings.output_value == gpiod.line.Value.INACTIVE
    used = inspect.signature(gpiod.Chip.request_lines).parameters
    assert {"config", "consumer", "output_values"} <= set(used)
    assert {"set_values", "get_values", "release"} <= set(dir(gpiod.LineRequest))
    with pytest.raises(ActuatorError, match="there are: none"):
        find_chip(gpiod, "pinctrl-rp1", folder=tmp_path)


def test_version_1_of_gpiod_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    old = FakeGpiod({}, version="1.6.3")
    monkeypatch.setattr(importlib, "import_module", lambda name: old)
    with pytest.raises(ActuatorError, match=r"gpiod 1\.6\.3 is too old"):
        load_gpiod()


def test_a_missing_gpiod_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(ActuatorError, match=r"vrspray\[vehicle\]"):
        load_gpiod()


def test_the_kernel_says_whether_it_keeps_levels(tmp_path: Path) -> None:
    file = tmp_path / "persist"
    assert keeps_levels(file) is None
    file.write_text("Y\n")
    assert keeps_levels(file) is True
    file.write_text("N\n")
    assert keeps_levels(file) is False


class FakePort:
    """A chain of registers: what was shifted through it."""

    def __init__(self) -> None:
        self.shifted: list[bytes] = []
        self.is_closed = False

    def transfer(self, data: bytes) -> bytes:
        self.shifted.append(data)
        return bytes(len(data))

    def close(self) -> None:
        self.is_closed = True


def test_a_register_takes_24_outputs_at_once_the_farthest_first() -> None:
    port = FakePort()
    register = SpiRegister(port, range(24), levels=0)
    register.write(1 << 0 | 1 << 9 | 1 << 23)
    assert port.shifted == [b"\0\0\0", bytes([0x80, 0x02, 0x01])]
    assert register.read() is None
    register.release()
    assert port.is_closed


def test_a_register_puts_outputs_where_they_are_wired() -> None:
    port = FakePort()
    SpiRegister(port, (8, 0), levels=0b01)
    assert port.shifted == [bytes([0x01, 0x00])]


def test_spi_that_is_not_there_is_refused() -> None:
    given = EngineSetup(
        wiring=Wiring(valves=(0,)), pwm=PWM, backend="spi595", device="/nonexistent/spidev9.9"
    )
    with pytest.raises(ActuatorError, match=r"spidev9.9: No such file"):
        open_lines(given)


def test_the_closer_leaves_the_lines_safe(chip: FakeChip) -> None:
    chip.keeps_levels = True
    chip.busy_times = 3
    arguments = closer.closer_arguments(setup())
    assert arguments == ["--chip", "gpiochip0", "--low", "22", "4", "--high", "17", "27"]
    assert closer.main(arguments) == 0
    assert chip.levels(17, 27, 22, 4) == [1, 1, 0, 0]


def test_the_closer_says_what_it_cannot_do(
    chip: FakeChip, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(closer, "PATIENCE_S", 0.03)
    chip.busy_times = 1000
    assert closer.main(["--low", "17"]) == 1
    assert capsys.readouterr().err == "closer: [Errno 16] Device or resource busy\n"
    with pytest.raises(SystemExit) as nothing:
        closer.main(["--chip", "gpiochip0"])
    assert nothing.value.code == 2


def test_the_closer_writes_a_register(monkeypatch: pytest.MonkeyPatch) -> None:
    port = FakePort()
    monkeypatch.setattr(closer, "open_port", lambda device, speed_hz: port)
    given = EngineSetup(
        wiring=Wiring(valves=(0, 12), normally_open=True), pwm=PWM, backend="spi595", device="spi"
    )
    arguments = closer.closer_arguments(given)
    assert arguments == ["--spi", "spi", "--bytes", "1001"]
    assert closer.main(arguments) == 0
    assert port.shifted == [bytes([0x10, 0x01])]
    assert port.is_closed


def test_a_real_port_is_asked_for_with_its_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, int]] = []
    port = FakePort()

    def open_port(path: str, speed_hz: int) -> FakePort:
        asked.append((path, speed_hz))
        return port

    monkeypatch.setattr("companion.output.engine.lines.open_port", open_port)
    given = EngineSetup(wiring=Wiring(valves=(1,)), pwm=PWM, backend="spi595", device="spidev0.0")
    assert isinstance(lines.open_lines(given), SpiRegister)
    assert asked == [("spidev0.0", 1_000_000)]
    assert port.shifted == [b"\0"]


def test_levels_of_a_request_are_physical(chip: FakeChip) -> None:
    held = GpiodLines(load_gpiod(), "gpiochip0", (5,), levels=1)
    assert chip.levels(5) == [1]
    held.write(0)
    assert chip.levels(5) == [0]
