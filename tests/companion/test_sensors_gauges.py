"""Pressure and tank: broken wires, converters that do not answer, levels that disagree."""

from __future__ import annotations

import asyncio
import math
import sys
import threading
from pathlib import Path
from types import ModuleType

import pytest

from companion.cli.sensor_parts import PressureSensor, TankSensor
from companion.core.types import PressureReport, TankReport
from companion.errors import SensorError
from companion.sensors import CurrentLoop, Gauge, I2cVoltage, IioVoltage

LOOP = CurrentLoop(name="pressure", shunt_ohm=100.0, at_4_ma=0.0, at_20_ma=1000.0)


@pytest.mark.parametrize(("volts", "kpa"), [(0.4, 0.0), (1.2, 500.0), (2.0, 1000.0)])
def test_current_stands_for_a_pressure(volts: float, kpa: float) -> None:
    value, fault = LOOP.value(volts)
    assert value == pytest.approx(kpa)
    assert not fault


@pytest.mark.parametrize(
    ("volts", "words"),
    [
        (0.0, "0.0 mA: wire broken"),
        (0.359, "3.6 mA: wire broken"),
        (2.11, "21.1 mA: short circuit"),
        (math.nan, "no reading"),
        (-math.inf, "no reading"),
    ],
)
def test_what_is_no_measurement_is_a_fault_and_never_a_zero(volts: float, words: str) -> None:
    value, fault = LOOP.value(volts)
    assert value is None
    assert words in fault


class FakeVoltage:
    """A converter whose readings, or failures, are given."""

    def __init__(self, readings: list[float | OSError]) -> None:
        self.readings = readings
        self.is_open = False

    def open(self) -> None:
        self.is_open = True

    def read_v(self) -> float:
        reading = self.readings.pop(0) if len(self.readings) > 1 else self.readings[0]
        if isinstance(reading, OSError):
            raise reading
        return reading

    def close(self) -> None:
        self.is_open = False


def gauge(source: FakeVoltage, clock: list[float]) -> Gauge:
    return Gauge(LOOP, source, rate_hz=200.0, window_s=0.3, clock=lambda: clock[0])


def kpa_of(made: Gauge, now_s: float) -> float | None:
    found = made.value(now_s)
    assert found is not None
    assert not found[1]
    return found[0]


async def sampled(source: FakeVoltage, clock: list[float]) -> Gauge:
    made = gauge(source, clock)
    await made.open()
    for _ in range(200):
        await asyncio.sleep(0.002)
        if made.value(clock[0]) is not None:
            break
    return made


async def test_gauge_gives_the_mean_of_the_last_whole_periods() -> None:
    made = gauge(FakeVoltage([1.0]), [0.0])
    for at_s, volts in [(0.1, 2.0), (0.5, 1.1), (0.6, 1.3), (0.75, 1.2)]:
        made.take(at_s, volts)
    assert kpa_of(made, 0.8) == pytest.approx(500.0)


async def test_pressure_is_sampled_beside_the_loop_and_ends_with_it() -> None:
    source, clock = FakeVoltage([1.2]), [5.0]
    sensor = PressureSensor(await sampled(source, clock))
    (report,) = sensor.read(5.0)
    assert isinstance(report, PressureReport)
    assert (report.received_s, report.fault) == (5.0, "")
    assert report.pressure_kpa == pytest.approx(500.0)
    await sensor.close()
    await sensor.close()
    assert not source.is_open


async def test_a_converter_that_does_not_answer_is_a_fault_until_it_does() -> None:
    source, clock = FakeVoltage([OSError(121, "Remote I/O error")]), [5.0]
    made = await sampled(source, clock)
    value, fault = made.value(5.0) or (0.0, "")
    assert value is None
    assert "Remote I/O error" in fault
    made.take(5.0, 1.2)
    assert kpa_of(made, 5.0) == pytest.approx(500.0)
    await made.close()


async def test_silence_is_a_fault() -> None:
    made = gauge(FakeVoltage([1.0]), [1.0])
    assert made.value(1.0) is None
    made.take(1.0, 1.2)
    assert kpa_of(made, 1.4) == pytest.approx(500.0)
    await made.open()
    await made.close()
    assert made.value(1.61) == (None, "pressure: no reading for 0.5 s")


# ------------------------------------------------------------------------------- converters


