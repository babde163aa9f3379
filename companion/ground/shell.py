"""The shell around ground work: link and outputs are opened, one piece is done, all is closed.

`perform` is what both `vrspray ground` and a guided check call. However it ends, the executor is
stopped first, which orders every output closed.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass
from typing import Protocol

from companion.core.types import Decision, Inhibit, OutputReport, SprayerState
from companion.ground.work import (
    GroundDecision,
    GroundMemory,
    GroundOrder,
    GroundReason,
    GroundSetup,
    GroundState,
    GroundTask,
    Hold,
    ground_reasons,
    ground_step,
    observe_ground,
)
from companion.ports import PlanExecutor, Sensor, VehicleLink

STEP_S = 0.05
WAIT_S = 10.0
# The outputs' parameters are read and judged within this; a fault shows before the first opening.
SETTLE_S = 1.5


class GroundLink(VehicleLink, Protocol):
    """A link that also says who flies here."""

    @property
    def mission_active(self) -> bool | None:
        """Whether the vehicle says that it flies its mission; None where it does not say."""

    @property
    def rival(self) -> str | None:
        """Return who speaks on the link as we do; None where nobody does."""

    def announce(self, text: str) -> None:
        """Tell the operator's ground station what is done."""


class HandHold(Protocol):
    """The operator's hand: a key, or lines of a script."""

    def begin(self) -> None:
        """Begin to listen; what was pressed before does not count."""

    @property
    def hold(self) -> Hold:
        """Return the strokes so far."""

    @property
    def stopped(self) -> str | None:
        """Return why the operator ended it (another key, a signal); None while it goes on."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundOutcome:
    """What came of a piece of work; `text` is what outputs or link said of a fault.

    `open_s` is how long the work went on: in a catch the time for which the valves were open.
    """

    reasons: frozenset[str]
    open_s: float
    has_begun: bool
    text: str = ""

    @property
    def is_done(self) -> bool:
        """Whether the whole piece was done."""
        return self.reasons == {GroundReason.DONE}


class _Work:
    """One piece, step by step."""

    def __init__(
        self,
        task: GroundTask,
        setup: GroundSetup,
        *,
        link: GroundLink,
        executor: PlanExecutor,
        hand: HandHold,
        sensors: Sequence[Sensor],
        clock: Callable[[], float],
        on_step: Callable[[GroundDecision], None],
    ) -> None:
        self._task, self._setup = task, setup
        self._link, self._executor, self._hand = link, executor, hand
        self._sensors, self._clock, self._on_step = sensors, clock, on_step
        self._state, self._memory = GroundState(), GroundMemory()
        self._started_s: float | None = None
        self.fault = ""

    def missing(self) -> frozenset[str]:
        """Return what the vehicle lacks for ground work; empty when it may begin."""
        found = ground_reasons(self._setup, self._state, self._clock())
        rival = self._link.rival
        return frozenset(found) | ({rival} if rival is not None else frozenset())

    def start(self) -> None:
        """Take the deliberate start: from now on a hold opens."""
        self._hand.begin()
        self._started_s = self._clock()

    def step(self) -> GroundDecision:
        """Take what came in, decide, and carry it out: close first, open last."""
        for item in self._link.receive():
            self._state = observe_ground(self._state, item)
        now_s = self._clock()
        for sensor in self._sensors:
            for item in sensor.read(now_s):
                self._state = observe_ground(self._state, item)
        self._look_at_outputs(now_s)
        order = None
        if self._started_s is not None and self._hand.stopped is None:
            order = GroundOrder(task=self._task, started_s=self._started_s, hold=self._hand.hold)
        decision, self._memory = ground_step(
            self._setup,
            self._state,
            order,
            self._memory,
            now_s,
            valve_count=self._task.valve_count,
        )
        told = _told(decision)
        if decision.plan.is_off:
            self._executor.submit(decision.plan)
            self._link.tell(told, now_s)
        else:
            # A watchdog that has heard no sign of life would undo an order to open.
            self._link.tell(told, now_s)
            self._executor.submit(decision.plan)
        self._on_step(decision)
        return decision

    def outcome(self, decision: GroundDecision) -> GroundOutcome:
        """Return what came of it."""
        reasons: frozenset[str] = frozenset(decision.reasons)
        if self._hand.stopped is not None and not decision.is_over:
            reasons = frozenset({self._hand.stopped})
        return GroundOutcome(
            reasons=reasons,
            open_s=decision.done_s,
            has_begun=self._memory.began_s is not None,
            text=self.fault,
        )

    def _look_at_outputs(self, now_s: float) -> None:
        fault, rival = self._executor.fault or self._link.fault, self._link.rival
        self.fault = fault or rival or self.fault
        report = OutputReport(
            received_s=now_s,
            healthy=fault is None and rival is None,
            guarded=self._executor.is_guarded,
            text=fault or rival or "",
        )
        state = observe_ground(self._state, report)
        self._state = GroundState(
            heartbeat=state.heartbeat,
            landed=state.landed,
            output=state.output,
            mission_active=self._link.mission_active,
            estop_line=state.estop_line,
            was_stopped=state.was_stopped,
        )


def _told(decision: GroundDecision) -> Decision:
    """Return the decision as the link tells it: a sprayer that nobody has enabled."""
    return Decision(
        now_s=decision.now_s,
        state=None,
        inhibits=frozenset({Inhibit.NOT_ENABLED}),
        plan=decision.plan,
        rate_l_ha=(None,) * len(decision.plan.duty),
        target_flow_l_min=0.0,
        flow_l_min=0.0,
        sprayer=SprayerState.SAFE,
    )


async def perform(
    task: GroundTask,
    setup: GroundSetup,
    *,
    link: GroundLink,
    executor: PlanExecutor,
    hand: HandHold,
    sensors: Sequence[Sensor] = (),
    wait_s: float = WAIT_S,
    settle_s: float = SETTLE_S,
    clock: Callable[[], float] = time.monotonic,
    on_ready: Callable[[], None] = lambda: None,
    on_step: Callable[[GroundDecision], None] = lambda _: None,
) -> GroundOutcome:
    """Do one piece of ground work, and return what came of it; everything is closed then.

    Waits up to `wait_s` for a vehicle at which it may be done for `settle_s`; `on_ready` is called
    before the hold counts, `on_step` with each decision when it was carried out. Raises a
    `LinkError`, `ActuatorError` or `SensorError` for what cannot be opened.
    """
    wake = asyncio.Event()
    work = _Work(
        task, setup,
        link=link, executor=executor, hand=hand, sensors=sensors, clock=clock, on_step=on_step,
    )  # fmt: skip
    try:
        await link.open(wake.set)
        async with AsyncExitStack() as opened:
            for sensor in sensors:
                opened.push_async_callback(sensor.close)
                await sensor.open(wake.set)
            try:
                await executor.start()
                return await _do(work, task, link, hand, wake, (wait_s, settle_s), clock, on_ready)
            finally:
                await executor.stop()
    finally:
        await link.close()


async def _do(
    work: _Work,
    task: GroundTask,
    link: GroundLink,
    hand: HandHold,
    wake: asyncio.Event,
    waits_s: tuple[float, float],
    clock: Callable[[], float],
    on_ready: Callable[[], None],
) -> GroundOutcome:
    wait_s, settle_s = waits_s
    until_s = clock() + wait_s
    ready_s = clock()
    decision = work.step()
    while not clock() - ready_s >= settle_s:
        if hand.stopped is not None:
            return work.outcome(decision)
        await _pause(wake)
        decision = work.step()
        missing = work.missing()
        if missing:
            ready_s = clock()
            if GroundReason.OUTPUTS_NEED_ARMING in missing:
                # Waiting does not help; what else is missing may only not have been heard yet.
                missing = frozenset({GroundReason.OUTPUTS_NEED_ARMING})
                until_s = ready_s
            if not ready_s < until_s:
                return GroundOutcome(reasons=missing, open_s=0.0, has_begun=False, text=work.fault)
    link.announce(f"ground work: {task.kind}")
    on_ready()
    work.start()
    while True:
        decision = work.step()
        if decision.is_over or hand.stopped is not None:
            return work.outcome(decision)
        await _pause(wake)


async def _pause(wake: asyncio.Event) -> None:
    """Wait for news, or for the next step."""
    with suppress(TimeoutError):
        await asyncio.wait_for(wake.wait(), STEP_S)
    wake.clear()
