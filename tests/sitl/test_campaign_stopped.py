"""A campaign that is interrupted keeps what was flown, says so in one line, and goes on."""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from companion.cli.app import execute
from sitl.campaign import cli
from sitl.campaign.bundle import Bundle, unpack
from sitl.campaign.dataset import read_columns
from tests.sitl.campaign_files import OwnProcess, write_campaign

# The end of the mission, and a place on the way to it.
SHORTER = ("35.9963478\t114.5435887", "35.9961495\t114.5435369")


class Interrupted(OwnProcess):
    """Flies in this process until somebody presses Ctrl-C."""

    left = 14

    def submit(self, function: Any, *given: Any) -> Future[Any]:
        if not self.left:
            raise KeyboardInterrupt
        self.left -= 1
        return super().submit(function, *given)


def test_what_was_flown_is_kept_and_the_same_command_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = write_campaign(tmp_path, "seeds = 24\n"), tmp_path / "out"
    # A few metres are a flight, too.
    mission = tmp_path / "field" / "short.waypoints"
    mission.write_text(mission.read_text().replace(*SHORTER))
    kinds = [Interrupted, OwnProcess]

    @contextmanager
    def workers(count: int | None, cluster: str | None, bundle: Bundle) -> Iterator[OwnProcess]:
        yield kinds.pop(0)(unpack(bundle, tmp_path / "bundle"))

    monkeypatch.setattr(cli, "_workers", workers)
    assert execute(["campaign", str(file), "--out", str(out)]) == 130
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.strip() == (
        f"interrupted: 10 of 24 flights are kept in {out}; run the same command again to continue"
    )
    assert execute(["campaign", str(file), "--out", str(out)]) == 0
    assert "10 of 24 flights are there already" in capsys.readouterr().err
    assert read_columns(out, ["seed"])["seed"].to_pylist() == list(range(1, 25))
    first, second = map(json.loads, (out / "log.jsonl").read_text().splitlines())
    assert (first["flown"], second["flown"]) == (14, 14)
    assert first["wall_s"] > 0.0 and first["own_cpu_s"] > 0.0
    assert execute(["campaign", str(file), "--out", str(out)]) == 0
    assert "all 24 flights are there already" in capsys.readouterr().out
