"""What a run with a guardian does before it reads a map: it closes."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

from companion.cli.output_parts import parts_of
from companion.guardian import AFTER_S
from companion.link.transport import LinkNotYetError
from companion.link.vehicle_link import VehicleLink
from companion.output.guarded import GuardedServoExecutor
from companion.ports import PlanExecutor
from companion.runtime import STEP_MAX_S

T = TypeVar("T")

# The guardian of a run that was killed keeps its port for a while.
_TRIES, _AGAIN_S = round((AFTER_S + 0.5) / 0.1), 0.1


async def meanwhile(make: Callable[[], T], link: VehicleLink, executor: PlanExecutor) -> T:
    """Return what `make` reads in a thread; meanwhile guardians close, by the link as it comes up.

    So a run that is started again in the air, with valves open, has them closed at once.
    """
    guarded = [part for part in parts_of(executor) if isinstance(part, GuardedServoExecutor)]
    for part in guarded:
        await part.guard()
    opening = asyncio.create_task(_open(link))
    making = asyncio.create_task(asyncio.to_thread(make))
    try:
        while not making.done():
            await asyncio.wait({making}, timeout=STEP_MAX_S)
            if opening.done() and opening.exception() is None:
                link.attend()
                for part in guarded:
                    part.attend()
        made = making.result()
        await opening
    finally:
        # Who is told to stop does not wait for the reader.
        making.cancel()
        opening.cancel()
        await asyncio.gather(opening, making, return_exceptions=True)
    return made


async def _open(link: VehicleLink) -> None:
    for _ in range(_TRIES):
        with suppress(LinkNotYetError):
            return await link.open(lambda: None)
        await asyncio.sleep(_AGAIN_S)
    return await link.open(lambda: None)
