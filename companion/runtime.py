"""The shell around the core: what arrives becomes inputs, what is decided becomes orders.

One task makes all decisions. It is woken by whatever arrives, and by a timer where nothing does,
so that leases are renewed while all is well and run out when it is not. However it ends (signal,
duration, exception, cancellation) the valves are ordered closed first; the `finally` in `run` is
what makes this true. Nothing is remembered from one run to the next: a restart is disabled.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import selectors
import signal
import sys
import threading
import time
from collections.abc import Callable, Coroutine, Iterator, Sequence
from concurrent.futures import Future
from typing import Any, TypeVar

from companion.core.controller import Memory, expected_coverage, step
from companion.core.estimator import Track, estimate, observe
from companion.core.options.coverage import Coverage
from companion.core.setup import Setup
from companion.core.types import (
    Decision,
    EstopReport,
    Finding,
    HeartbeatReport,
    Input,
    OperatorCommand,
    OutputReport,
    SprayerState,
    StandstillReport,
    VehicleState,
)
from companion.errors import SensorError
from companion.ports import (
    COMMIT_EVERY_S,
    PlanExecutor,
    Recorder,
    Required,
    Sensor,
    VehicleLink,
)

_logger = logging.getLogger(__name__)

T = TypeVar("T")

SWITCH_S = 0.0002

# Turns are at most STEP_MAX_S apart; this far, and the process was stopped, or the computer slept:
# longer than any lease's worth of waiting on a busy computer that is still fit to spray.
STANDSTILL_S = 0.5
# Of what arrives so soon after it nobody can say how long it has waited: full buffers are read in
# some tenths of a second.
DEAF_S = 1.0
# A start that fails on a sensor waits so long for the vehicle, to have its valves ordered closed:
# heartbeats come once a second.
LEAVE_CLOSED_S = 3.0

# Between messages a step follows at the latest after this: often enough for the lease and for the
# sign of life to the autopilot's watchdog (10 Hz), and not just before a position at 20 Hz.
STEP_MAX_S = 0.06

# Only from then on is it said in flight that nothing reaches the disk: a card is slow now and then.
TOLD_AFTER_S = 5.0
# The record gets the treated ground so often while it grows.
COVERAGE_EVERY_S = 0.1


def coverage_ahead_s(commit_every_s: float) -> float:
    """Return how far ahead of its moment the treated ground is written.

    A cut of power comes at any moment until the next commit, in the middle on the mean. What is
    written is what will be treated by then, so that a flight that goes on errs to both sides.
    """
    return 0.5 * (commit_every_s + COVERAGE_EVERY_S)


def boot_time_s() -> float:
    """Return the time since the start of the computer, its sleep included."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class NoRecorder:
    """Takes nothing down."""

    def record_input(self, item: Input) -> None:
        """Forget it."""

    def record_decision(self, decision: Decision) -> None:
        """Forget it."""

    def record_event(self, at_s: float, kind: str, text: str) -> None:
        """Forget it."""

    def record_coverage(self, coverage: Coverage) -> None:
        """Forget it."""


