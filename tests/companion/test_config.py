from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest

from companion.cli.app import execute
from companion.config import Config, load
from companion.config.rules import mismatches, without_effect
from companion.core.nozzle import choose_set
from companion.core.types import Fix, Method
from companion.errors import ConfigError

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "anyang" / "config.toml"

# What no file may leave out: it has to be measured on the sprayer.
MEASURED = """
version = 1
[boom]
width_m = 4.0
[[valve]]
name = "left"
right_m = -1.0
channel = 9
[[valve]]
name = "right"
right_m = 1.0
channel = 10
[[nozzle_set]]
valves = ["left", "right"]
duty = [0.2, 1.0]
flow_l_min = [1.0, 4.0]
[lag]
on_s = 0.1
off_s = 0.1
up_s = 0.1
down_s = 0.1
on_start_s = 0.05
off_end_s = 0.2
output_s = 0.02
"""


def refusal(path: Path, *overrides: str) -> str:
    with pytest.raises(ConfigError) as refused:
        load(path, overrides=overrides)
    text = str(refused.value)
    assert "\n" not in text
    return text


def test_example_becomes_types_of_the_core() -> None:
    config = load(EXAMPLE)
    boom = config.boom()
    assert [valve.right_m for valve in boom.valves] == [-2.5, -1.5, -0.5, 0.5, 1.5, 2.5]
    assert [valve.width_m for valve in boom.valves] == [1.0] * 6
    assert [valve.channel for valve in boom.valves] == [9, 10, 11, 12, 13, 14]
    (nozzles,) = config.nozzle_sets()
    assert nozzles.valves == (0, 1, 2, 3, 4, 5)
    assert (nozzles.flow_min_l_min, nozzles.flow_max_l_min) == (1.476, 6.096)
    assert config.pwm_limits().frequency_hz == 11.0
    assert config.method() is Method.SCHEDULED
    assert config.look_ahead_s() == pytest.approx(0.97)
    assert config.limits().fix is Fix.RTK_FLOAT
    assert config.limits().modes == {"AUTO"}


SET = """[[nozzle_set]]
valves = ["1", "2", "3", "4", "5", "6"]
duty = [0.2, 0.4, 0.5, 0.7, 0.8, 0.9, 1.0]
flow_l_min = [1.476, 3.024, 3.276, 4.62, 5.052, 5.952, 6.096]
"""
PRESETS = """[[nozzle_set]]
valves = ["1", "2", "3", "4", "5", "6"]
preset = "wang-2024-eq2"
[[nozzle_set]]
valves = ["1", "2", "3", "4"]
preset = "wang-2024-eq2"
"""


def with_sets(folder: Path, sets: str) -> Path:
    text = EXAMPLE.read_text(encoding="utf-8")
    assert SET in text
    path = folder / "config.toml"
    path.write_text(text.replace(SET, sets), encoding="utf-8")
    return path


def test_the_published_law_is_a_preset_for_both_of_its_sets(tmp_path: Path) -> None:
    config = load(with_sets(tmp_path, PRESETS))
    eight, twelve = config.nozzle_sets()
    assert (eight.valves, twelve.valves) == ((0, 1, 2, 3), (0, 1, 2, 3, 4, 5))
    # Wang et al. 2024, Eq. 2: 18.73 Q + 17.557 and 17.67 Q - 9.874, in percent.
    for flow in (2.0, 3.0, 3.99):
        assert 100.0 * eight.curve.duty_for(flow) == pytest.approx(18.73 * flow + 17.557)
    for flow in (4.0, 5.0, 6.0):
        assert 100.0 * twelve.curve.duty_for(flow) == pytest.approx(17.67 * flow - 9.874)
    # Outside: held at the ends, closed below half of the least.
    assert twelve.curve.duty_for(7.0) == twelve.curve.duty_for(6.0)
    assert eight.curve.duty_for(1.5) == eight.curve.duty_for(2.0)
    assert eight.curve.duty_for(0.9) == 0.0


