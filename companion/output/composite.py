"""Several executors as one: for a pump that hangs elsewhere than its valves.

A fault of one stops all: a pump without its valves has no way out, valves without their pump spray
what nobody ordered.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass, replace

from companion.core.types import SprayPlan
from companion.ports import PlanExecutor


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """An executor, and what of each plan is its: the valves, drives by their numbers."""

    executor: PlanExecutor
    has_valves: bool = False
    drives: tuple[int, ...] = ()

    def submit(self, plan: SprayPlan) -> None:
        """Hand it its part of a plan; a plan without drives has them stopped."""
        own = tuple(plan.drives[number] for number in self.drives) if plan.drives else ()
        if self.has_valves:
            self.executor.submit(replace(plan, drives=own))
        else:
            self.executor.submit(replace(plan, duty=(), changes=(), drives=own))


class CompositeExecutor:
    """Hands each part of a plan to the executor whose it is.

    At one moment a pump starts behind its valves and stops ahead of them, so that there is always
    a way out.
    """

    def __init__(self, parts: Sequence[Part]) -> None:
        if not parts or sum(part.has_valves for part in parts) > 1:
            raise ValueError("parts are needed, of which one at most has the valves")
        self._drives_first = sorted(parts, key=lambda part: part.has_valves)

    @property
    def executors(self) -> tuple[PlanExecutor, ...]:
        """Return the executors, that of the valves last."""
        return tuple(part.executor for part in self._drives_first)

    @property
    def fault(self) -> str | None:
        """Why the outputs cannot be trusted; the first that is known."""
        faults = (executor.fault for executor in self.executors)
        return next((fault for fault in faults if fault is not None), None)

    @property
    def is_guarded(self) -> bool:
        """Whether something closes all of them when this computer fails."""
        return all(executor.is_guarded for executor in self.executors)

    async def start(self) -> None:
        """Take all outputs; where one cannot be had, the others are let go again."""
        for number, executor in enumerate(self.executors):
            try:
                await executor.start()
            except BaseException:
                for started in self.executors[:number]:
                    await started.stop()
                raise

    def submit(self, plan: SprayPlan) -> None:
        """Replace what has not happened; with a fault of any, everything stops."""
        if self.fault is not None:
            plan = replace(plan, duty=(0.0,) * len(plan.duty), changes=(), drives=())
        starts = any(drive.fraction for drive in plan.drives)
        for part in reversed(self._drives_first) if starts else self._drives_first:
            part.submit(plan)

    async def stop(self) -> None:
        """Stop the drives, close the valves; none waits for another."""
        ended = await asyncio.gather(
            *(executor.stop() for executor in self.executors), return_exceptions=True
        )
        for error in ended:
            if isinstance(error, BaseException):
                raise error
