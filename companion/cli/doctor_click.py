"""`vrspray doctor --click`: each valve in turn, judged by the operator's ear or by the meter."""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from statistics import fmean

from companion import runtime
from companion.cli.answer import note
from companion.cli.ground import INTERRUPTED, Hand, in_words, read_line
from companion.cli.ground_tasks import ground_setup
from companion.cli.output_parts import build_link
from companion.cli.run import build_executor, component_options
from companion.cli.sensor_parts import EstopSwitch, build_sensors
from companion.config import Config
from companion.core.inputs import AutopilotLiquid
from companion.core.types import BatteryReport, Decision, FaultKind, FlowReport, Input
from companion.doctor.check import Check, fail, not_applicable, ok, warn
from companion.errors import VrsprayError
from companion.ground import shell
from companion.ground.clicks import ClickFinding, ClickFlow, ClickJudgement, ClickLaw, judge_clicks
from companion.ground.shell import GroundLink, GroundOutcome, HandHold
from companion.ground.work import (
    CLICK_TIMES,
    STROKES_OVER_S,
    GroundKind,
    GroundTask,
    Hold,
    Phase,
    clicks,
    flow_of,
)
from companion.ports import Sensor
from companion.sensors import FlowMeter

_BROKEN = "not measured: stopped early"
_LEFT_OUT = "left out by the operator"


class ClickError(VrsprayError):
    """The guided click cannot be done as it was asked for."""


def terminal() -> int:
    """Return the terminal at which the operator sits."""
    try:
        descriptor = sys.stdin.fileno()
    except (OSError, ValueError, AttributeError) as error:
        raise ClickError("doctor --click: stdin is closed; call it from a terminal") from error
    if not os.isatty(descriptor):
        raise ClickError(
            "doctor --click: stdin is not a terminal, and nobody else can hear a valve"
        )
    return descriptor


def guided_click(config: Config, given: tuple[str, ...], *, is_wet: bool) -> Iterator[Check]:
    """Yield a check for each valve, and of what a meter says of all of them."""
    if config.output.kind == "none":
        raise ClickError('doctor --click: output.kind = "none": there are no valves to click')
    if is_wet and config.flow_meter.source == "none":
        raise ClickError(
            "doctor --wet: needs a flow meter ([flow_meter], docs/howto/wire-flow-meter.md)"
        )
    bench = _Bench(config, given, terminal())
    yield from bench.wet() if is_wet else bench.dry()