@pytest.mark.parametrize(
    ("flow_l_min", "current", "expected"),
    [(4.09, 0, 0), (4.11, 0, 1), (3.71, 1, 1), (3.69, 1, 0), (2.0, 1, 0), (6.0, 0, 1)],
)
def test_the_published_laws_sets_change_with_hysteresis(
    tmp_path: Path, flow_l_min: float, current: int, expected: int
) -> None:
    sets = load(with_sets(tmp_path, PRESETS)).nozzle_sets()
    assert choose_set(sets, flow_l_min, current=current) == expected
    assert sets[expected].curve.delivers(flow_l_min)


def test_a_published_law_is_warned_of(tmp_path: Path) -> None:
    found = list(without_effect(load(with_sets(tmp_path, PRESETS))))
    assert [each.key for each in found] == ["nozzle_set[0].preset", "nozzle_set[1].preset"]
    assert "measure yours" in found[0].text


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("nozzles = 2\n", "nozzles = 1\n"), "is for 8 or 12 nozzles, but this set has 6"),
        (("nozzles = 2\n", ""), "this set has valves without valve.nozzles"),
        (('"5", "6"]\n', '"5", "6"]\nduty = [0.2, 1.0]\n'), "already gives the flow"),
        (("wang-2024-eq2", "wang-2025"), "nozzle_set[0].preset"),
    ],
)
def test_a_published_law_for_another_sprayer_is_refused(
    tmp_path: Path, change: tuple[str, str], said: str
) -> None:
    path = with_sets(tmp_path, PRESETS)
    path.write_text(path.read_text(encoding="utf-8").replace(*change), encoding="utf-8")
    assert said in refusal(path)


def test_every_lag_reaches_the_core_under_its_own_name(tmp_path: Path) -> None:
    names = ("on_s", "off_s", "up_s", "down_s", "on_start_s", "off_end_s", "output_s", "position_s")
    values = dict(zip(names, (0.21, 0.22, 0.23, 0.24, 0.05, 0.26, 0.27, 0.28), strict=True))
    lag = load(EXAMPLE, overrides=[f"lag.{name}={value}" for name, value in values.items()])
    assert {name: getattr(lag.lag_model(), name) for name in names} == values
    settled = load(EXAMPLE, overrides=["lag.reference=settled"]).lag_model()
    assert settled.reference == "settled"


def test_every_limit_reaches_the_core_under_its_own_name() -> None:
    values: dict[str, Any] = {
        "position_age_max_s": 0.71,
        "heartbeat_age_max_s": 2.2,
        "speed_min_m_s": 1.3,
        "speed_max_m_s": 9.4,
        "speed_disagreement_max_m_s": 0.6,
        "height_min_m": 1.7,
        "height_max_m": 8.8,
        "wind_max_m_s": 5.9,
        "wind_required": True,
        "rc_channel": 8,
    }
    overrides = [f"safety.{key}={json.dumps(value)}" for key, value in values.items()]
    overrides += ['safety.modes=["guided"]', 'safety.enable_by=["rc"]', "safety.fix=rtk-fixed"]
    limits = load(EXAMPLE, overrides=overrides).limits()
    assert {key: getattr(limits, key) for key in values} == values
    assert limits.modes == {"GUIDED"}
    assert limits.enable_by == {"rc"}
    assert limits.fix is Fix.RTK_FIXED


def test_strips_share_the_width_by_the_largest_set_unless_a_valve_has_its_own(
    tmp_path: Path,
) -> None:
    small = '[[nozzle_set]]\nvalves = ["left"]\nduty = [0.2, 1.0]\nflow_l_min = [0.5, 2.0]\n'
    path = tmp_path / "config.toml"
    path.write_text(MEASURED + small)
    config = load(path, overrides=["valve[1].width_m=1.5", "valve[1].forward_m=-0.3"])
    left, right = config.boom().valves
    assert (left.width_m, right.width_m) == (2.0, 1.5)
    assert (left.forward_m, right.forward_m) == (0.0, -0.3)
    assert [nozzles.valves for nozzles in config.nozzle_sets()] == [(0,), (0, 1)]


