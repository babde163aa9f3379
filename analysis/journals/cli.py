"""Those commands of `vrspray flights` that look into a damaged file, or at a whole one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from analysis.journals.remaining import remaining
from analysis.journals.salvage import recover_folder
from analysis.journals.show import content_lines, content_of
from companion.cli.answer import AsJson, answer
from companion.cli.flights import FAILED, ConfigFile, Folder, as_object, line_of, place_of
from companion.errors import JournalError
from companion.journal.folder import look_at

SHOW, REMAINING, RECOVER = (
    typer.Typer(add_completion=False, rich_markup_mode=None) for _ in range(3)
)
REMAINING.command(
    epilog="Example: vrspray flights remaining flights/flight-0001.gpkg --out rest.geojson"
)(remaining)


@SHOW.command(epilog="Example: vrspray flights show flights/flight-0001.gpkg")
def show(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="A journal, a .gpkg file.")],
    as_json: AsJson = False,
) -> None:
    """Show what a journal records about its flight, and how much it holds.

    Exit 0: all can be read; 1: it is damaged or of another version, and what could not be read is
    said; 2: no journal, or its flight still writes it.
    """
    flight = look_at(path)
    if flight.state == "open" or not path.is_file():
        raise JournalError(flight.problem or f"{path}: its flight still writes it")
    content = content_of(path)
    result = {**as_object(flight), **content}
    answer(result, [line_of(flight), *content_lines(content)], as_json=as_json)
    if content["unread"]:
        raise typer.Exit(FAILED)


@RECOVER.command(epilog="Example: vrspray flights recover --folder flights")
def recover(folder: Folder = None, config_file: ConfigFile = None, as_json: AsJson = False) -> None:
    """Repair journals after a crash or power cut; exit 1 if one stays damaged."""
    where, _ = place_of(folder, config_file)
    found = recover_folder(where)
    result = {
        "folder": str(where),
        "journals": [
            {"file": str(each.path), "outcome": each.outcome, "text": each.text}
            | {"took_s": each.took_s}
            for each in found
        ],
    }
    lines = [f"{each.path.name}: {each.outcome}: {each.text}" for each in found]
    answer(result, lines or ["nothing to recover"], as_json=as_json)
    if not all(each.is_good for each in found):
        raise typer.Exit(FAILED)
