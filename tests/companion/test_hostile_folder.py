"""A working directory with modules of every name that is imported: nothing of it is run."""

from __future__ import annotations

import asyncio
import math
import os
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from analysis.fleet.adding import ALONE, _no_module_of_this_folder, add
from analysis.fleet.store import Store
from companion.cli.folders_own import _in_root
from companion.core.types import PwmLimits
from companion.output.child import Child
from companion.output.engine.wire import PACKET_MAX, EngineSetup, Kind, Wiring, pack, unpack
from companion.output.gpio import COMMAND
from sitl.workers import do_all
from tests.companion.test_service_unit import UNIT

VRSPRAY = Path(sys.executable).with_name("vrspray")
EXAMPLE = Path(__file__).parents[2] / "examples" / "anyang"
OURS = ("companion", "missions", "sitl", "analysis", "tests")
OTHERS = (
    *("numpy", "scipy", "shapely", "pyproj", "rasterio", "matplotlib", "PIL", "typer", "click"),
    *("pydantic", "pydantic_settings", "pydantic_core", "pymavlink", "serial", "gpiod", "spidev"),
    *("rich", "yaml", "pyarrow", "mcap", "mavsdk", "sitecustomize", "usercustomize", "backend"),
    *("certifi", "affine", "attr", "cycler", "kiwisolver", "dotenv", "typing_extensions", "gi"),
)
MATPLOTLIBRC = "backend: module://backend\ntext.usetex: True\nfigure.facecolor: red\n"


@pytest.fixture
def hostile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "hostile"
    folder.mkdir()
    for name in {*sys.stdlib_module_names, *OURS, *OTHERS}:
        marks, line = str(tmp_path / "ran"), f"{name}\n"
        code = f"with open({marks!r}, 'a') as file:\n    file.write({line!r})\n"
        (folder / f"{name}.py").write_text(code)
    (folder / "matplotlibrc").write_text(MATPLOTLIBRC)
    monkeypatch.chdir(folder)
    return folder


def what_ran(hostile: Path) -> set[str]:
    marks = hostile.parent / "ran"
    return set(marks.read_text().split()) if marks.exists() else set()


pytestmark = pytest.mark.timeout(300)


def call(*words: object) -> subprocess.CompletedProcess[str]:
    command = [str(word) for word in words]
    return subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)


def test_the_folder_is_hostile_to_a_python_that_looks_there(hostile: Path) -> None:
    call(sys.executable, "-m", "companion", "--version")
    assert what_ran(hostile)


@pytest.mark.parametrize(
    "words",
    [
        ("config", "check", EXAMPLE / "config.toml"),
        ("flights", "recover", "--folder", "."),
    ],
    ids=lambda words: " ".join(words[:2]),
)
def test_a_command_runs_nothing_of_it(hostile: Path, words: tuple[object, ...]) -> None:
    done = call(VRSPRAY, *words)
    assert done.returncode == 0, done.stderr
    assert not what_ran(hostile)


def test_a_picture_is_the_same_whatever_the_folder_says(hostile: Path, tmp_path: Path) -> None:
    pictures = []
    for folder in (hostile, EXAMPLE):
        out = tmp_path / f"{folder.name}.png"
        done = subprocess.run(
            [VRSPRAY, "map", "show", EXAMPLE / "prescription.shp", "--out", out],
            cwd=folder, capture_output=True, text=True, timeout=240, check=False,
        )  # fmt: skip
        # A note is of another run on this computer.
        said = [line for line in done.stderr.splitlines() if not line.startswith("note: ")]
        assert (done.returncode, said) == (0, [])
        pictures.append(out.read_bytes())
    assert pictures[0] == pictures[1]
    assert not what_ran(hostile)


def test_the_valve_engine_runs_nothing_of_it(hostile: Path) -> None:
    pwm = PwmLimits(frequency_hz=11, duty_min=0.2, duty_max=0.9, min_on_s=0, min_off_s=0)
    wiring = Wiring(valves=(17, 18), return_line=22, return_normally_open=False)
    child = Child(COMMAND)
    try:
        setup = EngineSetup(wiring=wiring, pwm=pwm, device="no-such-chip")
        child.send(pack(Kind.SETUP, setup.as_bytes()))
        child.socket.settimeout(120.0)
        answer = child.socket.recv(PACKET_MAX)
    finally:
        child.disconnect()
        asyncio.run(child.ended(60.0))
    assert not what_ran(hostile)
    assert unpack(answer)[0] is not Kind.READY  # it got as far as the chip that is not there


@pytest.mark.parametrize("processes", [1, 2])
def test_the_processes_of_a_demo_run_nothing_of_it(hostile: Path, processes: int) -> None:
    assert do_all(math.sqrt, [9.0, 4.0], processes=processes) == [3.0, 2.0]
    assert not what_ran(hostile)


def test_the_processes_of_a_fleet_run_nothing_of_it(hostile: Path, tmp_path: Path) -> None:
    journals = [tmp_path / f"flight-{i}.gpkg" for i in range(ALONE)]
    for journal in journals:
        journal.write_bytes(b"no journal")
    added = add(journals, Store.at(str(tmp_path / "fleet")), processes=2)
    assert len(added.problems) == ALONE
    assert not what_ran(hostile)
    assert "PYTHONSAFEPATH" not in os.environ  # others start processes, too


@pytest.mark.parametrize("before", [None, "0"])
def test_an_error_leaves_the_environment_as_it_was(
    monkeypatch: pytest.MonkeyPatch, before: str | None
) -> None:
    if before is not None:
        monkeypatch.setenv("PYTHONSAFEPATH", before)
    with pytest.raises(OSError), _no_module_of_this_folder():
        assert os.environ["PYTHONSAFEPATH"] == "1"
        raise OSError
    assert os.environ.get("PYTHONSAFEPATH") == before


def test_the_service_and_its_closer_run_nothing_of_it(hostile: Path) -> None:
    # A service of a user's own is started in the user's home.
    text = replace(UNIT, python=sys.executable, closer=("--help",), is_user=True).text()
    commands = re.findall(r"^Exec\w+=(.*)$", text, re.MULTILINE)
    assert len(commands) == 2
    for command in commands:
        done = call(*shlex.split(command))
        assert done.returncode in (0, 2), done.stderr
        assert "Traceback" not in done.stderr
    assert not what_ran(hostile)


def test_the_unit_in_the_repository_is_started_so_too() -> None:
    unit = Path(__file__).parents[2] / "deploy" / "systemd" / "vrspray.service"
    for command in re.findall(r"^Exec\w+=(.*)$", unit.read_text(), re.MULTILINE):
        assert shlex.split(command)[1] == "-P"


def test_whatever_an_import_does_the_command_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    files = len(list(Path("/proc/self/fd").iterdir()))
    with _in_root():
        assert Path.cwd() == Path("/")
    with pytest.raises(ImportError), _in_root():
        raise ImportError
    assert Path.cwd() == tmp_path
    assert len(list(Path("/proc/self/fd").iterdir())) == files
