"""What the runtime needs of the outside; each is implemented by hardware, stub and fake alike."""

from __future__ import annotations

from typing import Protocol

from companion.core.types import Decision, Input, SprayPlan


class PlanExecutor(Protocol):
    """Carries a plan out to the millisecond and closes everything when its lease ends."""

    async def start(self) -> None:
        """Take the outputs and order all of them closed."""

    def submit(self, plan: SprayPlan) -> None:
        """Replace the part of the last plan that has not happened; never waits."""

    async def stop(self) -> None:
        """Order all outputs closed and let go; may be called twice and before `start`."""


class Recorder(Protocol):
    """Takes down what came in and what was decided; never waits, never raises."""

    def record_input(self, item: Input) -> None:
        """Take down one input as the core saw it."""

    def record_decision(self, decision: Decision) -> None:
        """Take down one decision."""

    def record_event(self, at_s: float, kind: str, text: str) -> None:
        """Take down what happened besides."""
