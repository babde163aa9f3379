"""One flight: the real companion is started, sprays, and something goes wrong."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from tests.bench.faults.cases import Draw, Kind
from tests.bench.faults.chip import Chip
from tests.bench.faults.ending import clear_away, finish
from tests.bench.faults.launcher import companion_command
from tests.bench.faults.levels import behind_monostable, levels_of, openings_of
from tests.bench.faults.place import CHANNELS, SPEED_M_S, settings, write_files
from tests.bench.faults.record import Opening, Record, Struck
from tests.bench.faults.strike import strike
from tests.bench.faults.vehicle import Vehicle

START_MAX_S = 40.0
SETTLE_S = 0.3
COMPANION_NICE = 0


# What the engine's test of itself says on a computer that is too busy for valves.
BUSY = "wakes up "


class NotFlownError(Exception):
    """The flight did not come so far that anything could go wrong in it."""

    @property
    def is_busy(self) -> bool:
        """Whether the computer was too busy to fly: no fault of what flies."""
        return BUSY in str(self)


@dataclass(slots=True)
class Flight:
    """What is under way; `deaths` is when a process was seen to be dead."""

    draw: Draw
    vehicle: Vehicle
    chip: Chip
    process: asyncio.subprocess.Process
    deaths: dict[int, float] = field(default_factory=dict)
    struck: list[Struck] = field(default_factory=list)
    watched: dict[int, int] = field(default_factory=dict)

    @property
    def pid(self) -> int:
        """Return the companion's process id."""
        return self.process.pid

    @property
    def engine_pid(self) -> int | None:
        """Return the engine's process id, once it has the lines."""
        return next((row.pid for row in self.chip.rows() if row.pid != self.pid), None)

    def watch(self, pid: int) -> None:
        """Have the death of a process noticed: the kernel has let go of its files by then."""
        file = os.pidfd_open(pid)
        self.watched[pid] = file
        asyncio.get_running_loop().add_reader(file, self._died, pid)

    def _died(self, pid: int) -> None:
        self.deaths[pid] = time.monotonic()
        self.let_go(pid)

    def let_go(self, pid: int) -> None:
        """Watch a process no longer."""
        file = self.watched.pop(pid, None)
        if file is not None:
            asyncio.get_running_loop().remove_reader(file)
            os.close(file)

    def send(self, pid: int, number: signal.Signals) -> None:
        """Send a signal and note it."""
        self.struck.append(Struck(time.monotonic(), f"{number.name} {pid}"))
        os.kill(pid, number)


async def fly(draw: Draw) -> Record:
    """Fly once; NotFlownError if it did not come to spraying."""
    with _folder(draw) as folder:
        config = write_files(folder, draw.field_m(SPEED_M_S))
        output = draw.case.output
        async with Vehicle(output, draw.case.link, seed=draw.seed) as vehicle:
            arguments = ["run", "--json", "--config", str(config)]
            for setting in settings(output, vehicle.url):
                arguments += ["--set", setting]
            command: tuple[str, ...] = (sys.executable, "-m", "companion", *arguments)
            if output == "gpio":
                command = companion_command(folder, arguments)
            process = await asyncio.create_subprocess_exec(
                *command,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.PIPE,
                stderr=asyncio.subprocess.PIPE,
            )
            with suppress(PermissionError, ProcessLookupError):
                # Whatever we run with; its engine is started later.
                os.setpriority(os.PRIO_PROCESS, process.pid, COMPANION_NICE)
            flight = Flight(draw, vehicle, Chip(folder), process)
            said = asyncio.create_task(process.communicate())
            try:
                return await _fly(flight, said)
            finally:
                await clear_away(flight, said)


@contextmanager
def _folder(draw: Draw) -> Iterator[Path]:
    folder = Path(tempfile.mkdtemp(prefix=f"faults-{draw.number}-"))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