def test_smallest_file_is_accepted_and_shows_the_origin_of_each_setting(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    path.write_text(MEASURED)
    settings = load(path, overrides=["lag.on_s = 0.12"]).settings()
    assert settings["lag.on_s"] == (0.12, "override")
    assert settings["lag.off_s"] == (0.1, "file")
    assert settings["valve[1].right_m"] == (1.0, "file")
    assert settings["link.url"] == ("udpin:127.0.0.1:14550", "default")


MEASURED_KEYS = [
    "boom.width_m",
    "valve",
    "nozzle_set",
    "valve[0].right_m",
    "nozzle_set[0].duty",
    "nozzle_set[0].flow_l_min",
    *(f"lag.{kind}_s" for kind in ("on", "off", "up", "down", "on_start", "off_end", "output")),
]


@pytest.mark.parametrize("key", MEASURED_KEYS)
def test_what_must_be_measured_has_no_default(key: str) -> None:
    raw = tomllib.loads(MEASURED)
    node: Any = raw
    *steps, last = key.replace("[0]", ".0").split(".")
    for step in steps:
        node = node[int(step)] if step.isdigit() else node[step]
    del node[last]
    with pytest.raises(ValueError, match="required"):
        Config.model_validate(raw)


REFUSED = [
    ("lag.onn_s=0.1", "lag.onn_s = 0.1: unknown key; did you mean lag.on_s?"),
    ("prescripton.file=x", "unknown key; did you mean prescription?"),
    ("valve_tracking.enabled=false", "unknown key; valves are no longer tracked in flight: delete"),
    ("valve[2].rihgt_m=1", "did you mean valve[2].right_m?"),
    ("lag.on_s=fast", 'lag.on_s = "fast": not a number; write a number from 0 to 30'),
    ('boom.width_m="6.0"', 'boom.width_m = "6.0": not a number'),
    ("lag.on_s=true", "lag.on_s = true: not a number"),
    ("lag.on_s=nan", "lag.on_s = NaN: not finite"),
    ("boom.height_m=inf", "boom.height_m = Infinity: not finite"),
    ("lag.on_s=99", "lag.on_s = 99: out of range; write a number from 0 to 30"),
    ("lag.on_s=-0.1", "lag.on_s = -0.1: out of range"),
    ("boom.width_m=0", "boom.width_m = 0: out of range; write a number above 0 up to 100"),
    ("link.system_id=1.5", "link.system_id = 1.5: not a whole number"),
    ("link.url=com3", "udpin:HOST:PORT"),
    ("link.url=tcp:host:70000", "a port from 1 to 65535"),
    ("version=2", "version = 2: out of range; write 1"),
    ("version=true", "version = true: not a whole number; write 1"),
    ("output.kind=usb", 'output.kind = "usb": not known; write one of "servo", "gpio", "none"'),
    ("safety.modes=AUTO", 'safety.modes = "AUTO": not a list'),
    ("safety.modes=[]", "safety.modes = []: too few entries"),
    ("mission.angle_deg=north", 'write a number from -360 to 360 or "auto"'),
    (
        "coverage.switch_off_percent=off",
        'coverage.switch_off_percent = "off": not a number; '
        'write a number above 0 up to 100 or "never"',
    ),
    ("coverage.switch_off_percent=0", "= 0: out of range; write a number above 0 up to 100"),
    ("mission.depots=[[36.0, 114.0], [99.0, 3.0]]", "mission.depots[1][0] = 99.0: out of range"),
    ("boom=3", "boom = 3: not a table; write a table [boom]"),
    ("valve=[]", "valve = []: too few entries; write [[valve]] tables"),
    ("valve[2].right_m=-4", "valve[2].right_m = -4: not to the right of valve[1] (-1.5)"),
    ("valve[2].name='1'", 'valve[2].name = "1": another valve has this name'),
    ("valve[1].channel=9", "valve[0].channel = 9: used twice"),
    ("valve[1].channel=33", "valve[1].channel = 33: not a servo output; write one from 1 to 32"),
    ("output.return_channel=9", "used twice"),
    ("nozzle_set[0].valves=['7']", 'no valve is named "7"'),
    ("nozzle_set[0].valves=['1', '1']", "names a valve twice"),
    ("nozzle_set[0].valves=['1']", 'valve[1].name = "2": not in any nozzle_set.valves'),
    ("nozzle_set[0].flow_l_min[3]=3.0", "nozzle_set[0].flow_l_min = [1.476, 3.024, 3.276, 3.0"),
    ("nozzle_set[0].flow_l_min[3]=3.276", "flow_l_min must be strictly increasing"),
    ("nozzle_set[0].duty[0]=0.45", "nozzle_set[0].duty = [0.45, 0.4"),
    ("nozzle_set[0].duty=[0.2, 1.0]", "7 flows for 2 duties"),
    ("nozzle_set[0].duty[6]=1.5", "nozzle_set[0].duty[6] = 1.5: out of range"),
    ("pwm.valve=normally-open", "safety.pump_cutoff = true"),
    ("pwm.duty_min=0.95", "not below pwm.duty_max = 0.9"),
    ("pwm.min_on_s=0.09", "write less, or a lower pwm.frequency_hz"),
    ("lag.on_start_s=0.2", "lag.on_start_s = 0.2: the first flow cannot come after lag.on_s = 0.1"),
    ("lag.off_end_s=0.01", "lag.off_end_s = 0.01: the flow cannot end before lag.off_s = 0.1"),
    ("output.full_us=1010", "output.full_us = 1010"),
    ("output.dither_us=20", "output.dither_us = 20"),
    ("safety.speed_min_m_s=20", "not below safety.speed_max_m_s = 12"),
    ("safety.height_min_m=20", "not below safety.height_max_m = 10"),
    ("safety.enable_by=['rc']", "safety.rc_channel"),
    ("safety.enable_by=['web']", "web.enabled"),
    ("mission.reserve_l=40", "not below mission.tank_l = 40"),
]


@pytest.mark.parametrize(("override", "expected"), REFUSED, ids=[case[0] for case in REFUSED])
def test_wrong_setting_is_refused_in_one_line_with_file_key_value_and_fix(
    override: str, expected: str
) -> None:
    text = refusal(EXAMPLE, override)
    assert text.startswith(f"{EXAMPLE}: ")
    assert expected in text


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("lag", "write KEY=VALUE"),
        ("lag..on_s=1", "write KEY=VALUE"),
        ("valve[9].right_m=1", "no entry [9]"),
        ("link.url.host=x", "host stands in no table"),
    ],
)
def test_override_that_names_no_setting_is_refused(override: str, expected: str) -> None:
    text = refusal(EXAMPLE, override)
    assert text.startswith("override")
    assert expected in text


