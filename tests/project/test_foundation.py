"""The project around the code: lock files, documents, one command that sets everything up."""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from tests.try_image import instructions, labels

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
DOCUMENTS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
LOCKS = ("build", "vehicle", "office", "dev", "docs")
EXTRAS: dict[str, list[str]] = PROJECT["project"]["optional-dependencies"]
needs_make = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")


def pins(lock: str) -> list[Requirement]:
    """Return what a lock file pins, hashes left out."""
    text = (ROOT / "requirements" / f"{lock}.txt").read_text().replace("\\\n", " ")
    return [Requirement(line.split("--hash")[0]) for line in text.splitlines() if line.strip()]


def wanted(extra: str | None) -> list[Requirement]:
    """Return what the project asks for, extras of its own resolved."""
    lines = PROJECT["project"]["dependencies"] if extra is None else EXTRAS[extra]
    requirements = [Requirement(line) for line in lines]
    own = [name for one in requirements if one.name == "vrspray" for name in one.extras]
    others = [one for one in requirements if one.name != "vrspray"]
    return others + [one for name in own for one in wanted(name)]


def is_pinned(requirement: Requirement, lock: str) -> bool:
    """Return whether every pin of that name, and there is one, satisfies the requirement."""
    found = [pin for pin in pins(lock) if pin.name.lower() == requirement.name.lower()]
    versions = [next(iter(pin.specifier)).version for pin in found]
    return bool(found) and all(requirement.specifier.contains(one) for one in versions)


# ----------------------------------------------------------------------------------------- locks


@pytest.mark.parametrize(
    ("lock", "extra"),
    [
        ("vehicle", None),
        ("vehicle", "vehicle"),
        ("office", None),
        ("office", "office"),
        ("dev", None),
        ("dev", "dev"),
        ("dev", "all"),
        ("docs", "docs"),
    ],
)
def test_lock_file_holds_every_dependency_of_the_project(lock: str, extra: str | None) -> None:
    assert [str(one) for one in wanted(extra) if not is_pinned(one, lock)] == []


def test_lock_file_holds_the_build_tool() -> None:
    required = [Requirement(line) for line in PROJECT["build-system"]["requires"]]
    assert all(is_pinned(one, "build") for one in required)


@pytest.mark.parametrize("lock", LOCKS)
def test_every_pin_is_exact_and_has_a_hash(lock: str) -> None:
    text = (ROOT / "requirements" / f"{lock}.txt").read_text().replace("\\\n", " ")
    for line in filter(None, text.splitlines()):
        assert re.match(r"[a-z0-9-]+==\S+ .*--hash=sha256:[0-9a-f]{64}", line), line[:80]


@pytest.mark.parametrize("lock", LOCKS)
def test_every_python_has_the_same_versions(lock: str) -> None:
    versions: dict[str, set[str]] = {}
    for pin in pins(lock):
        versions.setdefault(pin.name, set()).add(str(pin.specifier))
        assert "python_" not in str(pin.marker).replace("platform_python", "")
    assert {name: found for name, found in versions.items() if len(found) > 1} == {}


@pytest.mark.parametrize("lock", LOCKS)
def test_lock_file_names_no_package_index(lock: str) -> None:
    text = (ROOT / "requirements" / f"{lock}.txt").read_text()
    assert "://" not in text
    assert not re.search(r"^\s*-(-index|-extra|-find|i\b|f\b)", text, re.MULTILINE)


@pytest.mark.parametrize(("small", "large"), [("vehicle", "dev"), ("office", "dev")])
def test_the_same_versions_fly_that_were_tested(small: str, large: str) -> None:
    assert {str(one) for one in pins(small)} <= {str(one) for one in pins(large)}