class _Bench:
    """One valve after the other; link and outputs are opened for each, and closed after it."""

    def __init__(self, config: Config, given: tuple[str, ...], descriptor: int) -> None:
        self._config, self._given = config, given
        self._descriptor = descriptor
        self._names = tuple(valve.name for valve in config.valve)

    def dry(self) -> Iterator[Check]:
        """Let each valve click; the operator says what was heard."""
        count = len(self._names)
        note(f"{count} valves, each clicks {CLICK_TIMES} times. Pump off, lines without pressure.")
        self._warn_of_safety_switch()
        for valve, name in enumerate(self._names):
            task = clicks(count, (valve,))
            found = self._ask(f"valve {name} ({valve + 1} of {count}): Enter clicks, q ends: ")
            if found == END:
                yield from not_clicked(self._names[valve:], _LEFT_OUT)
                return
            said = AGAIN
            while said == AGAIN:
                outcome = self._click(task)
                if not outcome.has_begun:
                    yield from self._refused(outcome, self._names[valve:])
                    return
                said = self._heard(name)
            if said == END:
                yield from not_clicked(self._names[valve:], _LEFT_OUT)
                return
            yield dry_check(name, said, channel=self._config.valve[valve].channel)

    def _heard(self, name: str) -> str:
        while True:
            text = self._ask(f"did valve {name} click? [y/n/again/q, or the name of another]: ")
            said = answer_of(text, self._names, name)
            if said is not None:
                return said

    def _click(self, task: GroundTask) -> GroundOutcome:
        hand = Hand(self._descriptor, is_lines=False)
        return self._perform(task, hand, ShortHand(hand, seconds=task.seconds), Readings())

    def wet(self) -> Iterator[Check]:
        """Let each valve deliver by itself; the meter says how much."""
        count = len(self._names)
        seconds = wet_click(count, 0).seconds
        note(
            f"{count} valves, each delivers {WET_TIMES} times for {WET_OPEN_S:g} s. Pump on, water "
            "in the tank, lines primed, everybody away from the nozzles."
        )
        self._warn_of_safety_switch()
        flows: list[ClickFlow] = []
        idle: list[tuple[float, float]] = []
        for valve, name in enumerate(self._names):
            readings, outcome = Readings(), None
            while outcome is None or not outcome.is_done:
                again = "" if outcome is None else f"broken off ({in_words(outcome.reasons)}). "
                text = f"{again}valve {name} ({valve + 1} of {count}): Enter, then hold the space "
                if self._ask(f"{text}bar for {seconds:.1f} s; q ends: ") == END:
                    yield from not_clicked(self._names, _BROKEN)
                    return
                readings = Readings()
                hand = Hand(self._descriptor, is_lines=False)
                outcome = self._perform(wet_click(count, valve), hand, hand, readings)
                if not outcome.has_begun and outcome.reasons != {hand.stopped}:
                    yield from self._refused(outcome, self._names)
                    return
            flows.append(readings.flow(valve, WET_TIMES * WET_OPEN_S))
            idle.append(readings.idle())
        yield from wet_checks(judge_clicks(self._law(idle), flows), self._names)

    def _law(self, idle: Sequence[tuple[float, float]]) -> ClickLaw:
        config, sets = self._config, self._config.nozzle_sets()
        idle_s = math.fsum(seconds for _, seconds in idle)
        if not idle_s > 0.0:
            idle, idle_s = [(math.nan, 1.0)], 1.0
        per_l = config.flow_meter.pulses_per_l
        is_local = config.flow_meter.source == "gpio" and per_l is not None
        flows = [flow_of(sets, (valve,), 1.0) / 0.06 for valve in range(len(self._names))]
        return ClickLaw(
            # A valve of no set has no table: it is compared with the others' mean.
            valve_ml_s=tuple(flow or fmean(filter(None, flows)) for flow in flows),
            step_ml=1000.0 / per_l if is_local and per_l else 1.0,
            idle_ml=math.fsum(volume for volume, _ in idle),
            idle_s=idle_s,
            meter_spread=config.detection.spread,
            closed_share=config.detection.closed_share,
        )

    # ----------------------------------------------------------------------------- inside

    def _perform(
        self, task: GroundTask, hand: Hand, hold: shell.HandHold, readings: Readings
    ) -> GroundOutcome:
        config = self._config
        options = component_options(config, training="ground", watch_mission=True)
        link = build_link(config, self._given, options)
        executor = build_executor(config, link)

        async def main() -> GroundOutcome:
            with hand.attending():
                return await shell.perform(
                    task,
                    ground_setup(config),
                    link=HeardLink(link, readings, self._liquid()),
                    executor=executor,
                    hand=hold,
                    sensors=self._sensors(readings),
                    on_ready=readings.is_ready,
                )

        outcome = runtime.execute(main)
        if INTERRUPTED in outcome.reasons:
            raise KeyboardInterrupt
        return outcome

    def _liquid(self) -> AutopilotLiquid:
        """Return which of the autopilot's battery monitors is the flow meter."""
        meter = self._config.flow_meter
        return AutopilotLiquid(flow_battery=meter.battery if meter.source == "autopilot" else None)

    def _sensors(self, readings: Readings) -> list[Sensor]:
        """Return the emergency stop, and the meter of this computer with its counts heard."""
        found: list[Sensor] = []
        for sensor in build_sensors(self._config):
            if isinstance(sensor, EstopSwitch):
                found.append(sensor)
            elif isinstance(sensor, FlowMeter):
                found.append(HeardSensor(sensor, readings))
        return found

    def _refused(self, outcome: GroundOutcome, names: Sequence[str]) -> Iterator[Check]:
        text = in_words(outcome.reasons, outcome.text)
        what, _, fix = text.partition("; ")
        yield fail(
            name_of(names[0]),
            f"nothing was opened: {what}",
            fix or "see docs/howto/check-before-flight.md",
        )
        yield from not_clicked(names[1:], "the valve before it could not be opened")

    def _warn_of_safety_switch(self) -> None:
        if self._config.output.kind == "servo":
            note("The flight controller's safety switch must be off, or nothing opens.")

    def _ask(self, text: str) -> str:
        """Return what the operator types; the end of the terminal is the end of the questions."""
        sys.stderr.write(text)
        sys.stderr.flush()
        said = read_line(self._descriptor)
        return END if said is None or said.lower() in ("q", "quit") else said