async def _fly(flight: Flight, said: asyncio.Task[tuple[bytes, bytes]]) -> Record:
    draw, vehicle = flight.draw, flight.vehicle
    await _until(flight, said, lambda: _is_ready(flight))
    flight.watch(flight.pid)
    if flight.engine_pid is not None:
        flight.watch(flight.engine_pid)
    await asyncio.sleep(SETTLE_S)
    vehicle.go()
    enabled_s = time.monotonic()
    vehicle.enable(True)
    at_s = vehicle.path.reaches_s(0.0) + draw.after_s
    await asyncio.sleep(max(at_s - time.monotonic(), 0.0))
    now_s = time.monotonic()
    before = _openings(flight, now_s)[1]
    if not any(one.to_s > at_s - draw.after_s for one in before):
        raise NotFlownError(f"it did not spray{_last_words(vehicle)}")
    ticks = len(vehicle.late_s)
    waited_s = _waited_s(flight.pid)
    fault_s = time.monotonic()
    await strike(flight)
    await asyncio.sleep(max(fault_s + draw.watched_s - time.monotonic(), 0.0))
    until_s = time.monotonic()
    waited_s = max(_waited_s(flight.pid) - waited_s, 0.0)
    # Later orders are of the ending of the flight, and no fault's.
    effective, own = _openings(flight, until_s)
    ending = await finish(flight, said)
    return Record(
        draw=draw,
        path=vehicle.path,
        enabled_s=enabled_s,
        fault_s=fault_s,
        until_s=until_s,
        sent=tuple(vehicle.wire.sent),
        struck=tuple(flight.struck),
        openings=tuple(effective),
        own=tuple(own),
        late_s=max(vehicle.late_s[ticks:], default=0.0),
        waited_s=waited_s,
        exit_code=ending.exit_code,
        ended_s=ending.ended_s,
        lost_rows=ending.lost_rows,
        errors=ending.errors,
        engine_left=ending.engine_left,
    )


def _waited_s(pid: int) -> float:
    """Return how long the control loop has waited for a core so far; 0 once it is dead."""
    try:
        return int(Path(f"/proc/{pid}/schedstat").read_text().split()[1]) * 1e-9
    except (OSError, IndexError):
        return 0.0


def _is_ready(flight: Flight) -> bool:
    if flight.draw.case.output == "gpio":
        return flight.vehicle.is_known and flight.engine_pid is not None
    return flight.vehicle.is_known and flight.vehicle.heard_outputs == len(CHANNELS)


async def _until(
    flight: Flight, said: asyncio.Task[tuple[bytes, bytes]], is_so: Callable[[], bool]
) -> None:
    end_s = time.monotonic() + START_MAX_S
    while not is_so():
        if said.done():
            words = said.result()[1].decode(errors="replace").strip().splitlines()
            raise NotFlownError(f"it did not start: {words[-1] if words else 'it ended'}")
        if not time.monotonic() < end_s:
            raise NotFlownError(f"not ready after {START_MAX_S:g} s")
        await asyncio.sleep(0.05)


def _last_words(vehicle: Vehicle) -> str:
    texts = vehicle.texts[-8:]
    return f" ({'; '.join(texts)})" if texts else ""


def _openings(flight: Flight, until_s: float) -> tuple[list[Opening], list[Opening]]:
    """Return the openings that count, and those of engine or companion alone."""
    if flight.draw.case.output != "gpio":
        return flight.vehicle.openings(until_s)
    # The outputs of a chip that is gone stay as they are, whoever dies.
    gone = flight.draw.case.kind is Kind.CHIP_GONE
    rows = [row for row in flight.chip.rows() if row.at_s <= until_s]
    levels = levels_of(rows, {} if gone else flight.deaths)
    levels = [level for level in levels if level.at_s <= until_s]
    own = openings_of(levels, len(CHANNELS), until_s)
    return behind_monostable(own, levels, len(CHANNELS)), own
