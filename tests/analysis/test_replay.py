"""Replay: the same inputs give the same decisions, and a difference is found and named."""

from __future__ import annotations

import json
import math
import os
import platform
import random
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from numpy._core import _multiarray_umath

from analysis.journals.unpacking import Entry
from analysis.replay import FlownCore, first_difference, override, replay
from companion.cli.app import execute
from companion.core.setup import Setup
from companion.core.types import (
    Decision,
    EstimatorReport,
    Fix,
    GnssReport,
    HeartbeatReport,
    Input,
    LandedReport,
    Method,
    OperatorCommand,
    SpeedReport,
    Telemetry,
)
from companion.errors import ConfigError, JournalError
from companion.journal.journal import Journal
from tests.builders import setup
from tests.companion.journal_edit import edit_rows, with_body

DISABLED = "NPY_DISABLE_CPU_FEATURES"


def inputs_of(step_number: int, given: Setup, chance: random.Random) -> Iterator[Input]:
    """Yield what arrives before a step of a flight at 5 m/s over the plots, 20 steps a second."""
    now_s = 100.0 + step_number / 20
    if step_number % 10 == 0:
        yield HeartbeatReport(received_s=now_s, autopilot="ardupilot", armed=True, mode="AUTO")
        yield GnssReport(received_s=now_s, fix=Fix.RTK_FIXED)
        yield EstimatorReport(received_s=now_s, healthy=True)
        yield LandedReport(received_s=now_s, in_air=True)
    if step_number == 10:
        yield OperatorCommand(received_s=now_s, enable=True, source="command")
    east_m = -5.0 + step_number / 4 + chance.gauss(0.0, 0.01)
    latitude, longitude = given.frame.to_geographic(east_m, 3.0 + chance.gauss(0.0, 0.01))
    yield Telemetry(
        received_s=now_s + chance.gauss(0.0, 0.001),
        boot_s=step_number / 20,
        latitude_deg=math.nan if step_number == 150 else latitude,
        longitude_deg=longitude,
        relative_altitude_m=3.5,
        velocity_north_m_s=chance.gauss(0.0, 0.03),
        velocity_east_m_s=5.0 + chance.gauss(0.0, 0.03),
        velocity_down_m_s=0.0,
        heading_deg=90.0,
    )
    yield SpeedReport(received_s=now_s, ground_speed_m_s=math.nan if step_number == 120 else 5.0)


def fly(folder: Path, steps: int = 200) -> tuple[Path, list[Decision]]:
    """Return the journal of a flight over four plots, and the decisions as they were made."""
    given, chance, made = setup(), random.Random(7), []
    core = FlownCore(given)
    with Journal.create(folder, setup=given, started_s=100.0, waits=True) as journal:
        for number in range(steps):
            for item in inputs_of(number, given, chance):
                journal.record_input(item)
                core.observe(item)
            made.append(core.decide(100.0 + number / 20 + chance.uniform(0.0, 0.004)))
            journal.record_decision(made[-1])
    return journal.path, made


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Decision]]:
    return fly(tmp_path_factory.mktemp("flown"))


@pytest.fixture
def copy(flown: tuple[Path, list[Decision]], tmp_path: Path) -> Path:
    path = tmp_path / "flight.gpkg"
    path.write_bytes(flown[0].read_bytes())
    return path


# -------------------------------------------------------------------------------------- the same


def test_the_flight_of_these_tests_sprays_and_is_inhibited(
    flown: tuple[Path, list[Decision]],
) -> None:
    _, made = flown
    assert sum(not decision.inhibits for decision in made) > 100
    assert any(decision.inhibits for decision in made[20:])
    assert len({duty for decision in made for duty in decision.plan.duty}) >= 4


def test_every_decision_of_a_flight_comes_out_again(flown: tuple[Path, list[Decision]]) -> None:
    result = replay(flown[0])
    assert (result.decisions, result.differences, result.first_difference) == (200, 0, None)
    assert result.inputs > 400
    assert (result.lost, result.is_closed, result.is_what_if) == (0, True, False)