# Takes down what the flow meter says while one valve is opened; and the hand of a short click.

# A step comes every 0.05 s, and a hold begins with strokes over some time.
_STROKE_S = 0.1
_BEGIN_S = STROKES_OVER_S + 2.0 * _STROKE_S


@dataclass(slots=True)
class Readings:
    """Counts of the meter, and when the operator was asked to begin."""

    counts: list[FlowReport] = field(default_factory=list)
    ready_s: float = math.inf

    def take(self, items: Sequence[Input], liquid: AutopilotLiquid | None = None) -> None:
        """Keep the counts among what came in; those of the autopilot where it has the meter."""
        for item in items:
            report = item
            if liquid is not None and isinstance(item, BatteryReport):
                found = liquid.flow(item)
                report = item if found is None else found
            if isinstance(report, FlowReport):
                self.counts.append(report)

    def is_ready(self) -> None:
        """Take that the operator is asked to begin: from now on something may flow."""
        self.ready_s = time.monotonic()

    def idle(self) -> tuple[float, float]:
        """Return (volume, time) of what was counted before, with all closed; no number: unknown."""
        before = [each for each in self.counts if each.received_s <= self.ready_s]
        if len(before) < 2 or not _is_sound(before):
            return math.nan, math.nan
        volume_ml = before[-1].volume_ml - before[0].volume_ml
        return volume_ml, before[-1].received_s - before[0].received_s

    def flow(self, valve: int, open_s: float) -> ClickFlow:
        """Return what was counted from the last count before the opening to the last of all."""
        before = [each for each in self.counts if each.received_s <= self.ready_s]
        after = [each for each in self.counts if each.received_s > self.ready_s]
        if not before or not after or not _is_sound([before[-1], *after]):
            return ClickFlow(valve=valve, open_s=open_s, window_s=open_s, metered_ml=math.nan)
        return ClickFlow(
            valve=valve,
            open_s=open_s,
            window_s=max(after[-1].received_s - before[-1].received_s, open_s),
            metered_ml=after[-1].volume_ml - before[-1].volume_ml,
        )


def _is_sound(counts: Sequence[FlowReport]) -> bool:
    return all(math.isfinite(each.volume_ml) and not each.fault for each in counts)


class HeardSensor:
    """A sensor whose counts are taken down."""

    def __init__(self, sensor: Sensor, readings: Readings) -> None:
        self._sensor = sensor
        self._readings = readings

    async def open(self, wake: Callable[[], None]) -> None:
        """Take the sensor."""
        await self._sensor.open(wake)

    def read(self, now_s: float) -> Sequence[Input]:
        """Return what it has measured."""
        found = self._sensor.read(now_s)
        self._readings.take(found)
        return found

    async def close(self) -> None:
        """Let go of it."""
        await self._sensor.close()