class ControlLoop:
    """Inputs to track, track to state, state to decision, decision to executor and link."""

    def __init__(
        self,
        setup: Setup,
        *,
        link: VehicleLink,
        executor: PlanExecutor,
        recorder: Recorder,
        clock: Callable[[], float],
        sensors: Sequence[Sensor] = (),
        boot_clock: Callable[[], float] | None = None,
        required: Required | None = None,
        commit_every_s: float = COMMIT_EVERY_S,
    ) -> None:
        self._setup = setup
        self._boot_clock = boot_clock or boot_time_s
        self._turned_boot_s: float | None = None
        self._deaf_until_s = float("-inf")
        self._link = link
        self._executor = executor
        self._recorder = recorder
        self._required = required
        self._told_record: str | None = None
        self._ahead_s = coverage_ahead_s(commit_every_s)
        self._has_begun = False
        self._clock = clock
        self._track = Track()
        self._memory = Memory()
        self._sensors = sensors
        self._told: frozenset[Finding] = frozenset()
        self._reported: tuple[str | None, str | None, bool] | None = None
        self._stepped_s = float("-inf")
        self._coverage_s = float("-inf")

    @property
    def next_step_s(self) -> float:
        """Return when a step is due even if nothing arrives."""
        return self._stepped_s + STEP_MAX_S

    def turn(self) -> Decision | None:
        """Take what came in and decide; without news and before its time, do nothing."""
        inputs = [*self._standstill(), *self._heard(), *self._output_report()]
        for sensor in self._sensors:
            inputs.extend(sensor.read(self._clock()))
        if not inputs and self._clock() < self.next_step_s:
            return None
        for item in inputs:
            self._recorder.record_input(item)
            self._track = observe(self._track, item, self._setup)
        now_s = self._stepped_s = self._clock()
        state = estimate(self._track, now_s)
        decision, self._memory = step(self._setup, state, self._memory, now_s)
        self._carry_out(decision)
        self._note_begin(decision)
        self._recorder.record_decision(decision)
        if self._setup.records_coverage and now_s >= self._coverage_s + COVERAGE_EVERY_S:
            self._keep_coverage(state, now_s, ahead_s=self._ahead_s)
        if decision.findings:
            self._tell_findings(decision)
        return decision

    def ended(self) -> None:
        """Leave the record what was treated until now, and not what was to be."""
        if self._setup.records_coverage:
            now_s = self._clock()
            self._keep_coverage(estimate(self._track, now_s), now_s, ahead_s=0.0)

    def _keep_coverage(self, state: VehicleState | None, now_s: float, *, ahead_s: float) -> None:
        self._coverage_s = now_s
        cut_s = now_s + ahead_s
        self._recorder.record_coverage(
            expected_coverage(self._setup, self._memory, state, now_s=now_s, cut_s=cut_s)
        )

    def _standstill(self) -> Iterator[Input]:
        """Yield that this process stood still, if it did: of sleep only the boot clock knows."""
        boot_s, before_s = self._boot_clock(), self._turned_boot_s
        self._turned_boot_s = boot_s
        if before_s is None or boot_s - before_s <= STANDSTILL_S:
            return
        gap_s = boot_s - before_s
        self._deaf_until_s = boot_s + DEAF_S
        text = f"companion paused for {gap_s:.1f} s"
        _logger.warning("%s; positions must be confirmed again", text)
        self._link.tell_fault(text)
        self._recorder.record_event(self._clock(), "standstill", text)
        yield StandstillReport(received_s=self._clock(), gap_s=gap_s)

    def _heard(self) -> list[Input]:
        """Return what came in; after a standstill only what closes, and who the vehicle is."""
        is_deaf = self._turned_boot_s is not None and self._turned_boot_s < self._deaf_until_s
        return [item for item in self._link.receive() if not is_deaf or _may_have_waited(item)]

    def _tell_findings(self, decision: Decision) -> None:
        """Say once of each fault of the liquid what it is; that of a valve again with its name."""
        for finding in decision.findings:
            if finding in self._told:
                continue
            self._told |= {finding}
            text = finding.text
            if finding.valve is not None:
                text += f" (valve {self._setup.boom.valves[finding.valve].name})"
            _logger.warning("%s: %s", finding.kind, text)
            self._link.tell_fault(text)
            self._recorder.record_event(decision.now_s, f"fault-{finding.kind}", text)

    def _carry_out(self, decision: Decision) -> None:
        """Close before anything else; open only after the sign of life that allows it.

        A watchdog on the autopilot that has heard no sign of life would undo an order to open.
        """
        if decision.plan.is_off:
            self._executor.submit(decision.plan)
            self._link.tell(decision, decision.now_s)
        else:
            self._link.tell(decision, decision.now_s)
            self._executor.submit(decision.plan)

    def _note_begin(self, decision: Decision) -> None:
        """Take when spraying may have begun, and when the vehicle is disarmed again."""
        if decision.sprayer in (SprayerState.ARMED, SprayerState.SPRAYING):
            self._has_begun = True
        elif decision.state is not None and not decision.state.armed:
            self._has_begun = False

    def _missing_record(self) -> str | None:
        """Return why nothing may be sprayed without its record; None while it is kept.

        A valve that closes in the middle of a field because a card is slow does more harm than a
        record that comes late: once spraying may have begun, only what lasts closes.
        """
        if self._required is None:
            return None
        record, close_after_s = self._required
        fault = record.fault
        if fault is None or not self._has_begun or not record.saved_age_s <= close_after_s:
            self._told_record = None
            return None if fault is None else f"journal: {fault}"
        if self._told_record is None and record.saved_age_s > TOLD_AFTER_S:
            self._told_record = fault
            self._link.tell_fault(f"journal: {fault}; valves close after {close_after_s:g} s")
        return None

    def _output_report(self) -> Iterator[Input]:
        """Yield what changed in the way to the valves: the link to the vehicle, or the outputs."""
        faults = (self._executor.fault or self._missing_record(), self._link.fault)
        is_guarded = self._executor.is_guarded
        if self._reported == (*faults, is_guarded):
            return
        first, self._reported = self._reported is None, (*faults, is_guarded)
        fault = faults[0] or faults[1]
        now_s = self._clock()
        if fault is not None:
            _logger.warning("outputs: %s", fault)
            self._link.tell_fault(fault)
        if not first or fault is not None:
            self._recorder.record_event(now_s, "outputs", fault or "healthy")
        yield OutputReport(
            received_s=now_s,
            healthy=faults[0] is None,
            link_up=faults[1] is None,
            guarded=is_guarded,
            text=fault or "",
        )


