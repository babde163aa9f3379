"""`vrspray doctor --watchdogs`: what closes when this program does not is tried, or asked for."""

from __future__ import annotations

import asyncio
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

from companion.cli.answer import note
from companion.cli.ground import in_words, read_line
from companion.cli.ground_tasks import ground_setup
from companion.cli.output_parts import build_link, engine_setup, servo_options
from companion.cli.run import component_options
from companion.cli.systemd import read_unit, systemctl, unit_path
from companion.config import Config
from companion.core.types import Decision, Inhibit, SprayPlan
from companion.doctor.check import Check, Status, fail, not_applicable, ok, warn
from companion.doctor.computer import WATCHDOG_MAX_S, hardware_watchdog_check, read_computer
from companion.doctor.gpio import EngineTrial, try_engine
from companion.errors import LinkError
from companion.ground.work import (
    GroundReason,
    GroundSetup,
    GroundState,
    ground_reasons,
    observe_ground,
)
from companion.link.vehicle_link import VehicleLink
from companion.output.autopilot_options import TOLERANCE_US, ServoOptions, ardupilot_places

_UNIT = "LoadState,ActiveState,WatchdogUSec,WatchdogTimestampMonotonic"


def watchdog_checks(
    config: Config, given: tuple[str, ...], *, wait_s: float | None
) -> Iterator[Check]:
    """Yield a check for each watchdog; `wait_s` None: the vehicle is left out."""
    yield from engine_checks(_engine(config), lease_s=config.output.lease_s)
    yield _script(config, given, wait_s)
    yield from systemd_checks(read_systemd())
    yield hardware_watchdog_check(read_computer({}))
    for question in _questions(config):
        yield _ask(question)


def _engine(config: Config) -> EngineTrial | None:
    if config.output.kind != "gpio":
        return None
    return asyncio.run(try_engine(engine_setup(config), lease_s=config.output.lease_s))


def _script(config: Config, given: tuple[str, ...], wait_s: float | None) -> Check:
    options = servo_options(config)
    if options is None or not options.channels:
        return script_check(None, why="no servo outputs are used")
    if wait_s is None:
        return script_check(None, why="skipped (--no-link)")
    link = build_link(config, given, component_options(config, watch_mission=True))
    trial = asyncio.run(try_script(link, options, wait_s=wait_s, setup=ground_setup(config)))
    return script_check(trial, words=in_words(trial.reasons))


def read_systemd() -> Systemd:
    """Return what systemd says of its watchdogs: of the system's unit, else of this user's."""
    manager = systemctl("show", "--property=RuntimeWatchdogUSec", is_user=False)
    is_user = not unit_path(is_user=False).exists() and unit_path(is_user=True).exists()
    unit = systemctl("show", "vrspray.service", f"--property={_UNIT}", is_user=is_user)
    text = read_unit(unit_path(is_user=is_user)) or ""
    found = None
    if unit.code == 0:
        pairs = (word.partition("=") for word in unit.text.split())
        found = {key: value for key, _, value in pairs}
    return Systemd(
        runtime_watchdog=manager.text.partition("=")[2] if manager.code == 0 else None,
        unit=found,
        now_s=time.monotonic(),
        has_closer="\nExecStopPost=" in text,
    )


def _questions(config: Config) -> tuple[Question, ...]:
    return questions(
        is_servo=config.output.kind == "servo",
        has_dither=config.output.dither_us > 0,
        has_cutoff=config.safety.pump_cutoff,
        has_alive=config.output.kind == "gpio" and config.gpio.alive_line is not None,
        has_estop=config.safety.estop_line is not None,
    )


def _ask(question: Question) -> Check:
    """Ask at a terminal; s skips. Nobody is asked where there is none."""
    if not question.applies:
        return asked_check(question, None)
    if not _has_terminal():
        return asked_check(question, None, why="is asked at a terminal only")
    note(f"{question.text}?")
    while True:
        note("[y/n, s skips]")
        said = read_line(sys.stdin.fileno())
        word = "skip" if said is None else said.lower()
        if word in ("s", "skip"):
            return asked_check(question, None)
        if word in ("y", "yes", "n", "no"):
            return asked_check(question, word.startswith("y"))


