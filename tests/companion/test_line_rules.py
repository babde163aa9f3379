"""A line of this computer belongs to one thing."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import pytest

from companion.config import load
from companion.config.rules import without_effect
from companion.config.wiring_rules import claims
from companion.errors import ConfigError

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "anyang" / "config.toml"
GPIO = ("output.kind=gpio",)
METER = ("flow_meter.source=gpio", "flow_meter.pulses_per_l=4600.0")
# Of one chip, and each may be set to the line of another.
KEYS = ("valve[0].channel", "output.return_channel", "gpio.alive_line", "safety.estop_line",
        "flow_meter.line")  # fmt: skip
APART = tuple(f"{key}={line}" for key, line in zip(KEYS, (9, 15, 4, 17, 24), strict=True))


def test_lines_of_their_own_are_good_and_all_are_known() -> None:
    config = load(EXAMPLE, overrides=(*GPIO, *METER, *APART))
    assert {claim.key for claim in claims(config)} == {
        *KEYS, *(f"valve[{n}].channel" for n in range(1, 6)),
    }  # fmt: skip
    assert {claim.chip for claim in claims(config)} == {"gpiochip0"}
    assert [found.key for found in without_effect(config)] == []


@pytest.mark.parametrize(("first", "second"), [*combinations(KEYS, 2)])
def test_no_two_keys_may_name_one_line(first: str, second: str) -> None:
    given = (*GPIO, *METER, *APART, f"{first}=30", f"{second}=30")
    with pytest.raises(ConfigError, match=r"(uses the same line|used twice); give each") as refused:
        load(EXAMPLE, overrides=given)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("chip", ["gpiochip0", "/dev/gpiochip0"])
def test_the_emergency_stop_on_a_valves_line_is_refused_in_words(chip: str) -> None:
    given = (*GPIO, "safety.estop_line=11", f"output.chip={chip}")
    with pytest.raises(ConfigError) as refused:
        load(EXAMPLE, overrides=given)
    assert "safety.estop_line = 11: valve[2].channel uses the same line" in str(refused.value)
    path_and_name = (*GPIO, *METER, "flow_meter.line=11", f"flow_meter.chip={chip}")
    with pytest.raises(ConfigError, match=r"valve\[2\]\.channel uses the same line"):
        load(EXAMPLE, overrides=path_and_name)


def test_one_number_on_chips_of_two_names_is_a_warning() -> None:
    given = (*GPIO, *METER, "flow_meter.line=11", "flow_meter.chip=pinctrl-bcm2711")
    (found,) = without_effect(load(EXAMPLE, overrides=given))
    assert found.key == "flow_meter.line"
    assert "valve[2].channel has line 11 too" in found.text
    assert "pinctrl-bcm2711 (flow_meter.chip) are one chip" in found.text
    assert "\n" not in found.text


def test_the_stop_and_the_meter_share_no_line_on_servo_outputs_either() -> None:
    given = (*METER, "flow_meter.line=17", "safety.estop_line=17")
    with pytest.raises(ConfigError, match=r"safety\.estop_line uses the same line"):
        load(EXAMPLE, overrides=given)


def test_what_counts_on_its_own_claims_no_line() -> None:
    # Servo outputs, and outputs of shift registers.
    for kind in (("output.kind=servo",), (*GPIO, "gpio.driver=spi595", "gpio.alive_line=20")):
        found = load(EXAMPLE, overrides=(*kind, *METER, "flow_meter.line=11",
                                         "safety.estop_line=9"))  # fmt: skip
        assert {claim.key for claim in claims(found)} == {"safety.estop_line", "flow_meter.line"}
        assert [each.key for each in without_effect(found)] == []
