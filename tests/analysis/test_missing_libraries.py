"""A command that lacks a library ends in one line, with the command that adds it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from companion.wording import install_command
from tests.analysis.report_flight import fly

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "anyang"
EXTRAS = (
    "matplotlib jinja2 scipy PIL pyarrow duckdb fsspec statsmodels mcap rasterio mavsdk pyulog "
    "SALib distributed dask gpiod smbus2 fastapi starlette uvicorn segno"
)
WITHOUT = f"""
import sys
sys.modules.update(dict.fromkeys({EXTRAS.split()}))
if __name__ == "__main__":
    from companion.cli.app import execute
    sys.exit(execute(sys.argv[1:]))
"""
COMMANDS = {
    "report {flown} --out report": "jinja2",
    "fleet add {flown} --into fleet": "pyarrow",
    "fleet query --fleet fleet {flown}": "duckdb",
    "fleet serve --fleet fleet": "fastapi",
    "export {flown} --format mcap --out a.mcap": "mcap",
    "wsp measure card.png": "PIL",
    "map show {map} --out a.png": "matplotlib",
    "plan {map} --config {config} --out a.plan --png a.png": "matplotlib",
    "upload {mission} --link udpin:127.0.0.1:1": "mavsdk",
}


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fly(tmp_path_factory.mktemp("flown"))


@pytest.mark.parametrize(("command", "library"), COMMANDS.items())
def test_a_library_that_is_not_there_is_said_in_one_line(
    command: str, library: str, flown: Path, tmp_path: Path
) -> None:
    places = {"flown": flown, "map": EXAMPLE / "prescription.shp"}
    places |= {"config": EXAMPLE / "config.toml", "mission": EXAMPLE / "mission.waypoints"}
    words = [word.format(**places) for word in command.split()]
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT, *words, "--json"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    assert done.stderr.count("\n") <= 2, done.stderr  # another program may be running: a note
    told = json.loads(done.stdout)["error"]
    assert f"the library {library} is not installed; add it: " in told
    assert told.endswith(install_command("office"))


@pytest.mark.parametrize(
    ("mark", "begins"),
    [("pipx_metadata.json", "pipx runpip vrspray"), ("uv-receipt.toml", "uv pip install --python")],
)
def test_the_command_is_that_of_who_installed_it_wherever_it_was_told_to(
    mark: str, begins: str, tmp_path: Path
) -> None:
    assert install_command("office", str(tmp_path)).startswith("pip install ")
    (tmp_path / mark).write_text("")
    assert install_command("office", str(tmp_path)).startswith(begins)