def _has_terminal() -> bool:
    try:
        return os.isatty(sys.stdin.fileno())
    except (OSError, ValueError, AttributeError):
        return False


# Do the watchdogs bark: what was tried and what the operator said, judged.

# docs/safety.md: after the death or the stop of the companion, on lines of this computer.
CLOSED_MAX_S = 0.35
# The script's 0.3 s, one run of it, and what a message takes.
SCRIPT_MAX_S = 0.35
_UNITS_S = {"us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0}
_BUSY = (
    "check what else this computer is doing: vrspray doctor (real-time, cpu-governor, throttling)"
)
_SCRIPT = "reinstall the script, and set SPRW_TIMEOUT_MS to 300: deploy/ardupilot/README.md"


@dataclass(frozen=True, slots=True, kw_only=True)
class Systemd:
    """What systemd says: of its hardware watchdog, and of our unit; None where it says nothing."""

    runtime_watchdog: str | None = None
    unit: Mapping[str, str] | None = None
    now_s: float = 0.0
    has_closer: bool = False


def engine_checks(found: EngineTrial | None, *, lease_s: float) -> Iterator[Check]:
    """Yield what the trial of the valve engine showed; None: no engine is used."""
    names = ("engine-lease", "engine-killed", "engine-alive")
    if found is None:
        yield from (not_applicable(name, "no GPIO lines are used") for name in names)
        return
    if found.problem is not None:
        yield fail(names[0], found.problem, "vrspray doctor says what the engine lacks")
        yield from (not_applicable(name, "the engine did not start") for name in names[1:])
        return
    yield _closes(names[0], found.lease_s, "after a lease", f"(output.lease_s = {lease_s:g})")
    yield _closes(names[1], found.killed_s, "after the engine was killed", "")
    yield _alive(names[2], found)


def _closes(name: str, after_s: float | None, when: str, more: str) -> Check:
    if after_s is None:
        return fail(name, f"valves stay open {when}", "do not fly; " + _BUSY)
    text = f"closed {after_s * 1e3:.0f} ms {when} {more}".strip()
    if not after_s <= CLOSED_MAX_S:
        return fail(name, text, _BUSY)
    return ok(name, text)


def _alive(name: str, found: EngineTrial) -> Check:
    if found.alive_changes is None:
        return not_applicable(name, "gpio.alive_line is not set")
    if found.alive_changes < 2:
        return fail(name, "ALIVE does not toggle while plans come", _BUSY)
    if found.is_alive_after:
        return fail(name, "ALIVE toggles though the engine was killed", "do not fly; report it")
    return ok(name, f"toggled {found.alive_changes} times while plans came, stood still after")


def script_check(found: ScriptTrial | None, *, why: str = "", words: str = "") -> Check:
    """Return what the trial of the watchdog script showed; `why` there was none.

    `words` are the reasons for which the vehicle is not one to try it at.
    """
    name = "script-closes"
    if found is None or found.is_px4:
        px4 = "PX4 has no script: a driver board with alive dither does it"
        return not_applicable(name, why if found is None else px4)
    if found.reasons:
        what, _, fix = words.partition("; ")
        return fail(name, f"not tried: {what}", fix or "see docs/howto/check-before-flight.md")
    if found.problem is not None:
        return fail(name, f"not tried: {found.problem}", "vrspray doctor says what is wrong")
    if found.closed_s is None or found.open_s is None:
        return fail(name, "an output stays as ordered when the sign of life stops", _SCRIPT)
    text = f"closed {found.open_s:.2f} to {found.closed_s:.2f} s after the last sign of life"
    if not found.open_s <= SCRIPT_MAX_S:
        return fail(name, text, _SCRIPT)
    return ok(name, text)


def systemd_checks(found: Systemd) -> Iterator[Check]:
    """Yield the checks of systemd's own watchdogs."""
    yield _runtime(found.runtime_watchdog)
    yield _fed(found)
    name = "service-closer"
    if found.unit is None or found.unit.get("LoadState") != "loaded":
        yield not_applicable(name, "the service is not installed")
    elif found.has_closer:
        yield ok(name, "ExecStopPost closes the lines after every end")
    else:
        fix = "run vrspray service install again"
        yield warn(name, "the unit has no ExecStopPost that closes", fix)


def _runtime(value: str | None) -> Check:
    name = "system-watchdog"
    fix = f"write RuntimeWatchdogSec={WATCHDOG_MAX_S} into /etc/systemd/system.conf, then restart"
    if value is None:
        return not_applicable(name, "no systemd on this computer")
    seconds = seconds_of(value)
    if seconds is None or not seconds > 0.0:
        return warn(name, "systemd feeds no hardware watchdog: a hung kernel stays hung", fix)
    if not seconds <= WATCHDOG_MAX_S:
        return warn(name, f"{value}: a Raspberry Pi's counter holds {WATCHDOG_MAX_S} s", fix)
    return ok(name, f"RuntimeWatchdogSec is {value}")


def _fed(found: Systemd) -> Check:
    name, unit = "watchdog-feed", found.unit
    if unit is None or unit.get("LoadState") != "loaded":
        return not_applicable(name, "the service is not installed")
    limit_s = seconds_of(unit.get("WatchdogUSec", ""))
    if limit_s is None or not limit_s > 0.0:
        return warn(name, "the unit has no WatchdogSec", "run vrspray service install again")
    if unit.get("ActiveState") != "active":
        why = "the service does not run: start it, and ask again with --watchdogs"
        return not_applicable(name, why)
    stamp = unit.get("WatchdogTimestampMonotonic", "")
    age_s = found.now_s - int(stamp) / 1e6 if stamp.isdecimal() and int(stamp) else None
    if age_s is None or not 0.0 <= age_s <= limit_s:
        return fail(name, "the control loop no longer feeds it", "see journalctl -u vrspray")
    return ok(name, f"fed {age_s:.1f} s ago, WatchdogSec is {limit_s:g}")


def seconds_of(text: str) -> float | None:
    """Return a time as systemd writes it; None for anything else, such as `infinity`.

    >>> seconds_of("1min 30s"), seconds_of("250ms"), seconds_of("0"), seconds_of("infinity")
    (90.0, 0.25, 0.0, None)
    """
    if text.strip() == "0":
        return 0.0
    total = 0.0
    for word in text.split():
        number = word.rstrip("abcdefghijklmnopqrstuvwxyz")
        unit = _UNITS_S.get(word[len(number) :])
        if unit is None or not number.replace(".", "", 1).isdecimal():
            return None
        total += float(number) * unit
    return total if text.strip() else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Question:
    """What only a person can see: what to do, what to look at, and what to do about a no."""

    name: str
    text: str
    fix: str
    applies: bool = True
    otherwise: str = ""


def questions(
    *,
    has_dither: bool,
    is_servo: bool,
    has_cutoff: bool,
    has_alive: bool,
    has_estop: bool,
) -> tuple[Question, ...]:
    """Return all questions; those without a meaning here say why."""
    return (
        Question(
            name="board-dither",
            text="Let a valve run (vrspray ground prime --valve NAME) and pull the cable between "
            "flight controller and driver board's orders, or kill -STOP the companion: did it "
            "close within half a second",
            fix="do not fly: check output.dither_us and docs/howto/build-a-driver-board.md",
            applies=is_servo and has_dither,
            otherwise="output.dither_us is 0, or no servo outputs are used",
        ),
        Question(
            name="dead-man",
            text="Let a valve run and pull the wire of ALIVE: did pump and master valve drop "
            "within half a second",
            fix="do not fly: check the monostable and its relay (docs/howto/wire-gpio.md)",
            applies=has_alive,
            otherwise="gpio.alive_line is not set",
        ),
        Question(
            name="pump-cutoff-works",
            text="With the pump on and the companion off, throw the pump's cut-off: did it stop",
            fix="do not fly: with open valves nothing else ends the spraying",
            applies=has_cutoff,
            otherwise="safety.pump_cutoff is not declared",
        ),
        Question(
            name="estop-works",
            text="Press the emergency stop with the pump on: did the pump stop at once",
            fix="do not fly: check its wiring (docs/safety.md)",
            applies=has_estop,
            otherwise="safety.estop_line is not set",
        ),
    )


def asked_check(question: Question, said: bool | None, *, why: str = "not answered") -> Check:
    """Return what an answer makes of a question; None: there was none, and `why`."""
    if not question.applies:
        return not_applicable(question.name, question.otherwise)
    if said is None:
        # Nobody has looked: whether it works is as unknown as before.
        return Check(
            name=question.name,
            status=Status.WARN,
            text=why,
            fix=f"try it, and answer at a terminal: {question.text}?",
            is_open=True,
        )
    if said:
        return ok(question.name, "the operator has seen it")
    return fail(question.name, "the operator has not seen it", question.fix)


# Tries the watchdog script of a disarmed ArduPilot: it must close when no sign of life comes.
#
# One output is moved by so little that no valve opens, `NUDGE_US` from its closed pulse, while
# signs of life go out; then they stop, and SERVO_OUTPUT_RAW shows when the script puts it back.
# Four of a thousand microseconds are a duty of 0.4 %, 0.4 ms of a period of 91 ms: valves need 10
# ms.

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
    listener = _OutputListener(options)
    link.follow_outputs(listener)
    wake = asyncio.Event()
    try:
        await link.open(wake.set)
    except LinkError as error:
        return ScriptTrial(problem=str(error))
    trial = _Trial(link, listener, options, setup, wake)
    try:
        return await trial.run(wait_s)
    finally:
        trial.end()
        await link.close()


class _OutputListener:
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
        listener: _OutputListener,
        options: ServoOptions,
        setup: GroundSetup,
        wake: asyncio.Event,
    ) -> None:
        self._link, self._listener, self._options, self._setup = link, listener, options, setup
        self._wake = wake
        self._state = GroundState()
        self._sequence = 0
        self._has_moved = False
        towards = 1 if options.full_us > options.closed_us else -1
        self._moved_us = options.closed_us + towards * NUDGE_US

    async def run(self, wait_s: float) -> ScriptTrial:
        """Wait for the vehicle, move the output with a sign of life, then fall silent."""
        await self._steps(
            lambda now_s: self._listener.is_px4 is True or not self._reasons(now_s), for_s=wait_s
        )
        if self._listener.is_px4:
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
        if not self._is_moved(self._listener.reports[-1][1] if self._listener.reports else 0):
            return ScriptTrial(problem=self._unmoved())
        await self._steps(lambda _now_s: False, for_s=_SILENT_S)
        return self._result(live_s)

    def end(self) -> None:
        """Order the output closed if it was moved, whatever was seen."""
        if self._has_moved:
            self._order(self._options.closed_us)

    # ----------------------------------------------------------------------------- inside

    def _result(self, live_s: float) -> ScriptTrial:
        after = [
            (at_s - live_s, pulse_us) for at_s, pulse_us in self._listener.reports if at_s > live_s
        ]
        closed = [since_s for since_s, pulse_us in after if self._is_closed(pulse_us)]
        moved = [since_s for since_s, pulse_us in after if not self._is_closed(pulse_us)]
        if not after:
            return ScriptTrial(problem="SERVO_OUTPUT_RAW stopped arriving")
        closed_s = min(closed) if closed and not max(closed) < max(moved, default=0.0) else None
        return ScriptTrial(open_s=max(moved, default=0.0), closed_s=closed_s)

    def _unmoved(self) -> str:
        if not self._listener.reports:
            return "nothing reports what the output does (SERVO_OUTPUT_RAW)"
        return (
            f"output {self._options.outputs[0]} reads {self._listener.reports[-1][1]} us, "
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
