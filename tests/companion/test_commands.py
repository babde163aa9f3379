"""Sub-commands come from whoever registers them, and a vehicle flies without the office's."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from companion.cli.app import execute
from companion.commands import registered
from tests.companion.test_flight_map import config_naming, office_files, written
from tests.companion.wire_peer import free_port, heard

# What the README of a distribution of somebody else would say (docs/contributing/commands.md).
METADATA = "Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n"
HELLO = '''
import typer

app = typer.Typer(help="Say hello.", add_completion=False)


@app.command()
def hello(name: str) -> None:
    print(f"hello {name}")


def three() -> int:
    """Return three."""
    return 3
'''
ANNOUNCED = """
from companion.commands import Command

SLOW = Command(target="slow_to_import:app", help="Announced, and not imported for the list.")
"""
# Stands before everything that Python imports.
NO_OFFICE = """
import sys
from importlib.abc import MetaPathFinder


class NotThere(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {"missions", "analysis", "sitl"}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


sys.meta_path.insert(0, NotThere())
"""


def install(folder: Path, name: str, source: str, entries: str) -> None:
    """Lay a small distribution into a folder, as an installer would."""
    (folder / f"{name}.py").write_text(source)
    about = folder / f"{name}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(METADATA.format(name=name))
    (about / "entry_points.txt").write_text(f"[vrspray.commands]\n{entries}\n")


def vrspray(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the program with a folder of installed distributions before all others."""
    return subprocess.run(
        [sys.executable, "-m", "companion", *arguments],
        env={**os.environ, "PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        check=False,
        timeout=110,
    )


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    install(
        tmp_path, "hello_spray", HELLO, "hello = hello_spray:app\nthree = hello_spray:three\n"
        "run = hello_spray:three\nmap = hello_spray:three",
    )  # fmt: skip
    install(tmp_path, "announced", ANNOUNCED, "slow = announced:SLOW")
    install(tmp_path, "broken", "", "broken = broken:nothing")
    return tmp_path


def test_a_third_party_adds_commands(installed: Path) -> None:
    done = vrspray(installed, "hello", "you")
    assert (done.returncode, done.stdout) == (0, "hello you\n")
    assert vrspray(installed, "three").returncode == 3


def test_commands_of_others_are_listed_with_their_help(installed: Path) -> None:
    done = vrspray(installed, "--help")
    assert done.returncode == 0
    for line in ("Say hello.", "Return three.", "Announced, and not imported for the list."):
        assert line in done.stdout
    assert "  broken " in done.stdout


def test_what_cannot_be_loaded_is_one_line(installed: Path) -> None:
    for name, text in (("broken", "cannot be loaded"), ("slow", "slow_to_import is not installed")):
        done = vrspray(installed, name)
        assert done.returncode == 2
        assert text in done.stderr
        assert done.stderr.count("\n") == 1


def test_nobody_replaces_a_command_of_ours(installed: Path) -> None:
    for name in ("run", "map"):
        done = vrspray(installed, name, "--help")
        assert done.returncode == 0
        assert "Return three." not in done.stdout


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("plam", "error: no command 'plam'; did you mean plan? (see --help)"),
        ("xyzzy", "error: no command 'xyzzy' (see --help)"),
    ],
)
def test_of_a_mistyped_command_the_nearest_is_named(
    capsys: pytest.CaptureFixture[str], typed: str, said: str
) -> None:
    assert execute([typed]) == 2
    assert capsys.readouterr().err.splitlines() == [said]


def test_every_registered_command_is_a_line_and_no_more() -> None:
    script = (
        "import sys; from companion.commands import all_registered; found = all_registered();"
        "heavy = {'numpy', 'shapely', 'typer', 'companion.cli'} & set(sys.modules);"
        "print(len(found), sorted(heavy))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.split(maxsplit=1) == [str(len(registered())), "[]\n"]


# ------------------------------------------------------------------- a vehicle without the office


@pytest.fixture
def vehicle(tmp_path: Path) -> Path:
    """Return a folder before all others in which nothing of the office can be imported."""
    folder = tmp_path / "vehicle"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(NO_OFFICE)
    return folder


def test_a_vehicle_without_the_office_flies_a_compiled_map(vehicle: Path, tmp_path: Path) -> None:
    flight_map = written(tmp_path)
    config = config_naming(tmp_path, flight_map.path.name)
    checked = vrspray(vehicle, "config", "check", str(config), "--json")
    assert (checked.returncode, json.loads(checked.stdout)["ok"]) == (0, True)
    port = free_port()
    with heard(port):
        flown = vrspray(
            vehicle, "run", "--config", str(config), "--duration-s", "0.5", "--json",
            "--set", f"link.url=udpin:127.0.0.1:{port}", "--set", "output.kind=none",
        )  # fmt: skip
    assert flown.returncode == 0, flown.stderr
    listed = vrspray(vehicle, "flights", "list", "--folder", str(tmp_path / "flights"))
    assert "flight-0001.gpkg" in listed.stdout
    absent = vrspray(vehicle, "flights", "show", json.loads(flown.stdout)["journal"])
    assert "is not installed; add it: " in absent.stderr
    shown = vrspray(tmp_path, "flights", "show", json.loads(flown.stdout)["journal"])
    assert f"flight map: {flight_map.sha256[:8]} of prescription.shp, compiled " in shown.stdout


@pytest.mark.parametrize("command", [("config", "check"), ("run", "--config")], ids=" ".join)
def test_a_vehicle_without_the_office_says_what_to_do_with_any_other_map(
    command: tuple[str, ...], vehicle: Path, tmp_path: Path
) -> None:
    config = office_files(tmp_path)
    done = vrspray(vehicle, *command, str(config))
    assert done.returncode == 2
    # `config check` lists it among the problems that it prints.
    told, silent = (done.stdout, done.stderr)[:: 1 if command[0] == "config" else -1]
    assert silent == ""
    (line,) = [line for line in told.splitlines() if line.startswith("error: ")]
    assert "this vehicle opens flight maps only" in line
    assert (
        "vrspray map compile prescription.shp --out prescription.flightmap.gpkg --config "
        "config.toml" in line
    )


def test_a_vehicle_without_the_office_has_its_own_commands(vehicle: Path) -> None:
    listed = vrspray(vehicle, "--help").stdout
    assert "  run " in listed
    done = vrspray(vehicle, "plan", "field.geojson")
    assert done.returncode == 2
    assert "is not installed; add it: " in done.stderr
