"""What goes wrong with the liquid behind the stub, and what its sensors say of it."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.errors import ConfigError
from companion.sensors import CurrentLoop, IioVoltage
from sitl.liquid_faults import LiquidFaultKind, healthy_kpa
from sitl.scenario_file import load_scenario
from sitl.serve import ServeOptions, serve
from sitl.stub.outputs import ServoOrder
from sitl.stub.protocol import dialect
from sitl.stub.server import StubOptions, build_autopilot
from sitl.stub.sprayer import FLIGHT_BATTERY, LiquidEntry, LiquidOptions, Sprayer, SprayerOptions
from tests.sitl.stub_bench import HOME

BATTERY = dialect.MAVLINK_MSG_ID_BATTERY_STATUS
STUCK = """
[sensors]
meter_battery = 1
tank_battery = 2
tank_l = 4.0
[[liquid]]
kind = "stuck-open"
since = "spraying"
at_s = 3.0
valve = 3
[[liquid]]
kind = "clog"
share = 0.4
"""


def sprayer_with(options: LiquidOptions, *, seed: int = 1) -> Sprayer:
    return Sprayer(SprayerOptions(liquid=options, seed=seed), start_s=0.0)


def order(sprayer: Sprayer, at_s: float, pulse_us: int) -> None:
    for channel in sprayer.options.channels:
        sprayer.take(ServoOrder(at_s=at_s, channel=channel, pulse_us=pulse_us))


def run(sprayer: Sprayer, from_s: float, until_s: float) -> None:
    for number in range(round((until_s - from_s) / 0.02) + 1):
        sprayer.advance(from_s + number * 0.02)


def volumes_ml(sprayer: Sprayer, at_s: float) -> NDArray[np.float64]:
    return sprayer.volume_ml(np.array([at_s]))[0]


def metered_ml(sprayer: Sprayer) -> int:
    assert sprayer.liquid is not None
    consumed = next(each.consumed for each in sprayer.liquid.batteries() if each.number == 1)
    assert consumed is not None
    return consumed


def test_a_scenario_says_what_goes_wrong_and_who_sees_it(tmp_path: Path) -> None:
    path = tmp_path / "stuck.toml"
    path.write_text(STUCK)
    scenario = load_scenario(path)
    assert (scenario.meter_battery, scenario.tank_battery, scenario.tank_l) == (1, 2, 4.0)
    assert scenario.liquid == (
        LiquidEntry(kind=LiquidFaultKind.STUCK_OPEN, since="spraying", at_s=3.0, valve=3),
        LiquidEntry(kind=LiquidFaultKind.CLOG, share=0.4),
    )


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("liquid = 3", r"liquid = 3: not a list; write \[\[liquid\]\] tables"),
        (
            '[[liquid]]\nkind = "clogged"',
            r'liquid\[0\].kind = "clogged": not known; write one of "clog", ',
        ),
        ('[[liquid]]\nkind = "clog"', "share: no share; give more than 0, up to 1"),
        ('[[liquid]]\nkind = "clog"\nshare = "much"', 'liquid.0..share = "much": not a number'),
        (
            '[[liquid]]\nkind = "clog"\nshare = 0.5\nvalve = 0',
            "valve = 0: out of range; .* from 1 .1 is the leftmost",
        ),
        ('[[liquid]]\nkind = "stuck-open"', "valve: missing; 1 is the leftmost"),
        ('[[liquid]]\nkind = "air"\nshare = 0.5', "share = 0.5: means nothing to kind 'air'"),
        ('[[liquid]]\nkind = "leak"\nshare = 0.5\nvalve = 1', "valve = 1: means nothing"),
        (
            '[[liquid]]\nkind = "air"\nsince = "noon"',
            'since = "noon": not known; write one of "start", "take-off", "spraying"',
        ),
        ('[[liquid]]\nkind = "air"\nat_s = -1', "at_s = -1: out of range"),
        ('[[liquid]]\nkind = "air"\nduration_s = 1', "duration_s = 1: unknown key"),
        ("[sensors]\nmeter_battery = 1.5", "meter_battery = 1.5: not a whole number"),
        (
            "[sensors]\nmeter_battery = 16",
            "meter_battery = 16: out of range; write a whole number from 0 to 15",
        ),
        (
            "[sensors]\nmeter = 1",
            "sensors.meter = 1: unknown key; did you mean sensors.meter_battery",
        ),
    ],
)
def test_what_has_no_meaning_is_refused(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "scenario.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=said):
        load_scenario(path)


def test_a_fault_of_a_valve_that_is_not_there_is_refused() -> None:
    entry = LiquidEntry(kind=LiquidFaultKind.STUCK_OPEN, valve=7)
    with pytest.raises(ConfigError, match="valve = 7: the sprayer wang-2024 has 6"):
        sprayer_with(LiquidOptions(entries=(entry,)))


async def test_px4_has_no_meter_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "scenario.toml"
    path.write_text("[sensors]\nmeter_battery = 1")
    with pytest.raises(ConfigError, match="PX4 has no fuel flow meter"):
        await serve(ServeOptions(autopilot="px4", scenario=path), lambda _text: None)


async def test_a_folder_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"--sensors .*file.* cannot be written"):
        await serve(ServeOptions(sensors=tmp_path / "file"), lambda _text: None)


def test_the_meter_counts_what_the_valves_deliver_and_the_tank_falls() -> None:
    sprayer = sprayer_with(LiquidOptions(meter_battery=1, tank_battery=2, tank_l=2.0))
    order(sprayer, 1.0, 2000)
    run(sprayer, 1.0, 11.0)
    assert sprayer.liquid is not None
    first, meter, tank = sprayer.liquid.batteries()
    assert first == FLIGHT_BATTERY
    # Within the 3 % of the meter's own gain.
    assert meter.consumed == pytest.approx(1000.0 * sprayer.volume_l(11.0), rel=0.04)
    assert (meter.remaining_percent, tank.consumed) == (None, None)
    assert tank.remaining_percent == pytest.approx(100.0 - 50.0 * sprayer.volume_l(11.0), abs=3.0)


def test_a_fault_counts_from_the_first_open_valve_and_acts_on_the_truth_too() -> None:
    entry = LiquidEntry(kind=LiquidFaultKind.STUCK_OPEN, since="spraying", at_s=2.0, valve=3)
    sprayer = sprayer_with(LiquidOptions(entries=(entry,), meter_battery=1))
    assert sprayer.liquid is not None
    order(sprayer, 0.5, 1000)
    run(sprayer, 0.5, 5.0)
    assert not sprayer.liquid.faults
    order(sprayer, 5.0, 1500)
    run(sprayer, 5.0, 6.9)
    assert not sprayer.liquid.begun(6.9)
    run(sprayer, 6.9, 8.0)
    assert [fault.from_s for fault in sprayer.liquid.begun(8.0)] == [7.0]
    order(sprayer, 8.0, 1000)
    run(sprayer, 8.0, 9.0)
    before_ml, metered_before = volumes_ml(sprayer, 9.0), metered_ml(sprayer)
    run(sprayer, 9.0, 12.0)
    moved = volumes_ml(sprayer, 12.0) - before_ml
    assert [valve for valve, ml in enumerate(moved) if ml > 1.0] == [2]
    assert metered_ml(sprayer) - metered_before == pytest.approx(float(moved[2]), abs=4.0)


def test_the_companion_reads_the_pressure_from_the_folder(tmp_path: Path) -> None:
    sprayer = sprayer_with(LiquidOptions(pressure_folder=tmp_path / "iio"))
    voltage = IioVoltage(str(tmp_path / "iio"), 0)
    voltage.open()
    loop = CurrentLoop(name="pressure", shunt_ohm=100.0, at_4_ma=0.0, at_20_ma=1000.0)
    order(sprayer, 1.0, 1500)
    run(sprayer, 1.0, 2.0)
    kpa, fault = loop.value(voltage.read_v())
    assert fault == ""
    assert kpa == pytest.approx(healthy_kpa(0.5), rel=0.06)


def test_monitors_take_turns_and_without_any_nothing_comes() -> None:
    autopilot = build_autopilot(StubOptions(home=HOME), start_s=0.0)
    assert not autopilot.has(BATTERY, 0.0)
    sprayer = sprayer_with(LiquidOptions(meter_battery=1, tank_battery=4))
    assert sprayer.liquid is not None
    autopilot.batteries = sprayer.batteries
    assert autopilot.has(BATTERY, 0.0)
    messages = [autopilot.build(BATTERY, 0.0) for _ in range(4)]
    assert [message.id for message in messages] == [0, 1, 4, 0]
    assert [message.current_consumed for message in messages] == [1200, 0, -1, 1200]
    assert [message.battery_remaining for message in messages] == [80, -1, 100, 80]
    assert all(math.isfinite(message.current_battery) for message in messages)


def test_a_count_is_of_the_time_at_which_it_is_sent_however_long_a_tick_took() -> None:
    sprayer = sprayer_with(LiquidOptions(meter_battery=1))
    order(sprayer, 1.0, 2000)
    run(sprayer, 1.0, 5.0)
    before, after = (
        next(each.consumed for each in sprayer.batteries(at_s) if each.number == 1)
        for at_s in (5.0, 5.5)
    )
    assert before is not None
    assert after is not None
    assert after - before == pytest.approx(0.5 * 6.096 * 1000.0 / 60.0, rel=0.1)
