"""Where the log of a cut journal is damaged, and how much of the flight went with that."""

from __future__ import annotations

import math
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from companion.atomic_write import sync_folder
from companion.journal.geopackage import time_text
from companion.journal.leaf_page import Cell, cells_of, is_of, tables_of, values_of
from companion.journal.log_frames import Log, page_bytes_of, read_log
from companion.journal.read_only import kept_log_of, log_of
from companion.journal.writer import SET_META

EVENT_KIND = "log-damaged"
META_KEY = "log_damaged"
# Tables whose rows have a time and lie in one page, and its column.
_TIMES_S = {"applied": 3, "link_stats": 1, "events": 2}
_LAST_S = {
    "applied": "SELECT max(time_s) FROM applied",
    "blocks": "SELECT max(until_s) FROM blocks",
    "link_stats": "SELECT max(time_s) FROM link_stats",
}
_NUMBERS = {
    "events": "SELECT max(sequence) FROM events",
    "applied": "SELECT max(sequence) FROM applied",
    "blocks": "SELECT max(last_sequence) FROM blocks",
    "records": "SELECT max(sequence) FROM records",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class LogDamage:
    """The first bad byte of a log that goes on behind it; `until_s`: how far it goes, if known."""

    at: int
    size: int
    until_s: float | None

    def text(self, last_s: float | None) -> str:
        """Return it in words; `last_s` is the last time in what is left of the journal."""
        lost = ""
        if self.until_s is not None and last_s is not None:
            lost = f", at most about {math.ceil(self.until_s - last_s)} s,"
        return (
            f"the log is damaged at byte {self.at} of {self.size}: "
            f"what was committed behind it{lost} is lost"
        )


def log_damage(path: Path) -> LogDamage | None:
    """Return where the log of a journal is damaged; None where it is whole or ordinarily torn."""
    log = read_log(log_of(path), page_bytes_of(path))
    if log.damage_at is None:
        return None
    return LogDamage(
        at=log.damage_at, size=len(log.content), until_s=max(_times_s(log), default=None)
    )


def _times_s(log: Log) -> Iterator[float]:
    """Yield the times of the rows behind the damage."""
    for frame in log.behind:
        page = log.page(frame)
        try:
            cells = cells_of(page, log.page_bytes)
        except ValueError:
            continue
        for table in tables_of(cells) & _TIMES_S.keys():
            # The newest row is the last one.
            at_s = _time_s(cells[-1], table, log.page_bytes)
            if at_s is not None:
                yield at_s


def _time_s(cell: Cell, table: str, usable: int) -> float | None:
    """Return the time of a row that lies in one page."""
    try:
        row = (cell.rowid, *values_of(cell, lambda _: None, usable)[1:])
    except ValueError:
        return None
    at_s = row[_TIMES_S[table]] if is_of(table, row) else None
    return float(at_s) if isinstance(at_s, int | float) else None


def keep_log(path: Path) -> None:
    """Copy the log beside the journal: recovery takes of it what counts, and removes it."""
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".new-") as folder:
        draft = Path(folder) / "log"
        shutil.copyfile(log_of(path), draft)
        with draft.open("rb") as file:
            os.fsync(file.fileno())
        draft.replace(kept_log_of(path))
    sync_folder(path.parent)


def mark(connection: sqlite3.Connection, damage: LogDamage) -> str | None:
    """Write it into `meta` and `events`, within the caller's transaction; return it in words.

    None where nothing is lost: all of the log was in the file already.
    """
    tables = {row[0] for row in connection.execute("SELECT name FROM sqlite_master")}
    # Where nothing is left, all since the start is lost.
    last_s = max(_asked(connection, tables, _LAST_S), default=_told_s(connection, "started_s"))
    number = int(max(_asked(connection, tables, _NUMBERS), default=0)) + 1
    if damage.until_s is not None and last_s is not None and damage.until_s <= last_s:
        return None
    text = damage.text(last_s)
    offset_s = _told_s(connection, "utc_offset_s")
    time = None if offset_s is None or last_s is None else time_text(offset_s + last_s)
    connection.execute(
        "INSERT INTO events VALUES (?, ?, ?, ?, ?)", (number, time, last_s, EVENT_KIND, text)
    )
    for fact in ((META_KEY, text), ("closed", "recovered")):
        connection.execute(SET_META, fact)
    return text


def _asked(
    connection: sqlite3.Connection, tables: set[str], questions: dict[str, str]
) -> Iterator[float]:
    for table, sql in questions.items():
        (found,) = connection.execute(sql).fetchone() if table in tables else (None,)
        if isinstance(found, int | float):
            yield found


def _told_s(connection: sqlite3.Connection, key: str) -> float | None:
    """Return a time that `meta` says; None where it says none."""
    found = connection.execute("SELECT value FROM meta WHERE key = ?", (key,)).fetchone()
    try:
        time_s = float(found[0])
    except (TypeError, ValueError):
        return None
    return time_s if math.isfinite(time_s) else None