def _may_have_waited(item: Input) -> bool:
    """Whether an input is good however long it has waited for us."""
    if isinstance(item, OperatorCommand):
        return not item.enable
    return isinstance(item, HeartbeatReport | EstopReport)


class _Ending:
    """Why the run ends, and the event that wakes its task."""

    def __init__(self) -> None:
        self.wake = asyncio.Event()
        self.reason: str | None = None
        self.error: BaseException | None = None
        # What still opens its parts, which may take its time: a stop does not wait for it.
        self.opening: asyncio.Task[Any] | None = None

    def end(self, reason: str) -> None:
        """End for `reason`; the first one counts."""
        self.reason = self.reason or reason
        self.wake.set()
        opening, self.opening = self.opening, None
        if opening is not None:
            opening.cancel()

    def failed(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Take an exception that left a callback: nothing that runs here may fail unnoticed."""
        error = context.get("exception")
        if error is None:
            loop.default_exception_handler(context)
            return
        self.error = self.error or error
        self.end("exception")


async def run(
    setup: Setup,
    *,
    link: VehicleLink,
    executor: PlanExecutor,
    recorder: Recorder | None = None,
    sensors: Sequence[Sensor] = (),
    duration_s: float | None = None,
    clock: Callable[[], float] = time.monotonic,
    boot_clock: Callable[[], float] | None = None,
    on_step: Callable[[], None] | None = None,
    watch: Callable[[Decision], None] | None = None,
    required: Required | None = None,
    commit_every_s: float = COMMIT_EVERY_S,
) -> int:
    """Spray until a signal comes or `duration_s` is over; return 0 then.

    `on_step` is called after each step that was carried out, and at no other time: a watchdog that
    it feeds sees a loop that stands still. `watch` gets the decision then; it must not wait.
    `boot_clock`, the computer's if not given, shows that
    this process itself stood still. `required`, if given, is the record without which a flight does
    not begin to spray, and how long one that has begun goes on. `commit_every_s` is how often the
    recorder commits.

    Raises what went wrong otherwise, a `LinkError` for a link that cannot be opened, a
    `SensorError` for a sensor. The valves are closed before any sensor is let go. A link that
    is lost later comes back by itself; until then all is closed.
    """
    taken = recorder if recorder is not None else NoRecorder()
    ending = _Ending()
    ending.opening = asyncio.current_task()
    control: ControlLoop | None = None
    with _ends_at_signals(ending):
        try:
            await link.open(ending.wake.set)
            async with contextlib.AsyncExitStack() as opened:
                try:
                    # Closed is ordered before anything that may fail.
                    await executor.start()
                    try:
                        for sensor in sensors:
                            opened.push_async_callback(sensor.close)
                            await sensor.open(ending.wake.set)
                    except SensorError:
                        await _leave_closed(link, ending)
                        raise
                    taken.record_event(clock(), "start", "")
                    control = ControlLoop(
                        setup,
                        link=link,
                        executor=executor,
                        recorder=taken,
                        clock=clock,
                        sensors=sensors,
                        boot_clock=boot_clock,
                        required=required,
                        commit_every_s=commit_every_s,
                    )
                    ending.opening = None
                    await _turn_until_the_end(control, ending, duration_s, on_step, watch)
                finally:
                    await executor.stop()
                    if control is not None:
                        control.ended()
        except asyncio.CancelledError:
            if ending.error is not None:
                raise ending.error from None
            if ending.reason is None:
                raise
        finally:
            await link.close()
            taken.record_event(clock(), "stop", ending.reason or "failure")
    _logger.info("stopped: %s", ending.reason)
    return 0


async def _leave_closed(link: VehicleLink, ending: _Ending) -> None:
    """Wait for the vehicle: the executor orders all closed as soon as it is met."""
    loop = asyncio.get_running_loop()
    until_s = loop.time() + LEAVE_CLOSED_S
    while ending.reason is None and loop.time() < until_s:
        link.receive()
        link.tell(None, loop.time())
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(ending.wake.wait(), STEP_MAX_S)
        ending.wake.clear()


async def _turn_until_the_end(
    control: ControlLoop,
    ending: _Ending,
    duration_s: float | None,
    on_step: Callable[[], None] | None,
    watch: Callable[[Decision], None] | None,
) -> None:
    loop = asyncio.get_running_loop()
    timers = []
    if duration_s is not None:
        timers.append(loop.call_later(duration_s, ending.end, "duration"))
    step_timer: asyncio.TimerHandle | None = None
    try:
        while ending.reason is None:
            decision = control.turn()
            if decision is not None and on_step is not None:
                on_step()
            if decision is not None and watch is not None:
                watch(decision)
            step_timer = loop.call_at(control.next_step_s, ending.wake.set)
            await ending.wake.wait()
            ending.wake.clear()
            step_timer.cancel()
    finally:
        for timer in [*timers, *([step_timer] if step_timer is not None else [])]:
            timer.cancel()
    if ending.error is not None:
        raise ending.error


@contextlib.contextmanager
def _ends_at_signals(ending: _Ending) -> Iterator[None]:
    """Have SIGTERM, SIGINT and exceptions in callbacks end the run in its usual way."""
    loop = asyncio.get_running_loop()
    before = loop.get_exception_handler()
    loop.set_exception_handler(ending.failed)
    signals = (signal.SIGTERM, signal.SIGINT)
    is_main = threading.current_thread() is threading.main_thread()
    try:
        for number in signals if is_main else ():
            loop.add_signal_handler(number, ending.end, number.name)
        yield
    finally:
        for number in signals if is_main else ():
            loop.remove_signal_handler(number)
        loop.set_exception_handler(before)


class _Loop(asyncio.SelectorEventLoop):
    """Its calls in threads, of a name server or of a map's reader, hold up no end."""

    def run_in_executor(self, _: Any, func: Any, *args: Any) -> Any:  # type: ignore[override]
        """Call in a thread of its own: for those of a pool the interpreter waits at its end."""
        found: Future[Any] = Future()

        def work() -> None:
            found.set_running_or_notify_cancel()
            try:
                found.set_result(func(*args))
            except BaseException as error:  # noqa: BLE001 - raised where it is awaited
                found.set_exception(error)

        threading.Thread(target=work, daemon=True).start()
        return asyncio.wrap_future(found, loop=self)


def precise_event_loop() -> asyncio.AbstractEventLoop:
    """Return an event loop whose timers are not rounded up to whole milliseconds.

    epoll's timeouts are (Python's `selectors.EpollSelector.select`); select's are microseconds.
    """
    return _Loop(selectors.SelectSelector())


def settle() -> None:
    """Have what exists by now out of the collector's way."""
    gc.collect()
    gc.freeze()


def execute(start: Callable[[], Coroutine[Any, Any, T]]) -> T:
    """Run `start()` on a precise event loop."""
    settle()
    # The journal's thread gives the interpreter back within this, not within 5 ms: an order that
    # is due does not wait for it.
    sys.setswitchinterval(SWITCH_S)
    with asyncio.Runner(loop_factory=precise_event_loop) as runner:
        return runner.run(start())
