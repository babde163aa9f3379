"""The folder of journals: which flights are in it, in what state, and which of them are pinned.

A flight that has ended is never written into: a pin is an empty file beside it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from companion.errors import JournalError
from companion.journal.read_only import DAMAGE, log_of, one_line
from companion.journal.reader import OpenJournal, opened
from companion.journal.totals import applied_l
from companion.journal.versions import OtherVersionError
from companion.simulated import Simulated, simulated_in

_NAME = re.compile(r"flight-\d+(\.salvaged)?\.gpkg")
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
    simulated: Simulated | None = None
    problem: str | None = None

    @property
    def ended_utc_s(self) -> float | None:
        """Return when it ended, as far as that is known."""
        if self.started_utc_s is None or self.duration_s is None:
            return None
        return self.started_utc_s + self.duration_s


def journals(folder: Path) -> list[Path]:
    """Return the journals in their order; JournalError for a folder that cannot be read.

    A folder or a dangling link of such a name is none.
    """
    try:
        names = [
            entry.name
            for entry in folder.iterdir()
            if _NAME.fullmatch(entry.name) and entry.is_file()
        ]
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
    size_bytes, is_pinned = 0, False
    try:
        size_bytes = sum(file.stat().st_size for file in (path, log_of(path)) if file.exists())
        is_pinned = pin_of(path).exists()
        with opened(path, is_lenient=True) as journal:
            return _flight(journal, size_bytes=size_bytes, is_pinned=is_pinned)
    except OtherVersionError as error:
        state, problem = "other-version", str(error)
    except JournalError as error:
        problem = str(error)
        state = "open" if "still writes it" in problem else "damaged"
    except OSError as error:
        state, problem = "damaged", f"{path}: cannot be read: {error.strerror}"
    return Flight(
        path=path,
        size_bytes=size_bytes,
        state=state,
        is_pinned=is_pinned,
        problem=None if state == "open" else problem,
    )


def _flight(journal: OpenJournal, *, size_bytes: int, is_pinned: bool) -> Flight:
    meta, problems = journal.meta, list(journal.unread)
    duration_s = litres = started_utc_s = None
    try:
        started_utc_s = float(meta["started_s"]) + float(meta["utc_offset_s"])
        first_s, last_s = journal.connection.execute(_SPANS[journal.version]).fetchone()
        duration_s = None if first_s is None else float(last_s) - float(first_s)
        litres = applied_l(journal.connection, meta)
    except DAMAGE as error:
        problems += [] if any(one_line(error) in text for text in problems) else [one_line(error)]
    state = _STATES.get(meta.get("closed", ""), "damaged")
    return Flight(
        path=journal.path,
        size_bytes=size_bytes,
        state="damaged" if problems else state,
        is_pinned=is_pinned,
        started_utc_s=started_utc_s,
        utc_source=meta.get("utc_source"),
        duration_s=duration_s,
        applied_l=litres,
        training=meta.get("training"),
        simulated=simulated_in(meta),
        problem=f"{journal.path}: is damaged: {'; '.join(problems)}" if problems else None,
    )


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
