"""docs/ardupilot.md beside a real ArduCopter: its commands, typed as they stand there."""

from __future__ import annotations

import asyncio
import re
import shlex
import subprocess
from collections.abc import Iterator
from contextlib import AsyncExitStack, contextmanager
from functools import partial
from pathlib import Path

import pytest

from tests.firmware.fields import copy_example
from tests.firmware.firmware import ROOT, WATCHDOG, companion, process
from tests.sitl.other_clients import Console, mavproxy, needs_mavproxy

pytestmark = [pytest.mark.firmware, needs_mavproxy, pytest.mark.timeout(300)]

PAGE = ROOT / "docs" / "ardupilot.md"
SECTION = "## ArduCopter's own simulation"
WAIT = "# wait for: "


def blocks() -> list[tuple[str, list[str]]]:
    """Return the section's blocks: where they are typed, and their lines."""
    section = PAGE.read_text().split(SECTION)[1]
    found = re.findall(r"^```(\w+)\n(.*?)^```$", section, re.MULTILINE | re.DOTALL)
    return [(kind, text.splitlines()) for kind, text in found]


class Typist:
    """Types blocks into MAVProxy; what is waited for comes after the line before it."""

    def __init__(self, shown: Console) -> None:
        self._shown, self._since = shown, 0

    def _has(self, text: str) -> bool:
        return text in self._shown.said[self._since :]

    async def types(self, lines: list[str]) -> None:
        """Type lines, one after the answer to the other."""
        for line in lines:
            if line.startswith(WAIT):
                has = partial(self._has, line.removeprefix(WAIT))
                await self._shown.until(has, within_s=90.0)
            else:
                self._since = len(self._shown.said)
                self._shown.type(line)
                await self._shown.until(partial(self._has, "\n"))


def is_spraying(said: str) -> bool:
    """Whether the last outputs that MAVProxy showed open all six valves."""
    outputs = said.rsplit("SERVO_OUTPUT_RAW {", 1)[-1]
    pulses = [int(us) for us in re.findall(r"servo(?:9|1[0-4])_raw : (\d+)", outputs)]
    return len(pulses) == 6 and all(1010 < us <= 2000 for us in pulses)


@contextmanager
def docs_copter(firmwares: Path, folder: Path, home: str) -> Iterator[None]:
    """ArduCopter as `sim_vehicle.py` starts it, with the script where the page puts it."""
    (folder / "scripts").mkdir(parents=True)
    (folder / "scripts" / WATCHDOG.name).write_bytes(WATCHDOG.read_bytes())
    with process((firmwares / "arducopter.sh", folder, home), folder / "arducopter.txt"):
        yield


async def test_the_commands_of_the_page_fly_and_spray(firmwares: Path, tmp_path: Path) -> None:
    here = tmp_path / "here"
    copy_example(here / "examples" / "anyang")
    (_, simulation), (_, setting), (_, run), (_, flying), (_, killed) = blocks()
    home = simulation[0].split("--custom-location=")[1].strip()
    (command,) = run
    words = shlex.split(command)
    assert words[:2] == ["vrspray", "run"]
    async with AsyncExitStack() as stack:
        stack.enter_context(docs_copter(firmwares, tmp_path / "copter", home))
        shown = await stack.enter_async_context(mavproxy("tcp:127.0.0.1:5760", here))
        typist = Typist(shown)
        await typist.types(setting)
        started: subprocess.Popen[bytes] = stack.enter_context(
            companion(here, *words[2:], within=here)
        )
        await typist.types(flying)
        async with asyncio.timeout(60.0):
            while not is_spraying(shown.said):
                await typist.types(flying[-1:])
        started.kill()
        started.wait()
        await typist.types(killed)
    said = (here / "companion.txt").read_text()
    assert "vehicle: system 1, ardupilot" in said
