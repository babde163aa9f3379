"""The doctor's checks of vehicle, outputs, serial port and lines: facts in, verdicts out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from companion.cli.doctor import output_checks, watchdog_trouble
from companion.cli.output_parts import servo_options
from companion.config import load
from companion.core.types import Fix
from companion.doctor import gpio
from companion.doctor.check import Check, Status
from companion.doctor.computer import Device, read_device, serial_check
from companion.doctor.gpio import Chip, Line, gpio_checks, read_chip, read_register
from companion.doctor.vehicle import Heard, Position, Rate, link_checks, no_link
from companion.output.autopilot_options import DriveOutput, ServoOptions
from companion.output.engine.wire import Wiring
from companion.receiver import ReceiverOffset
from missions.maps.compiling import compiled_setup

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "anyang"
CONFIG = load(EXAMPLE / "config.toml", overrides=("safety.rc_channel=7",))
SETUP = compiled_setup(CONFIG)
_FOUND = servo_options(CONFIG)
assert _FOUND is not None
OPTIONS: ServoOptions = _FOUND
CHANNELS = OPTIONS.channels
NAN = float("nan")

PARAMETERS: dict[str, float | None] = {
    **{f"SERVO{channel}_FUNCTION": 0.0 for channel in CHANNELS},
    "SPRAY_ENABLE": 0.0,
    "BRD_SAFETY_DEFLT": 0.0,
    "BRD_SAFETY_MASK": 0.0,
    "SPRW_ENABLE": 1.0,
    "SPRW_FIRST": 9.0,
    "SPRW_LAST": 14.0,
    "SPRW_MASK": 0.0,
    "SPRW_CLOSED_US": 1000.0,
    "SPRW_RET_CH": 0.0,
}
HOME = SETUP.frame.to_geographic(0.0, 0.0)
GOOD = Heard(
    url="udpin:127.0.0.1:14550",
    waited_s=5.0,
    system_id=1,
    autopilot="ardupilot",
    is_armed=False,
    mode="LOITER",
    rates=(Rate(name="position", wanted_hz=20.0, rate_hz=19.5),),
    fix=Fix.RTK_FIXED,
    accuracy_m=0.02,
    is_estimator_healthy=True,
    position=Position(latitude_deg=HOME[0], longitude_deg=HOME[1]),
    rc_pulse_us=(1500,) * 18,
    is_clock_known=True,
    parameters=PARAMETERS,
    outputs_us=dict.fromkeys(CHANNELS, 1000),
    is_closed_ordered=True,
    order_results=(0,) * 6,
)


def of_link(heard: Heard, *overrides: str) -> dict[str, Check]:
    config = load(EXAMPLE / "config.toml", overrides=("safety.rc_channel=7", *overrides))
    return {check.name: check for check in link_checks(heard, config, SETUP)}


def of_outputs(heard: Heard) -> dict[str, Check]:
    return {check.name: check for check in output_checks(heard, OPTIONS)}


def test_a_vehicle_that_is_ready_has_nothing_to_be_seen_to() -> None:
    checks = {**of_link(GOOD), **of_outputs(GOOD)}
    odd = {name for name, check in checks.items() if check.status is not Status.OK}
    assert odd == {"wind", "disarmed-values"}


def rated(name: str, rate_hz: float) -> Heard:
    return replace(GOOD, rates=(Rate(name=name, wanted_hz=20.0, rate_hz=rate_hz),))


def off(off_m: float, late_s: float | None = None) -> ReceiverOffset:
    return ReceiverOffset(late_s=late_s, off_m=off_m, is_rtk=True)


@pytest.mark.parametrize(
    ("heard", "name", "status"),
    [
        (replace(GOOD, autopilot="generic"), "heartbeat", Status.FAIL),
        (replace(GOOD, is_armed=True), "disarmed", Status.WARN),
        (replace(GOOD, is_armed=None), "disarmed", Status.WARN),
        (replace(GOOD, rates=()), "streams", Status.WARN),
        (rated("position", 13.0), "streams", Status.WARN),
        (rated("position", 1.0), "streams", Status.FAIL),
        (rated("position", NAN), "streams", Status.FAIL),
        (rated("GNSS", 0.0), "streams", Status.WARN),
        (replace(GOOD, is_clock_known=False), "vehicle-clock", Status.WARN),
        (replace(GOOD, fix=None), "fix", Status.FAIL),
        (replace(GOOD, fix=Fix.FIX_3D), "fix", Status.FAIL),
        (replace(GOOD, is_estimator_healthy=None), "estimator", Status.WARN),
        (replace(GOOD, receiver=off(0.25)), "estimator", Status.OK),
        (replace(GOOD, receiver=off(0.6)), "estimator", Status.WARN),
        (replace(GOOD, receiver=off(NAN)), "estimator", Status.WARN),
        (replace(GOOD, receiver=off(0.1, 0.08)), "estimator", Status.OK),
        (replace(GOOD, receiver=off(0.1, 0.3)), "estimator", Status.WARN),
        (replace(GOOD, is_estimator_healthy=False), "estimator", Status.FAIL),
        (replace(GOOD, position=None), "place", Status.FAIL),
        (
            replace(GOOD, position=Position(latitude_deg=HOME[0] + 1.0, longitude_deg=HOME[1])),
            "place",
            Status.WARN,
        ),
        (
            replace(GOOD, position=Position(latitude_deg=NAN, longitude_deg=NAN)),
            "place",
            Status.WARN,
        ),
        (replace(GOOD, rc_pulse_us=()), "rc-switch", Status.FAIL),
        (replace(GOOD, rc_pulse_us=(0,) * 18), "rc-switch", Status.FAIL),
        (replace(GOOD, troubles=("autopilots 1,2: set link.system_id",)), "link", Status.WARN),
    ],
)
def test_each_fact_of_the_vehicle_has_its_verdict(heard: Heard, name: str, status: Status) -> None:
    checks = of_link(heard)
    assert checks[name].status is status
    others = {check.status for other, check in checks.items() if other not in (name, "wind")}
    assert others == {Status.OK}


def test_wind_counts_where_it_is_required() -> None:
    required = "safety.wind_required=true"
    assert of_link(GOOD, required)["wind"].status is Status.FAIL
    assert of_link(replace(GOOD, has_wind=True), required)["wind"].status is Status.OK


@pytest.mark.parametrize(
    "heard",
    [
        Heard(url="x", refused="link.url = 'tcp:a:1': refused; start the router"),
        Heard(url="x", waited_s=5.0),
        Heard(url="x", troubles=("no bytes come in: is the cable right?",)),
    ],
    ids=["refused", "silent", "told"],
)
def test_without_a_vehicle_one_check_fails_and_the_rest_is_not_applicable(heard: Heard) -> None:
    checks = of_link(heard)
    assert checks.pop("link").status is Status.FAIL
    assert {check.status for check in checks.values()} == {Status.NOT_APPLICABLE}
    assert set(checks) == {check.name for check in no_link("left out")} - {"link"}
    assert {check.status for check in of_outputs(heard).values()} == {Status.NOT_APPLICABLE}


def known(**changes: float | None) -> Heard:
    return replace(GOOD, parameters={**PARAMETERS, **changes})


@pytest.mark.parametrize(
    ("heard", "name", "status"),
    [
        (known(SERVO9_FUNCTION=33.0), "output-parameters", Status.FAIL),
        (known(SERVO9_FUNCTION=None), "output-parameters", Status.WARN),
        (known(SPRW_ENABLE=None), "watchdog-script", Status.FAIL),
        (known(SPRW_ENABLE=0.0), "watchdog-script", Status.FAIL),
        (known(SPRW_ENABLE=NAN), "watchdog-script", Status.FAIL),
        (known(SPRW_LAST=13.0), "watchdog-script", Status.FAIL),
        (known(SPRW_FIRST=0.0, SPRW_LAST=0.0), "watchdog-script", Status.FAIL),
        (known(SPRW_LAST=13.0, SPRW_MASK=float(1 << 13)), "watchdog-script", Status.OK),
        (known(SPRW_LAST=NAN, SPRW_MASK=NAN), "watchdog-script", Status.FAIL),
        (known(SPRW_CLOSED_US=1100.0), "watchdog-script", Status.FAIL),
        (known(SPRW_CLOSED_US=NAN), "watchdog-script", Status.FAIL),
        (known(SPRW_CLOSED_US=None), "watchdog-script", Status.FAIL),
        (replace(GOOD, is_closed_ordered=False), "closed-order", Status.NOT_APPLICABLE),
        (replace(GOOD, order_results=(0, 4)), "closed-order", Status.FAIL),
        (replace(GOOD, outputs_us={}), "closed-order", Status.WARN),
        (replace(GOOD, outputs_us=dict.fromkeys(CHANNELS, 0)), "closed-order", Status.FAIL),
        (
            replace(GOOD, outputs_us=dict.fromkeys(CHANNELS, 1000) | {11: 1500}),
            "closed-order",
            Status.FAIL,
        ),
    ],
)
def test_each_fact_of_the_outputs_has_its_verdict(heard: Heard, name: str, status: Status) -> None:
    checks = of_outputs(heard)
    assert checks[name].status is status
    others = {check.status for other, check in checks.items() if other != name}
    assert others <= {Status.OK, Status.NOT_APPLICABLE}


def test_parameters_that_did_not_come_in_time_are_no_verdict() -> None:
    checks = of_outputs(replace(GOOD, parameters=None))
    assert checks["output-parameters"].status is Status.WARN
    assert checks["watchdog-script"].status is Status.WARN


def test_a_board_with_alive_dither_takes_the_place_of_the_script() -> None:
    options = replace(OPTIONS, dither_us=8)
    checks = {check.name: check for check in output_checks(known(SPRW_ENABLE=None), options)}
    assert checks["watchdog-script"].status is Status.WARN


SECTIONS = servo_options(load(EXAMPLE.parent / "pump-sections" / "config.toml"))


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ({}, "does not close output 15"),
        ({"SPRW_MASK": float(1 << 13)}, "does not close output 15"),
        ({"SPRW_MASK": NAN}, "does not close output 15"),
        ({"SPRW_MASK": float(1 << 14)}, None),
        ({"SPRW_LAST": 15.0}, None),
        ({"SPRW_LAST": 15.0, "SPRW_CLOSED_US": 1200.0}, "not output.closed_us"),
    ],
)
def test_a_pump_must_be_among_the_outputs_that_the_script_guards(
    script: dict[str, float | None], words: str | None
) -> None:
    assert SECTIONS is not None
    assert [drive.channel for drive in SECTIONS.drives] == [15]
    returns = {"SPRW_RET_CH": SECTIONS.return_channel or 0.0}
    trouble = watchdog_trouble({**PARAMETERS, **returns, **script}, SECTIONS)
    if words is None:
        assert trouble is None
    else:
        assert trouble is not None
        assert words in trouble[0]


def test_the_closed_pulse_of_the_script_must_stop_each_motor() -> None:
    for stop_us, is_good in ((1000, True), (999, False)):
        options = replace(OPTIONS, drives=(DriveOutput(channel=15, stop_us=stop_us),))
        trouble = watchdog_trouble({**PARAMETERS, "SPRW_LAST": 15.0}, options)
        assert (trouble is None) == is_good, trouble
    # A pump alone, its valves on other outputs.
    alone = ServoOptions(channels=(), drives=(DriveOutput(channel=20, stop_us=1000),))
    wired = {"SPRW_FIRST": 20.0, "SPRW_LAST": 20.0}
    assert watchdog_trouble({**PARAMETERS, **wired}, alone) is None
    assert watchdog_trouble(PARAMETERS, alone) is not None


def test_no_board_takes_the_place_of_the_script_for_a_motor() -> None:
    options = replace(OPTIONS, dither_us=8, drives=(DriveOutput(channel=15),))
    checks = {check.name: check for check in output_checks(known(SPRW_ENABLE=None), options)}
    assert checks["watchdog-script"].status is Status.FAIL
    on_px4 = replace(options, channels=(1, 2), drives=(DriveOutput(channel=3),))
    check = {check.name: check for check in output_checks(px4(), on_px4)}["watchdog-script"]
    assert check.status is Status.WARN
    assert "only disarming stops the motor at output 3" in check.text


def test_a_motor_is_ordered_to_stop_and_must_read_so() -> None:
    options = replace(OPTIONS, drives=(DriveOutput(channel=15, stop_us=1050),))
    for pulse_us, status in ((1050, Status.OK), (1900, Status.FAIL)):
        heard = replace(GOOD, outputs_us=dict.fromkeys(CHANNELS, 1000) | {15: pulse_us})
        checks = {check.name: check for check in output_checks(heard, options)}
        assert checks["closed-order"].status is status


def test_the_return_valve_must_be_known_to_the_script_and_rests_open() -> None:
    options = replace(OPTIONS, return_channel=15)
    trouble = watchdog_trouble(PARAMETERS, options)
    assert trouble is not None
    assert "SPRW_RET_CH" in trouble[0]
    assert watchdog_trouble({**PARAMETERS, "SPRW_RET_CH": 15.0}, options) is None
    closed = {check.name: check for check in output_checks(
        replace(GOOD, outputs_us=dict.fromkeys((*CHANNELS, 15), 1000)), options
    )}["closed-order"]  # fmt: skip
    assert closed.status is Status.FAIL
    assert "output 15" in closed.text


def px4(**parameters: float) -> Heard:
    functions = {f"PWM_MAIN_FUNC{number}": 0.0 for number in range(1, 17)}
    functions |= {f"PWM_AUX_FUNC{number}": 300.0 + number for number in range(1, 7)}
    ends = {"MIN": 1000.0, "MAX": 2000.0, "DIS": 1000.0, "FAIL": -1.0}
    pins = {f"PWM_AUX_{kind}{n}": value for kind, value in ends.items() for n in range(1, 7)}
    known: dict[str, float | None] = {**functions, **pins, **parameters}
    return replace(GOOD, autopilot="px4", is_px4=True, parameters=known)


@pytest.mark.parametrize(
    ("parameters", "status"),
    [
        ({}, Status.OK),
        ({"PWM_AUX_DIS3": 1500.0}, Status.FAIL),
        ({"PWM_AUX_DIS3": 900.0}, Status.WARN),
    ],
)
def test_px4s_values_while_disarmed(parameters: dict[str, float], status: Status) -> None:
    options = replace(OPTIONS, channels=(1, 2, 3, 4, 5, 6), dither_us=8)
    checks = {check.name: check for check in output_checks(px4(**parameters), options)}
    assert checks["output-parameters"].status is Status.OK
    assert checks["disarmed-values"].status is status
    assert checks["watchdog-script"].status is Status.NOT_APPLICABLE
    bare = replace(options, dither_us=0)
    found = {check.name: check for check in output_checks(px4(), bare)}["watchdog-script"]
    assert found.status is Status.FAIL


def test_px4_has_six_actuators() -> None:
    found = of_outputs(px4())["output-parameters"]
    assert (found.status, found.text) == (Status.FAIL, "channel 9 on PX4")


# ---------------------------------------------------------------------- serial port and lines


def test_the_serial_port(tmp_path: Path) -> None:
    assert serial_check(read_device("udpin:127.0.0.1:14550")).status is Status.NOT_APPLICABLE
    path = tmp_path / "tty"
    assert serial_check(read_device(f"serial:{path}:57600")).status is Status.FAIL
    path.touch()
    assert serial_check(read_device(f"serial:{path}:57600")).status is Status.OK
    found = serial_check(Device(path="/dev/x", exists=True, is_permitted=False, group="dialout"))
    assert (found.status, "usermod -aG dialout" in found.fix) == (Status.FAIL, True)


WIRING = Wiring(valves=(17, 18), alive_line=4)
FREE = Chip(
    name="pinctrl",
    lines=(Line(number=17, is_used=False), Line(number=18, is_used=False)),
    keeps_levels=False,
)


@pytest.mark.parametrize(
    ("chip", "wiring", "statuses"),
    [
        (FREE, WIRING, "ok ok ok"),
        (replace(FREE, keeps_levels=True), WIRING, "ok ok warn"),
        (FREE, replace(WIRING, alive_line=None), "ok ok warn"),
        (replace(FREE, lines=(Line(number=17, is_used=True, consumer="spi"),)), WIRING,
         "ok fail ok"),
        (replace(FREE, lines=(Line(number=17, is_used=True, consumer="vrspray"),)), WIRING,
         "ok warn ok"),
        (replace(FREE, lines=()), WIRING, "ok not-applicable ok"),
        (Chip(name="x", problem="gone", fix="find it"), WIRING, "fail not-applicable ok"),
        (None, None, "not-applicable not-applicable not-applicable"),
    ],
)  # fmt: skip
def test_the_lines(chip: Chip | None, wiring: Wiring | None, statuses: str) -> None:
    found = [*gpio_checks(chip, wiring)]
    assert [check.name for check in found] == ["gpio-chip", "gpio-lines", "gpio-wiring"]
    assert " ".join(check.status for check in found) == statuses


class FakeChip:
    def __init__(self, path: str) -> None:
        if path.endswith("locked"):
            raise PermissionError(13, "Permission denied")

    def __enter__(self) -> FakeChip:
        return self

    def __exit__(self, *_: object) -> None: ...

    def get_info(self) -> SimpleNamespace:
        return SimpleNamespace(label="pinctrl")

    def get_line_info(self, number: int) -> SimpleNamespace:
        if number > 53:
            raise ValueError("line does not exist")
        return SimpleNamespace(used=number == 18, consumer="spi" if number == 18 else "")


def test_facts_of_a_chip(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpio, "load_gpiod", lambda: SimpleNamespace(Chip=FakeChip))
    monkeypatch.setattr(gpio, "find_chip", lambda _gpiod, name: f"/dev/{name}")
    assert read_chip("gpiochip0", (17, 18)).lines == (
        Line(number=17, is_used=False),
        Line(number=18, is_used=True, consumer="spi"),
    )
    assert "permission" in (read_chip("locked", (17,)).problem or "")
    assert "does not exist" in (read_chip("gpiochip0", (99,)).problem or "")


def test_facts_of_a_register(tmp_path: Path) -> None:
    assert read_register(str(tmp_path / "spidev0.0")).problem is not None
    (tmp_path / "spidev0.0").touch()
    assert read_register(str(tmp_path / "spidev0.0")).problem is None
