"""The wheel: all that the commands need is in it, and they work without the source tree."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Sequence
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("companion", "missions", "sitl", "analysis")
# In the wheel these are folders of a package; in the source tree links to the top.
LINKED = {"sitl/examples": "examples", "companion/deploy": "deploy"}
NOT_IN_WHEEL = ("__pycache__", ".pyc")


def shipped() -> set[str]:
    """Return the files of the source tree that belong into the wheel, by their names in it."""
    found = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and not path.is_symlink()
    }
    for inside, outside in LINKED.items():
        files = [path for path in (ROOT / outside).rglob("*") if path.is_file()]
        found |= {f"{inside}/{path.relative_to(ROOT / outside).as_posix()}" for path in files}
    return {name for name in found if not any(part in name for part in NOT_IN_WHEEL)}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the wheel, built from a copy: nothing of an earlier build, nothing left behind."""
    folder = tmp_path_factory.mktemp("wheel")
    tree = folder / "tree"
    tree.mkdir()
    for name in (*PACKAGES, *LINKED.values()):
        shutil.copytree(
            ROOT / name, tree / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__")
        )
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, tree)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", "wheel"]
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", str(folder)]
    subprocess.run([*pip, *options, str(tree)], check=True, capture_output=True)
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the wheel's content that nobody may write to."""
    folder = tmp_path_factory.mktemp("installed")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    for path in folder.rglob("*"):
        path.chmod(0o555 if path.is_dir() else 0o444)
    return folder


# The demo needs each of its files and modules for one pass too, and `test_tutorial.py` flies all
# four in a pool of processes. What perfect knowledge needs, the demo needs as well.
BRIEFLY = "import sitl.anyang as a, sitl.workers as w; a.PASS_COUNT, w.PROCESSES_MAX = 1, 1; "
NOT_COMPARED = "import sitl.fly as f; f._perfect = lambda *_: None; "


def vrspray(
    installed: Path, arguments: Sequence[str], folder: Path, *, before: str = ""
) -> subprocess.CompletedProcess[str]:
    """Run the wheel's own program in `folder`; -P keeps the source tree off its path.

    Not by `main`, which gives way to all else on the computer: other tests run beside these.
    """
    start = "import sys; from companion.cli.app import execute; sys.exit(execute(sys.argv[1:]))"
    return subprocess.run(
        [sys.executable, "-P", "-c", before + start, *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(installed)},
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_wheel_holds_every_file_of_the_packages_and_the_examples(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        inside = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert sorted(shipped() - inside) == []
    assert sorted(inside - shipped()) == []


def test_the_links_lead_to_the_folders_at_the_top() -> None:
    for inside, outside in LINKED.items():
        assert (ROOT / inside).is_symlink()
        assert (ROOT / inside).resolve() == ROOT / outside


def test_the_wheels_program_is_the_wheels_own(installed: Path, tmp_path: Path) -> None:
    code = "import companion, sitl.anyang; print(companion.__file__, sitl.anyang.EXAMPLE)"
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    said = subprocess.run(
        [sys.executable, "-P", "-c", code],
        cwd=tmp_path, env=environment, check=True, capture_output=True, text=True,
    ).stdout  # fmt: skip
    assert said.split() == [
        str(installed / "companion" / "__init__.py"),
        str(installed / "sitl" / "examples" / "anyang"),
    ]


def test_an_example_is_copied_and_flown_outside_the_source_tree(
    installed: Path, tmp_path: Path
) -> None:
    copied = vrspray(installed, ["examples", "copy", "anyang", "--json"], tmp_path)
    assert (copied.returncode, copied.stderr) == (0, "")
    config, mission = "examples/anyang/config.toml", "examples/anyang/mission.waypoints"
    checked = vrspray(installed, ["config", "check", config], tmp_path)
    assert checked.returncode == 0, checked.stderr
    flown = vrspray(
        installed, ["sitl", "fly", "--config", config, "--mission", mission, "--json"], tmp_path,
        before=NOT_COMPARED,
    )  # fmt: skip
    assert flown.returncode == 0, flown.stderr
    assert json.loads(flown.stdout)["flights"][0]["missed"] == 0


def test_the_demo_flies_outside_the_source_tree(installed: Path, tmp_path: Path) -> None:
    arguments = ["demo", "--speed", "5", "--fidelity", "averaged", "--json"]
    flown = vrspray(installed, arguments, tmp_path, before=BRIEFLY)
    assert (flown.returncode, flown.stderr) == (0, "")
    assert [each["method"] for each in json.loads(flown.stdout)["flights"]] == [
        "none", "look-ahead", "look-ahead-stated", "scheduled", "calibrated",
    ]  # fmt: skip
    report = vrspray(
        installed, ["report", "demo-out/flight-0001.gpkg", "--out", "report"], tmp_path
    )
    assert report.returncode in (0, 1), report.stderr
    assert (tmp_path / "report" / "report.html").exists()


def test_the_stub_serves_its_example_outside_the_source_tree(
    installed: Path, tmp_path: Path
) -> None:
    served = vrspray(
        installed, ["sitl", "serve", "--link", "udpout:127.0.0.1:9", "--wait-s", "0.1"], tmp_path
    )
    assert served.returncode == 1
    assert served.stdout.startswith("no companion")
