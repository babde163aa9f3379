"""`vrspray doctor --click`: each valve in turn, judged by the operator's ear or by the meter."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator, Sequence
from statistics import fmean

from companion import runtime
from companion.cli.answer import note
from companion.cli.ground_doing import in_words
from companion.cli.ground_tasks import ground_setup
from companion.cli.hand import INTERRUPTED, Hand, read_line
from companion.cli.link_parts import build_link
from companion.cli.run import build_executor, component_options
from companion.cli.sensor_parts import build_sensors
from companion.config import Config
from companion.core.inputs import AutopilotLiquid
from companion.doctor.check import Check, fail
from companion.doctor.click_bench import (
    AGAIN,
    END,
    WET_OPEN_S,
    WET_TIMES,
    HeardLink,
    HeardSensor,
    Readings,
    ShortHand,
    answer_of,
    dry_check,
    name_of,
    not_clicked,
    wet_checks,
    wet_click,
)
from companion.errors import VrsprayError
from companion.ground import shell
from companion.ground.clicks import ClickFlow, ClickLaw, judge_clicks
from companion.ground.shell import GroundOutcome
from companion.ground.work import CLICK_TIMES, GroundTask, clicks, flow_of
from companion.ports import Sensor
from companion.sensors.estop import EstopSwitch
from companion.sensors.flow_meter import FlowMeter

_BROKEN = "not measured: it was broken off"
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
        raise ClickError("doctor --click: stdin is no terminal, and nobody else can hear a valve")
    return descriptor


def guided_click(config: Config, given: tuple[str, ...], *, is_wet: bool) -> Iterator[Check]:
    """Yield a check for each valve, and of what a meter says of all of them."""
    if config.output.kind == "none":
        raise ClickError('doctor --click: output.kind = "none": there are no valves to click')
    if is_wet and config.flow_meter.source == "none":
        raise ClickError("doctor --wet: needs a flow meter ([flow_meter], docs/sensors.md)")
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
        yield fail(name_of(names[0]), f"nothing was opened: {what}", fix or "see docs/doctor.md")
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