class HeardLink:
    """A link whose counts of the autopilot's flow meter are taken down."""

    def __init__(self, link: GroundLink, readings: Readings, liquid: AutopilotLiquid) -> None:
        self._link = link
        self._readings = readings
        self._liquid = liquid

    @property
    def fault(self) -> str | None:
        """Return why nothing reaches the vehicle."""
        return self._link.fault

    @property
    def mission_active(self) -> bool | None:
        """Return whether the vehicle says that it flies its mission."""
        return self._link.mission_active

    @property
    def rival(self) -> str | None:
        """Return who speaks on the link as we do."""
        return self._link.rival

    async def open(self, wake: Callable[[], None]) -> None:
        """Open the link."""
        await self._link.open(wake)

    def receive(self) -> Sequence[Input]:
        """Return what came in."""
        found = self._link.receive()
        self._readings.take(found, self._liquid)
        return found

    def tell(self, decision: Decision | None, now_s: float) -> None:
        """Send what is due."""
        self._link.tell(decision, now_s)

    def tell_fault(self, text: str) -> None:
        """Tell the operator of something that does not work."""
        self._link.tell_fault(text)

    def announce(self, text: str) -> None:
        """Tell the operator's ground station what is done."""
        self._link.announce(text)

    async def close(self) -> None:
        """Let go of the link."""
        await self._link.close()