class HangingBus:
    """A converter that no longer answers once `hangs` is set, until it is let go."""

    def __init__(self, *, hangs: bool = False) -> None:
        self.hangs = hangs
        self.is_hanging, self.let_go = threading.Event(), threading.Event()

    def open(self) -> None:
        self.read_v()

    def read_v(self) -> float:
        if self.hangs:
            self.is_hanging.set()
            assert self.let_go.wait(30.0)
        return 1.2

    def close(self) -> None:
        self.read_v()


async def test_a_bus_that_hangs_does_not_delay_the_end() -> None:
    source = HangingBus()
    made = Gauge(LOOP, source, rate_hz=200.0, window_s=0.3)
    await made.open()
    source.hangs = True
    assert await asyncio.to_thread(source.is_hanging.wait, 5.0)
    try:
        async with asyncio.timeout(5.0):
            await made.close()
            # What asyncio.run does at its end: it waits for the threads of its pool.
            await asyncio.get_running_loop().shutdown_default_executor()
        assert all(t.daemon for t in threading.enumerate() if t.name == "gauge pressure")
    finally:
        source.let_go.set()


async def test_a_bus_that_hangs_from_the_beginning_is_said_and_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("companion.sensors.OPEN_MAX_S", 0.05)
    source = HangingBus(hangs=True)
    made = Gauge(LOOP, source, rate_hz=200.0, window_s=0.3)
    try:
        with pytest.raises(SensorError, match="does not answer within"):
            await made.open()
        async with asyncio.timeout(5.0):
            await made.close()
    finally:
        source.let_go.set()


def iio_device(root: Path, name: str = "ads1115", *, scale_name: str = "in_voltage2_scale") -> Path:
    folder = root / "iio:device0"
    folder.mkdir(parents=True)
    (folder / "name").write_text(f"{name}\n")
    (folder / "in_voltage2_raw").write_text("9600\n")
    (folder / scale_name).write_text("0.125000000\n")
    return folder


@pytest.mark.parametrize("scale_name", ["in_voltage2_scale", "in_voltage_scale"])
def test_kernel_driver_is_found_by_its_name(tmp_path: Path, scale_name: str) -> None:
    folder = iio_device(tmp_path, scale_name=scale_name)
    source = IioVoltage("", 2, root=tmp_path)
    source.open()
    assert source.read_v() == pytest.approx(1.2)
    (folder / "in_voltage2_raw").write_text("nonsense")
    with pytest.raises(OSError, match="nonsense"):
        source.read_v()
    source.close()
    with pytest.raises(OSError, match="not open"):
        source.read_v()


def test_kernel_driver_that_is_not_there_is_said_with_what_is(tmp_path: Path) -> None:
    iio_device(tmp_path, name="bme280")
    with pytest.raises(SensorError, match=r"there: bme280\); add dtoverlay=ads1115"):
        IioVoltage("", 0, root=tmp_path).open()
    with pytest.raises(SensorError, match="channel 3"):
        IioVoltage("bme280", 3, root=tmp_path).open()
    IioVoltage(str(tmp_path / "iio:device0"), 2).open()


class FakeBus:
    """An I2C bus with one ADS1115, or with nothing."""

    words: tuple[int, int] = (0x25, 0x80)
    fails = False

    def __init__(self, number: int) -> None:
        self.number = number
        self.written: list[tuple[int, int, list[int]]] = []
        self.is_closed = False

    def write_i2c_block_data(self, address: int, register: int, values: list[int]) -> None:
        if self.fails:
            raise OSError(121, "Remote I/O error")
        self.written.append((address, register, values))

    def read_i2c_block_data(self, address: int, register: int, count: int) -> list[int]:
        assert (register, count) == (0, 2)
        return list(self.words)

    def close(self) -> None:
        self.is_closed = True


def with_bus(monkeypatch: pytest.MonkeyPatch, *, fails: bool = False) -> list[FakeBus]:
    made: list[FakeBus] = []

    def open_bus(number: int) -> FakeBus:
        bus = FakeBus(number)
        bus.fails = fails
        made.append(bus)
        return bus

    module = ModuleType("smbus2")
    module.__dict__["SMBus"] = open_bus
    monkeypatch.setitem(sys.modules, "smbus2", module)
    return made