def test_a_vehicle_gets_nothing_heavy_and_earlier_names_of_extras_still_install() -> None:
    heavy = {"matplotlib", "scipy", "pillow", "rasterio", "pyarrow", "mavsdk", "jinja2"}
    assert {pin.name for pin in pins("vehicle")} & heavy == set()
    assert heavy <= {pin.name for pin in pins("office")}
    assert [one.name for one in wanted("plot")] == ["matplotlib"]
    assert [one.name for one in wanted("mavsdk")] == ["mavsdk"]
    assert {one.name for one in wanted("all")} >= heavy | {"gpiod", "smbus2"}


def test_the_tools_of_the_site_change_no_version_of_development() -> None:
    tested = {pin.name: str(pin.specifier) for pin in pins("dev")}
    site = {pin.name: str(pin.specifier) for pin in pins("docs")}
    assert {name: it for name, it in site.items() if tested.get(name, it) != it} == {}


# ------------------------------------------------------------------------------------- documents


def prose(document: Path) -> str:
    """Return a document without its code."""
    return re.sub(r"```.*?```|`[^`\n]*`", "", document.read_text(), flags=re.DOTALL)


def anchors(document: Path) -> set[str]:
    """Return the anchors of a document's headings, as GitHub makes them."""
    heads = re.findall(r"^#+ +(.+)$", document.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head).strip().lower().replace(" ", "-") for head in heads}


def broken_links(document: Path) -> list[str]:
    """Return the relative links of a document that lead nowhere."""
    broken = []
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(document)):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (document.parent / path).resolve() if path else document
        if not target.exists() or (anchor and anchor not in anchors(target)):
            broken.append(link)
    return broken


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_relative_link_leads_somewhere(document: Path) -> None:
    assert broken_links(document) == []


def test_a_link_to_nothing_is_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# A head\n[a](page.md#a-head) [b](gone.md) [c](#no-head) `[d](code.md)`\n")
    assert broken_links(page) == ["gone.md", "#no-head"]


