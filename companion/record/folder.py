"""The folder of journals: which flights are in it, in what state, and which of them are pinned.

A flight that has ended is never written into: a pin is an empty file beside it.
"""

from __future__ import annotations

import re
import sqlite3
from dataclasses import dataclass
from pathlib import Path

from companion.errors import JournalError
from companion.record.content_hash import log_of
from companion.record.reader import OpenJournal, opened
from companion.record.versions import OtherVersionError

_NAME = re.compile(r"flight-\d+(\.salvaged)?\.gpkg")
_GAP_MAX_S = 1.0
_STATES = {"yes": "closed", "no": "cut", "recovered": "recovered", "salvaged": "salvaged"}
_SPANS = {
    "1": "SELECT min(time_s), max(time_s) FROM records",
    "2": "SELECT min(from_s), max(until_s) FROM blocks",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Flight:
    """A journal in the folder; what cannot be told of it is None, and `problem` says why.

    `state` is open (its flight still writes it), closed, cut (by a crash, not yet recovered),
    recovered, salvaged, damaged, or other-version.
    """

    path: Path
    size_bytes: int
    state: str
    is_pinned: bool
    started_utc_s: float | None = None
    utc_source: str | None = None
    duration_s: float | None = None
    applied_l: float | None = None
    training: str | None = None
    problem: str | None = None

    @property
    def ended_utc_s(self) -> float | None:
        """Return when it ended, as far as that is known."""
        if self.started_utc_s is None or self.duration_s is None:
            return None
        return self.started_utc_s + self.duration_s


def journals(folder: Path) -> list[Path]:
    """Return the journals in their order; JournalError for a folder that cannot be read."""
    try:
        names = sorted(entry.name for entry in folder.iterdir() if _NAME.fullmatch(entry.name))
    except OSError as error:
        raise JournalError(
            f"{folder}: cannot be read ({error.strerror}); name the folder of the flights"
        ) from error
    return [folder / name for name in sorted(names, key=_number)]


def _number(name: str) -> tuple[int, str]:
    found = re.match(r"flight-(\d+)", name)
    return (int(found[1]) if found else 0, name)


def look_at(path: Path) -> Flight:
    """Return what can be told of a journal without reading all of it."""
    size_bytes = sum(file.stat().st_size for file in (path, log_of(path)) if file.exists())
    is_pinned = pin_of(path).exists()
    try:
        with opened(path, is_lenient=True) as journal:
            return _flight(journal, size_bytes=size_bytes, is_pinned=is_pinned)
    except OtherVersionError as error:
        state, problem = "other-version", str(error)
    except JournalError as error:
        problem = str(error)
        state = "open" if "still writes it" in problem else "damaged"
    return Flight(
        path=path,
        size_bytes=size_bytes,
        state=state,
        is_pinned=is_pinned,
        problem=None if state == "open" else problem,
    )


def _flight(journal: OpenJournal, *, size_bytes: int, is_pinned: bool) -> Flight:
    meta, problem = journal.meta, None
    duration_s = applied_l = None
    try:
        first_s, last_s = journal.connection.execute(_SPANS[journal.version]).fetchone()
        duration_s = None if first_s is None else last_s - first_s
        applied_l = _applied_l(journal.connection)
    except sqlite3.DatabaseError as error:
        problem = f"{journal.path}: is damaged: {' '.join(str(error).split())}"
    return Flight(
        path=journal.path,
        size_bytes=size_bytes,
        state="damaged" if problem else _STATES.get(meta.get("closed", ""), "damaged"),
        is_pinned=is_pinned,
        started_utc_s=float(meta["started_s"]) + float(meta["utc_offset_s"]),
        utc_source=meta["utc_source"],
        duration_s=duration_s,
        applied_l=applied_l,
        training=meta.get("training"),
        problem=problem,
    )


def _applied_l(connection: sqlite3.Connection) -> float:
    """Return what the ordered duties stand for in litres: not a measurement."""
    applied_l, before_s, flow_l_min = 0.0, None, 0.0
    rows = connection.execute("SELECT time_s, flow_l_min FROM applied ORDER BY sequence")
    for at_s, flow in rows:
        if before_s is not None and at_s is not None and 0.0 < at_s - before_s < _GAP_MAX_S:
            applied_l += flow_l_min * (at_s - before_s) / 60.0
        before_s, flow_l_min = at_s, flow or 0.0
    return applied_l


def pin_of(path: Path) -> Path:
    """Return the file that says that a flight is pinned."""
    return path.with_name(path.name + ".pin")


def set_pinned(path: Path, *, is_pinned: bool) -> bool:
    """Pin a flight, or no longer; return whether that was news."""
    if not path.is_file():
        raise JournalError(f"{path}: there is no such file; give the .gpkg file of a flight")
    pin = pin_of(path)
    if pin.exists() == is_pinned:
        return False
    try:
        if is_pinned:
            pin.touch()
        else:
            pin.unlink()
    except OSError as error:
        raise JournalError(f"{pin}: cannot be written ({error.strerror})") from error
    return True