def test_replay_needs_nothing_but_the_file(copy: Path) -> None:
    assert [file.name for file in copy.parent.iterdir()] == ["flight.gpkg"]
    assert replay(copy).differences == 0


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="kernels of x86")
@pytest.mark.parametrize("without", ["blas", "numpy"])
def test_no_decision_depends_on_the_kernels_of_blas_and_numpy(
    flown: tuple[Path, list[Decision]], without: str
) -> None:
    """An older processor, as far as these two choose their code by it, decides the same."""
    # OpenBLAS and NumPy would take the widest registers that this processor has.
    features = " ".join(_multiarray_umath.__cpu_dispatch__)
    older = {"blas": ("OPENBLAS_CORETYPE", "Prescott"), "numpy": (DISABLED, features)}[without]
    done = subprocess.run(
        [sys.executable, "-m", "companion", "replay", str(flown[0]), "--json"],
        capture_output=True,
        text=True,
        env={**os.environ, older[0]: older[1]},
        check=False,
    )
    found = json.loads(done.stdout)
    assert (done.returncode, found["decisions"], found["differences"]) == (0, 200, 0)


def test_what_flew_elsewhere_is_said_beside_a_difference(
    copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with sqlite3.connect(copy) as journal:
        journal.execute("UPDATE meta SET value = 'aarch64' WHERE key = 'machine'")
    journal.close()
    assert execute(["replay", str(copy)]) == 0
    assert "flown with" not in capsys.readouterr().err
    edit_rows(copy, lambda entries: [one for one in entries if one.kind != "SpeedReport"])
    assert execute(["replay", str(copy)]) == 1
    said = capsys.readouterr().err
    assert f"flown with machine aarch64 (here {platform.machine()}): a last bit may differ" in said


# ---------------------------------------------------------------------------------- differences


def test_nan_is_nan_and_minus_zero_is_not_zero() -> None:
    was, now = {"a": [math.nan], "b": 0.0}, {"a": [math.nan], "b": -0.0}
    assert first_difference(was, now) == "b was 0.0, is -0.0"


def test_a_field_that_only_one_version_has_is_no_difference() -> None:
    assert first_difference({"a": 1, "old": 2}, {"a": 1, "new": 3}) is None


def test_a_change_more_or_less_is_a_difference() -> None:
    assert first_difference({"plan": [1]}, {"plan": [1, 2]}) == "plan was [1], is [1, 2]"


class LatelyDifferent(FlownCore):
    """The core with an error that shows once: the last bit of one flow."""

    def decide(self, now_s: float) -> Decision:
        decision = super().decide(now_s)
        if 105.0 <= now_s < 105.05:
            return replace(decision, flow_l_min=math.nextafter(decision.flow_l_min, 99.0))
        return decision


def test_a_difference_in_the_last_bit_is_found_and_named(
    flown: tuple[Path, list[Decision]],
) -> None:
    result = replay(flown[0], core=LatelyDifferent)
    was = flown[1][100].flow_l_min
    assert result.differences == 1
    assert result.first_difference is not None
    assert result.first_difference.startswith("decision 101: at 105.0")
    now = math.nextafter(was, 99.0)
    assert result.first_difference.endswith(f"flow_l_min was {was!r}, is {now!r}")


def test_a_lost_input_is_seen_and_reported(copy: Path) -> None:
    def without(entries: list[Entry]) -> list[Entry]:
        lost = [entry for entry in entries if entry.kind == "Telemetry"][100]
        return [entry for entry in entries if entry is not lost]

    edit_rows(copy, without)
    result = replay(copy)
    assert result.lost == 1
    assert result.differences > 0


def test_inputs_in_another_order_are_another_flight(copy: Path) -> None:
    edit_rows(
        copy,
        lambda entries: [
            Entry(100_000, entry.kind, entry.body) if entry.kind == "OperatorCommand" else entry
            for entry in entries
        ],
    )
    assert replay(copy).differences > 100


def test_another_setting_gives_other_decisions(flown: tuple[Path, list[Decision]]) -> None:
    result = replay(flown[0], overrides=["lag.up_s=0.15"])
    assert result.differences > 0
    assert result.is_what_if
    assert result.first_difference is not None
    assert "plan.changes" in result.first_difference


def test_the_same_setting_again_gives_the_same_decisions(
    flown: tuple[Path, list[Decision]],
) -> None:
    assert replay(flown[0], overrides=[f"lag.up_s={setup().lag.up_s!r}"]).differences == 0


# -------------------------------------------------------------------------------------- settings


@pytest.mark.parametrize(
    ("text", "path", "value"),
    [
        ("lag.on_s=0.12", "lag.on_s", 0.12),
        (" border_buffer_m = 0.5 ", "border_buffer_m", 0.5),
        ("method=none", "method", Method.NONE),
        ("lag.method=look-ahead", "method", Method.LOOK_AHEAD),
        ("border=volume", "border", "volume"),
        ("prescription.across=max", "across", "max"),
        ("limits.fix=3d", "limits.fix", Fix.FIX_3D),
        ("safety.fix=rtk-fixed", "limits.fix", Fix.RTK_FIXED),
        ("safety.modes=AUTO,GUIDED", "limits.modes", frozenset({"AUTO", "GUIDED"})),
        ('limits.modes=["AUTO"]', "limits.modes", frozenset({"AUTO"})),
        ("limits.rc_channel=7", "limits.rc_channel", 7),
        ("limits.rc_channel=none", "limits.rc_channel", None),
        ("limits.wind_required=true", "limits.wind_required", True),
        ("boom.valves.1.width_m=0.5", "boom.valves.1.width_m", 0.5),
        ("nozzle_sets.0.curve.duty=0.1,0.4,0.5,0.7,0.8,0.9,1", "nozzle_sets.0.curve.duty.0", 0.1),
    ],
)
def test_a_setting_can_be_changed(text: str, path: str, value: object) -> None:
    found: object = override(setup(), [text])
    for part in path.split("."):
        found = found[int(part)] if isinstance(found, tuple) else getattr(found, part)
    assert found == value


@pytest.mark.parametrize(
    ("text", "refusal"),
    [
        ("lag.on_s", "write KEY=VALUE"),
        ("=3", "write KEY=VALUE"),
        ("lag.onn_s=1", r"lag.onn_s=1: onn_s is unknown; on_s\?"),
        ("lag.on_s=fast", "could not convert"),
        ("lag.on_s=-1", "must lie in"),
        ("lag=1", "name one of its fields"),
        ("lag.on_s.x=1", "nothing below it"),
        ("boom.valves.9.width_m=1", "not an index of 6 values"),
        ("limits.wind_required=maybe", "none of true"),
        ("limits.fix=best", r"none of .*rtk-float"),
        ("timing.on_s=1", "timing is unknown"),
        ("frame.latitude_deg=1", "ground of a recorded flight"),
        ("prescription.sha256=1", "ground of a recorded flight"),
    ],
)
def test_a_wrong_setting_is_refused_in_one_line(text: str, refusal: str) -> None:
    with pytest.raises(ConfigError, match=refusal) as refused:
        override(setup(), [text])
    assert "\n" not in str(refused.value)


# ----------------------------------------------------------------------------------- the command


def test_the_command_answers_with_one_object(
    flown: tuple[Path, list[Decision]], capsys: pytest.CaptureFixture[str]
) -> None:
    code = execute(["replay", str(flown[0]), "--json"])
    answer = json.loads(capsys.readouterr().out)
    assert code == 0
    assert (answer["decisions"], answer["differences"]) == (200, 0)


def test_the_command_fails_at_a_difference(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = execute(["replay", str(copy), "--set", "lag.up_s=0.15", "--set", "method=scheduled"])
    shown = capsys.readouterr()
    assert code == 1
    assert "first difference: decision" in shown.err
    assert shown.out.startswith("200 decisions from ")


def test_the_command_refuses_what_is_no_journal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = execute(["replay", str(tmp_path / "none.gpkg"), "--json"])
    shown = capsys.readouterr()
    assert code == 2
    assert "there is no such file" in json.loads(shown.out)["error"]
    assert len(shown.err.splitlines()) == 1


def test_a_row_that_is_no_input_is_refused(copy: Path) -> None:
    with_body(copy, 5, "{}")
    with pytest.raises(JournalError, match="row 5"):
        replay(copy)


def test_a_what_if_that_changes_nothing_says_so(
    flown: tuple[Path, list[Decision]], capsys: pytest.CaptureFixture[str]
) -> None:
    same = f"lag.on_s={setup().lag.on_s!r}"
    assert execute(["replay", str(flown[0]), "--set", same]) == 0
    said = capsys.readouterr().out
    assert f"no decision of this flight depends on {same}" in said
    assert "lag.on_start_s rules in its place" in said
    assert "what-if" not in said


def test_a_row_that_is_no_input_fails_in_one_line(
    copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with_body(copy, 5, "{}")
    assert execute(["replay", str(copy)]) == 1
    said = capsys.readouterr().err
    assert "row 5" in said
    assert len(said.splitlines()) == 1
