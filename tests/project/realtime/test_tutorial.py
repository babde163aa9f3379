"""Every command of docs/tutorial.md, typed as it stands, in its order, in an empty folder.

A fence of class `sh` is typed. `fails` must be refused (exit 2), `differs` may find a difference
(exit 0 or 1); `terminal-1` goes on beside the others, `terminal-2` until the first one has ended.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.companion.wire_peer import free_port

ROOT = Path(__file__).resolve().parents[3]
PAGE = ROOT / "docs" / "tutorial.md"
FENCE = re.compile(r"^```(?:sh| \{ \.sh \.(?P<kind>[\w-]+) \})\n(?P<text>.*?)^```$", re.M | re.S)
EXITS: dict[str, tuple[int, ...]] = {"": (0,), "fails": (2,), "differs": (0, 1)}
FLIGHT_MAX_S = 300.0
pytestmark = [pytest.mark.sitl, pytest.mark.timeout(900)]


class Typist:
    """Types into a shell, and goes where the shell has gone."""

    def __init__(self, folder: Path, port: int) -> None:
        self.folder, self.port = folder, port
        self._gone = folder.parent / "gone"
        bin_folder = Path(sys.executable).parent
        path = f"{bin_folder}{os.pathsep}{os.environ['PATH']}"
        self._environment = os.environ | {"PATH": path, "TYPED_PWD": str(self._gone)}

    def _words(self, text: str) -> list[str]:
        # Two flights on one computer would meet on the port of the page.
        text = text.replace("127.0.0.1:14550", f"127.0.0.1:{self.port}")
        text = text.replace("sitl serve ", f"sitl serve --link udpout:127.0.0.1:{self.port} ")
        return ["bash", "-c", text]

    def type(self, text: str) -> subprocess.CompletedProcess[str]:
        """Type commands, and wait for their end."""
        words = self._words(f"trap 'pwd > \"$TYPED_PWD\"' EXIT\nset -e\n{text}")
        ended = subprocess.run(
            words,
            cwd=self.folder,
            env=self._environment,
            capture_output=True,
            text=True,
            check=False,
            stdin=subprocess.DEVNULL,
        )
        self.folder = Path(self._gone.read_text().strip())
        return ended

    @contextmanager
    def beside(self, text: str) -> Iterator[subprocess.Popen[str]]:
        """Start one command that goes on; it has ended when the block has."""
        process = subprocess.Popen(
            self._words(f"exec {text}"),
            cwd=self.folder,
            env=self._environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            stdin=subprocess.DEVNULL,
        )
        with process:
            try:
                yield process
            finally:
                process.kill()


def blocks() -> list[tuple[str, str]]:
    """Return kind and text of every block that is typed."""
    found = FENCE.finditer(PAGE.read_text(encoding="utf-8"))
    return [(match["kind"] or "", match["text"]) for match in found]


def test_every_command_of_the_tutorial_does_what_it_says(tmp_path: Path) -> None:
    folder = tmp_path / "somewhere"
    folder.mkdir()
    typist = Typist(folder, free_port())
    todo = iter(blocks())
    for kind, text in todo:
        if kind == "terminal-1":
            _fly(typist, text, todo)
            continue
        ended = typist.type(text)
        assert ended.returncode in EXITS[kind], f"{text}\n{ended.stdout}{ended.stderr}"
        _is_as_shown(text, ended.stdout + ended.stderr)
        if "config new" in text:
            config = typist.folder / "config.toml"
            config.write_text(config.read_text().replace(":14550", f":{typist.port}"))
    assert list(folder.iterdir()) == []  # the last block removes all that was made


def _fly(typist: Typist, serve: str, todo: Iterator[tuple[str, str]]) -> None:
    with typist.beside(serve) as vehicle:
        for kind, text in todo:
            if kind != "terminal-2":
                ended = typist.type(text)
                assert ended.returncode == 0, f"{text}\n{ended.stdout}{ended.stderr}"
                continue
            with typist.beside(text) as companion:
                said, _ = vehicle.communicate(timeout=FLIGHT_MAX_S)
                assert vehicle.returncode == 0, said
                companion.send_signal(signal.SIGINT)
                told, _ = companion.communicate(timeout=30.0)
                assert "flight-0001.gpkg" in told, told
            return


def _is_as_shown(text: str, said: str) -> None:
    """Assert that what the page shows below a block is what was printed."""
    page = PAGE.read_text(encoding="utf-8")
    after = page[page.index(text) + len(text) + len("```") :]
    shown = re.match(r"\s*(?:(?!```)[^#\n][^\n]*\n+)*?```text\n(.*?)```", after, re.DOTALL)
    if shown is None or "sh" in after[: shown.start(1)].split("```")[0].split():
        return
    if "demo" in text:
        assert re.search(r"0\.0[45]\d m \(worst 0\.1\d m\)", said), said
        return
    assert shown[1].strip() in said, said


def test_the_tutorial_is_short_and_types_all_it_shows() -> None:
    words = len(PAGE.read_text(encoding="utf-8").split())
    assert words <= 2_500
    fences = re.findall(r"^```(\S.*|\s\{.*)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert {fence.strip() for fence in fences} <= {
        "sh", "text", "{ .sh .fails }", "{ .sh .differs }", "{ .sh .terminal-1 }",
        "{ .sh .terminal-2 }",
    }  # fmt: skip
