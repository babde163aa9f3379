"""`vrspray ground`: prime, flush, rinse, catch, click; a held key, a disarmed vehicle.

The operator's hand is the space bar of a terminal, or lines of a script. Whatever else comes
(another key, a signal, the end of the terminal) ends the work: a piece of software that cannot hear
the hand any more must not take it for held.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import select
import signal
import sys
import termios
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from companion import runtime
from companion.cli.answer import (
    REQUIRED,
    AsJson,
    ConfigFile,
    Option,
    Overrides,
    answer,
    new_app,
    note,
    with_options,
)
from companion.cli.beside import shown
from companion.cli.ground_tasks import (
    GroundOptionError,
    Piece,
    Wish,
    csv_line,
    ground_setup,
    needs_autopilot,
    piece_of,
    plan_line,
)
from companion.cli.output_parts import build_link, load_with_kept
from companion.cli.run import build_executor, component_options, training_mark
from companion.cli.sensor_parts import EstopSwitch, build_sensors
from companion.config import Config
from companion.errors import ActuatorError, JournalError
from companion.ground import shell
from companion.ground.shell import GroundLink, GroundOutcome
from companion.ground.work import HOLD_S, GroundDecision, GroundKind, GroundReason, GroundTask, Hold
from companion.ports import Sensor

# -------------------------------------------------------------------------------- one piece of work

KEY, ENDED, INTERRUPTED = "another-key", "stdin-ended", "interrupted"
# Ctrl-Z and Ctrl-\\ too: a process that stands still or dies orders nothing closed. SIGHUP is a
# terminal that went away.
_SIGNALS = {
    signal.SIGINT: INTERRUPTED,
    signal.SIGTERM: "terminated",
    signal.SIGHUP: "terminal-gone",
    signal.SIGQUIT: INTERRUPTED,
    signal.SIGTSTP: KEY,
}
# So often a wait for a line looks for signals: Ctrl-C is answered at once to a person.
_SIGNALS_EVERY_S = 0.1
# A line that is longer is not a line.
_LINE_MAX = 4096
_INPUT_FLAGS, _LOCAL_FLAGS, _CHARACTERS = 0, 3, 6


class Hand:
    """Implements `ground.HandHold` on a file descriptor: a terminal's keys, or lines."""

    def __init__(
        self, descriptor: int, *, is_lines: bool, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._file = descriptor
        self._is_lines = is_lines
        self._clock = clock
        self._before: list[Any] | None = None
        self._listens = False
        self._line = b""
        self.hold = Hold()
        self.stopped: str | None = None

    @property
    def invitation(self) -> str:
        """Return what the operator, or the script, is told to do now."""
        if self._is_lines:
            return (
                f"Lines hold, one at least every {HOLD_S:g} s; stop, or the end of stdin, closes."
            )
        return "Hold the space bar; any other key closes."

    @contextmanager
    def attending(self) -> Iterator[None]:
        """Have signals end the work; give the terminal back at the end."""
        loop = asyncio.get_running_loop()
        for number, reason in _SIGNALS.items():
            loop.add_signal_handler(number, self._stop, reason)
        try:
            yield
        finally:
            if self._listens:
                loop.remove_reader(self._file)
            for number in _SIGNALS:
                loop.remove_signal_handler(number)
            if self._before is not None:
                # What was still pressed is no command of the shell.
                with suppress(termios.error, OSError):
                    termios.tcsetattr(self._file, termios.TCSAFLUSH, self._before)

    def begin(self) -> None:
        """Begin to listen; what was pressed before does not count."""
        if not self._is_lines:
            self._take_terminal()
        asyncio.get_running_loop().add_reader(self._file, self._read)
        self._listens = True

    def _take_terminal(self) -> None:
        """Have keys come one by one and unseen; Ctrl-S stops no output, as it would stop us."""
        self._before = termios.tcgetattr(self._file)
        now = termios.tcgetattr(self._file)
        now[_INPUT_FLAGS] &= ~termios.IXON
        now[_LOCAL_FLAGS] &= ~(termios.ICANON | termios.ECHO)
        now[_CHARACTERS][termios.VMIN], now[_CHARACTERS][termios.VTIME] = 1, 0
        termios.tcsetattr(self._file, termios.TCSAFLUSH, now)

    def _read(self) -> None:
        try:
            data = os.read(self._file, 4096)
        except OSError:
            data = b""  # the terminal is gone
        if not data:
            self._stop(ENDED)
        elif self._is_lines:
            self._take_lines(data)
        elif data.strip(b" "):
            self._stop(KEY)
        else:
            self.hold = self.hold.renewed(self._clock())

    def _take_lines(self, data: bytes) -> None:
        """Take whole lines, however they come in; the word to stop counts before its line ends."""
        text = self._line + data
        _, found, self._line = text.rpartition(b"\n")
        if b"stop" in text or len(self._line) > _LINE_MAX:
            self._stop(KEY)
        elif found:
            self.hold = self.hold.renewed(self._clock())

    def _stop(self, reason: str) -> None:
        """End the work; the first reason counts."""
        self.stopped = self.stopped or reason
        if self._listens:
            self._listens = False
            asyncio.get_running_loop().remove_reader(self._file)


def read_line(descriptor: int) -> str | None:
    """Return the next line without what stands around it; what follows stays to be read.

    None: the terminal, or the script, has ended without one.
    """
    line = b""
    while not line.endswith(b"\n"):
        # A signal that comes just before the call that waits does not end it: Python would look
        # for it after the next key only.
        while not select.select([descriptor], [], [], _SIGNALS_EVERY_S)[0]:
            pass
        try:
            byte = os.read(descriptor, 1)
        except OSError:
            byte = b""  # the terminal is gone
        if not byte:
            break
        line += byte
    return line.decode(errors="replace").strip() if line else None


_Lines = Annotated[
    bool,
    typer.Option("--hold-lines", help="Lines on stdin hold instead of the space bar: for scripts."),
]
# One of these ends work that was begun and of which a part is worth something.
_GOOD_ENDS: frozenset[str] = frozenset(
    {GroundReason.DONE, GroundReason.NOT_HELD, GroundReason.TIME_OVER, KEY}
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """What every piece of ground work is asked."""

    config_file: Path
    is_lines: bool
    overrides: tuple[str, ...]
    as_json: bool


def _asked(
    *, config_file: Path, is_lines: bool, overrides: list[str] | None, as_json: bool
) -> Asked:
    return Asked(
        config_file=config_file,
        is_lines=is_lines,
        overrides=tuple(overrides or ()),
        as_json=as_json,
    )


# Gives a command that takes `asked: Asked` these options instead.
asked_options = with_options(
    "asked",
    {
        "config_file": Option(ConfigFile, REQUIRED),
        "is_lines": Option(_Lines, False),
        "overrides": Option(Overrides),
        "as_json": Option(AsJson, False),
    },
    _asked,
)


def do(asked: Asked, wish: Wish, *, is_water: bool = False) -> None:
    """Do one piece: say it, ask for the word, wait for the vehicle, and while the key is held."""
    logging.basicConfig(stream=sys.stderr, level=logging.ERROR, format="%(levelname)s %(message)s")
    wanted = (*asked.overrides, *(["journal.training=true"] if is_water else []))
    config, given = load_with_kept(asked.config_file, wanted)
    piece = piece_of(config, wish)
    log = ready_log(config.resolve(config.journal.folder))
    descriptor = listening(asked.is_lines)
    _ask(piece, config, descriptor)
    hand = Hand(descriptor, is_lines=asked.is_lines)
    outcome = perform(config, given, piece.task, hand)
    result = _result(config, piece, outcome)
    if outcome.has_begun:
        trouble = append(log, {"ended_utc": datetime.now(UTC).isoformat(), **result})
        if trouble is not None:
            note(f"warning: {trouble}")
    if INTERRUPTED in outcome.reasons:
        raise KeyboardInterrupt
    if not outcome.has_begun:
        raise ActuatorError(f"{wish.kind}: nothing was opened: {result['ended']}")
    answer(result, _lines(piece, result), as_json=asked.as_json)
    raise typer.Exit(0 if result["ok"] else 1)


def listening(is_lines: bool) -> int:
    """Return where the hand is heard; a script has to say that it is one."""
    try:
        descriptor = sys.stdin.fileno()
    except (OSError, ValueError, AttributeError) as error:
        raise GroundOptionError("ground: stdin is closed; nobody could hold the key") from error
    if not is_lines and not os.isatty(descriptor):
        raise GroundOptionError(
            "ground: stdin is not a terminal, so that no key can be held; give --hold-lines and a "
            "line at least every 0.5 s"
        )
    return descriptor


def _ask(piece: Piece, config: Config, descriptor: int) -> None:
    """Say what will be done and take the deliberate word."""
    word = "click" if piece.task.kind is GroundKind.CLICK else "spray"
    note(plan_line(piece))
    ask(word, config, descriptor)


def ask(word: str, config: Config, descriptor: int) -> None:
    """Say what has to be so, and take the deliberate word."""
    if word != "click":
        note(_warning(config))
    if needs_autopilot(config):
        note("The flight controller's safety switch must be off, or nothing opens.")
    note(f"Type {word} and Enter to go on:")
    if read_line(descriptor) != word:
        raise GroundOptionError(f"ground: the word was not {word}; nothing was opened")


def _warning(config: Config) -> str:
    """Return what has to be so before liquid comes, or that none will."""
    if training_mark(config) == "dry":
        return "A dry run: no outputs are configured, nothing will open."
    pump = "The pump has to run." if config.pump is None else "The pump will run."
    return f"Everybody away from the nozzles. {pump}"


def perform(
    config: Config,
    given: tuple[str, ...],
    task: GroundTask,
    hand: Hand,
    *,
    sensors: Sequence[Sensor] = (),
    on_step: Callable[[GroundDecision], None] = lambda _: None,
    hear: Callable[[GroundLink], GroundLink] = lambda link: link,
) -> GroundOutcome:
    """Do one piece with the configured link and outputs; `sensors` are read beside the stops.

    `hear` puts something around the link that takes down what comes in.
    """
    options = component_options(config, training="ground", watch_mission=True)
    link = build_link(config, given, options)
    executor = build_executor(config, link)
    stops = [sensor for sensor in build_sensors(config) if isinstance(sensor, EstopSwitch)]

    async def main() -> GroundOutcome:
        with hand.attending():
            return await shell.perform(
                task,
                ground_setup(config),
                link=hear(link),
                executor=executor,
                hand=hand,
                sensors=[*stops, *sensors],
                on_ready=lambda: note(hand.invitation),
                on_step=on_step,
            )

    with shown():
        return runtime.execute(main)


def _result(config: Config, piece: Piece, outcome: GroundOutcome) -> dict[str, Any]:
    """Return what came of it, as it is recorded and answered."""
    is_catch = piece.task.kind is GroundKind.CATCH
    is_good = outcome.has_begun and outcome.reasons <= _GOOD_ENDS and not piece.task.is_whole
    result: dict[str, Any] = {
        "ok": outcome.is_done or is_good,
        "kind": str(piece.task.kind),
        "valves": list(piece.names),
        "duty": piece.duty,
        "seconds": piece.task.seconds,
        "open_s": round(outcome.open_s, 4),
        "is_done": outcome.is_done,
        "reasons": sorted(str(reason) for reason in outcome.reasons),
        "ended": in_words(outcome.reasons, outcome.text),
        "training": "ground",
        "liquid": {"dry": "none", "water": "water"}.get(training_mark(config), "product"),
    }
    if piece.task.kind is GroundKind.CLICK:
        result["liquid"] = "none"
    if is_catch and outcome.is_done:
        result["expected_ml"] = round(piece.expected_ml(config), 1)
        result["csv"] = csv_line(piece, piece.task.seconds)
    return result


def _lines(piece: Piece, result: dict[str, Any]) -> list[str]:
    lines = [f"{piece.task.kind}: {result['ended']}, {result['open_s']:.2f} s"]
    if "expected_ml" in result:
        lines += [
            f"expected by the curve: {result['expected_ml']:.1f} mL of all these valves",
            "for `vrspray calibrate flow`, with what was measured instead of the ?:",
            "duty,seconds,millilitres,set",
            result["csv"],
        ]
    elif piece.task.is_whole:
        lines.append("a catch that stopped early is useless: empty the cups and repeat it")
    return lines


# The record of ground work: one line of JSON for each piece, beside the journals.

NAME = "ground-work.jsonl"


def ready_log(folder: Path) -> Path:
    """Return the file in `folder`; a `JournalError` where it cannot be written."""
    path = folder / NAME
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with path.open("a"):
            pass
    except OSError as error:
        raise JournalError(
            f"journal folder {folder}: cannot be written ({error}); "
            "set journal.folder to a folder that can"
        ) from error
    return path


def append(path: Path, entry: Mapping[str, Any]) -> str | None:
    """Write one piece down for good; return why it could not be, None where it could."""
    try:
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry, allow_nan=False) + "\n")
            file.flush()
            os.fsync(file.fileno())
    except (OSError, ValueError) as error:
        return f"{path}: not written: {error}"
    return None


