from __future__ import annotations

import json
from pathlib import Path

import pytest

from companion.cli.app import execute
from companion.config import load
from companion.config.limits import read_limits
from sitl.campaign.design import read_campaign
from sitl.examples_cli import ABOUT, DEPLOY, all_examples

ROOT = Path(__file__).resolve().parents[2]
Captured = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_every_folder_of_examples_is_listed(capsys: Captured) -> None:
    folders = {path.name for path in (ROOT / "examples").iterdir() if path.is_dir()}
    assert folders == set(ABOUT) - {DEPLOY}
    assert execute(["examples", "list", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)["examples"]
    assert [each["name"] for each in listed] == list(ABOUT)
    assert execute(["examples", "list"]) == 0
    assert capsys.readouterr().out.count("\n") == len(ABOUT)


@pytest.mark.parametrize("name", [name for name in ABOUT if name != DEPLOY])
def test_a_copied_example_has_all_that_its_configurations_name(
    name: str, tmp_path: Path, capsys: Captured
) -> None:
    assert execute(["examples", "copy", name, "--to", "mine"]) == 0
    capsys.readouterr()
    folder = tmp_path / "mine" / name
    theirs = {
        path.relative_to(ROOT / "examples" / name) for path in _files(ROOT / "examples" / name)
    }
    assert {path.relative_to(folder) for path in _files(folder)} == theirs
    for path in folder.glob("*.toml"):
        if name == "campaigns":
            assert read_campaign(path).flights > 1
            continue
        if path.name == "limits.toml":
            assert read_limits(path, "limits.toml").buffers("limits.toml")
            continue
        config = load(path)
        assert config.prescription is not None
        if name == "zones":  # whose script and `make zones` write what it names
            continue
        assert (path.parent / config.prescription.file).resolve().exists()


def _files(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file() and path.suffix != ".pyc"]


def test_without_a_folder_the_commands_of_the_documents_work(
    tmp_path: Path, capsys: Captured
) -> None:
    assert execute(["examples", "copy", "pump"]) == 0
    assert capsys.readouterr().out == (
        f"examples/pump: {len(_files(tmp_path))} files, with anyang beside it\n"
        "check it: vrspray config check examples/pump/config.toml\n"
    )
    assert execute(["config", "check", "examples/pump/config.toml"]) == 0
    assert execute(["examples", "copy", DEPLOY]) == 0
    script = Path("deploy/ardupilot/vrspray_watchdog.lua")
    assert script.read_bytes() == (ROOT / script).read_bytes()


def test_what_is_there_is_not_written_over_unless_forced(capsys: Captured) -> None:
    assert execute(["examples", "copy", "pump"]) == 0
    mine, field = Path("examples/pump/config.toml"), Path("examples/anyang/config.toml")
    mine.write_text("mine")
    field.write_text("mine")
    capsys.readouterr()
    assert execute(["examples", "copy", "pump"]) == 2
    refused = capsys.readouterr().err
    assert refused.count("\n") == 1
    assert "examples/pump: is there already; --force" in refused
    assert mine.read_text() == "mine"
    assert execute(["examples", "copy", "orchard"]) == 0
    assert field.read_text() == "mine"
    assert execute(["examples", "copy", "pump", "--force"]) == 0
    assert "mine" not in (mine.read_text(), field.read_text())


def test_an_unknown_name_and_a_folder_that_cannot_be_written_are_one_line(
    capsys: Captured,
) -> None:
    assert execute(["examples", "copy", "field"]) == 2
    assert "no example is called 'field'; one of: anyang, orchard" in capsys.readouterr().err
    Path("file").touch()
    assert execute(["examples", "copy", "pump", "--to", "file"]) == 2
    refused = capsys.readouterr().err
    assert refused.count("\n") == 1
    assert "cannot be written (Not a directory)" in refused


def test_all_are_found_in_the_package() -> None:
    assert all(
        each.folder.is_dir() and list(each.folder.iterdir()) for each in all_examples().values()
    )