def test_bus_is_read_by_single_shots_of_one_channel(monkeypatch: pytest.MonkeyPatch) -> None:
    (made,) = (with_bus(monkeypatch),)
    source = I2cVoltage(1, 0x48, 2)
    source.open()
    assert source.read_v() == pytest.approx(0x2580 * 4.096 / 32768.0)
    # Data sheet: start, channel 2 against ground, +-4.096 V, single shot, 860 a second.
    assert made[0].written[-1] == (0x48, 1, [0b1_110_001_1, 0b111_0_0_0_11])
    source.close()
    assert made[0].is_closed
    with pytest.raises(OSError, match="not open"):
        source.read_v()


def test_bus_without_a_converter_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    with_bus(monkeypatch, fails=True)
    with pytest.raises(SensorError, match="no ADS1115 at address 0x49 of /dev/i2c-1"):
        I2cVoltage(1, 0x49, 0).open()
    monkeypatch.setitem(sys.modules, "smbus2", None)
    with pytest.raises(SensorError, match=r"pip install 'vrspray\[vehicle\]'"):
        I2cVoltage(1, 0x49, 0).open()


# ------------------------------------------------------------------------------------- tank


class FakeCounter:
    """What was metered so far."""

    def __init__(self) -> None:
        self.ml = 0.0

    def volume_ml(self) -> float:
        return self.ml


class FakeLevel:
    """A level, or its fault."""

    def __init__(self, litres: float | None, fault: str = "") -> None:
        self.litres, self.fault = litres, fault

    async def open(self) -> None:
        pass

    def value(self, now_s: float) -> tuple[float | None, str]:
        return self.litres, self.fault

    async def close(self) -> None:
        pass


def report_of(tank: TankSensor, now_s: float) -> TankReport:
    (report,) = tank.read(now_s)
    assert isinstance(report, TankReport)
    return report


def test_tank_is_counted_down_from_what_was_filled_in() -> None:
    counter = FakeCounter()
    counter.ml = 500.0
    tank = TankSensor(counter, None, capacity_l=40.0, filled_l=10.0)
    assert report_of(tank, 1.0).level_l == 9.5
    assert tank.read(1.5) == []
    counter.ml = 1500.0
    tank.filled(20.0)
    counter.ml = 3500.0
    assert report_of(tank, 2.0).level_l == 18.0
    counter.ml = 1e9
    assert report_of(tank, 3.0).level_l == 0.0
    counter.ml = math.nan
    assert report_of(tank, 4.0).level_l is None


def test_tank_that_nobody_has_filled_is_not_known() -> None:
    report = report_of(TankSensor(FakeCounter(), None, capacity_l=40.0), 1.0)
    assert (report.level_l, report.fault) == (None, "")


def test_level_says_where_the_count_begins_and_when_they_come_apart() -> None:
    counter, level = FakeCounter(), FakeLevel(12.0)
    tank = TankSensor(counter, level, capacity_l=40.0)
    assert report_of(tank, 1.0).level_l is None
    assert report_of(tank, 11.0).level_l == 12.0
    counter.ml = 5000.0
    report = report_of(tank, 12.0)
    assert report.level_l == pytest.approx(7.0)
    assert report.fault == "tank: 12.0 L by its level, 7.0 L by the flow meter"


def test_slosh_is_no_fault() -> None:
    counter, level = FakeCounter(), FakeLevel(12.0)
    tank = TankSensor(counter, level, capacity_l=40.0)
    for step in range(100):
        level.litres = 12.0 + (6.0 if step % 2 else -6.0)
        for report in tank.read(1.0 + 0.5 * step):
            assert isinstance(report, TankReport)
            assert not report.fault
    assert report_of(tank, 60.0).level_l == pytest.approx(12.0, abs=1.0)


def test_fault_of_the_level_leaves_the_count() -> None:
    tank = TankSensor(
        FakeCounter(), FakeLevel(None, "tank: 0.0 mA: wire broken"), capacity_l=40.0, filled_l=5.0
    )
    report = report_of(tank, 1.0)
    assert (report.level_l, report.fault) == (5.0, "tank: 0.0 mA: wire broken")


@pytest.mark.parametrize("litres", [-1.0, 41.0, math.nan])
def test_what_cannot_be_filled_in_is_refused(litres: float) -> None:
    with pytest.raises(ValueError, match="litres"):
        TankSensor(FakeCounter(), None, capacity_l=40.0).filled(litres)