def test_every_document_has_its_place_in_the_navigation() -> None:
    listed = re.findall(
        r"^ +- (?:[^:\n]+: )?(\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE
    )
    pages = [str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md")]
    assert sorted(listed) == sorted(pages)


def test_project_package_and_changelog_agree_on_the_version() -> None:
    newest = re.findall(r"^## \[(\d[^\]]*)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert {PROJECT["project"]["version"], version("vrspray"), newest[0]} == {version("vrspray")}


def test_changelog_tells_what_changed_in_flight() -> None:
    assert "### Changed behaviour in flight" in (ROOT / "CHANGELOG.md").read_text()


def test_a_module_that_is_run_has_all_of_itself_by_then() -> None:
    """What stands below `if __name__ == "__main__"` is not there yet when the command runs."""
    early = []
    for package in ("companion", "missions", "sitl", "analysis", "tests"):
        for path in sorted((ROOT / package).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            if "__main__" not in text:
                continue
            *before, _ = ast.parse(text).body
            early += [
                f"{path.relative_to(ROOT)}:{node.lineno}"
                for node in before
                if isinstance(node, ast.If) and "'__main__'" in ast.unparse(node.test)
            ]
    assert not early


def test_no_file_of_the_project_names_a_place_on_somebodys_machine() -> None:
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip("not a git checkout")
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    files = [ROOT / name for name in listed.split("\0") if name]
    # Written so that this file does not name one itself.
    places = re.compile(rb"(?<![\w.}/-])/(?:work|tmp|root|Users)/|/home/(?!vrspray\b)\w")
    naming = [path.name for path in files if path.is_file() and places.search(path.read_bytes())]
    assert naming == []


# ----------------------------------------------------------------------------------- one command

# Stands in for Python: tells its version, makes a .venv with itself inside, logs every call.
FAKE_PYTHON = """#!/bin/sh
echo "$*" >> "{log}"
case "$*" in
    *version_info*) exit {old} ;;
    "-m venv .venv") mkdir -p .venv/bin && cp "$0" .venv/bin/python ;;
esac
"""


def fresh_project(folder: Path, *, is_old: bool) -> tuple[list[str], Path]:
    """Return a make command for a copy of the project whose Python is a stand-in, and its log."""
    shutil.copy(ROOT / "Makefile", folder)
    shutil.copy(ROOT / "pyproject.toml", folder)
    shutil.copytree(ROOT / "requirements", folder / "requirements")
    log, python = folder / "calls.log", folder / "fake-python"
    python.write_text(FAKE_PYTHON.format(log=log, old=int(is_old)))
    python.chmod(0o755)
    # What was said to the make that runs these tests is not for this one.
    command = ["env", "--unset=MAKEFLAGS", "--unset=MAKEOVERRIDES", "--unset=VENV", "make"]
    return [*command, "--directory", str(folder), f"PYTHON={python}", "setup"], log


@needs_make
def test_setting_up_twice_does_nothing_the_second_time(tmp_path: Path) -> None:
    command, log = fresh_project(tmp_path, is_old=False)
    subprocess.run(command, check=True, capture_output=True)
    first = log.read_text()
    assert "--require-hashes --requirement requirements/build.txt" in first
    assert "--editable ." in first
    subprocess.run(command, check=True, capture_output=True)
    assert log.read_text() == first


@needs_make
@pytest.mark.parametrize("changed", ["pyproject.toml", "requirements/dev.txt"])
def test_a_change_of_what_is_needed_sets_up_again(tmp_path: Path, changed: str) -> None:
    command, log = fresh_project(tmp_path, is_old=False)
    subprocess.run(command, check=True, capture_output=True)
    installed = (tmp_path / ".venv/.installed").stat().st_mtime
    os.utime(tmp_path / changed, (installed + 1, installed + 1))
    log.unlink()
    subprocess.run(command, check=True, capture_output=True)
    calls = log.read_text()
    assert "requirements/dev.txt" in calls
    assert "-m venv" not in calls


@needs_make
def test_an_old_python_is_refused_with_the_way_out(tmp_path: Path) -> None:
    command, log = fresh_project(tmp_path, is_old=True)
    result = subprocess.run(command, check=False, capture_output=True, text=True)
    assert result.returncode != 0
    assert "needs Python >= 3.11: make PYTHON=" in result.stderr
    assert not (tmp_path / ".venv").exists()
    assert PROJECT["project"]["requires-python"] == ">=3.11"
    assert "sys.version_info < (3, 11)" in log.read_text()


@needs_make
def test_every_target_that_was_promised_exists() -> None:
    promised = [
        "demo",
        "test",
        "lint",
        "bench",
        "faults",
        "test-gpio",
        "test-firmware",
        "docs",
        "clean",
        "lock",
    ]
    makefile = (ROOT / "Makefile").read_text()
    assert [name for name in promised if f"\n{name}:" not in makefile] == []


def test_ci_runs_lint_and_tests() -> None:
    script = ROOT / ".ci/run"
    assert os.access(script, os.X_OK)
    text = script.read_text()
    # What it does with them: test_ci_run.py.
    for step in (
        "--keep-going lint",
        "test-computing",
        "test-flights",
        "test-wheel",
        "test-firmware",
    ):
        assert f" on_oldest {step}" in text


IMAGE = (ROOT / "Dockerfile").read_text()


def test_image_copies_only_what_exists_and_is_not_ignored() -> None:
    lines = [one.argument for one in instructions(IMAGE) if one.word == "COPY"]
    copied = [name for line in lines if "--from" not in line for name in line.split()[:-1]]
    allowed = re.findall(r"^!(\S+)$", (ROOT / ".dockerignore").read_text(), re.MULTILINE)
    assert {"companion", "examples", "deploy"} <= set(copied)
    assert [name for name in copied if not (ROOT / name).exists()] == []
    assert {name.split("/")[0] for name in copied} == set(allowed)


def test_image_says_what_it_is_and_blueos_can_read_it() -> None:
    said = labels(IMAGE)
    newest = PROJECT["project"]["version"]
    assert said["version"] == said["org.opencontainers.image.version"] == newest
    for name in ("authors", "company", "links", "permissions", "tags"):
        json.loads(said[name])
    assert json.loads(said["permissions"])["HostConfig"]["Binds"] == [
        "/usr/blueos/extensions/vrspray:/data"
    ]


def test_image_can_be_had_for_each_role_and_is_watched() -> None:
    words = [one.word for one in instructions(IMAGE)]
    assert {"HEALTHCHECK", "STOPSIGNAL", "USER", "VOLUME"} <= set(words)
    for role in ("vehicle", "office"):
        assert f"requirements/{role}.txt" in IMAGE
    alive = [one for one in instructions(IMAGE) if "VRSPRAY_ALIVE_FILE" in one.argument]
    assert [one.word for one in alive] == ["ENV", "HEALTHCHECK"]


def test_compose_file_names_commands_that_there_are() -> None:
    text = (ROOT / "deploy/compose.yaml").read_text()
    config = re.search(r"--config=(\S+)", text)
    assert config is not None
    assert (ROOT / config[1]).exists()
    given = re.findall(r"--set=(\S+?)=", text)  # also in quotes
    assert given[:3] == ["link.url", "journal.folder", "link.state_folder"]
    assert given[3:] == ["web.enabled", "web.host", "web.names"]


# ------------------------------------------------------------------------------- nothing is left

LEAKS = {
    "task": "async def test_it():\n    held.append(asyncio.create_task(asyncio.sleep(60)))\n",
    "thread": "def test_it():\n    Thread(target=Event().wait, daemon=True).start()\n",
    "process": "def test_it():\n    held.append(subprocess.Popen(['sleep', '60']))\n",
    "file": "def test_it():\n    one = [open('/dev/null')]\n    one.append(one)\n",
    "child": "def test_it():\n    subprocess.run([sys.executable, '-c', 'open(\"/dev/null\")'])\n",
}
CLEAN = """
async def test_it():
    task = asyncio.create_task(asyncio.sleep(60))
    await asyncio.to_thread(int)
    await (await asyncio.create_subprocess_exec('true')).wait()
    task.cancel()
"""
HEAD = "import asyncio, subprocess, sys\nfrom threading import Event, Thread\nheld = []\n"


def test_a_test_that_leaves_something_running_fails(tmp_path: Path) -> None:
    tests = tmp_path / "tests"
    tests.mkdir()
    shutil.copy(ROOT / "tests/conftest.py", tests)
    shutil.copytree(ROOT / "tests/child_python", tests / "child_python")
    (tests / "pytest.ini").write_text(
        "[pytest]\nasyncio_mode = auto\nfilterwarnings = error\n"
        "asyncio_default_fixture_loop_scope = function\n"
    )
    for name, body in {**LEAKS, "clean": CLEAN}.items():
        (tests / f"test_{name}.py").write_text(HEAD + body.replace("test_it", f"test_{name}"))
    # A grace of 2 s for a thread that never ends would be the whole time of this test.
    conftest = tests / "conftest.py"
    conftest.write_text(conftest.read_text().replace("GRACE_S = 2.0", "GRACE_S = 0.05"))
    command = [sys.executable, "-m", "pytest", "-q", "-rA", "-p", "no:cacheprovider", str(tests)]
    # What it leaves open is meant to be left.
    environment = {key: text for key, text in os.environ.items() if key != "VRSPRAY_LEFT_OPEN"}
    result = subprocess.run(
        command, check=False, capture_output=True, text=True, cwd=tmp_path, env=environment
    )
    errors = re.findall(r"^ERROR .*::test_(\w+)", result.stdout, re.MULTILINE)
    assert sorted(errors) == sorted(LEAKS), json.dumps(result.stdout)
