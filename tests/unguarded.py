"""Outputs without their guardian, for tests in one process on a time of their own."""

from __future__ import annotations

from companion.cli.output_parts import parts_of
from companion.output.guarded import GuardedServoExecutor
from companion.ports import PlanExecutor


def unguarded(executor: PlanExecutor) -> PlanExecutor:
    """Return the executor, whose servo outputs now need no guardian: one lives in real time."""
    for part in parts_of(executor):
        if isinstance(part, GuardedServoExecutor):
            part.guard = _nothing  # type: ignore[method-assign]
            part._is_closing = False
    return executor


async def _nothing() -> None:
    pass
