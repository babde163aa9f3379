"""The ready wirings of both papers: they load, they open and shut what they should, and say why."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

from companion.cli.output_parts import engine_setup
from companion.config import Config, load
from companion.core.types import SprayPlan, TimedChange
from companion.errors import ConfigError
from companion.output.engine.closer import closer_arguments
from companion.output.engine.wire import hazards
from companion.output.pwm import PulseEngine
from missions.maps.compiling import compiled_setup

PROFILES = Path(__file__).resolve().parents[2] / "examples" / "profiles"
NAMES = {
    "wang-2024-normally-open": 6,
    "wang-2024-normally-closed": 6,
    "rovira-mas-2024-24-valves": 24,
    "rovira-mas-2024-16-valves": 16,
}
NO_ALIVE = "no ALIVE line"


@cache
def profile(name: str) -> Config:
    return load(PROFILES / f"{name}.toml")


def test_every_file_is_tested_here() -> None:
    assert {path.stem for path in PROFILES.glob("*.toml")} == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_a_wiring_is_ready_to_fly(name: str) -> None:
    config = profile(name)
    setup = compiled_setup(config)
    assert len(setup.boom.valves) == NAMES[name]
    assert config.output.kind == "gpio"
    assert config.gpio.alive_line is not None
    assert config.output.return_channel is not None
    # All lines of one wiring are different, or Wiring would have refused them.
    wiring = engine_setup(config).wiring
    assert len(wiring.lines) == NAMES[name] + 2


@pytest.mark.parametrize("name", NAMES)
def test_the_engine_pulses_every_valve_by_its_level_and_leaves_all_safe(name: str) -> None:
    """A plan of eight seconds at the least duty, then its lease ends; in memory, no clock."""
    setup = engine_setup(profile(name))
    wiring, count = setup.wiring, NAMES[name]
    engine = PulseEngine(setup.pwm, count, start_s=0.0, has_return=True)
    changes = tuple(TimedChange(at_s=0.1, valve=v, duty=setup.pwm.duty_min) for v in range(count))
    plan = SprayPlan(
        sequence=1, issued_s=0.0, duty=(0.0,) * count, changes=changes, lease_until_s=8.1
    )
    assert engine.submit(plan, now_s=0.0)
    levels = wiring.safe_levels
    current_while_shut = wiring.level(0, is_open=False)
    assert current_while_shut == wiring.normally_open
    opened_s = [0.0] * count
    on_s = [0.0] * count
    for edge in engine.advance(9.0):
        bit = 1 << edge.valve
        level = wiring.level(edge.valve, is_open=edge.is_open)
        levels = levels | bit if level else levels & ~bit
        if edge.valve < count and edge.is_open:
            opened_s[edge.valve] = edge.at_s
            assert level != current_while_shut
        elif edge.valve < count:
            on_s[edge.valve] += edge.at_s - opened_s[edge.valve]
            assert level == current_while_shut
    # The valves come back to their places in the period by pulses that follow a little sooner.
    assert on_s == pytest.approx([setup.pwm.duty_min * 8.0] * count, rel=0.06)
    assert levels == wiring.safe_levels


@pytest.mark.parametrize(
    ("name", "keeps", "expected"),
    [
        ("wang-2024-normally-open", True, ["normally open valves spray when their power fails"]),
        (
            "wang-2024-normally-open",
            False,
            ["normally open valves spray when their power fails", "remove strict_gpiod"],
        ),
        ("wang-2024-normally-closed", True, ["add dtparam=strict_gpiod"]),
        ("wang-2024-normally-closed", False, []),
        ("rovira-mas-2024-16-valves", False, []),
        ("rovira-mas-2024-24-valves", None, []),
    ],
)
def test_what_a_wiring_says_of_its_hazards(
    name: str, keeps: bool | None, expected: list[str]
) -> None:
    found = hazards(engine_setup(profile(name)).wiring, keeps_levels=keeps)
    assert len(found) == len(expected)
    for text, part in zip(found, expected, strict=True):
        assert part in text
    assert not any(NO_ALIVE in text for text in found)


def test_normally_open_valves_without_a_cutoff_are_refused(tmp_path: Path) -> None:
    text = (PROFILES / "wang-2024-normally-open.toml").read_text(encoding="utf-8")
    assert "pump_cutoff = true\n" in text
    path = tmp_path / "config.toml"
    path.write_text(text.replace("pump_cutoff = true\n", ""), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"pwm\.valve.*safety\.pump_cutoff = true") as refused:
        load(path)
    assert "\n" not in str(refused.value)


def test_the_papers_wiring_has_current_in_all_valves_while_nothing_sprays() -> None:
    """Wang et al. 2024: after the start "automatically set to a high level"."""
    wiring = engine_setup(profile("wang-2024-normally-open")).wiring
    assert wiring.safe_levels == 0b1111111
    closed = engine_setup(profile("wang-2024-normally-closed")).wiring
    assert closed.safe_levels == 0


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        (
            "wang-2024-normally-open",
            "--chip pinctrl-bcm2711 --low 4 --high 17 18 27 22 23 24 25",
        ),
        ("rovira-mas-2024-24-valves", "--spi /dev/spidev0.0 --bytes 00000000"),
    ],
)
def test_the_closer_of_a_wiring(name: str, arguments: str) -> None:
    assert " ".join(closer_arguments(engine_setup(profile(name)))) == arguments
