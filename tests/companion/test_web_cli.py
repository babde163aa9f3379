"""The page on the command line: its links, and what is refused before anything flies."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from companion.cli.app import execute

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "anyang" / "config.toml"


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "config.toml"
    path.write_text(EXAMPLE.read_text().replace("[output]", "[web]\nenabled = true\n\n[output]"))
    for file in EXAMPLE.parent.glob("prescription.*"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / "boundary.geojson").write_bytes((EXAMPLE.parent / "boundary.geojson").read_bytes())
    return path


def test_links_are_shown_again_and_made_anew(
    config: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lan = ("--config", str(config), "--set", "web.host=192.0.2.7")
    assert execute(["token", "show", *lan, "--json"]) == 0
    first = json.loads(capsys.readouterr().out)
    assert execute(["token", "show", *lan]) == 0
    shown = capsys.readouterr().out
    assert f"http://192.0.2.7:8880/#token={first['operate']}" in shown
    assert f"http://192.0.2.7:8880/#token={first['view']}" in shown
    assert "\u2580" in shown  # the QR code
    assert execute(["token", "rotate", *lan, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) != first


def test_without_the_libraries_the_command_that_adds_them_is_said(config: Path) -> None:
    hidden = (
        "import sys, importlib.util as u; real = u.find_spec\n"
        "u.find_spec = lambda name, *a: None if name == 'fastapi' else real(name, *a)\n"
        "from companion.cli.app import execute\n"
        f"sys.exit(execute(['run', '--config', {str(config)!r}, '--duration-s', '1']))"
    )
    done = subprocess.run([sys.executable, "-c", hidden], capture_output=True, text=True)
    assert done.returncode == 2
    assert "web.enabled: the library fastapi is not installed" in done.stderr
    assert "vrspray[vehicle]" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("web.tls_key=key.pem", "web.tls_certificate and web.tls_key go together"),
        ("web.host=203.0.113.9", "cannot listen on 203.0.113.9 port 8880"),
        ("web.port=70000", "web.port"),
    ],
)
def test_what_cannot_be_served_is_refused_in_one_line(
    config: Path, override: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code = execute(["run", "--config", str(config), "--set", override, "--duration-s", "1"])
    assert code == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert said in last
