"""`vrspray ground`: prime, flush, rinse, catch, click; a held key, a disarmed vehicle."""

from __future__ import annotations

import logging
import os
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from companion import ground, runtime
from companion.cli.answer import AsJson, Overrides, answer, note
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
from companion.cli.ground_words import in_words
from companion.cli.hand import INTERRUPTED, KEY, Hand, read_line
from companion.cli.link_parts import build_link, load_with_kept
from companion.cli.run import build_executor, component_options, training_mark
from companion.cli.sensor_parts import build_sensors
from companion.config import Config
from companion.core.ground_task import GroundKind
from companion.core.ground_work import GroundReason
from companion.errors import ActuatorError
from companion.ground import GroundOutcome
from companion.record import ground_log
from companion.sensors.estop import EstopSwitch

app = typer.Typer(
    add_completion=False,
    rich_markup_mode=None,
    help="Work on the ground with valves open: the vehicle disarmed, a key held.",
    epilog="Example: vrspray ground prime --config config.toml",
)
ConfigFile = Annotated[
    Path, typer.Option("--config", metavar="FILE", help="Configuration, a TOML file.")
]
Valves = Annotated[
    list[str] | None,
    typer.Option("--valve", metavar="NAME", help="Only this valve; may be repeated."),
]
Seconds = Annotated[
    float | None, typer.Option(min=0.2, max=30.0, help="In all; 30 at most in one piece.")
]
Together = Annotated[bool, typer.Option("--together", help="All valves at once, not in turn.")]
Water = Annotated[bool, typer.Option("--water", help="With water: marked so in the record.")]
Lines = Annotated[
    bool,
    typer.Option("--hold-lines", help="Lines on stdin hold instead of the space bar: for scripts."),
]
# One of these ends work that was begun and of which a part is worth something.
_GOOD_ENDS: frozenset[str] = frozenset(
    {GroundReason.DONE, GroundReason.NOT_HELD, GroundReason.TIME_OVER, KEY}
)


