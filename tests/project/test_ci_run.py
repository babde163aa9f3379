"""`.ci/run`: which Pythons it finds, and that whatever fails makes it fail."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

RUN = Path(__file__).parents[2] / ".ci" / "run"
TOOLS = ("bash", "cat", "chmod", "dirname", "ls", "mktemp", "rm", "sort")
pytestmark = pytest.mark.skipif(
    any(shutil.which(tool) is None for tool in TOOLS), reason="a tool of the system is missing"
)

# Stands in for Python: of that version to whoever asks, or a command of pyenv that does not run.
PYTHON = '#!/bin/sh\n[ "$1" = --version ] && echo Python {version}.7\nexit 0\n'
SHIM = "#!/bin/sh\necho 'pyenv: command not found' >&2\nexit 127\n"
MAKE = '#!/bin/sh\necho "make $*" >> {log}\ncase "$*" in {fails}) exit 5 ;; esac\n'


class Computer:
    """One with its own few programs."""

    def __init__(self, folder: Path) -> None:
        self.project, self.bin, self.log = folder / "project", folder / "bin", folder / "log"
        self.pyenv = folder / "pyenv"
        (self.project / ".ci").mkdir(parents=True)
        shutil.copy(RUN, self.project / ".ci" / "run")
        self.bin.mkdir()
        for tool in TOOLS:
            (self.bin / tool).symlink_to(str(shutil.which(tool)))
        self.make_fails("nothing")

    def has(self, path: Path, text: str) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        path.chmod(0o755)

    def on_path(self, version: str, text: str = PYTHON) -> None:
        self.has(self.bin / f"python{version}", text.format(version=version))

    def of_pyenv(self, version: str, patch: int) -> None:
        place = self.pyenv / "versions" / f"{version}.{patch}" / "bin" / f"python{version}"
        self.has(place, PYTHON.format(version=version))

    def make_fails(self, pattern: str) -> None:
        self.has(self.bin / "make", MAKE.format(log=self.log, fails=pattern))

    def run(self) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [self.project / ".ci" / "run"],
            env={"PATH": str(self.bin), "PYENV_ROOT": str(self.pyenv), "HOME": str(self.project)},
            capture_output=True,
            text=True,
            check=False,
        )

    def made(self) -> list[str]:
        return self.log.read_text().splitlines()


@pytest.fixture
def computer(tmp_path: Path) -> Computer:
    return Computer(tmp_path)


def test_the_oldest_and_the_newest_are_tested_and_named(computer: Computer) -> None:
    computer.on_path("3.11")
    computer.on_path("3.12")
    computer.on_path("3.13", SHIM)
    computer.of_pyenv("3.13", 9)
    computer.of_pyenv("3.13", 10)
    result = computer.run()
    assert (result.returncode, result.stderr) == (0, "")
    for said in ("Oldest Python here: 3.11", "Newest Python here: 3.13", "not tested: 3.14"):
        assert result.stdout.count(said) == 2
    newest = computer.pyenv / "versions/3.13.10/bin/python3.13"
    made = computer.made()
    for target in ("setup", "test-computing WORKERS=2", "test-flights"):
        assert f"make PYTHON={computer.bin}/python3.11 VENV=.venv-3.11 {target}" in made
        assert f"make PYTHON={newest} VENV=.venv-3.13 {target}" in made
    assert sum("lint" in line for line in made) == 1
    assert "test-firmware" in made[-1]
    assert not [line for line in made if "3.12" in line]


def test_one_python_runs_everything_once(computer: Computer) -> None:
    computer.on_path("3.12")
    result = computer.run()
    assert result.returncode == 0
    assert "the tests run once" in result.stdout
    assert "not tested: 3.11 3.13 3.14" in result.stdout
    assert sum("test-computing" in line for line in computer.made()) == 1


@pytest.mark.skipif(os.geteuid() != 0, reason="only root installs packages")
@pytest.mark.parametrize(("status", "skipped"), [(0, False), (100, True)])
def test_a_browser_is_installed_where_it_can_be(
    computer: Computer, status: int, skipped: bool
) -> None:
    computer.on_path("3.11")
    computer.has(
        computer.bin / "apt-get",
        f'#!/bin/sh\necho "apt-get $*" >> {computer.log}\n[ "$1" = update ] || exit {status}\n',
    )
    result = computer.run()
    assert (result.returncode, result.stderr) == (0, "")
    assert ("tests in a browser are skipped" in result.stdout) == skipped
    assert computer.made()[1].endswith("chromium")


def test_a_browser_that_is_there_is_taken(computer: Computer) -> None:
    computer.on_path("3.11")
    computer.has(computer.bin / "chromium", "#!/bin/sh\n")
    assert "skipped" not in computer.run().stdout


def test_without_a_python_nothing_passes(computer: Computer) -> None:
    computer.on_path("3.12", SHIM)
    result = computer.run()
    assert result.returncode == 1
    assert "nothing was tested" in result.stderr
    assert not computer.log.exists()


@pytest.mark.parametrize(
    ("pattern", "name"),
    [
        ("*lint*", "lint"),
        ("*3.13*setup*", "setup on Python 3.13"),
        ("*3.11*docs", "documentation"),
        ("*3.11*test-computing*", "computing tests on Python 3.11"),
        ("*3.13*test-computing*", "computing tests on Python 3.13"),
        ("*3.11*test-flights*", "flights on Python 3.11"),
        ("*3.13*test-flights*", "flights on Python 3.13"),
        ("*test-wheel*", "wheel outside the source tree"),
        ("*test-firmware*", "flights beside real firmwares"),
    ],
)
def test_whatever_fails_fails_the_run_and_the_rest_goes_on(
    computer: Computer, pattern: str, name: str
) -> None:
    computer.on_path("3.11")
    computer.on_path("3.13")
    computer.make_fails(pattern)
    result = computer.run()
    assert result.returncode == 1
    assert result.stderr == f"FAILED: {name}\n"
    assert len(computer.made()) == 10
