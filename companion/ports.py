"""What the runtime needs of the outside; each is implemented by hardware, stub and fake alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from companion.core.options.coverage import Coverage
from companion.core.types import Decision, Input, SprayPlan

# How often a recorder commits, unless it is told otherwise.
COMMIT_EVERY_S = 1.0


class PlanExecutor(Protocol):
    """Carries a plan out to the millisecond and closes everything when its lease ends."""

    @property
    def fault(self) -> str | None:
        """Why the outputs cannot be trusted, in a few words, latched; None while all is well."""

    @property
    def is_guarded(self) -> bool:
        """Whether something beside this computer closes when it fails, where that is asked for."""

    async def start(self) -> None:
        """Take the outputs and order all of them closed."""

    def submit(self, plan: SprayPlan) -> None:
        """Replace the part of the last plan that has not happened; never waits."""

    async def stop(self) -> None:
        """Order all outputs closed and let go; may be called twice and before `start`."""


class VehicleLink(Protocol):
    """Messages of one vehicle in, this component's own messages out."""

    @property
    def fault(self) -> str | None:
        """Why nothing reaches the vehicle, in a few words; None while the link is up."""

    async def open(self, wake: Callable[[], None]) -> None:
        """Open the link; from then on `wake` is called whenever `receive` has something new."""

    def receive(self) -> Sequence[Input]:
        """Return what came in since the last call, in its order; never waits."""

    def tell(self, decision: Decision | None, now_s: float) -> None:
        """Send what is due by itself; called at every step, at least 20 times a second."""

    def tell_fault(self, text: str) -> None:
        """Tell the operator once of something that does not work."""

    async def close(self) -> None:
        """Let go of the link; may be called twice and before `open`."""


class Sensor(Protocol):
    """What measures the liquid; read at each step, which comes often enough for all of them."""

    async def open(self, wake: Callable[[], None]) -> None:
        """Take the sensor, or raise `SensorError`; `wake` may be called to hurry a step."""

    def read(self, now_s: float) -> Sequence[Input]:
        """Return what it has measured; its fault is a report too, and never a zero. Never waits."""

    async def close(self) -> None:
        """Let go of the sensor; may be called twice and before `open`."""


class Recorder(Protocol):
    """Takes down what came in and what was decided; never waits, never raises."""

    def record_input(self, item: Input) -> None:
        """Take down one input as the core saw it."""

    def record_decision(self, decision: Decision) -> None:
        """Take down one decision."""

    def record_event(self, at_s: float, kind: str, text: str) -> None:
        """Take down what happened besides."""

    def record_coverage(self, coverage: Coverage) -> None:
        """Keep which ground is treated by now; the newest counts."""


class Record(Protocol):
    """What the flight is kept in."""

    @property
    def fault(self) -> str | None:
        """Why it is not kept, or soon will not be; None while all is well."""

    @property
    def saved_age_s(self) -> float:
        """How long ago all that there was reached the disk."""


# The record that a flight must have, and for how long it may spray without.
Required = tuple[Record, float]
