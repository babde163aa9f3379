"""Those commands of `vrspray flights` that look into a damaged file, or at a whole one."""

from __future__ import annotations

import json
import shlex
import sqlite3
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from analysis.journals.content import read_entries
from analysis.journals.jobs import joined, one_job
from analysis.journals.remaining import remaining
from analysis.journals.salvage import recover_folder
from companion.cli.answer import AsJson, answer, new_app
from companion.cli.flights import FAILED, ConfigFile, Folder, as_object, line_of, place_of
from companion.errors import JournalError, UnreadableError
from companion.journal.folder import look_at
from companion.journal.read_only import DAMAGE, one_line
from companion.journal.reader import (
    SEE_SHOW,
    OpenJournal,
    OtherVersionError,
    damaged_pages,
    opened,
    readable_rows,
)
from companion.journal.writer import missing_rows
from companion.wording import counted

# In `meta` for programs, or shown elsewhere.
_LONG = frozenset({"setup", "config_toml"})
_FLIGHT_MAP = "flight_map_json"
_LINK = (
    "SELECT count(*), max(lost_percent), max(round_trip_s), min(position_hz), max(bad_frames), "
    "max(unsent_frames) FROM link_stats"
)
_LINK_KEYS = (
    "samples",
    "lost_percent",
    "round_trip_max_s",
    "position_min_hz",
    "bad_frames",
    "unsent_frames",
)
_COUNTED = ("applied", "valve_changes", "link_stats", "coverage_tiles", "zones", "events")


def content_of(path: Path) -> dict[str, Any]:
    """Return all of it; `unread` says in a line each what is damaged or unknown.

    JournalError for what is no journal.
    """
    result: dict[str, Any] = {
        "meta": {},
        "entries": {},
        "tables": {},
        "events": [],
        "link": None,
        "unread": [],
    }
    unread: list[str] = result["unread"]
    try:
        with opened(path, is_lenient=True) as journal:
            _fill(result, journal)
    except OtherVersionError as error:
        result["meta"] = _shown(error.meta)
        unread.append(str(error))
    except UnreadableError as error:
        unread.append(str(error).partition("is damaged: ")[2] or str(error))
    return result


def _shown(meta: Mapping[str, str]) -> dict[str, str]:
    return {key: value for key, value in meta.items() if key not in _LONG}


def _fill(result: dict[str, Any], journal: OpenJournal) -> None:
    unread: list[str] = result["unread"]
    result["meta"] = _shown(journal.meta)
    unread += journal.unread
    kinds: Counter[str] = Counter()
    result["entries"] = kinds
    connection = journal.connection
    unread += damaged_pages(connection)
    try:
        for entry in read_entries(connection, journal.version, unread=unread):
            kinds[entry.kind] += 1
    except sqlite3.DatabaseError as error:
        unread.append(f"inputs and decisions behind the first {kinds.total()}: {error}")
    try:
        journal.setup()
    except UnreadableError as error:
        unread.append(str(error).partition("is damaged: ")[2].removesuffix(SEE_SHOW))
    except DAMAGE as error:
        unread.append(f"what earlier flights treated: {one_line(error)}")
    _fill_tables(result, journal)
    sql = "SELECT time, time_s, kind, text FROM events ORDER BY sequence"
    marks = _tried(unread, "events", connection, sql)
    keys = ("time", "time_s", "kind", "text")
    result["events"] = [dict(zip(keys, row, strict=True)) for row in marks or []]


def _fill_tables(result: dict[str, Any], journal: OpenJournal) -> None:
    unread: list[str] = result["unread"]
    connection = journal.connection
    there = {row[0] for row in connection.execute("SELECT name FROM sqlite_master")}
    for name in _COUNTED:
        if name in there:
            result["tables"][name] = _count(unread, name, connection)
    told = {text.partition(":")[0] for text in unread}
    for text in missing_rows(connection, journal.meta):
        unread += [] if text.partition(":")[0] in told else [text]
    if "link_stats" in there:
        rows = _tried(unread, "link_stats", connection, _LINK)
        if rows and rows[0][0]:
            result["link"] = dict(zip(_LINK_KEYS, rows[0], strict=True))


