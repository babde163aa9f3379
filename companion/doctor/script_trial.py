"""Tries the watchdog script of a disarmed ArduPilot: it must close when no sign of life comes.

One output is moved by so little that no valve opens, `NUDGE_US` from its closed pulse, while signs
of life go out; then they stop, and SERVO_OUTPUT_RAW shows when the script puts it back. Four of a
thousand microseconds are a duty of 0.4 %, 0.4 ms of a period of 91 ms: valves need 10 ms.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from companion.core.types import Decision, Inhibit, SprayPlan
from companion.errors import LinkError
from companion.ground.work import (
    GroundReason,
    GroundSetup,
    GroundState,
    ground_reasons,
    observe_ground,
)
from companion.link.vehicle_link import VehicleLink
from companion.output.autopilot_check import TOLERANCE_US, ardupilot_places
from companion.output.autopilot_options import ServoOptions

NUDGE_US = 4
_STEP_S = 0.02
_LIVE_S = 1.0
_ORDER_EVERY_S = 0.2
_SILENT_S = 2.0
# What has no meaning for outputs that are read and not trusted.
_NOT_ASKED = frozenset({GroundReason.OUTPUT_FAULT})


@dataclass(frozen=True, slots=True, kw_only=True)
class ScriptTrial:
    """Seconds after the last sign of life: the last report that was not closed, the first that was.

    `problem` is why there is nothing to judge; `reasons` why the vehicle is not one to try it at.
    """

    open_s: float | None = None
    closed_s: float | None = None
    problem: str | None = None
    is_px4: bool = False
    reasons: frozenset[str] = frozenset()


async def try_script(
    link: VehicleLink, options: ServoOptions, *, wait_s: float, setup: GroundSetup
) -> ScriptTrial:
    """Return how soon the script closes the first valve's output; it is ordered closed after."""
    ear = _Ear(options)
    link.follow_outputs(ear)
    wake = asyncio.Event()
    try:
        await link.open(wake.set)
    except LinkError as error:
        return ScriptTrial(problem=str(error))
    trial = _Trial(link, ear, options, setup, wake)
    try:
        return await trial.run(wait_s)
    finally:
        trial.end()
        await link.close()


class _Ear:
    """Hears what the outputs read; asks for no parameters."""

    def __init__(self, options: ServoOptions) -> None:
        ((self._port, self._index),) = ardupilot_places(options.outputs)[0]
        self.reports: list[tuple[float, int]] = []
        self.is_px4: bool | None = None

    def met(self, is_px4: bool) -> Sequence[str]:
        """Take that the vehicle was met."""
        self.is_px4 = is_px4
        return ()

    def armed(self, is_armed: bool) -> None:
        """Nothing: the heartbeat itself is kept."""

    def learned(self, known: dict[str, float | None]) -> Sequence[str]:  # noqa: ARG002 - OutputListener
        """Nothing was asked for."""
        return ()

    def reported(self, port: int, pulse_us: Sequence[int], at_s: float) -> None:
        """Take what the outputs read."""
        if port == self._port and self._index < len(pulse_us):
            self.reports.append((at_s, pulse_us[self._index]))