@app.command(epilog="Example: vrspray ground prime --config config.toml")
def prime(
    config_file: ConfigFile,
    valves: Valves = None,
    seconds: Seconds = None,
    is_water: Water = False,
    is_lines: Lines = False,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Fill the lines: valves fully open until liquid comes."""
    wish = Wish(kind=GroundKind.PRIME, valves=tuple(valves or ()), seconds=seconds)
    _do(config_file, wish, is_water, is_lines, overrides, as_json=as_json)


@app.command(epilog="Example: vrspray ground flush --config config.toml --valve 3")
def flush(
    config_file: ConfigFile,
    valves: Valves = None,
    seconds: Seconds = None,
    is_together: Together = False,
    is_water: Water = False,
    is_lines: Lines = False,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Push out what is in the lines: valves in turn, or all together."""
    wish = Wish(
        kind=GroundKind.FLUSH,
        valves=tuple(valves or ()),
        seconds=seconds,
        is_together=is_together,
    )
    _do(config_file, wish, is_water, is_lines, overrides, as_json=as_json)


@app.command(epilog="Example: vrspray ground rinse --config config.toml --litres 2 --together")
def rinse(
    config_file: ConfigFile,
    litres: Annotated[
        float | None, typer.Option(min=0.01, max=1000.0, help="Of clean water.")
    ] = None,
    valves: Valves = None,
    seconds: Seconds = None,
    is_together: Together = False,
    is_water: Water = True,
    is_lines: Lines = False,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Rinse with so much clean water, valves in turn or all together."""
    wish = Wish(
        kind=GroundKind.RINSE,
        valves=tuple(valves or ()),
        seconds=seconds,
        litres=litres,
        is_together=is_together,
    )
    _do(config_file, wish, is_water, is_lines, overrides, as_json=as_json)


@app.command(epilog="Example: vrspray ground catch --config config.toml --duty 0.5 --water")
def catch(
    config_file: ConfigFile,
    duty: Annotated[float | None, typer.Option(help="Of the valves, 0 to 1.")] = None,
    valves: Valves = None,
    seconds: Seconds = None,
    is_water: Water = False,
    is_lines: Lines = False,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Open valves at one duty for an exact time over cups; say what the curve expects."""
    wish = Wish(kind=GroundKind.CATCH, valves=tuple(valves or ()), duty=duty, seconds=seconds)
    _do(config_file, wish, is_water, is_lines, overrides, as_json=as_json)


@app.command(epilog="Example: vrspray ground click --config config.toml")
def click(
    config_file: ConfigFile,
    valves: Valves = None,
    is_lines: Lines = False,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Let each valve click in turn, dry: which one is which, and which one is dumb."""
    wish = Wish(kind=GroundKind.CLICK, valves=tuple(valves or ()))
    _do(config_file, wish, False, is_lines, overrides, as_json=as_json)


def _do(
    config_file: Path,
    wish: Wish,
    is_water: bool,
    is_lines: bool,
    overrides: list[str] | None,
    *,
    as_json: bool,
) -> None:
    """Do one piece: say it, ask for the word, wait for the vehicle, and while the key is held."""
    logging.basicConfig(stream=sys.stderr, level=logging.ERROR, format="%(levelname)s %(message)s")
    wanted = (*(overrides or ()), *(["journal.training=true"] if is_water else []))
    config, given = load_with_kept(config_file, wanted)
    piece = piece_of(config, wish)
    log = ground_log.ready_log(config.resolve(config.journal.folder))
    descriptor = _stdin(is_lines)
    _ask(piece, config, descriptor)
    hand = Hand(descriptor, is_lines=is_lines)
    outcome = _perform(config, given, piece, hand)
    result = _result(config, piece, outcome)
    if outcome.has_begun:
        trouble = ground_log.append(log, {"ended_utc": datetime.now(UTC).isoformat(), **result})
        if trouble is not None:
            note(f"warning: {trouble}")
    if INTERRUPTED in outcome.reasons:
        raise KeyboardInterrupt
    if not outcome.has_begun:
        raise ActuatorError(f"{wish.kind}: nothing was opened: {result['ended']}")
    answer(result, _lines(piece, result), as_json=as_json)
    raise typer.Exit(0 if result["ok"] else 1)


def _stdin(is_lines: bool) -> int:
    """Return where the hand is heard; a script has to say that it is one."""
    try:
        descriptor = sys.stdin.fileno()
    except (OSError, ValueError, AttributeError) as error:
        raise GroundOptionError("ground: stdin is closed; nobody could hold the key") from error
    if not is_lines and not os.isatty(descriptor):
        raise GroundOptionError(
            "ground: stdin is no terminal, so that no key can be held; give --hold-lines and a "
            "line at least every 0.5 s"
        )
    return descriptor


def _ask(piece: Piece, config: Config, descriptor: int) -> None:
    """Say what will be done and take the deliberate word."""
    word = "click" if piece.task.kind is GroundKind.CLICK else "spray"
    note(plan_line(piece))
    if piece.task.kind is not GroundKind.CLICK:
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


def _perform(config: Config, given: tuple[str, ...], piece: Piece, hand: Hand) -> GroundOutcome:
    options = component_options(config, training="ground", watch_mission=True)
    link = build_link(config, given, options)
    executor = build_executor(config, link)
    stops = [sensor for sensor in build_sensors(config) if isinstance(sensor, EstopSwitch)]

    async def main() -> GroundOutcome:
        with hand.attending():
            return await ground.perform(
                piece.task,
                ground_setup(config),
                link=link,
                executor=executor,
                hand=hand,
                sensors=stops,
                on_ready=lambda: note(hand.invitation),
            )

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
        lines.append("a catch that was broken off is worth nothing: empty the cups, do it again")
    return lines
