"""The text of the unit, which systemd itself reads."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from companion.cli.service import build_unit
from companion.cli.systemd import Unit, command, is_ours, quoted, watchdog_is_on
from companion.config import load

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "anyang"
UNIT = Unit(
    python="/opt/vrspray/bin/python",
    config="/etc/vrspray/config.toml",
    writable=("/etc/vrspray/flights", "/etc/vrspray/state"),
    account="vrspray",
    groups=("dialout", "gpio"),
)


def lines_of(unit: Unit) -> list[str]:
    return unit.text().splitlines()


def test_the_sample_in_deploy_is_what_the_template_gives() -> None:
    assert (ROOT / "deploy" / "systemd" / "vrspray.service").read_text() == UNIT.text()


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"closer": ("--chip", "gpiochip0", "--low", "17"), "is_realtime": True},
        {"is_user": True, "is_realtime": True},
        {"config": '/a field/50 % "x"/$HOME.toml', "writable": ("/a field/50 %",)},
        {"account": "root", "groups": ()},
    ],
    ids=["servo", "gpio", "user", "odd-names", "root"],
)
def test_systemd_finds_nothing_wrong(changes: dict[str, Any], tmp_path: Path) -> None:
    program = shutil.which("systemd-analyze")
    if program is None:
        pytest.skip("systemd-analyze is not installed")
    unit = replace(UNIT, python=sys.executable, **changes)
    path = tmp_path / "vrspray.service"
    path.write_text(unit.text())
    mode = ["--user"] if unit.is_user else []
    done = subprocess.run(
        [program, *mode, "verify", str(path)],
        capture_output=True,
        text=True,
        timeout=60,
        env={**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)},
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_the_watchdog_and_the_restart_are_those_of_a_sprayer() -> None:
    lines = lines_of(UNIT)
    assert {"Type=notify", "WatchdogSec=2", "Restart=on-failure"} <= set(lines)
    assert watchdog_is_on(lines)
    assert not watchdog_is_on(["#WatchdogSec=2", "WatchdogSec=0"])
    assert is_ours(UNIT.text())


def test_only_valves_on_own_lines_have_a_closer() -> None:
    closed = replace(UNIT, closer=("--chip", "gpiochip0", "--low", "17", "18"))
    assert [line for line in lines_of(closed) if line.startswith("ExecStopPost=")] == [
        "ExecStopPost=/opt/vrspray/bin/python -P -m companion.output.engine.closer "
        "--chip gpiochip0 --low 17 18"
    ]
    assert not any(line.startswith("ExecStopPost=") for line in lines_of(UNIT))


def test_the_closer_is_given_the_lines_of_the_configuration() -> None:
    config = load(
        EXAMPLE / "config.toml",
        overrides=("output.kind=gpio", "output.return_channel=22", "output.chip=gpiochip4"),
    )
    unit = build_unit(config, is_user=False, account="pi", is_realtime=False)
    text = " ".join(unit.closer)
    assert text == "--chip gpiochip4 --low 9 10 11 12 13 14 22"


def test_real_time_of_the_loop_is_below_the_engine_and_only_when_asked_for() -> None:
    lines = lines_of(replace(UNIT, is_realtime=True))
    assert {"CPUSchedulingPolicy=fifo", "CPUSchedulingPriority=20"} <= set(lines)
    assert not any(line.startswith("CPUScheduling") for line in lines_of(UNIT))


def test_a_users_unit_asks_for_nothing_that_needs_root() -> None:
    lines = lines_of(replace(UNIT, is_user=True, is_realtime=True))
    forbidden = ("User=", "SupplementaryGroups=", "ProtectSystem=", "CPUScheduling", "Capability")
    assert [line for line in lines if line.startswith(forbidden)] == []
    assert "WantedBy=default.target" in lines


def test_root_keeps_the_capabilities_that_it_needs_to_write() -> None:
    assert "CapabilityBoundingSet=" in lines_of(UNIT)
    assert "CapabilityBoundingSet=" not in lines_of(replace(UNIT, account="root"))


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("/plain/path", "/plain/path"),
        ("with space", '"with space"'),
        ("50%", '"50%%"'),
        ('"', '"\\""'),
        ("back\\slash", '"back\\\\slash"'),
        ("", '""'),
        ("a;b", '"a;b"'),
    ],
)
def test_a_word_stays_one_word(word: str, expected: str) -> None:
    assert quoted(word) == expected


def test_variables_are_not_replaced_in_a_command() -> None:
    assert command("echo", "$HOME") == 'echo "$$HOME"'


def test_a_line_break_in_a_name_is_refused() -> None:
    with pytest.raises(ValueError, match="control character"):
        quoted("a\nExecStart=/bin/sh")
