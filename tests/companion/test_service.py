"""`vrspray service`: what is written, what systemd is asked, what is left alone."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from companion.cli.app import execute
from companion.cli.service import make_folders
from companion.cli.systemd import ServiceError, typed

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "anyang"
Captured = pytest.CaptureFixture[str]


@dataclass
class FakeSystemd:
    """A `systemctl` on the path, which notes what it is asked."""

    folder: Path
    unit: Path

    def answers(self, text: str = "", *, code: int = 0, error: str = "") -> None:
        script = self.folder / "systemctl"
        script.write_text(
            f'#!/bin/sh\necho "$@" >> {self.folder}/calls\nprintf "{text}"\n'
            f'printf "{error}" >&2\nexit {code}\n'
        )
        script.chmod(0o755)

    @property
    def calls(self) -> list[str]:
        file = self.folder / "calls"
        return file.read_text().splitlines() if file.exists() else []


@pytest.fixture
def systemd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeSystemd:
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", f"{folder}:/bin:/usr/bin")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "xdg"))
    fake = FakeSystemd(folder, tmp_path / "xdg" / "systemd" / "user" / "vrspray.service")
    fake.answers()
    return fake


@pytest.fixture
def config(tmp_path: Path) -> Path:
    folder = tmp_path / "field"
    shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("flights", "state"))
    return folder / "config.toml"


def called(capsys: Captured, *arguments: str) -> tuple[int, dict[str, Any]]:
    code = execute(["service", *arguments, "--json"])
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return code, found


def test_install_writes_enables_and_makes_the_folders(
    systemd: FakeSystemd, config: Path, capsys: Captured
) -> None:
    code, found = called(capsys, "install", "--user", "--config", str(config))
    assert (code, found["ok"], found["unit"]) == (0, True, str(systemd.unit))
    assert f"run --config {config}" in systemd.unit.read_text()
    assert systemd.calls == ["--user daemon-reload", "--user enable vrspray.service"]
    assert (config.parent / "flights").is_dir()
    assert (config.parent / "state").is_dir()


def test_install_again_replaces_its_own_unit(
    systemd: FakeSystemd, config: Path, capsys: Captured
) -> None:
    for _ in range(2):
        code, _found = called(capsys, "install", "--user", "--config", str(config))
        assert code == 0
    assert not list(systemd.unit.parent.glob("*.part"))


def test_a_dry_run_prints_the_unit_and_changes_nothing(
    systemd: FakeSystemd, config: Path, capsys: Captured
) -> None:
    arguments = ["service", "install", "--user", "--dry-run", "--config", str(config)]
    assert execute(arguments) == 0
    assert capsys.readouterr().out.startswith("# Written by `vrspray service install`")
    assert not systemd.unit.exists()
    assert not (config.parent / "flights").exists()
    assert systemd.calls == []


@pytest.mark.parametrize("action", ["install", "uninstall"])
def test_a_unit_of_somebody_else_is_left_alone(
    action: str, systemd: FakeSystemd, config: Path, capsys: Captured
) -> None:
    systemd.unit.parent.mkdir(parents=True)
    systemd.unit.write_text("[Service]\nExecStart=/bin/true\n")
    more = ["--config", str(config)] if action == "install" else []
    code, found = called(capsys, action, "--user", *more)
    assert code == 2
    assert "move it away first" in found["error"]
    assert systemd.unit.read_text() == "[Service]\nExecStart=/bin/true\n"
    assert systemd.calls == []


def test_a_systemd_that_refuses_is_exit_1_and_says_why(
    systemd: FakeSystemd, config: Path, capsys: Captured
) -> None:
    systemd.answers(code=1, error="Failed to connect to bus")
    code, found = called(capsys, "install", "--user", "--config", str(config))
    assert (code, found["ok"]) == (1, False)
    assert found["problem"] == "systemctl daemon-reload: Failed to connect to bus"


def test_a_configuration_that_is_refused_installs_nothing(
    systemd: FakeSystemd, config: Path, capsys: Captured
) -> None:
    config.write_text(config.read_text().replace("version = 1", "version = 2"))
    code, _found = called(capsys, "install", "--user", "--config", str(config))
    assert code == 2
    assert not systemd.unit.exists()


def test_a_folder_that_cannot_be_written_is_one_line(
    systemd: FakeSystemd, config: Path, capsys: Captured
) -> None:
    systemd.unit.parents[2].write_text("a file where a folder should be")
    code, found = called(capsys, "install", "--user", "--config", str(config))
    assert code == 2
    assert "\n" not in found["error"]


def test_uninstall_stops_and_removes(systemd: FakeSystemd, config: Path, capsys: Captured) -> None:
    called(capsys, "install", "--user", "--config", str(config))
    code, found = called(capsys, "uninstall", "--user")
    assert (code, found["removed"], systemd.unit.exists()) == (0, True, False)
    assert systemd.calls[-2:] == ["--user disable --now vrspray.service", "--user daemon-reload"]
    code, found = called(capsys, "uninstall", "--user")
    assert (code, found["removed"]) == (0, False)


RUNNING = "LoadState=loaded UnitFileState=enabled ActiveState=active SubState=running NRestarts=3"


@pytest.mark.parametrize(
    ("said", "code", "expected"),
    [
        (RUNNING, 0, {"enabled": True, "active": "active", "restarts": 3}),
        (
            "LoadState=not-found UnitFileState= ActiveState=inactive",
            1,
            {"enabled": False, "active": "inactive", "restarts": None},
        ),
    ],
)
def test_status(
    said: str, code: int, expected: dict[str, Any], systemd: FakeSystemd, capsys: Captured
) -> None:
    systemd.answers(said)
    left, found = called(capsys, "status", "--user")
    assert left == code
    assert expected.items() <= found.items()
    assert found["ok"] is (code == 0)


def test_status_without_systemd_is_unknown(systemd: FakeSystemd, capsys: Captured) -> None:
    systemd.answers(code=1, error="Failed to connect to bus")
    code, found = called(capsys, "status", "--user")
    assert (code, found["active"], found["installed"]) == (1, None, False)


def test_a_folder_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ServiceError, match="cannot be made"):
        make_folders((str(tmp_path / "file" / "flights"),), account="")


def test_the_line_to_type_names_the_program_by_its_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["/opt/a b/bin/vrspray", "service", "install"])
    assert typed() == "'/opt/a b/bin/vrspray' service install"
    monkeypatch.setattr("sys.argv", ["/src/companion/__main__.py", "service", "install"])
    assert typed().endswith(" -m companion service install")
