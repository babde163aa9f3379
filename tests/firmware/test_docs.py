"""Pages of the firmwares' own simulations: their commands, typed as they stand.

ArduCopter's into MAVProxy, PX4's into its own shell and into MAVProxy.
"""

from __future__ import annotations

import asyncio
import os
import re
import shlex
import subprocess
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from functools import partial
from pathlib import Path

import pytest

from tests.companion.realtime.other_clients import Console, mavproxy, needs_mavproxy
from tests.firmware.fields import copy_example
from tests.firmware.firmware import ROOT, WATCHDOG, companion, process, vrspray, with_links

pytestmark = [pytest.mark.firmware, needs_mavproxy, pytest.mark.timeout(300)]

WAIT = "# wait for: "
ENDED_WITHIN_S = 10.0


def blocks(page: str, section: str) -> list[tuple[str, list[str]]]:
    """Return a section's blocks: where they are typed, and their lines."""
    section = (ROOT / "docs" / "howto" / page).read_text().split(f"## {section}\n")[1]
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


def pulses_us(said: str) -> list[int]:
    """Return the last outputs 9 to 14 that MAVProxy showed."""
    outputs = said.rsplit("SERVO_OUTPUT_RAW {", 1)[-1]
    return [int(us) for us in re.findall(r"servo(?:9|1[0-4])_raw : (\d+)", outputs)]


def is_spraying(said: str) -> bool:
    """Whether they open all six valves."""
    found = pulses_us(said)
    return len(found) == 6 and all(1010 < us <= 2000 for us in found)


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
    section = blocks("simulate-arducopter.md", "ArduCopter's own simulation")
    (_, simulation), (_, setting), (_, run), (_, flying), (_, killed) = section
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


@asynccontextmanager
async def pxh(
    firmwares: Path, folder: Path, variables: Mapping[str, str]
) -> AsyncIterator[Console]:
    """PX4 as its `make` starts it, with its shell on a pipe."""
    started = with_links(firmwares, folder / "firmware") / "px4"
    pipe = asyncio.subprocess.PIPE
    process = await asyncio.create_subprocess_exec(
        *(started / "bin" / "px4", started / "etc", "-w", folder),
        stdin=pipe,
        stdout=pipe,
        stderr=asyncio.subprocess.STDOUT,
        cwd=folder,
        env={**os.environ, **variables},
    )
    console = Console(process)
    reading = asyncio.create_task(console.read())
    try:
        yield console
    finally:
        if process.returncode is None:
            process.terminate()
        try:
            await asyncio.wait_for(process.wait(), ENDED_WITHIN_S)
        except TimeoutError:
            process.kill()
            await process.wait()
        await reading
        (folder / "px4.txt").write_text(console.said)


async def test_the_commands_of_px4s_page_fly_and_spray(firmwares: Path, tmp_path: Path) -> None:
    here = tmp_path / "here"
    copy_example(here / "examples" / "anyang")
    section = blocks("simulate-px4.md", "PX4's own simulation")
    shells = ["sh", "pxh", "sh", "sh", "pxh", "sh", "mavproxy", "pxh", "mavproxy"]
    assert [kind for kind, _ in section] == shells
    simulation, setting, upload, run, arming, station, enabling, landing, again = (
        lines for _, lines in section
    )
    *given, make, target, model = shlex.split(simulation[0])
    assert (make, target) == ("make", "px4_sitl")
    variables = dict(one.split("=") for one in given) | {"PX4_SIM_MODEL": model}
    (tmp_path / "px4").mkdir()
    async with AsyncExitStack() as stack:
        shell = await stack.enter_async_context(pxh(firmwares, tmp_path / "px4", variables))
        at_shell = Typist(shell)
        await at_shell.types(setting)
        words = shlex.split(upload[0])
        done = await asyncio.to_thread(partial(vrspray, *words[1:], within=here))
        assert (words[0], done.returncode) == ("vrspray", 0), done.stderr
        words = shlex.split(run[0])
        assert words[:2] == ["vrspray", "run"]
        started: subprocess.Popen[bytes] = stack.enter_context(
            companion(here, *words[2:], within=here)
        )
        await at_shell.types(arming)
        program, master = shlex.split(station[0])
        assert program == "mavproxy.py"
        shown = await stack.enter_async_context(mavproxy(master.removeprefix("--master="), here))
        typist = Typist(shown)
        await typist.types(enabling)
        async with asyncio.timeout(60.0):
            while not is_spraying(shown.said):
                await typist.types(enabling[-1:])
        started.kill()
        started.wait()
        await typist.types(enabling[-1:])
        assert is_spraying(shown.said)  # as the page says
        await at_shell.types(landing)
        async with asyncio.timeout(10.0):
            while pulses_us(shown.said) != [900] * 6:
                await typist.types(enabling[-1:])
        await typist.types(again)
    said = (here / "companion.txt").read_text()
    assert "vehicle: system 1, px4" in said
