"""From the configuration to sensors, and from sensors to decisions: what `run` reads."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace

import pytest

from companion import runtime
from companion.cli.sensor_parts import PressureSensor, TankSensor, build_sensors
from companion.config import load
from companion.config.rules import without_effect
from companion.core.estimator import Track, observe
from companion.core.inputs import AutopilotLiquid
from companion.core.types import BatteryReport, Decision, FlowReport, Input, PressureReport
from companion.errors import ConfigError, SensorError
from companion.link.codec import FROM_VEHICLE
from companion.link.streams import wanted_streams
from companion.ports import Sensor
from companion.sensors import FlowMeter
from missions.maps.compiling import compiled_setup
from tests.builders import position, setup

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "anyang" / "config.toml"
METER = ["flow_meter.source=gpio", "flow_meter.line=24", "flow_meter.pulses_per_l=4600.0"]


def test_sensors_are_those_that_the_configuration_names() -> None:
    assert build_sensors(load(EXAMPLE)) == []
    given = [*METER, "pressure.source=iio", "tank.source=flow", "tank.filled_l=20.0"]
    meter, pressure, tank = build_sensors(load(EXAMPLE, overrides=given))
    assert isinstance(meter, FlowMeter)
    assert meter.counter.meter.pulses_per_l == 4600.0
    assert meter.counter.meter.flow_max_l_min == 2.0 * 6.096
    assert isinstance(pressure, PressureSensor)
    assert isinstance(tank, TankSensor)
    assert len(build_sensors(load(EXAMPLE, overrides=["tank.source=i2c"]))) == 1


def test_detection_reaches_the_core_with_what_was_measured() -> None:
    given = [
        *METER, "detection.enabled=true", "detection.spread=0.02", "pressure.source=iio",
        "pressure.duty=[0.5, 1.0]", "pressure.kpa=[227.0, 290.0]", "tank.source=flow",
        "tank.reserve_l=2.0",
    ]  # fmt: skip
    law = compiled_setup(load(EXAMPLE, overrides=given)).detection
    assert law is not None
    assert (law.spread, law.reserve_l) == (0.02, 2.0)
    assert (law.pressure_duty, law.pressure_kpa) == ((0.5, 1.0), (227.0, 290.0))
    assert compiled_setup(load(EXAMPLE)).detection is None


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["detection.enabled=true"], "detection.enabled"),
        (["flow_meter.source=gpio", "flow_meter.line=1"], "flow_meter.pulses_per_l"),
        (["flow_meter.source=gpio", "flow_meter.pulses_per_l=1.0"], "flow_meter.line"),
        (
            [*METER, "output.kind=gpio", "flow_meter.line=9"],
            "flow_meter.line = 9: valve[0].channel uses the same line",
        ),
        (
            [*METER, "output.kind=gpio", "valve[0].channel=0", "flow_meter.line=0"],
            "flow_meter.line = 0: valve[0].channel uses the same line",
        ),
        (["pressure.at_20_ma_kpa=0.0"], "pressure.at_20_ma_kpa"),
        (["pressure.duty=[0.5]", "pressure.kpa=[1.0]"], "two or more"),
        (["pressure.duty=[0.5, 0.4]", "pressure.kpa=[1.0, 2.0]"], "must increase"),
        (["tank.source=flow"], "needs a flow meter"),
        (["tank.source=iio", "tank.filled_l=1000.0"], "more than the tank holds"),
        (["tank.source=iio", "tank.at_20_ma_l=0.0"], "tank.at_20_ma_l"),
    ],
)
def test_what_does_not_go_together_is_refused_in_one_line(given: list[str], words: str) -> None:
    with pytest.raises(ConfigError) as refused:
        load(EXAMPLE, overrides=given)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_trim_without_a_meter_is_said_and_with_one_is_not() -> None:
    def said(*given: str) -> list[str]:
        config = load(EXAMPLE, overrides=["flow_trim.enabled=true", *given])
        return [found.key for found in without_effect(config)]

    assert said() == ["flow_trim.enabled"]
    assert said(*METER) == []


# -------------------------------------------------------------------------- the autopilot's own


def test_flow_meter_and_tank_of_the_autopilot_are_its_batteries() -> None:
    wiring = AutopilotLiquid(flow_battery=1, tank_battery=2, tank_l=40.0)
    over = setup(autopilot_liquid=wiring)

    def battery(number: int, consumed: float | None, percent: float | None) -> BatteryReport:
        return BatteryReport(
            received_s=5.0, battery=number, consumed=consumed, remaining_percent=percent
        )

    track = observe(Track(), battery(0, 100.0, 50.0), over)
    assert (track.flow, track.tank) == (None, None)
    track = observe(track, battery(1, 4711.0, None), over)
    assert track.flow is None  # until a position tells how late it came
    track = observe(track, position(5.05, 0.0, 0.0), over)
    assert track.flow == FlowReport(received_s=5.0, volume_ml=4711.0)
    track = observe(track, battery(2, None, 25.0), over)
    assert track.tank is not None
    assert track.tank.level_l == 10.0
    assert track.flow == FlowReport(received_s=5.0, volume_ml=4711.0)
    track = observe(observe(track, battery(1, None, None), over), position(5.1, 0.25, 0.0), over)
    assert track.flow is not None
    assert math.isnan(track.flow.volume_ml)
    assert track.flow.fault
    assert observe(track, battery(1, 1.0, 1.0), setup()).counted is None


@pytest.mark.parametrize(("from_s", "until_s"), [(21.0, 21.7), (21.04, 21.4), (20.9, 21.85)])
def test_a_count_that_a_link_held_back_is_as_old_as_the_positions_around_it(
    from_s: float, until_s: float
) -> None:
    """Between `from_s` and `until_s` nothing comes; then all of it does, in its order."""
    over = setup(autopilot_liquid=AutopilotLiquid(flow_battery=1))

    def arrival_s(sent_s: float) -> float:
        return until_s if from_s <= sent_s < until_s else sent_s

    track, dated = Track(), dict[float, float]()
    for turn in range(260):
        sent_s = 10.0 + turn / 20.0
        sent = position(arrival_s(sent_s), 5.0 * sent_s, 0.0, boot_s=sent_s)
        track = observe(track, sent, over)
        if track.flow is not None:
            assert track.flow.received_s <= sent.received_s
            dated[track.flow.volume_ml] = track.flow.received_s
        if turn % 4 == 3:
            counted_s = sent_s + 0.02
            count = BatteryReport(
                received_s=arrival_s(counted_s),
                battery=1,
                consumed=100.0 * counted_s,
                remaining_percent=None,
            )
            track = observe(track, count, over)
    assert len(dated) == 64
    times = list(dated.values())
    assert times == sorted(set(times))
    for volume_ml, at_s in dated.items():
        # Half an interval of the positions, and what the mean of the arrivals gave way.
        assert at_s == pytest.approx(volume_ml / 100.0, abs=0.035)
    calm = [abs(at_s - ml / 100.0) for ml, at_s in dated.items() if ml < 100.0 * (from_s - 0.05)]
    assert max(calm) < 1e-6


def test_batteries_are_asked_for_where_one_is_a_meter() -> None:
    def asked(*, with_battery: bool) -> set[int]:
        streams = wanted_streams(position_rate_hz=20.0, is_px4=False, with_battery=with_battery)
        return {stream.message_id for stream in streams}

    assert asked(with_battery=True) - asked(with_battery=False) == {147}
    config = load(EXAMPLE, overrides=["flow_meter.source=autopilot", "flow_meter.battery=3"])
    wiring = compiled_setup(config).autopilot_liquid
    assert wiring is not None
    assert (wiring.flow_battery, wiring.tank_battery) == (3, None)
    assert compiled_setup(load(EXAMPLE)).autopilot_liquid is None


# -------------------------------------------------------------------------------- the event loop


class Quiet:
    """A link on which nothing comes, and an executor that only says what it was told."""

    fault: str | None = None

    def __init__(self, said: list[str]) -> None:
        self.said = said
        self.texts: list[str] = []

    async def open(self, wake: Callable[[], None]) -> None:
        self.said.append("link open")

    def receive(self) -> Sequence[Input]:
        return []

    def tell(self, decision: Decision | None, now_s: float) -> None:
        pass

    def tell_fault(self, text: str) -> None:
        self.texts.append(text)

    async def close(self) -> None:
        self.said.append("link closed")

    async def start(self) -> None:
        self.said.append("valves taken")

    is_guarded = True

    def submit(self, plan: object) -> None:
        pass

    async def stop(self) -> None:
        self.said.append("valves closed")


class FakeSensor:
    """A sensor that reports a pressure at every step, or cannot be had."""

    def __init__(self, said: list[str], *, fails: bool = False) -> None:
        self.said, self.fails = said, fails

    async def open(self, wake: Callable[[], None]) -> None:
        self.said.append("sensor open")
        if self.fails:
            raise SensorError("no such line")

    def read(self, now_s: float) -> Sequence[Input]:
        return [PressureReport(received_s=now_s, pressure_kpa=200.0)]

    async def close(self) -> None:
        self.said.append("sensor closed")


class Kept(runtime.NoRecorder):
    """Keeps the inputs."""

    def __init__(self) -> None:
        self.inputs: list[Input] = []

    def record_input(self, item: Input) -> None:
        self.inputs.append(item)


async def run_with(said: list[str], sensors: Sequence[Sensor], kept: Kept) -> None:
    quiet = Quiet(said)
    await runtime.run(
        setup(), link=quiet, executor=quiet, recorder=kept, sensors=sensors, duration_s=0.3
    )


async def test_sensors_are_read_at_each_step_and_valves_close_before_they_are_let_go() -> None:
    said: list[str] = []
    kept = Kept()
    await run_with(said, [FakeSensor(said)], kept)
    assert said == [
        "link open", "valves taken", "sensor open", "valves closed", "sensor closed", "link closed",
    ]  # fmt: skip
    pressures = [item for item in kept.inputs if isinstance(item, PressureReport)]
    assert len(pressures) >= 2


async def test_a_sensor_that_is_not_to_be_had_ends_the_run_with_the_valves_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(runtime, "LEAVE_CLOSED_S", 0.2)
    said: list[str] = []
    with pytest.raises(SensorError, match="no such line"):
        await run_with(said, [FakeSensor(said, fails=True)], Kept())
    assert said == [
        "link open", "valves taken", "sensor open", "valves closed", "sensor closed", "link closed",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("consumed", "remaining", "expected"), [(4711, 25, (4711.0, 25.0)), (-1, -1, (None, None))]
)
def test_battery_status_is_read_with_its_unknowns(
    consumed: int, remaining: int, expected: tuple[float | None, float | None]
) -> None:
    message = SimpleNamespace(id=1, current_consumed=consumed, battery_remaining=remaining)
    report = FROM_VEHICLE[147](message, 5.0)
    assert isinstance(report, BatteryReport)
    assert (report.battery, report.received_s) == (1, 5.0)
    assert (report.consumed, report.remaining_percent) == expected