def _count(unread: list[str], name: str, connection: sqlite3.Connection) -> int:
    """Return how many rows of a table there are, or can be read."""
    try:
        return int(connection.execute(f"SELECT count(*) FROM {name}").fetchone()[0])
    except sqlite3.DatabaseError as error:
        count = sum(1 for _ in readable_rows(connection, name, [True]))
        unread.append(f"{name}: only {count} rows can be read: {one_line(error)}")
        return count


def _tried(
    unread: list[str], what: str, connection: sqlite3.Connection, sql: str
) -> list[tuple[Any, ...]]:
    """Return all rows of a question; what damage hinders is said in `unread`."""
    try:
        return connection.execute(sql).fetchall()
    except sqlite3.DatabaseError as error:
        unread.append(f"{what}: {' '.join(str(error).split())}")
        return []


def content_lines(content: Mapping[str, Any]) -> Iterator[str]:
    """Yield it for a person."""
    for key, value in content["meta"].items():
        if key == _FLIGHT_MAP:
            yield f"flight map: {_told_of_map(str(value))}"
            continue
        text = " ".join(str(value).split())
        yield f"{key}: {text if len(text) <= 90 else text[:87] + '...'}"
    if content["entries"]:
        counts = ", ".join(f"{count} {kind}" for kind, count in content["entries"].items())
        yield f"inputs and decisions: {counts}"
    if content["tables"]:
        rows = ", ".join(f"{name} {count}" for name, count in content["tables"].items())
        yield f"rows: {rows}"
    if content["link"]:
        link = ", ".join(f"{key} {_number(value)}" for key, value in content["link"].items())
        yield f"link: {link}"
    for event in content["events"]:
        yield f"{event['time'] or '-'} {event['kind']}: {event['text']}"
    for text in content["unread"]:
        yield f"not read: {text}"


def _told_of_map(text: str) -> str:
    """Return in a line which flight map was flown; a journal may say anything there."""
    try:
        found = json.loads(text)
        line = (
            f"{str(found['sha256'])[:8]} of {found['source']}, compiled {found['compiled_utc']} by "
            f"{found['compiled_by']}, {counted(len(found['findings']), 'finding')}"
        )
    except (ValueError, TypeError, LookupError, RecursionError):
        line = text
    return " ".join(line.split())[:200]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:g}"


SHOW, REMAINING, RECOVER, JOB = (new_app() for _ in range(4))
REMAINING.command(
    epilog="Example: vrspray flights remaining flights/flight-0001.gpkg --out rest.geojson"
)(remaining)


@JOB.command(epilog="Example: vrspray flights job flights/flight-0001.gpkg")
def job(
    journals: Annotated[
        list[Path], typer.Argument(metavar="JOURNAL...", help="One sortie of the job, or several.")
    ],
    as_json: AsJson = False,
) -> None:
    """List the sorties of a job: flights in the same folder with the id of one plan.

    Flights of the same map within 48 hours are only named: it may be a second treatment.
    """
    found, others = joined(one_job(journals))
    paths = [shlex.quote(str(each.path)) for each in found]
    more = [shlex.quote(str(each.path)) for each in others]
    result = {
        "job": next((each.job for each in found if each.job), None),
        "sorties": [as_object(look_at(each.path)) for each in found],
        "perhaps": [as_object(look_at(each.path)) for each in others],
        "report": f"vrspray report {' '.join(paths)} --out report",
    }
    lines = [line_of(look_at(each.path)) for each in found]
    lines.append(f"report of {counted(len(found), 'sortie')}: {result['report']}")
    if more:
        lines.append(
            f"of the same map within 48 h, perhaps of this job: vrspray flights job "
            f"{' '.join([*paths, *more])}"
        )
    answer(result, lines, as_json=as_json)


@SHOW.command(epilog="Example: vrspray flights show flights/flight-0001.gpkg")
def show(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="A journal, a .gpkg file.")],
    as_json: AsJson = False,
) -> None:
    """Show what a journal records about its flight, and how much it holds.

    Exit 0: all can be read; 1: it is damaged or of another version, and what could not be read
    is listed; 2: no journal, or its flight still writes it.
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
