"""The flow meter: whole periods, lost and doubled pulses, and a line that is not to be had."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.cli.sensor_parts import GpiodEdges
from companion.core.types import FlowReport
from companion.errors import SensorError
from companion.output.engine import lines
from companion.sensors import Edge, FlowMeter, Meter, PulseCounter
from tests.virtual_edges import VirtualEdges

PERIOD_S = 1.0 / 11.0
METER = Meter(pulses_per_l=4600.0, flow_max_l_min=12.0, pwm_period_s=PERIOD_S)


def pulsating(flow_l_min: float, depth: float, seconds: float) -> list[float]:
    """Return the edges of a flow that goes up and down once a PWM period."""
    per_s = flow_l_min / 60.0 * METER.pulses_per_l
    step_s, volume, times, at_s = 1e-4, 0.0, [], 10.0
    while at_s < 10.0 + seconds:
        before = int(volume)
        volume += per_s * step_s * (1.0 + depth * math.sin(2.0 * math.pi * 11.0 * at_s))
        if int(volume) > before:
            times.append(at_s)
        at_s += step_s
    return times


def counted(times: list[float]) -> PulseCounter:
    counter = PulseCounter(METER)
    for number, at_s in enumerate(times, start=1):
        counter.take(Edge(at_s, number))
    return counter


@pytest.mark.parametrize("flow_l_min", [0.5, 1.5, 4.0, 6.0])
@pytest.mark.parametrize("depth", [0.0, 0.95])
def test_mean_over_whole_periods_does_not_see_the_pulsation(
    flow_l_min: float, depth: float
) -> None:
    times = pulsating(flow_l_min, depth, 3.0)
    assert counted(times).flow_l_min(times[-1]) == pytest.approx(flow_l_min, rel=0.015)


@given(first=st.floats(0.5, 8.0), count=st.integers(50, 400))
def test_count_is_exact_at_the_time_of_its_last_edge(first: float, count: int) -> None:
    gap_s = 60.0 / (first * METER.pulses_per_l)
    times = [5.0 + gap_s * i for i in range(count)]
    report = counted(times).report(times[-1] + 0.4 * gap_s)
    assert report == FlowReport(received_s=times[-1], volume_ml=count * 1000.0 / 4600.0)


def test_without_pulses_the_count_stands_still_and_stays_young() -> None:
    counter = counted([1.0, 1.1])
    assert counter.report(1.15).received_s == 1.1
    later = counter.report(2.0)
    assert (later.received_s, later.volume_ml) == (2.0, 2000.0 / 4600.0)
    assert not later.fault
    assert counter.flow_l_min(3.0) == 0.0


def test_pulses_that_the_kernel_dropped_are_counted_and_a_fault() -> None:
    counter = counted([1.0, 1.01])
    counter.take(Edge(1.10, 8))
    assert (counter.count, counter.lost_count) == (8, 5)
    report = counter.report(1.2)
    assert math.isnan(report.volume_ml)
    assert report.fault == "flow meter: 5 pulses lost"
    after = counter.report(2.2)
    assert not after.fault
    assert after.volume_ml == 8 * 1000.0 / 4600.0


def test_a_loss_that_is_found_late_is_told_once_it_is_found() -> None:
    counter = counted([1.0, 1.01])
    # The reader stood still for longer than a fault lasts; the loss lies before all that is left.
    for number in range(8, 208):
        counter.take(Edge(1.1 + 0.01 * number, number))
    assert counter.report(4.0).fault == "flow meter: 5 pulses lost"
    assert counter.report(4.9).fault
    assert not counter.report(5.1).fault
    assert counter.count == 207


def test_a_line_that_is_gone_is_a_fault_and_no_standstill() -> None:
    class Gone(VirtualEdges):
        def read(self) -> list[Edge]:
            raise OSError(19, "No such device")

    (report,) = FlowMeter(METER, Gone()).read(3.0)
    assert isinstance(report, FlowReport)
    assert (report.received_s, math.isnan(report.volume_ml)) == (3.0, True)
    assert report.fault == "flow meter: its line cannot be read: No such device"


def test_an_echo_of_an_edge_is_no_pulse_and_many_are_a_fault() -> None:
    times = [1.0 + 0.01 * i for i in range(40)]
    counter = PulseCounter(METER)
    for number, at_s in enumerate(times):
        counter.take(Edge(at_s, 2 * number + 1))
        counter.take(Edge(at_s + 0.0001, 2 * number + 2))
    assert counter.count == 40
    assert "come twice" in counter.report(times[-1]).fault


def test_more_than_can_be_is_a_fault_and_no_flow() -> None:
    gap_s = 60.0 / (20.0 * METER.pulses_per_l)
    times = [1.0 + gap_s * i for i in range(4000)]
    report = counted(times).report(times[-1])
    assert math.isnan(report.volume_ml)
    assert "more than flow_meter.flow_max_l_min = 12" in report.fault


def test_an_edge_without_a_time_is_not_taken() -> None:
    counter = counted([1.0])
    counter.take(Edge(math.nan, 2))
    assert counter.count == 1


@pytest.mark.parametrize("name", ["pulses_per_l", "flow_max_l_min", "pwm_period_s"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_a_meter_that_cannot_be_is_refused(name: str, value: float) -> None:
    given = {"pulses_per_l": 4600.0, "flow_max_l_min": 12.0, "pwm_period_s": PERIOD_S}
    with pytest.raises(ValueError, match=name):
        Meter(**(given | {name: value}))


async def test_sensor_reads_what_its_line_has_given() -> None:
    edges = VirtualEdges()
    sensor = FlowMeter(METER, edges)
    await sensor.open(lambda: None)
    edges.put(1.0, 1.1, 1.2)
    (report,) = sensor.read(1.25)
    assert report == FlowReport(received_s=1.2, volume_ml=3000.0 / 4600.0)
    edges.put(1.3, lost=4)
    (report,) = sensor.read(1.35)
    assert isinstance(report, FlowReport)
    assert report.fault
    assert sensor.volume_ml() == 8 * 1000.0 / 4600.0
    await sensor.close()
    assert not edges.is_open


# --------------------------------------------------------------------------------- libgpiod


class FakeRequest:
    """One line's request: events in batches, as the kernel's buffer gives them."""

    def __init__(self, batches: list[list[tuple[int, int]]]) -> None:
        self.batches = batches
        self.released = 0

    def wait_edge_events(self, timeout: object) -> bool:
        assert not timeout  # it must never wait
        return bool(self.batches)

    def read_edge_events(self) -> Iterator[SimpleNamespace]:
        return iter(
            SimpleNamespace(timestamp_ns=at_ns, line_seqno=number)
            for at_ns, number in self.batches.pop(0)
        )

    def release(self) -> None:
        self.released += 1


def fake_gpiod(request: FakeRequest | OSError, version: str = "2.3.0") -> ModuleType:
    module = ModuleType("gpiod")
    asked: dict[str, object] = {}

    def request_lines(path: str, **given: object) -> FakeRequest:
        asked.update(given, path=path)
        if isinstance(request, OSError):
            raise request
        return request

    names = SimpleNamespace(
        Bias=SimpleNamespace(PULL_UP="up", PULL_DOWN="down", AS_IS="as-is"),
        Direction=SimpleNamespace(INPUT="in"),
        Edge=SimpleNamespace(RISING="rising"),
        Clock=SimpleNamespace(MONOTONIC="monotonic"),
    )
    module.__dict__.update(
        __version__=version,
        line=names,
        LineSettings=lambda **given: given,
        request_lines=request_lines,
        asked=asked,
    )
    return module


@pytest.fixture
def dev(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of devices of a computer with one chip."""
    (tmp_path / "gpiochip0").touch()
    monkeypatch.setattr(lines, "DEV", tmp_path)
    return tmp_path


