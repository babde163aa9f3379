"""The end of a flight: the companion is asked to end, and nothing is left behind."""

from __future__ import annotations

import asyncio
import json
import signal
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from companion.journal.journal import ROOM_WITHIN_S
from tests.bench.faults.cases import Kind

if TYPE_CHECKING:
    from tests.bench.faults.flight import Flight

# A companion that was not killed has so long to close, to finish its journal and to end.
END_MAX_S = 8.0
# Where the disk is full, it waits so long for room before it gives the record up.
FULL_END_MAX_S = END_MAX_S + ROOM_WITHIN_S


@dataclass(frozen=True, slots=True, kw_only=True)
class Ending:
    """How it ended: `ended_s` is None if it had ended, or was stopped, before it was asked to."""

    exit_code: int | None
    ended_s: float | None
    lost_rows: int
    errors: str
    engine_left: bool


async def finish(flight: Flight, said: asyncio.Task[tuple[bytes, bytes]]) -> Ending:
    """End a companion that lives by SIGTERM, and see how it ends."""
    kind = flight.draw.case.kind
    began_s = time.monotonic()
    is_over = flight.process.returncode is not None
    if kind in (Kind.STOP_COMPANION, Kind.STOP_BOTH):
        is_over = True
        flight.process.kill()
    elif not is_over:
        with suppress(ProcessLookupError):
            flight.process.terminate()
    # An engine that was stopped with its companion hears nothing of its end.
    engine_left = kind is not Kind.STOP_BOTH and not await _engine_ends(flight)
    kill_engine(flight)
    out, err = b"", b""
    with suppress(TimeoutError):
        end_s = FULL_END_MAX_S if kind is Kind.DISK_FULL else END_MAX_S
        out, err = await asyncio.wait_for(asyncio.shield(said), end_s)
    lost = 0
    with suppress(ValueError, KeyError, TypeError):
        lost = int(json.loads(out)["lost_rows"])
    return Ending(
        exit_code=flight.process.returncode,
        ended_s=None if is_over else time.monotonic() - began_s,
        lost_rows=lost,
        errors=err.decode(errors="replace"),
        engine_left=engine_left,
    )


async def _engine_ends(flight: Flight) -> bool:
    """Return whether the engine ends with, or soon after, its companion."""
    engine = flight.engine_pid
    end_s = time.monotonic() + END_MAX_S
    while engine is not None and engine not in flight.deaths:
        if not time.monotonic() < end_s:
            return False
        await asyncio.sleep(0.02)
    return True


def kill_engine(flight: Flight) -> None:
    """End an engine that is still there."""
    file = flight.watched.get(flight.engine_pid or 0)
    if file is not None:
        # By its descriptor: the number cannot have gone to another process meanwhile.
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(file, signal.SIGKILL)


async def clear_away(flight: Flight, said: asyncio.Task[tuple[bytes, bytes]]) -> None:
    """Leave nothing behind, whatever happened."""
    if flight.process.returncode is None:
        with suppress(ProcessLookupError):
            flight.process.kill()
    kill_engine(flight)
    with suppress(TimeoutError, asyncio.CancelledError):
        await asyncio.wait_for(said, 5.0)
    for pid in list(flight.watched):
        flight.let_go(pid)
