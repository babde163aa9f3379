"""`vrspray ground`: options that cannot be followed are refused before anything is opened."""

from __future__ import annotations

import json
import os
import shutil
import socket
import sys
from pathlib import Path

import pytest

from companion.cli.app import execute
from companion.cli.ground_tasks import Wish, csv_line, ground_setup, piece_of, plan_line
from companion.config import load
from companion.ground.work import GroundKind

EXAMPLE = Path(__file__).parents[2] / "examples" / "anyang"


@pytest.fixture
def config(tmp_path: Path) -> Path:
    folder = tmp_path / "anyang"
    shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("flights"))
    return folder / "config.toml"


def refused(
    config: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    *arguments: str,
    stdin: bytes = b"",
) -> tuple[int, str]:
    """Return the exit code and the one line of the error."""
    near, far = os.pipe()
    os.write(far, stdin)
    os.close(far)
    with os.fdopen(near) as file:
        monkeypatch.setattr(sys, "stdin", file)
        code = execute(["ground", *arguments, "--config", str(config), "--json"])
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, captured.err
    assert json.loads(captured.out)["error"] == lines[0].removeprefix("error: ")
    return code, lines[0]


@pytest.mark.parametrize(
    ("arguments", "stdin", "words"),
    [
        (("prime",), b"", "not a terminal"),
        (("prime", "--hold-lines"), b"yes\n", "the word was not spray"),
        (("click", "--hold-lines"), b"spray\n", "the word was not click"),
        (("prime", "--hold-lines", "--valve", "7"), b"", "the valves are 1, 2, 3, 4, 5, 6"),
        (("prime", "--hold-lines", "--seconds", "31"), b"", "--seconds"),
        (("prime", "--hold-lines", "--seconds", "nan"), b"", "--seconds"),
        (("catch", "--hold-lines"), b"", "give --duty"),
        (("catch", "--hold-lines", "--duty", "0.05"), b"", "give 0.2 to 1"),
        (("catch", "--hold-lines", "--duty", "nan"), b"", "--duty nan"),
        (("rinse", "--hold-lines"), b"", "give --litres"),
        (("rinse", "--hold-lines", "--litres", "9"), b"", "fewer --litres"),
        (("paint",), b"", "paint"),
    ],
)
def test_wrong_options_are_one_line_and_exit_two(
    config: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    arguments: tuple[str, ...],
    stdin: bytes,
    words: str,
) -> None:
    code, line = refused(config, capsys, monkeypatch, *arguments, stdin=stdin)
    assert code == 2
    assert words in line


def test_a_port_that_a_run_holds_is_one_line_and_exit_two(
    config: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        url = f"link.url=udpin:127.0.0.1:{taken.getsockname()[1]}"
        code, line = refused(
            config, capsys, monkeypatch, "click", "--hold-lines", "--set", url, stdin=b"click\n"
        )
    assert code == 2
    assert "in use" in line


@pytest.mark.parametrize(("kind", "words"), [("none", "A dry run"), ("servo", "has to run")])
def test_a_dry_run_asks_for_no_pump(
    config: Path, capfd: pytest.CaptureFixture[str], kind: str, words: str
) -> None:
    near, far = os.pipe()
    os.write(far, b"no\n")
    os.close(far)
    with os.fdopen(near) as file, pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdin", file)
        settings = ("--hold-lines", "--set", f'output.kind="{kind}"')
        assert execute(["ground", "prime", *settings, "--config", str(config)]) == 2
    told = capfd.readouterr().err
    assert words in told
    assert ("The pump has to run" in told) == (kind == "servo")


def test_a_folder_that_cannot_be_written_is_refused_before_the_word(
    config: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (config.parent / "flights").write_text("no folder")
    code, line = refused(config, capsys, monkeypatch, "click", "--hold-lines", stdin=b"click\n")
    assert (code, "journal.folder" in line) == (2, True)


def test_the_pieces_are_what_was_asked_for(config: Path) -> None:
    settings = load(config)

    def piece(kind: GroundKind, **wish: object):  # type: ignore[no-untyped-def]
        return piece_of(settings, Wish(kind=kind, **wish))  # type: ignore[arg-type]

    assert piece(GroundKind.PRIME).task.seconds == 10.0
    assert piece(GroundKind.FLUSH).task.seconds == 30.0
    assert len(piece(GroundKind.FLUSH).task.phases) == 6
    assert piece(GroundKind.FLUSH, valves=("2",)).task.seconds == 5.0
    assert piece(GroundKind.FLUSH, is_together=True).task.seconds == 5.0
    # Two litres through all valves at 6.096 L/min; in turn a sixth of that flows.
    rinse = piece(GroundKind.RINSE, litres=2.0, is_together=True)
    assert rinse.task.seconds == pytest.approx(19.685, abs=1e-3)
    assert piece(GroundKind.RINSE, litres=0.4).task.seconds == pytest.approx(23.622, abs=1e-3)
    caught = piece(GroundKind.CATCH, duty=0.5, valves=("3", "1"))
    assert caught.task.phases[0].duty == (0.5, 0.0, 0.5, 0.0, 0.0, 0.0)
    assert caught.task.is_whole
    assert csv_line(caught, 30.0) == "0.5,30.000,?,1 3"
    for kind, words in [(GroundKind.CLICK, "dry"), (GroundKind.FLUSH, "in turn")]:
        assert words in plan_line(piece(kind))


def test_the_set_up_is_that_of_the_configuration(config: Path) -> None:
    given = ground_setup(
        load(config, overrides=['safety.modes=["AUTO", "GUIDED"]', "output.lease_s=0.2"])
    )
    assert given.modes == {"AUTO", "GUIDED"}
    assert (given.lease_s, given.has_servo_outputs) == (0.2, True)
    dry = ground_setup(load(config, overrides=['output.kind="none"']))
    assert not dry.has_servo_outputs


PUMPS = Path(__file__).parents[2] / "examples"


def test_a_pump_that_makes_the_flow_takes_the_duty_and_the_valves_are_open() -> None:
    settings = load(PUMPS / "pump-sections" / "config.toml")
    assert settings.pump is not None
    caught = piece_of(settings, Wish(kind=GroundKind.CATCH, duty=0.8))
    assert set(caught.task.phases[0].duty) == {1.0}
    assert caught.task.drives[0] == caught.duty == 0.8
    (nozzles,) = settings.nozzle_sets()
    assert caught.expected_ml(settings) == pytest.approx(
        nozzles.curve.flow_for(0.8) * 1000.0 * 25.0 / 60.0, rel=0.05
    )
    assert piece_of(settings, Wish(kind=GroundKind.CLICK)).task.drives == ()
    prime = piece_of(settings, Wish(kind=GroundKind.PRIME))
    assert prime.task.seconds == settings.pump.prime_s != 10.0
    slow = load(PUMPS / "pump-sections" / "config.toml", overrides=["pump.prime_s=200"])
    assert piece_of(slow, Wish(kind=GroundKind.PRIME)).task.seconds == 30.0
    assert prime.task.drives[0] == 1.0
    one = piece_of(settings, Wish(kind=GroundKind.CATCH, duty=0.8, valves=("1",)))
    assert one.expected_ml(settings) == caught.expected_ml(settings)
