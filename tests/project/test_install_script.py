"""The install script: what it would do, and what it refuses; nothing is done here."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "deploy" / "install.sh"
pytestmark = pytest.mark.skipif(
    any(shutil.which(tool) is None for tool in ("sh", "getent", "getconf")),
    reason="a tool of the system is missing",
)


@pytest.fixture
def fakes(tmp_path: Path) -> Path:
    folder = tmp_path / "bin"
    folder.mkdir()
    return folder


def fake(folder: Path, name: str, text: str) -> None:
    path = folder / name
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)


def run(fakes: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["sh", str(SCRIPT), *arguments],
        env={**os.environ, "PATH": f"{fakes}:{os.environ['PATH']}", "DESTDIR": str(fakes.parent)},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture
def wheel(tmp_path: Path) -> str:
    path = tmp_path / "vrspray-0.1.0-py3-none-any.whl"
    path.touch()
    return str(path)


def test_a_dry_run_names_every_command_and_does_nothing(
    fakes: Path, wheel: str, tmp_path: Path
) -> None:
    fake(fakes, "getent", '[ "$2" != vrspray ]')
    before = sorted(tmp_path.rglob("*"))
    said = run(fakes, "--dry-run", wheel)
    assert (said.returncode, said.stderr) == (0, "")
    assert sorted(tmp_path.rglob("*")) == before
    done = [line.removeprefix("+ ") for line in said.stdout.splitlines() if line.startswith("+ ")]
    assert [line.split()[0].rpartition("/")[2] for line in done] == [
        "useradd", "usermod", "usermod", "usermod", "install", "python3", "pip", "pip", "ln",
        "vrspray",
    ]  # fmt: skip
    assert f"{wheel}[vehicle]" in said.stdout
    assert "vrspray service install --run-as vrspray" in said.stdout


def test_pinned_versions_are_taken_where_they_lie_beside_the_wheel(fakes: Path, wheel: str) -> None:
    (Path(wheel).parent / "vehicle.txt").touch()
    said = run(fakes, "--dry-run", wheel)
    assert "--require-hashes --requirement" in said.stdout
    assert "[vehicle]" not in said.stdout


def test_without_a_group_for_gpio_one_is_made_with_its_rule(fakes: Path, wheel: str) -> None:
    fake(fakes, "getent", '[ "$2" != gpio ]')
    said = run(fakes, "--dry-run", wheel).stdout
    assert "+ groupadd --system gpio\n+ write " in said


@pytest.mark.parametrize(
    ("name", "text", "refusal"),
    [
        ("getconf", "echo 32", "this is a 32-bit system; install the 64-bit Raspberry Pi OS"),
        ("uname", "echo Darwin", "needs Linux"),
        ("python3", "exit 1", "needs Python 3.11 or newer"),
        ("python3", 'case "$2" in *ensurepip*) exit 1 ;; esac', "sudo apt install python3-venv"),
    ],
)
def test_a_computer_that_it_does_not_fit_is_refused_in_one_line(
    name: str, text: str, refusal: str, fakes: Path, wheel: str
) -> None:
    fake(fakes, name, text)
    said = run(fakes, "--dry-run", wheel)
    assert (said.returncode, said.stdout) == (2, "")
    assert said.stderr.startswith("error: ")
    assert refusal in said.stderr
    assert said.stderr.count("\n") == 1


def test_wrong_use_is_refused_in_one_line(fakes: Path, wheel: str) -> None:
    fake(fakes, "id", "echo 1000")
    for arguments, refusal in (
        ([wheel], "needs root"),
        (["--dry-run"], "which wheel?"),
        (["--dry-run", f"{wheel}.zip"], "no such file"),
        (["--force"], "no such option"),
    ):
        said = run(fakes, *arguments)
        assert (said.returncode, said.stderr.count("\n")) == (2, 1)
        assert refusal in said.stderr


def test_uninstalling_leaves_configuration_and_journals(fakes: Path) -> None:
    said = run(fakes, "--dry-run", "--uninstall")
    assert said.returncode == 0
    removed = [line for line in said.stdout.splitlines() if line.startswith("+ rm")]
    assert removed
    assert not [line for line in removed if "/etc/vrspray" in line]
