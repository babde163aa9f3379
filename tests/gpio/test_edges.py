"""Inputs: the flow meter's edges with the kernel's times and numbers; a switch."""

from __future__ import annotations

import math
import select
import time
from collections.abc import Iterator

import pytest

from companion.cli import sensor_parts
from companion.cli.sensor_parts import GpiodEdges, GpiodLevel
from companion.errors import SensorError
from companion.output.engine.lines import GpiodLines, load_gpiod
from companion.sensors import FlowMeter, Meter
from tests.gpio.sim import SimChip

pytestmark = pytest.mark.needs_gpiosim

LINE = 24
BUFFER = 64
# So fast that no pulse made here is an echo, and none too many.
METER = Meter(pulses_per_l=1000.0, flow_max_l_min=1e9, pwm_period_s=1.0 / 11.0)


@pytest.fixture
def edges(chip: SimChip, monkeypatch: pytest.MonkeyPatch) -> Iterator[GpiodEdges]:
    """The edges of a line, with a buffer that is soon full."""
    monkeypatch.setattr(sensor_parts, "BUFFER_SIZE", BUFFER)
    edges = GpiodEdges(chip.name, LINE)
    yield edges
    edges.close()


def test_every_rising_edge_comes_once_with_its_number_and_its_time(
    chip: SimChip, edges: GpiodEdges
) -> None:
    edges.open()
    assert edges.read() == []
    before_s = time.monotonic()
    chip.pulse(LINE, 40)
    after_s = time.monotonic()
    # A late reader loses nothing: the times are the kernel's.
    found = edges.read()
    assert [edge.number for edge in found] == list(range(1, 41))
    times_s = [edge.at_s for edge in found]
    assert times_s == sorted(times_s)
    assert before_s <= times_s[0] <= times_s[-1] <= after_s
    assert edges.read() == []
    chip.pulse(LINE)
    assert [edge.number for edge in edges.read()] == [41]


def test_edges_of_other_lines_are_not_its_own(chip: SimChip, edges: GpiodEdges) -> None:
    edges.open()
    chip.pulse(LINE + 1, 3)
    assert edges.read() == []
    edges.close()


@pytest.mark.parametrize(("pull", "level"), [("up", 1), ("down", 0)])
def test_the_pull_that_is_asked_for_is_made(chip: SimChip, pull: str, level: int) -> None:
    chip.pull(LINE, up=pull == "down")
    edges = GpiodEdges(chip.name, LINE, pull=pull)
    edges.open()
    assert chip.level(LINE) == level
    edges.close()


def test_what_the_kernel_drops_is_known_by_its_numbers(chip: SimChip, edges: GpiodEdges) -> None:
    edges.open()
    chip.pulse(LINE, 2)
    first = edges.read()
    chip.pulse(LINE, BUFFER + 20)
    later = edges.read()
    assert [edge.number for edge in first] == [1, 2]
    # The oldest are dropped, the newest are there.
    assert len(later) == BUFFER
    assert later[-1].number == BUFFER + 22
    assert later[0].number > 3
    edges.close()


async def test_the_meter_counts_dropped_pulses_and_says_so(
    chip: SimChip, edges: GpiodEdges
) -> None:
    meter = FlowMeter(METER, edges)
    await meter.open(lambda: None)
    chip.pulse(LINE, 10)
    (report,) = meter.read(time.monotonic())
    assert (report.volume_ml, report.fault) == (10.0, "")  # type: ignore[union-attr]
    chip.pulse(LINE, BUFFER + 30)
    (report,) = meter.read(time.monotonic())
    assert math.isnan(report.volume_ml)  # type: ignore[union-attr]
    assert report.fault == "flow meter: 30 pulses lost"  # type: ignore[union-attr]
    assert meter.volume_ml() == BUFFER + 40.0
    await meter.close()


async def test_a_chip_that_is_taken_out_is_a_fault(chip: SimChip, edges: GpiodEdges) -> None:
    meter = FlowMeter(METER, edges)
    await meter.open(lambda: None)
    chip.remove()
    (report,) = meter.read(time.monotonic())
    assert math.isnan(report.volume_ml)  # type: ignore[union-attr]
    assert report.fault.startswith("flow meter: its line")  # type: ignore[union-attr]
    await meter.close()


def test_a_closed_line_is_free_again(chip: SimChip, edges: GpiodEdges) -> None:
    edges.open()
    edges.close()
    edges.close()
    edges.open()
    chip.pulse(LINE)
    # The kernel counts from 1 for each request.
    assert [edge.number for edge in edges.read()] == [1]
    edges.close()


def test_a_line_that_a_valve_hangs_on_is_refused_in_one_line(
    chip: SimChip, edges: GpiodEdges
) -> None:
    valve = GpiodLines(load_gpiod(), chip.name, (LINE,), levels=0)
    with pytest.raises(SensorError, match=f"flow_meter.line = {LINE} on .*busy.*gpioinfo"):
        edges.open()
    valve.release()
    edges.open()
    edges.close()


def test_a_line_that_the_chip_does_not_have_is_refused(chip: SimChip) -> None:
    with pytest.raises(SensorError, match=r"flow_meter.line = 99 on "):
        GpiodEdges(chip.name, 99).open()


def test_a_chip_is_found_by_its_label_as_for_the_valves(chip: SimChip) -> None:
    edges = GpiodEdges(chip.label, LINE)
    edges.open()
    chip.pulse(LINE)
    assert len(edges.read()) == 1
    edges.close()


def test_a_chip_that_is_not_there_is_named(chip: SimChip) -> None:
    with pytest.raises(SensorError, match="pinctrl-rp1"):
        GpiodEdges("pinctrl-rp1", LINE).open()


def test_a_switch_is_high_by_its_own_pull_and_low_while_it_is_closed(chip: SimChip) -> None:
    switch = GpiodLevel(chip.label, LINE, key="safety.estop_line")
    switch.open()
    file = switch.fileno()
    assert file is not None
    assert switch.is_high()
    chip.pull(LINE, up=False)
    # The change wakes whoever waits, until it was looked at.
    assert select.select([file], (), (), 5.0)[0] == [file]
    assert not switch.is_high()
    assert select.select([file], (), (), 0.0)[0] == []
    chip.pull(LINE, up=True)
    assert select.select([file], (), (), 5.0)[0] == [file]
    assert switch.is_high()
    switch.close()
    GpiodLines(load_gpiod(), chip.label, (LINE,), levels=0).release()
