"""[pump] and [[atomiser]]: what they become, and what is refused in one line."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from companion.cli.output_parts import (
    build_outputs,
    motor_closer_arguments,
    parts_of,
    servo_options,
)
from companion.cli.run import component_options
from companion.cli.service import build_unit
from companion.config import Config, load
from companion.config.motor_rules import atomisers_of, pump_of
from companion.config.rules import without_effect
from companion.errors import ConfigError
from companion.link.vehicle_link import VehicleLink
from companion.output.composite import CompositeExecutor
from companion.output.guarded import GuardedServoExecutor
from companion.output.hardware_pwm import HardwarePwmExecutor
from companion.output.servo import ServoExecutor
from companion.output.timed import DryRunExecutor

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "howto" / "pump-instead-of-valves.md"
EXAMPLE = (
    """
[[valve]]
name = "left"
right_m = -1.5
channel = 9

[[valve]]
name = "right"
right_m = 1.5
channel = 10

[[nozzle_set]]
valves = ["left", "right"]

"""
    + re.findall(r"```toml\n(.*?)```", PAGE.read_text(), re.DOTALL)[0]
    + """
[[atomiser]]
name = "left"
channel = 6
us = [1100, 1500, 1900]
rpm = [2000, 8500, 14000]
droplet_um = 200
vmd_um = 210
vmd_rpm = 9000
vmd_flow_l_min = 1.0
spin_up_s = 0.8
"""
)
REST = """
version = 1
[boom]
width_m = 6.0
[lag]
on_s = 0.02
off_s = 0.02
up_s = 0.02
down_s = 0.02
on_start_s = 0.02
off_end_s = 0.02
output_s = 0.01
"""


def config(tmp_path: Path, *overrides: str, text: str = REST + EXAMPLE) -> Config:
    path = tmp_path / "config.toml"
    path.write_text(text)
    return load(path, overrides=overrides)


def test_the_documents_example_is_a_configuration(tmp_path: Path) -> None:
    found = config(tmp_path)
    pump = pump_of(found)
    assert pump is not None
    assert pump.curve is not None
    assert (pump.control, pump.outlet) == ("modulates", "valves")
    assert pump.curve.flow_for((1500 - 1000) / 950) == pytest.approx(3.1)
    assert pump.fraction_min == pytest.approx(150 / 950)
    lag = pump.lag
    assert (lag.on_start_s, lag.on_s, lag.up_s) == (0.30, 0.80, 0.60)
    assert (lag.off_end_s, lag.off_s, lag.output_s) == (1.5, 0.45, 0.01)
    (nozzles,) = found.nozzle_sets()
    assert nozzles.valves == (0, 1)
    assert nozzles.flow_max_l_min == 7.0
    (disc,) = atomisers_of(found)
    assert disc.share == 1.0
    assert disc.law.size_um(9000.0, 1.0) == pytest.approx(210.0)


def test_the_way_out_is_what_the_channels_say(tmp_path: Path) -> None:
    found = pump_of(config(tmp_path, "output.return_channel=15"))
    assert found is not None
    assert found.outlet == "return"
    bare = REST + re.sub(r"channel = (9|10)\n", "", EXAMPLE)
    found = pump_of(config(tmp_path, text=bare))
    assert found is not None
    assert found.outlet == "always"


PWM_VALVES = REST + EXAMPLE.replace(
    'valves = ["left", "right"]',
    'valves = ["left", "right"]\nduty = [0.2, 1.0]\nflow_l_min = [1.0, 6.0]',
)
CONSTANT = ('pump.control="constant"', "pump.run_us=1600")


def test_a_constant_pump_runs_at_one_pulse(tmp_path: Path) -> None:
    made = config(tmp_path, *CONSTANT, text=PWM_VALVES)
    found = pump_of(made)
    assert found is not None
    assert found.run_fraction == pytest.approx(600 / 950)
    assert [each.key for each in without_effect(made)][:1] == ["pump.control"]
    assert made.nozzle_sets()[0].flow_max_l_min == 6.0


REFUSED = [
    (["pump.us=[1150, 1300]"], "pump.flow_l_min = [0.6, 1.5, 3.1, 4.9, 7.0]: 5 values for 2"),
    (["pump.flow_l_min=[0.6, 1.5, 1.5, 4.9, 7.0]"], "must be strictly increasing"),
    (["pump.us=[900, 1300, 1500, 1700, 1950]"], "pump.us"),
    (["pump.max_us=1900"], "reaches outside pump.stop_us = 1000 to pump.max_us = 1900"),
    (["pump.max_us=1050"], "pump.max_us = 1050: less than 100 us above"),
    (["pump.min_us=1000"], "pump.min_us = 1000: not above pump.stop_us"),
    (["pump.min_us=1950", "pump.us=[1100, 1200, 1300, 1400, 1500]"], "above the curve"),
    (["pump.run_us=1500"], 'goes with control = "constant"'),
    (["pump.up_time_s=0.7"], "pump.up_time_s = 0.7: a part of pump.up_s = 0.6"),
    (["pwm.frequency_hz=11.0"], "pwm.frequency_hz = 11.0: valves behind a pump that makes"),
    (["lag.up_time_s=0.01"], "lag.up_time_s = 0.01: of the pump"),
    (["nozzle_set[0].duty=[0.2, 1.0]"], "the pump makes the flow, and its curve counts"),
    (["pump.channel=9"], "pump.channel = 9: used twice"),
    (["pump.channel=0"], "no servo output; write one from 1 to 32"),
    (["atomiser[0].channel=5"], "used twice"),
    (["atomiser[0].rpm=[2000, 8500, 8000]"], "atomiser[0].rpm"),
    (["atomiser[0].rpm=[2000, 8500]"], "2 values for 3 pulses"),
    (["atomiser[0].stop_us=1100"], "not all above atomiser[0].stop_us = 1100"),
    (["atomiser[0].droplet_um=100"], "rpm are wanted at the largest flow, the curve ends at 14000"),
    (["pump.us=[]"], "pump.us"),
    (["pump.speed=3"], "unknown key"),
    (['pump.control="variable"'], 'write one of "modulates", "constant"'),
    (['pump.control="constant"', "nozzle_set[0].duty=[0.2, 1.0]",
      "nozzle_set[0].flow_l_min=[1.0, 2.0]"], "pump.run_us: missing"),
    (['pump.control="constant"', "pump.run_us=1500"], "nozzle_set[0].duty: missing and required"),
]  # fmt: skip


@pytest.mark.parametrize(("overrides", "text"), REFUSED)
def test_a_contradiction_is_refused_in_one_line(
    tmp_path: Path, overrides: list[str], text: str
) -> None:
    with pytest.raises(ConfigError) as refused:
        config(tmp_path, *overrides)
    assert text in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("overrides", "text"),
    [
        (
            ["output.closed_us=2000", "output.full_us=1000"],
            "output.closed_us = 2000: above pump.stop_us = 1000: the watchdog script would run",
        ),
        (["output.closed_us=1500"], "write at most 1000"),
        (
            ["output.closed_us=1050", "pump.stop_us=1100"],
            "output.closed_us = 1050: above atomiser[0].stop_us = 1000",
        ),
        (["output.full_us=900"], "output.full_us = 900: not above output.closed_us = 1000"),
    ],
)
def test_a_closed_pulse_at_which_a_motor_runs_is_refused(
    tmp_path: Path, overrides: list[str], text: str
) -> None:
    with pytest.raises(ConfigError) as refused:
        config(tmp_path, *overrides)
    assert text in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_closed_pulse_that_stops_each_motor_is_good_and_one_elsewhere_is_free(
    tmp_path: Path,
) -> None:
    stops = ["pump.stop_us=1100", "pump.us=[1150, 1300, 1500, 1700, 1950]"]
    assert config(tmp_path, *stops).output.closed_us == 1000
    # Motors of this computer are no business of the script.
    local = ['pump.output="pwm"', 'atomiser[0].output="pwm"', "atomiser[0].channel=1"]
    turned = config(tmp_path, *local, "pump.channel=0", "output.closed_us=2000",
                    "output.full_us=1000")  # fmt: skip
    assert turned.output.closed_us == 2000


@pytest.mark.parametrize(
    ("without", "text"),
    [
        (r"spin_up_s = 0.30[^\n]*\n", "pump.spin_up_s: missing"),
        (r"us = \[1150[^\n]*\n", "pump.us: missing"),
        (r"stop_end_s[^\n]*\n", "pump.stop_end_s: missing"),
        (r"droplet_um[^\n]*\n", "atomiser[0].droplet_um: missing, and product.droplet_class"),
        (r"channel = 9\n", "valve[0].channel: missing; write it for each valve, or for none"),
    ],
)
def test_what_is_missing_is_named(tmp_path: Path, without: str, text: str) -> None:
    with pytest.raises(ConfigError) as refused:
        config(tmp_path, text=REST + re.sub(without, "", EXAMPLE, count=1))
    assert text in str(refused.value)


def test_a_way_that_is_never_shut_has_no_return_valve_and_no_lines(tmp_path: Path) -> None:
    bare = REST + re.sub(r"channel = (9|10)\n", "", EXAMPLE)
    with pytest.raises(ConfigError, match="the way out is never shut"):
        config(tmp_path, "output.return_channel=15", text=bare)
    with pytest.raises(ConfigError, match="nothing on lines"):
        config(tmp_path, 'output.kind="gpio"', text=bare)


def test_the_class_of_the_label_is_a_size(tmp_path: Path) -> None:
    text = REST + EXAMPLE.replace("droplet_um = 200\n", "")
    (disc,) = atomisers_of(config(tmp_path, 'product.droplet_class="Medium"', text=text))
    assert disc.droplet_um == 290.0


def test_two_sections_and_slow_droplets_are_warned_of(tmp_path: Path) -> None:
    found = {each.key: each.text for each in without_effect(config(tmp_path))}
    assert "only their sum is right" in found["pump.control"]
    slow = config(tmp_path, "atomiser[0].rpm=[9000, 12000, 14000]")
    assert (
        "droplets are smaller" in {e.key: e.text for e in without_effect(slow)}["atomiser[0].rpm"]
    )


def link(made: Config) -> VehicleLink:
    return VehicleLink(made.link.url, component_options(made))


def test_all_on_the_autopilot_is_one_executor(tmp_path: Path) -> None:
    made = config(tmp_path)
    options = servo_options(made)
    assert options is not None
    assert options.outputs == (9, 10, 5, 6)
    assert [options.ends_us(output) for output in range(4)] == [
        (1000, 2000), (1000, 2000), (1000, 1950), (1000, 1900),
    ]  # fmt: skip
    assert isinstance(build_outputs(made, link(made)), ServoExecutor)
    assert motor_closer_arguments(made) == []


def test_a_local_pump_is_a_part_of_its_own_and_is_stopped_after_the_service(tmp_path: Path) -> None:
    made = config(tmp_path, 'pump.output="pwm"', "pump.channel=1")
    executor = build_outputs(made, link(made))
    assert isinstance(executor, CompositeExecutor)
    kinds = [type(part) for part in parts_of(executor)]
    assert kinds == [HardwarePwmExecutor, GuardedServoExecutor]
    assert motor_closer_arguments(made) == ["--pwm", "0:1:1000"]
    text = build_unit(made, is_user=False, account="pi", is_realtime=False).text()
    assert "closer --pwm 0:1:1000" in text
    assert "ProtectKernelTunables" not in text


def test_nozzles_that_nothing_shuts_have_no_outputs(tmp_path: Path) -> None:
    bare = REST + re.sub(r"channel = (9|10)\n", "", EXAMPLE)
    made = config(tmp_path, text=bare)
    executor = build_outputs(made, link(made))
    (part,) = parts_of(executor)
    assert isinstance(part, ServoExecutor)
    options = servo_options(made)
    assert options is not None
    assert options.outputs == (5, 6)


def test_a_dry_run_has_no_motors(tmp_path: Path) -> None:
    made = config(tmp_path, 'output.kind="none"')
    assert isinstance(build_outputs(made, link(made)), DryRunExecutor)
    assert servo_options(made) is None
