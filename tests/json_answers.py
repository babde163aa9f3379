"""Commands of the program as a script calls them: with --json, on the example of a field."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from companion.cli.app import execute

FOLDER = Path(__file__).resolve().parents[1] / "examples" / "anyang"
CONFIG = str(FOLDER / "config.toml")
MAP = str(FOLDER / "prescription.shp")

Captured = pytest.CaptureFixture[str]


def run_json(capsys: Captured, *arguments: str) -> tuple[int, dict[str, Any]]:
    """Run with --json and insist on exactly one object on stdout."""
    code = execute([*arguments, "--json"])
    found = json.loads(capsys.readouterr().out)
    assert isinstance(found, dict)
    return code, found
