"""Command line of what is done after a flight."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from analysis.replay import ReplayResult

app = typer.Typer(add_completion=False, rich_markup_mode=None)


@app.command(epilog="Example: vrspray replay flights/flight-0001.gpkg --set lag.up_s=0.12")
def replay_journal(
    journal: Annotated[Path, typer.Argument(help="File of a flight, such as flight-0001.gpkg.")],
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change the set-up first: a what-if."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """Feed a flight's recorded inputs to the core and compare every decision.

    Exit 0: all the same; 1: at least one differs; 2: the file or an option cannot be used.
    """
    from analysis.replay import replay as run

    result = run(journal, overrides=changes or ())
    typer.echo(json.dumps(asdict(result)) if as_json else _sentence(result))
    for note in _notes(result):
        typer.echo(note, err=True)
    raise typer.Exit(1 if result.differences else 0)


def _sentence(result: ReplayResult) -> str:
    return (
        f"{result.decisions} decisions from {result.inputs} inputs, {result.differences} different"
    )


def _notes(result: ReplayResult) -> list[str]:
    notes = []
    if result.training not in (None, "no"):
        notes.append(f"training: {result.training}")
    if result.first_difference:
        notes.append(f"first difference: {result.first_difference}")
    if result.lost:
        notes.append(f"{result.lost} rows are missing in the journal: differences may follow")
    if not result.is_closed:
        notes.append("the flight was cut off: its last second may be missing")
    if not result.decisions:
        notes.append("the journal has no decisions")
    return notes


# What the program's own command line takes in: one command of the kind that Typer makes.
replay = typer.main.get_command(app)