class _Trial:
    """The steps of one trial."""

    def __init__(
        self,
        link: VehicleLink,
        ear: _Ear,
        options: ServoOptions,
        setup: GroundSetup,
        wake: asyncio.Event,
    ) -> None:
        self._link, self._ear, self._options, self._setup = link, ear, options, setup
        self._wake = wake
        self._state = GroundState()
        self._sequence = 0
        self._has_moved = False
        towards = 1 if options.full_us > options.closed_us else -1
        self._moved_us = options.closed_us + towards * NUDGE_US

    async def run(self, wait_s: float) -> ScriptTrial:
        """Wait for the vehicle, move the output with a sign of life, then fall silent."""
        await self._steps(
            lambda now_s: self._ear.is_px4 is True or not self._reasons(now_s), for_s=wait_s
        )
        if self._ear.is_px4:
            return ScriptTrial(is_px4=True)
        reasons = self._reasons(time.monotonic())
        if reasons:
            return ScriptTrial(reasons=reasons)
        ordered_s = float("-inf")
        live_s = began_s = time.monotonic()
        while not live_s - began_s >= _LIVE_S:
            if live_s - ordered_s >= _ORDER_EVERY_S:
                ordered_s, self._has_moved = live_s, True
                self._order(self._moved_us)
            await self._step(is_live=True)
            live_s = time.monotonic()
            if self._reasons(live_s):
                return ScriptTrial(reasons=self._reasons(live_s))
        if not self._is_moved(self._ear.reports[-1][1] if self._ear.reports else 0):
            return ScriptTrial(problem=self._unmoved())
        await self._steps(lambda _now_s: False, for_s=_SILENT_S)
        return self._result(live_s)

    def end(self) -> None:
        """Order the output closed if it was moved, whatever was seen."""
        if self._has_moved:
            self._order(self._options.closed_us)

    # ----------------------------------------------------------------------------- inside

    def _result(self, live_s: float) -> ScriptTrial:
        after = [(at_s - live_s, pulse_us) for at_s, pulse_us in self._ear.reports if at_s > live_s]
        closed = [since_s for since_s, pulse_us in after if self._is_closed(pulse_us)]
        moved = [since_s for since_s, pulse_us in after if not self._is_closed(pulse_us)]
        if not after:
            return ScriptTrial(problem="SERVO_OUTPUT_RAW came no more")
        closed_s = min(closed) if closed and not max(closed) < max(moved, default=0.0) else None
        return ScriptTrial(open_s=max(moved, default=0.0), closed_s=closed_s)

    def _unmoved(self) -> str:
        if not self._ear.reports:
            return "nothing tells what the output does (SERVO_OUTPUT_RAW)"
        return (
            f"output {self._options.outputs[0]} reads {self._ear.reports[-1][1]} us, "
            f"ordered {self._moved_us}"
        )

    def _is_moved(self, pulse_us: int) -> bool:
        return abs(pulse_us - self._moved_us) < TOLERANCE_US

    def _is_closed(self, pulse_us: int) -> bool:
        return abs(pulse_us - self._options.closed_us) < TOLERANCE_US

    def _order(self, pulse_us: int) -> None:
        self._link.order(self._options.outputs[0], pulse_us)
        self._link.flush_orders()

    def _reasons(self, now_s: float) -> frozenset[str]:
        found = ground_reasons(self._setup, self._state, now_s) - _NOT_ASKED
        rival = self._link.rival
        return frozenset(found) | ({rival} if rival is not None else frozenset())

    async def _steps(self, is_over: Callable[[float], bool], *, for_s: float) -> None:
        until_s = time.monotonic() + for_s
        while (now_s := time.monotonic()) < until_s and not is_over(now_s):
            await self._step(is_live=False)

    async def _step(self, *, is_live: bool) -> None:
        self._wake.clear()
        for item in self._link.receive():
            self._state = observe_ground(self._state, item)
        self._link.tell(self._living() if is_live else None, time.monotonic())
        with suppress(TimeoutError):
            await asyncio.wait_for(self._wake.wait(), _STEP_S)

    def _living(self) -> Decision:
        """Return a decision that shows a sign of life, as of a sprayer that nobody has enabled."""
        self._sequence += 1
        count, now_s = len(self._options.channels), time.monotonic()
        share = NUDGE_US / abs(self._options.full_us - self._options.closed_us)
        plan = SprayPlan(
            sequence=self._sequence,
            issued_s=now_s,
            duty=(share,) + (0.0,) * (count - 1),
            changes=(),
            lease_until_s=now_s + 0.3,
        )
        return Decision(
            now_s=now_s,
            state=None,
            inhibits=frozenset({Inhibit.NOT_ENABLED}),
            plan=plan,
            rate_l_ha=(None,) * count,
            target_flow_l_min=0.0,
            flow_l_min=0.0,
        )