# What is said of the reasons for which ground work was not done, or ended.

_WORDS: dict[str, str] = {
    GroundReason.NO_HEARTBEAT: "no vehicle heard; check link.url and power",
    GroundReason.STALE_HEARTBEAT: "the vehicle has stopped sending heartbeats",
    GroundReason.ARMED: "the vehicle is armed; disarm it",
    GroundReason.MISSION_MODE: "the vehicle is in a mode that flies missions or may spray; choose "
    "another, such as LOITER",
    GroundReason.MISSION_ACTIVE: "the vehicle's mission is active; end it",
    GroundReason.LANDED_UNKNOWN: "landed or flying is not reported (EXTENDED_SYS_STATE)",
    GroundReason.NOT_LANDED: "the vehicle does not report that it is on the ground",
    GroundReason.OUTPUT_FAULT: "the outputs have a fault",
    GroundReason.UNGUARDED: "nothing would close without power (no watchdog script or board); "
    "see output.guard",
    GroundReason.OUTPUTS_NEED_ARMING: "servo outputs of this autopilot follow orders only while it "
    'is armed (PX4), and ground work needs it disarmed; use valves on GPIO (output.kind = "gpio")',
    GroundReason.STOPPED: "stopped by MAVLink or by the emergency stop",
    GroundReason.ESTOP_UNKNOWN: "the emergency stop is pressed or cannot be read",
    GroundReason.NOT_HELD: "the key was released",
    GroundReason.STALLED: "this computer paused for a moment",
    GroundReason.TIME_OVER: "the time limit was reached; start again",
    GroundReason.DONE: "done",
    KEY: "another key was pressed",
    ENDED: "stdin ended",
    INTERRUPTED: "interrupted",
}