def test_line_is_asked_for_with_the_clock_of_the_control_loop(
    dev: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    request = FakeRequest([[(1_500_000_000, 1), (1_600_000_000, 2)], [(1_700_000_000, 3)]])
    module = fake_gpiod(request)
    monkeypatch.setitem(sys.modules, "gpiod", module)
    edges = GpiodEdges("gpiochip0", 24, pull="up")
    assert edges.read() == []
    edges.open()
    # What comes while it is read is read the next time: of a wire that hums there is no end.
    assert edges.read() == [Edge(1.5, 1), Edge(1.6, 2)]
    assert edges.read() == [Edge(1.7, 3)]
    assert edges.read() == []
    asked = module.__dict__["asked"]
    assert asked["path"] == str(dev / "gpiochip0")
    assert asked["config"] == {
        24: {
            "direction": "in",
            "edge_detection": "rising",
            "event_clock": "monotonic",
            "bias": "up",
        }
    }
    edges.close()
    edges.close()
    assert request.released == 1


@pytest.mark.parametrize(
    ("module", "words"),
    [
        (None, "pip install 'vrspray[vehicle]'"),
        (fake_gpiod(FakeRequest([]), version="1.6.3"), "1.6.3 is too old"),
        (fake_gpiod(OSError(16, "Device or resource busy")), "flow_meter.line = 24"),
        (fake_gpiod(FileNotFoundError(2, "No such file")), "gpiochip0: [Errno 2]"),
    ],
)
def test_a_line_that_is_not_to_be_had_is_said_in_one_line(
    dev: Path, monkeypatch: pytest.MonkeyPatch, module: ModuleType | None, words: str
) -> None:
    monkeypatch.setitem(sys.modules, "gpiod", module)
    with pytest.raises(SensorError) as refused:
        GpiodEdges("gpiochip0", 24).open()
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)