def test_missing_key_is_named_with_what_to_write(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    path.write_text(MEASURED.replace("up_s = 0.1\n", ""))
    text = refusal(path)
    assert text == (
        f"{path}: lag.up_s: missing; write a number from 0 to 30 "
        "(measured: the same, to a larger flow)"
    )


def test_typing_error_is_reported_before_the_gap_that_it_leaves(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    path.write_text(MEASURED.replace("up_s", "upp_s"))
    text = refusal(path)
    assert "lag.upp_s = 0.1: unknown key; did you mean lag.up_s? (and 1 more problem)" in text


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"version = 1\nlag.on_s = 0,1\n", 'line 2: "lag.on_s = 0,1"'),
        (b"version = 1\nversion = 1\n", "line 2"),
        (b"x = [", "not closed at the end of the file"),
        (b"\xff\xfe1\x00", "save the file as UTF-8"),
        (b"x = " + b"[" * 9000, "nested too deep"),
        (b"# " + b"x" * 1_000_001, "too large"),
        (b"", "version: missing"),
    ],
    ids=["syntax", "twice", "open", "utf-16", "deep", "large", "empty"],
)
def test_broken_file_is_refused_in_one_line(tmp_path: Path, content: bytes, expected: str) -> None:
    path = tmp_path / "config.toml"
    path.write_bytes(content)
    text = refusal(path)
    assert text.startswith(f"{path}: ")
    assert expected in text


