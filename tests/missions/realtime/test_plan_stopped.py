"""Ctrl-C while a plan is searched: the process itself, on a terminal of its own."""

from __future__ import annotations

import json
import os
import pty
import re
import signal
import subprocess
import sys
import termios
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import shapely
from shapely import box

from tests.mission_fields import degrees

# Longer than any test waits.
SEARCH = ("--effort", "best")
RUN = "import sys; from companion.cli import app; sys.exit(app.execute(sys.argv[1:]))"


@contextmanager
def planning(folder: Path, *more: str) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """Start the command; yield it with the terminal that its stderr is."""
    field = folder / "field.geojson"
    field.write_text(shapely.to_geojson(degrees(box(0.0, 0.0, 400.0, 300.0))), encoding="utf-8")
    terminal, line = pty.openpty()
    termios.tcsetwinsize(line, (24, 120))
    # Not by the entry that gives way to a flight on this computer.
    command = [sys.executable, "-c", RUN, "plan", str(field)]
    given = ["--swath-m", "6", "--speed-m-s", "6", "--rate-l-ha", "20", *more]
    with (folder / "told.json").open("wb") as told:
        process = subprocess.Popen(
            [*command, *given, "--out", str(folder / "out.geojson"), "--json"],
            stdin=subprocess.DEVNULL, stdout=told, stderr=line,
            env=os.environ | {"TERM": "xterm", "PYTHONDEVMODE": ""},
        )  # fmt: skip
    os.close(line)
    try:
        yield process, terminal
    finally:
        process.kill()
        process.wait()
        os.close(terminal)


def said_until(terminal: int, *texts: bytes) -> bytes:
    """Return what the terminal shows up to one of some texts, or to the end."""
    said = b""
    while not any(text in said for text in texts):
        try:
            some = os.read(terminal, 4096)
        except OSError:  # the other side is closed
            break
        if not some:
            break
        said += some
    return said


@pytest.mark.timeout(120)
def test_ctrl_c_ends_the_search_and_the_best_plan_so_far_is_written(tmp_path: Path) -> None:
    with planning(tmp_path, *SEARCH) as (process, terminal):
        # The bar, above 2 s: a quick computer is at the sorties by then. Lines there are with both.
        shown = said_until(terminal, b"ways between lines", b"sorties")
        assert b"ways between lines" in shown or b"sorties" in shown, shown
        process.send_signal(signal.SIGINT)
        rest = said_until(terminal, b"is written")
        assert process.wait() == 0
    told = json.loads((tmp_path / "told.json").read_text(encoding="utf-8"))
    assert told["stopped"] is True
    assert told["coverage_percent"] > 99.8
    assert re.search(r"stopped after \d+ s; wrote the best plan so far", rest.decode())
    written = json.loads((tmp_path / "out.geojson").read_text(encoding="utf-8"))
    assert {each["properties"]["kind"] for each in written["features"]} >= {"spray", "ferry"}
