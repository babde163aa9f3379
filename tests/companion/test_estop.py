"""The emergency stop's own line: what counts as pressed, and how it is heard."""

from __future__ import annotations

import asyncio
import os
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import pytest

from companion.cli.sensor_parts import EstopSwitch, GpiodLevel, build_sensors
from companion.core.types import EstopReport
from companion.errors import SensorError
from tests.companion.test_sensors_wiring import EXAMPLE, load


@dataclass
class Line:
    """A line by hand; faults are fields."""

    high: bool = False
    is_broken: bool = False
    file: int | None = None
    is_open: bool = False

    def open(self) -> None:
        self.is_open = True

    def is_high(self) -> bool:
        if self.is_broken:
            raise OSError(19, "No such device")
        return self.high

    def fileno(self) -> int | None:
        return self.file

    def close(self) -> None:
        self.is_open = False


def pressed(switch: EstopSwitch, now_s: float) -> list[bool]:
    reports = switch.read(now_s)
    for report in reports:
        assert isinstance(report, EstopReport)
        assert (report.received_s, report.source) == (now_s, "line")
    return [report.pressed for report in reports if isinstance(report, EstopReport)]


def test_each_change_is_told_once_and_the_first_state_too() -> None:
    line = Line()
    switch = EstopSwitch(line)
    assert pressed(switch, 1.0) == [False]
    assert pressed(switch, 1.1) == []
    line.high = True
    assert pressed(switch, 1.2) == [True]
    line.high = False
    assert pressed(switch, 1.3) == [False]


def test_a_line_that_cannot_be_read_is_pressed() -> None:
    line = Line()
    switch = EstopSwitch(line)
    assert pressed(switch, 1.0) == [False]
    line.is_broken = True
    assert pressed(switch, 1.1) == [True]


async def test_a_change_wakes_the_loop_and_closing_lets_go() -> None:
    reader, writer = os.pipe()
    try:
        line, woken = Line(file=reader), asyncio.Event()
        switch = EstopSwitch(line)
        await switch.open(woken.set)
        os.write(writer, b"x")
        await asyncio.wait_for(woken.wait(), 5.0)
        await switch.close()
        await switch.close()
        assert not line.is_open
        assert not asyncio.get_running_loop().remove_reader(reader)
    finally:
        os.close(reader)
        os.close(writer)


@dataclass
class FakeRequest:
    """What `gpiod` 2 gives for one input line."""

    events: list[str] = field(default_factory=list)
    value: str = "inactive"
    fd: int = 7
    released: int = 0
    config: dict[str, Any] = field(default_factory=dict)

    def wait_edge_events(self, _timeout: object) -> bool:
        return bool(self.events)

    def read_edge_events(self) -> list[object]:
        events, self.events = self.events, []
        return [SimpleNamespace(event_type=event) for event in events]

    def get_value(self, _line: int) -> str:
        return self.value

    def release(self) -> None:
        self.released += 1


def fake_module(request: FakeRequest | OSError) -> SimpleNamespace:
    def request_lines(path: str, **config: object) -> FakeRequest:
        if isinstance(request, OSError):
            raise request
        request.config = {"path": path, **config}
        return request

    return SimpleNamespace(
        __version__="2.5.0",
        request_lines=request_lines,
        LineSettings=lambda **given: given,
        EdgeEvent=SimpleNamespace(Type=SimpleNamespace(RISING_EDGE="rising")),
        line=SimpleNamespace(
            Direction=SimpleNamespace(INPUT="input"),
            Edge=SimpleNamespace(BOTH="both"),
            Bias=SimpleNamespace(PULL_UP="up"),
            Value=SimpleNamespace(ACTIVE="active"),
        ),
    )


def test_a_line_of_gpiod_is_an_input_with_its_pull_up(monkeypatch: pytest.MonkeyPatch) -> None:
    request = FakeRequest(events=["falling"])
    monkeypatch.setitem(__import__("sys").modules, "gpiod", fake_module(request))
    line = GpiodLevel("/dev/null", 5, key="safety.estop_line")
    with pytest.raises(OSError, match="not open"):
        line.is_high()
    line.open()
    assert request.config["config"] == {
        5: {"direction": "input", "edge_detection": "both", "bias": "up"}
    }
    assert line.fileno() == 7
    assert not line.is_high()
    assert not request.events  # left unread they would wake for ever
    request.events = ["rising", "falling"]
    assert line.is_high()  # pressed and released between two looks
    assert not line.is_high()
    request.value = "active"
    assert line.is_high()
    line.close()
    line.close()
    assert request.released == 1
    assert line.fileno() is None


class Chattering(FakeRequest):
    """A contact that never comes to rest: there is always another edge."""

    def wait_edge_events(self, _timeout: object) -> bool:
        self.events = ["falling", "rising"]
        return True


def test_a_contact_that_chatters_is_pressed_and_holds_up_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "gpiod", fake_module(Chattering()))
    line = GpiodLevel("/dev/null", 5, key="safety.estop_line")
    line.open()
    assert line.is_high()
    line.close()


def test_a_line_that_is_taken_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    module = fake_module(OSError(16, "Device or resource busy"))
    monkeypatch.setitem(__import__("sys").modules, "gpiod", module)
    with pytest.raises(SensorError, match=r"safety\.estop_line = 5"):
        GpiodLevel("/dev/null", 5, key="safety.estop_line").open()


def test_the_configuration_brings_it_and_requires_it() -> None:
    config = load(EXAMPLE, overrides=["safety.estop_line=5"])
    (switch,) = build_sensors(config)
    assert isinstance(switch, EstopSwitch)
    assert config.limits().estop_required
    assert not load(EXAMPLE).limits().estop_required


@pytest.mark.parametrize(
    ("given", "limit_m"),
    [
        ([], 0.3),
        (["safety.fix=rtk-fixed"], 0.3),
        (["safety.fix=dgps"], None),
        (["safety.fix=3d", "safety.accuracy_max_m=2.5"], 2.5),
        (["safety.accuracy_max_m=0.05"], 0.05),
    ],
)
def test_an_rtk_fix_has_to_be_as_accurate_as_one(given: list[str], limit_m: float | None) -> None:
    assert load(EXAMPLE, overrides=given).limits().accuracy_max_m == limit_m