@pytest.mark.parametrize(
    "key", ["journal.folder", "prescription.file", "prescription.exclusions", "valve[0].name"]
)
def test_a_nul_is_refused_in_one_line(tmp_path: Path, key: str) -> None:
    """No file can have such a name, and what asks for one raises where nobody expects it."""
    path = tmp_path / "config.toml"
    path.write_text(MEASURED)
    text = '["a", "b\\u0000c"]' if key.endswith("exclusions") else '"b\\u0000c"'
    said = refusal(path, f"{key}={text}")
    assert said.startswith(f"{path}: {key} = ")
    assert said.endswith(": a NUL character; write the text without it")


def test_path_that_is_no_file_is_refused(tmp_path: Path) -> None:
    assert "no such file" in refusal(tmp_path / "none.toml")
    assert "is a directory" in refusal(tmp_path)


def test_normally_open_valves_are_accepted_with_a_pump_cutoff() -> None:
    config = load(EXAMPLE, overrides=["pwm.valve=normally-open", "safety.pump_cutoff=true"])
    assert config.pwm.valve == "normally-open"


def test_dry_run_needs_no_channels(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    path.write_text("\n".join(line for line in MEASURED.splitlines() if "channel" not in line))
    assert "valve[0].channel: missing; write the servo output" in refusal(path)
    assert load(path, overrides=["output.kind=none"]).output.kind == "none"


@pytest.mark.parametrize(("swath_m", "found"), [(6.11, 0), (5.89, 0), (6.13, 1), (5.87, 1)])
def test_swath_may_differ_from_the_boom_by_two_percent(swath_m: float, found: int) -> None:
    config = load(EXAMPLE, overrides=[f"mission.swath_width_m={swath_m}"])
    keys = [mismatch.key for mismatch in mismatches(config)]
    assert keys == ["mission.swath_width_m"] * found


def test_strips_that_do_not_add_up_to_the_boom_are_a_mismatch() -> None:
    config = load(EXAMPLE, overrides=["valve[0].width_m=1.5"])
    assert [mismatch.key for mismatch in mismatches(config)] == ["boom.width_m"]


def problems_of(path: Path, *overrides: str) -> dict[str, str]:
    with pytest.raises(ConfigError) as refused:
        load(path, overrides=overrides)
    return {problem.where: problem.code for problem in refused.value.problems}


def test_the_record_gets_product_in_the_mix_from_the_map() -> None:
    mixed = load(EXAMPLE, overrides=["prescription.mix_rate=20"]).told()
    assert mixed["application.product_per_l"] == pytest.approx(0.05)
    assert mixed["application.product_unit"] == "L"
    own = ["application.product_unit=L", "application.product_per_l=0.0501"]
    told = load(EXAMPLE, overrides=["prescription.mix_rate=20", *own]).told()
    assert told["application.product_per_l"] == 0.0501
    own[1] = "application.product_per_l=0.1"
    assert "write 0.05 there" in refusal(EXAMPLE, "prescription.mix_rate=20", *own)


@pytest.mark.parametrize("value", ["nan", "inf", "0.5", "-20"])
def test_a_mix_rate_is_at_least_the_product_itself(value: str) -> None:
    assert "prescription.mix_rate" in refusal(EXAMPLE, f"prescription.mix_rate={value}")


def test_a_refusal_carries_all_that_is_wrong_with_the_keys() -> None:
    given = ["lag.onn_s=1", "lag.off_s=-1", "boom.width_m=wide", "valve[2].nozzles=0"]
    assert problems_of(EXAMPLE, *given) == {
        "lag.onn_s": "unknown-key",
        "boom.width_m": "wrong-value",
        "valve[2].nozzles": "wrong-value",
        "lag.off_s": "wrong-value",
    }
    assert "(and 3 more problems)" in refusal(EXAMPLE, *given)


def test_a_refusal_carries_all_contradictions() -> None:
    given = {
        "link.url=tcp:host:0": "link.url",
        'valve[1].name="1"': "valve[1].name",
        "valve[2].right_m=-2.0": "valve[2].right_m",
        "valve[3].channel=13": "valve[3].channel",
        "nozzle_set[0].duty=[0.2, 0.1]": "nozzle_set[0].flow_l_min",
        "pwm.duty_min=0.95": "pwm.duty_min",
        "lag.on_start_s=0.5": "lag.on_start_s",
        "lag.off_end_s=0.0": "lag.off_end_s",
        "output.full_us=1010": "output.full_us",
        "safety.speed_min_m_s=12.5": "safety.speed_min_m_s",
        "mission.reserve_l=900": "mission.reserve_l",
        "tank.source=flow": "tank.source",
    }
    found = problems_of(EXAMPLE, *given)
    assert set(given.values()) <= set(found)
    assert set(found.values()) == {"contradiction"}


# One contradiction must not make a rule behind it fail: each pair is refused in words.
@pytest.mark.parametrize("first", range(10))
def test_any_two_contradictions_are_refused_in_words(first: int) -> None:
    wrong = [
        'valve[1].name="1"', "nozzle_set[0].valves=[]", 'nozzle_set[0].valves=["9"]',
        "nozzle_set[0].duty=[]", "nozzle_set[0].flow_l_min=[]", "pwm.frequency_hz=0.1",
        "output.kind=gpio", "safety.height_min_m=400", "flow_meter.source=gpio", "pwm.duty_min=1",
        "gpio.alive_line=9", "lag.up_time_s=9",
    ]  # fmt: skip
    for second in wrong[first + 1 :]:
        if wrong[first].startswith(("output", "pwm.freq")) or second.startswith(("out", "pwm.f")):
            continue
        assert refusal(EXAMPLE, wrong[first], second)


@pytest.mark.parametrize(
    ("given", "key", "text"),
    [
        (
            'safety.modes=["ATUO"]',
            "safety.modes",
            'no flight mode is named "ATUO"; did you mean "AUTO"?',
        ),
        ('safety.modes=["AUTO", "x"]', "safety.modes", 'no flight mode is named "x"'),
        ("valve[2].right_m=-0.3", "valve[2].right_m", "leaves 0.20 m between its strip"),
        ("valve[3].right_m=0.3", "valve[3].right_m", "has its strip 0.20 m over that"),
    ],
)
def test_what_would_spray_nothing_or_stripes_is_a_mismatch(given: str, key: str, text: str) -> None:
    found = {each.key: each.text for each in mismatches(load(EXAMPLE, overrides=[given]))}
    assert text in found[key]


def test_modes_and_strips_that_are_right_are_no_mismatch() -> None:
    for given in ('safety.modes=["auto"]', 'safety.modes=["MISSION"]', "valve[2].right_m=-0.45"):
        assert not list(mismatches(load(EXAMPLE, overrides=[given])))


def test_boom_beside_the_aircraft_is_named() -> None:
    given = [f"valve[{number}].right_m={number - 2.0}" for number in range(6)]
    (found,) = without_effect(load(EXAMPLE, overrides=given))
    assert "0.50 m right of the aircraft" in found.text


def test_accepted_settings_without_effect_are_named() -> None:
    overrides = ["flow_trim.enabled=true"]
    config = load(EXAMPLE, overrides=overrides)
    found = {contradiction.key for contradiction in without_effect(config)}
    assert found == {"flow_trim.enabled"}
    assert not list(without_effect(load(EXAMPLE)))


def test_text_of_the_file_is_kept_for_the_record() -> None:
    config = load(EXAMPLE)
    assert config.source_text == EXAMPLE.read_text()
    assert config.resolve("flights") == EXAMPLE.parent / "flights"


def test_number_is_bounded_on_both_sides() -> None:
    schema = Config.model_json_schema()
    unbounded = [
        f"{name}.{key}"
        for name, table in schema["$defs"].items()
        for key, node in table["properties"].items()
        for branch in node.get("anyOf", [node])
        if branch.get("type") in ("number", "integer")
        and not (
            {"minimum", "exclusiveMinimum"} & set(branch)
            and {"maximum", "exclusiveMaximum"} & set(branch)
        )
    ]
    assert not unbounded


def test_an_unknown_key_is_named_and_not_its_value(capsys: pytest.CaptureFixture[str]) -> None:
    assert execute(["config", "check", str(EXAMPLE), "--set", "boom.widht_m=6.0"]) == 2
    said = capsys.readouterr().out
    assert "error: unknown key: boom.widht_m; did you mean boom.width_m?" in said