def in_words(reasons: Iterable[str], fault: str = "") -> str:
    """Return the reasons in one line; `fault` is what outputs or link said."""
    named = [str(reason) for reason in GroundReason if reason in set(reasons)]
    named += sorted(reason for reason in set(reasons) if reason not in named)
    words = [_WORDS.get(reason, reason) for reason in named]
    if GroundReason.OUTPUT_FAULT in named and fault:
        words[named.index(GroundReason.OUTPUT_FAULT)] += f" ({fault})"
    return "; ".join(words)


# ------------------------------------------------------------------------------------- the commands

app = new_app(
    help="Open valves on the ground, with the vehicle disarmed, while you hold a key.",
    epilog="Example: vrspray ground prime --config config.toml",
)
Valves = Annotated[
    list[str] | None,
    typer.Option("--valve", metavar="NAME", help="Only this valve; repeatable."),
]
Seconds = Annotated[
    float | None, typer.Option(min=0.2, max=30.0, help="Total time; at most 30 s in one go.")
]
Together = Annotated[bool, typer.Option("--together", help="All valves at once, not in turn.")]
Water = Annotated[bool, typer.Option("--water", help="With water: marks the record.")]


@app.command(epilog="Example: vrspray ground prime --config config.toml")
@asked_options
def prime(
    asked: Asked,
    valves: Valves = None,
    seconds: Seconds = None,
    is_water: Water = False,
) -> None:
    """Fill the lines: open the valves fully until liquid arrives."""
    wish = Wish(kind=GroundKind.PRIME, valves=tuple(valves or ()), seconds=seconds)
    do(asked, wish, is_water=is_water)


