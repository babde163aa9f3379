from __future__ import annotations

import signal
from pathlib import Path

import pytest

from companion.cli.app import execute
from sitl.demo_cli import FILES, _move, _staging
from sitl.workers import termination_as_interrupt

Captured = pytest.CaptureFixture[str]


def test_demo_has_help_with_an_example(capsys: Captured) -> None:
    assert execute(["demo", "--help"]) == 0
    assert "vrspray demo" in capsys.readouterr().out.partition("Example:")[2]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--speed", "16"], "--speed 16: outside [1, 15] m/s"),
        (["--speed", "5", "--speed", "nan"], "--speed nan: outside [1, 15] m/s"),
        (["--output", "servo", "--fidelity", "averaged"], "--output servo: the averaged twin"),
        (["--seed", "-1"], "--seed"),
        (["--out", "{file}"], "cannot be written (File exists); check folder"),
    ],
)
def test_what_cannot_be_done_is_refused_in_one_line(
    arguments: list[str], text: str, tmp_path: Path, capsys: Captured
) -> None:
    file = tmp_path / "file"
    file.touch()
    out = ["--out", str(tmp_path / "out")] if "--out" not in arguments else []
    given = [argument.format(file=file) for argument in arguments]
    assert execute(["demo", *out, *given]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert text in captured.err
    assert captured.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == [file]


def test_pictures_of_an_earlier_demo_do_not_stay_beside_new_figures(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    for name in (*FILES, "notes.txt"):
        (out / name).write_text("old")
    with _staging(out) as stage:
        (stage / "demo.json").write_text("new")
        _move(["demo.json"], stage, out)
    assert {path.name: path.read_text() for path in out.iterdir()} == {
        "demo.json": "new",
        "notes.txt": "old",
    }


@pytest.mark.parametrize("exists", [True, False])
def test_interrupted_demo_leaves_the_folder_as_it_was(exists: bool, tmp_path: Path) -> None:
    out = tmp_path / "out"
    if exists:
        out.mkdir()
        (out / "demo.json").write_text("old")
    with pytest.raises(KeyboardInterrupt), _staging(out) as stage:
        (stage / "demo.json").write_text("half")
        raise KeyboardInterrupt
    assert out.exists() == exists
    if exists:
        assert [path.name for path in out.iterdir()] == ["demo.json"]
        assert (out / "demo.json").read_text() == "old"


def test_termination_ends_the_demo_as_an_interrupt_does() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), termination_as_interrupt():
        signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) is before
