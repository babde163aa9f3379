"""Command line of what is done after a flight."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.answer import AsJson, JournalFile, answer, new_app, note
from companion.wording import CUT

if TYPE_CHECKING:
    from analysis.replay import ReplayResult

ZONES_SHOWN = 10
# A border that nothing may cross is kept by the first and the last flow of a valve.
STRICT = {"lag.on_s": "lag.on_start_s", "lag.off_s": "lag.off_end_s"}

app = new_app()


@app.command(epilog="Example: vrspray replay flights/flight-0001.gpkg --set lag.up_s=0.12")
def replay_journal(
    journal: JournalFile,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change a setting first, to ask what if."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Replay a flight's recorded inputs and compare every decision.

    With --set: what would have been sprayed. The ground cannot react: the aircraft flies as it
    flew, and the sprayer stays what the recorded set-up says of it.

    Exit 0: all the same; 1: a decision or the treated ground differs, or the file is damaged or of
    another version; 2: it is not a journal, or an option cannot be used.
    """
    from analysis.replay import replay as run

    result = run(journal, overrides=changes or (), say=note)
    more = _without_effect(changes or ()) if _is_idle(result) else _what_if(result)
    answer(asdict(result), [_sentence(result), *more], as_json=as_json)
    for line in _notes(result):
        note(line)
    is_same = not (result.differences or result.coverage_differs or result.unread)
    raise typer.Exit(0 if is_same else 1)


def _sentence(result: ReplayResult) -> str:
    return (
        f"{result.decisions} decisions from {result.inputs} inputs, {result.differences} different"
    )


def _is_idle(result: ReplayResult) -> bool:
    return result.is_what_if and not result.differences


def _without_effect(changes: Sequence[str]) -> Iterator[str]:
    """Yield that a what-if changed nothing, and why where that is known."""
    yield f"no decision of this flight depends on {', '.join(changes)}"
    for change in changes:
        key = change.partition("=")[0].strip()
        if key in STRICT:
            yield f"where the border is strict, {STRICT[key]} rules in its place"


def _what_if(result: ReplayResult) -> Iterator[str]:
    """Yield what the recorded decisions sprayed and what the others would have."""
    was, now, moved = result.recorded, result.what_if, result.moved_m
    if was is None or now is None or moved is None:
        return
    yield f"{'':24}{'recorded':>12}{'what-if':>12}"
    rows = (
        ("sprayed, L", was.volume_l, now.volume_l),
        ("misapplied, %", was.misapplied_percent, now.misapplied_percent),
        ("lag distance, mean, m", was.lag_distance_m.mean, now.lag_distance_m.mean),
        ("  mean of absolutes, m", was.lag_distance_m.mean_abs, now.lag_distance_m.mean_abs),
        ("border margin, least, m", was.border_margin_m.min, now.border_margin_m.min),
        ("outside the field, mL", was.off_target_ml, now.off_target_ml),
    )
    for name, *values in rows:
        yield f"{name:24}" + "".join(
            f"{'-':>12}" if value is None else f"{value:12.3f}" for value in values
        )
    if moved.mean is not None:
        yield (
            f"{moved.count} changes moved by {moved.mean:+.3f} m on average, "
            f"{moved.max_abs:.3f} m at most (+ is later)"
        )
    zones = sorted(was.zones.keys() | now.zones.keys())
    litres = [(zone, was.zones.get(zone, 0.0), now.zones.get(zone, 0.0)) for zone in zones]
    litres.sort(key=lambda row: -abs(row[2] - row[1]))
    for zone, before, after in litres[:ZONES_SHOWN]:
        yield f"{'zone ' + zone:24}{before:12.4f}{after:12.4f}"
    if len(litres) > ZONES_SHOWN:
        yield f"{len(litres) - ZONES_SHOWN} zones that differ less: --json has them"


def _notes(result: ReplayResult) -> list[str]:
    notes = []
    if result.simulated == "yes":
        notes.append("a simulated flight: nothing was flown")
    elif result.training not in (None, "no"):
        notes.append(f"training: {result.training}")
    if result.first_difference:
        notes.append(f"first difference: {result.first_difference}")
    if result.differences and result.elsewhere and not result.is_what_if:
        notes.append(f"flown with {', '.join(result.elsewhere)}: a last bit may differ for that")
    if result.coverage_differs:
        notes.append(f"treated ground: {result.coverage_differs} cells of 0.2 m differ")
    elif result.coverage_differs is None and not result.is_what_if:
        why = "it cannot be read" if result.unread else "the journal keeps none"
        notes.append(f"treated ground is not compared: {why}")
    notes += [f"not read: {text}" for text in result.unread]
    if result.lost:
        notes.append(f"{result.lost} rows are missing in the journal: differences may follow")
    if not result.is_closed:
        notes.append(CUT)
    if not result.decisions:
        notes.append("the journal has no decisions")
    return notes


# What the program's own command line takes in: one command of the kind that Typer makes.
replay = typer.main.get_command(app)