class ShortHand:
    """One Enter holds for the time of a short dry click; any key, or a signal, ends it.

    Only for what is over within `HOLD_MAX_S`: everything longer wants a key that is really held.
    """

    HOLD_MAX_S = 2.0

    def __init__(
        self, hand: HandHold, *, seconds: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        if not 0.0 < seconds <= self.HOLD_MAX_S:
            raise ValueError(f"a short click takes up to {self.HOLD_MAX_S} s, got {seconds}")
        self._hand = hand
        self._seconds = seconds
        self._clock = clock
        self._hold = Hold()
        self._until_s = -math.inf

    def begin(self) -> None:
        """Begin to hold."""
        self._hand.begin()
        self._until_s = self._clock() + self._seconds + _BEGIN_S

    @property
    def hold(self) -> Hold:
        """Return the strokes so far, one more at every look."""
        now_s = self._clock()
        if now_s < self._until_s:
            self._hold = self._hold.renewed(now_s)
        return self._hold

    @property
    def stopped(self) -> str | None:
        """Return why the operator ended it."""
        return self._hand.stopped


# The guided click: what is asked, and what an answer or a metered flow makes of each valve.

# Twice, as in the dry click; a second each, so that a turbine's pulses or whole millilitres of the
# autopilot tell a tenth of one valve's flow. Between them the flow has ended.
WET_OPEN_S, WET_CLOSED_S, WET_TIMES = 1.0, 0.8, 2
# Nearer to the others than this one can spray on, and see to it; a loss beyond it closes in flight.
FAR_SHARE = 0.25
YES, NO, AGAIN, END = "y", "n", "again", "q"


def name_of(valve: str) -> str:
    """Return the name of the check of a valve.

    >>> name_of("left 1")
    'click-left-1'
    """
    return "click-" + "-".join(valve.split())


def wet_click(count: int, valve: int, *, open_s: float = WET_OPEN_S) -> GroundTask:
    """Return the piece of work that lets one of `count` valves deliver twice.

    >>> [phase.duty for phase in wet_click(2, 1).phases]
    [(0.0, 1.0), (0.0, 0.0), (0.0, 1.0), (0.0, 0.0)]
    """
    closed = (0.0,) * count
    opened = tuple(1.0 if number == valve else 0.0 for number in range(count))
    phases = []
    for number in range(WET_TIMES):
        at_s = number * (open_s + WET_CLOSED_S)
        phases += [Phase(at_s=at_s, duty=opened), Phase(at_s=at_s + open_s, duty=closed)]
    return GroundTask(
        kind=GroundKind.CLICK,
        phases=tuple(phases),
        seconds=WET_TIMES * (open_s + WET_CLOSED_S),
        is_whole=True,
    )


def answer_of(said: str, names: Sequence[str], asked: str) -> str | None:
    """Return what an answer means: one of the four, or another valve's name; None: nothing.

    A valve may be called as an answer is; then the answer counts.

    >>> answer_of(" Yes ", ("1", "2"), "1"), answer_of("2", ("1", "2"), "1")
    ('y', '2')
    >>> answer_of("1", ("1", "2"), "1"), answer_of("", ("1",), "1")
    ('y', None)
    """
    word = said.strip().lower()
    for meaning, words in (
        (YES, ("y", "yes")),
        (NO, ("n", "no")),
        (AGAIN, ("a", "again")),
        (END, ("q", "quit")),
    ):
        if word in words:
            return meaning
    other = next((name for name in names if name.lower() == word), None)
    return YES if other is not None and other == asked else other


def dry_check(valve: str, answer: str, *, channel: int | None) -> Check:
    """Return what an answer makes of a valve."""
    name, where = name_of(valve), f"output {channel}" if channel is not None else "its output"
    if answer == YES:
        return ok(name, "clicked")
    if answer == NO:
        fix = f"check its coil's plug, its driver, and that it is wired to {where} (valve.channel)"
        return fail(name, "did not click", fix)
    fix = f"swap the wires, or correct valve.channel: {where} moves valve {answer}"
    return fail(name, f"valve {answer} clicked in its place", fix)


def not_clicked(valves: Sequence[str], why: str) -> Iterator[Check]:
    """Yield the checks of valves whose turn did not come."""
    yield from (not_applicable(name_of(valve), why) for valve in valves)


def wet_checks(judged: ClickJudgement, names: Sequence[str]) -> Iterator[Check]:
    """Yield what the metered flows make of the valves, and of what they have in common."""
    for found in judged.valves:
        yield _wet(found, names[found.valve])
    yield _common(judged)


def _wet(found: ClickFinding, valve: str) -> Check:
    name, kind = name_of(valve), found.kind
    if kind is FaultKind.METER_FAULT or found.share is None:
        fix = "check the meter's wiring and supply, then run it again"
        return fail(name, "the flow meter gave no reliable count", fix)
    share = f"{100.0 * found.share:.0f} % of the others' flow"
    if kind is None:
        return ok(name, f"{share} ({100.0 * found.limit:.0f} % off would be seen)")
    if kind is FaultKind.STUCK_OPEN:
        fix = "close the tap, then free or replace the valve"
        return fail(name, "delivers all the time: stuck open", fix)
    if kind is FaultKind.STUCK_CLOSED:
        fix = (
            "does it click (vrspray doctor --click)? then clean nozzle and strainer; else its wire"
        )
        return fail(name, "delivers nothing: dead, stuck closed or blocked", fix)
    judge = warn if abs(found.share - 1.0) <= FAR_SHARE else fail
    if kind is FaultKind.CLOG:
        return judge(name, f"{share}: clogged", "clean its nozzles and strainers")
    return judge(name, f"{share}: worn, or a leak behind it", "replace its nozzles, check its hose")


def _common(judged: ClickJudgement) -> Check:
    name, fault = "click-flow", judged.fault
    if fault is FaultKind.METER_FAULT or judged.common is None:
        fix = "check the meter's wiring and supply, then run it again"
        return fail(name, "the flow meter gave no reliable count", fix)
    share = f"valves deliver {100.0 * judged.common:.0f} % of what the table says"
    idle = f"{0.06 * judged.idle_ml_s:.2f} L/min with all closed"
    if fault is FaultKind.NO_FLOW:
        fix = "switch the pump on, open the tap, prime the lines (vrspray ground prime)"
        return fail(name, "no valve delivers anything", fix)
    if fault is FaultKind.SUPPLY:
        fix = "check pump, regulator and filter, or calibrate again (vrspray calibrate flow)"
        return warn(name, share, fix)
    if fault is FaultKind.STUCK_OPEN:
        return fail(
            name,
            f"{idle}: a valve stays open",
            "find the nozzle that drips, and replace that valve",
        )
    if fault is FaultKind.LEAK:
        return fail(
            name, f"{idle}: a leak", "find it before the valves, or look for the nozzle that drips"
        )
    return ok(name, f"{share}, {idle}")