@app.command(epilog="Example: vrspray ground flush --config config.toml --valve 3")
@asked_options
def flush(
    asked: Asked,
    valves: Valves = None,
    seconds: Seconds = None,
    is_together: Together = False,
    is_water: Water = False,
) -> None:
    """Flush the lines, valve by valve or all together."""
    wish = Wish(
        kind=GroundKind.FLUSH,
        valves=tuple(valves or ()),
        seconds=seconds,
        is_together=is_together,
    )
    do(asked, wish, is_water=is_water)


@app.command(epilog="Example: vrspray ground rinse --config config.toml --litres 2 --together")
@asked_options
def rinse(
    asked: Asked,
    litres: Annotated[
        float | None, typer.Option(min=0.01, max=1000.0, help="Volume of clean water.")
    ] = None,
    valves: Valves = None,
    seconds: Seconds = None,
    is_together: Together = False,
    is_water: Water = True,
) -> None:
    """Rinse with a volume of clean water, valve by valve or all together."""
    wish = Wish(
        kind=GroundKind.RINSE,
        valves=tuple(valves or ()),
        seconds=seconds,
        litres=litres,
        is_together=is_together,
    )
    do(asked, wish, is_water=is_water)


@app.command(epilog="Example: vrspray ground catch --config config.toml --duty 0.5 --water")
@asked_options
def catch(
    asked: Asked,
    duty: Annotated[float | None, typer.Option(help="Duty cycle of the valves, 0 to 1.")] = None,
    valves: Valves = None,
    seconds: Seconds = None,
    is_water: Water = False,
) -> None:
    """Catch test: open valves for an exact time.

    All at one duty cycle; prints the volume to expect.
    """
    wish = Wish(kind=GroundKind.CATCH, valves=tuple(valves or ()), duty=duty, seconds=seconds)
    do(asked, wish, is_water=is_water)


@app.command(epilog="Example: vrspray ground click --config config.toml")
@asked_options
def click(
    asked: Asked,
    valves: Valves = None,
) -> None:
    """Click each valve in turn, dry, to find swapped or dead valves."""
    wish = Wish(kind=GroundKind.CLICK, valves=tuple(valves or ()))
    do(asked, wish)
