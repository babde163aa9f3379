"""Which files are read as journals, by kind and version; and the words that refuse the others.

A JournalError is exit 2: no file, no journal, or one that cannot be had now. An UnreadableError is
exit 1: a journal, of which what is asked for cannot be read. All commands refuse by these words.

What journals of each version have where; nothing is ever changed in a file that is read:
1: every input and decision a row of `records`, in plain JSON; a row of `applied` a decision.
2: packed rows in `blocks`, `applied` thinned, tables `valve_changes` and `link_stats`, in `meta`
   `utc_source`, `utc_offset_s` and `calibration_sha256`.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Collection, Mapping
from datetime import datetime
from importlib import metadata
from pathlib import Path

from companion.errors import JournalError, UnreadableError
from companion.journal.geopackage import JOURNAL_VERSION
from companion.journal.read_only import one_line

# Tables of a journal, of any version; a file with some of them is one, whatever else is gone.
_OWN = frozenset(
    {"meta", "records", "blocks", "events", "zones", "field", "applied", "valve_changes"}
)
_SOME = 3
_GIVE = "give the .gpkg file of a flight"
SEE_SHOW = "; see vrspray flights show"
# SQLite's words for a file that is not to be had; whatever else it says is damage.
_KEPT_BACK = ("unable to open", "readonly", "access permission", "authorization")


def refused(path: Path, error: Exception) -> JournalError:
    """Return what hinders reading a journal as the error that all commands report."""
    text = one_line(error)
    if isinstance(error, sqlite3.OperationalError):
        if "locked" in text:
            return JournalError(f"{path}: its flight still writes it; end the flight first")
        if any(word in text for word in _KEPT_BACK):
            return JournalError(f"{path}: cannot be read: {text}")
        if "interrupted" in text:
            return UnreadableError(f"{path}: is damaged: reading it comes to no end")
    if isinstance(error, PermissionError):
        return JournalError(f"{path}: cannot be read: {text}")
    if isinstance(error, sqlite3.DatabaseError) and "not a database" in text:
        return JournalError(f"{path}: is no journal; {_GIVE}")
    return UnreadableError(f"{path}: is damaged: {text}")


def no_file(path: Path) -> JournalError:
    """Return the error for a path that no file is at."""
    what = "is a folder" if path.is_dir() else "there is no such file"
    return JournalError(f"{path}: {what}; {_GIVE}")


def check_kind(name: object, tables: Collection[str], *, is_geopackage: bool) -> None:
    """Refuse what is no journal by its tables: another database, another GeoPackage."""
    if not is_geopackage:
        raise JournalError(f"{name}: is no journal; {_GIVE}")
    if len(_OWN.intersection(tables)) < _SOME:
        raise JournalError(f"{name}: is a GeoPackage, but no journal of a flight")


def why_no_setup(error: Exception) -> str:
    """Return in plain words why what was constant in a flight cannot be had."""
    if isinstance(error, json.JSONDecodeError):
        return "its text is garbled or breaks off"
    text = str(error)
    if text.startswith("set-up of version "):
        return text
    return "what it says is no set-up that this program knows"


def extent(connection: sqlite3.Connection) -> str:
    """Return in words what else there is in a journal that lacks something."""
    parts = []
    for table in ("blocks", "applied", "valve_changes", "events"):
        try:
            (count,) = connection.execute(f"SELECT count(*) FROM {table}").fetchone()
        except sqlite3.DatabaseError:
            continue
        parts.append(f"{count} rows of {table}")
    return f"{', '.join(parts) or 'nothing else'} can be read{SEE_SHOW}"


_BOTH = {"meta", "events", "zones", "field", "applied"}
_TABLES = {
    "1": frozenset({*_BOTH, "records"}),
    "2": frozenset({*_BOTH, "blocks", "block_dictionaries", "valve_changes", "link_stats"}),
}
# Without these `meta` says too little of a flight.
_NEEDED = frozenset({"closed", "lost", "setup", "started_s", "started_utc"})
# Of a journal of another version, what its refusal says: the rest is for `flights show`.
_SHOWN = {
    "started_utc": "begun",
    "closed": "closed",
    "training": "training",
    "simulated": "simulated",
    "method": "method",
}


class OtherVersionError(UnreadableError):
    """A journal of a version that this program does not know: only `meta` can be read."""

    def __init__(self, text: str, meta: Mapping[str, str]) -> None:
        super().__init__(text)
        self.meta = meta


def check_version(
    name: object, meta: Mapping[str, str], tables: Collection[str], *, is_lenient: bool = False
) -> str:
    """Return the version of a journal; a JournalError where it is none, or none that is known.

    `is_lenient` allows that tables are missing, and the version too: then the tables tell it.
    """
    check_kind(name, tables, is_geopackage=True)
    told = meta.get("journal_version")
    if _is_later(told):
        raise OtherVersionError(
            f"{name}: is a journal of version {told}, this program reads versions "
            f"{' and '.join(_TABLES)}; {_advice(meta.get('version_vrspray'))}{_said(meta)}",
            meta,
        )
    if told in _TABLES:
        version = str(told)
    elif is_lenient:
        version = "1" if "records" in tables else JOURNAL_VERSION
    else:
        raise UnreadableError(f"{name}: is damaged: {_no_version(told)}")
    missing = missing_tables(version, tables)
    if missing and not is_lenient:
        raise UnreadableError(f"{name}: is damaged: the table {missing[0]} is missing")
    return version


def check_said(meta: Mapping[str, str]) -> None:
    """Refuse a journal that does not say what every flight does."""
    missing = sorted(_NEEDED - meta.keys())
    if missing:
        raise ValueError(f"what the flight said of {missing[0]} is missing")


def as_far_as_said(
    meta: Mapping[str, str], version: str, tables: Collection[str]
) -> tuple[dict[str, str], list[str]]:
    """Return `meta` of a damaged journal so that it can be worked with, and what it lacks."""
    told = meta.get("journal_version")
    unread = [f"the table {table} is missing" for table in missing_tables(version, tables)]
    if told != version:
        unread.append(f"{_no_version(told)}; by its tables it is of version {version}")
    unread += [f"what the flight said of {key} is missing" for key in sorted(_NEEDED - meta.keys())]
    found = {**meta, "journal_version": version}
    try:
        int(found.setdefault("lost", "0"))
    except ValueError:
        unread.append("what the flight said of lost is no number")
        found["lost"] = "0"
    try:
        return migrated(found), unread
    except (ValueError, TypeError, LookupError):
        # Said above, or by whoever wants a time of day.
        return {"utc_source": "computer", **found}, unread


def _is_later(version: str | None) -> bool:
    """Whether a version is a number, and one that comes after those that are known."""
    text = str(version)
    return text.isdecimal() and int(text) > int(JOURNAL_VERSION)


def _no_version(told: str | None) -> str:
    return "its version is missing" if told is None else f"its version ({str(told)[:20]}) is none"


def _said(meta: Mapping[str, str]) -> str:
    """Return what a journal says of itself as the end of a sentence."""
    facts = [f"{word} {str(meta[key])[:40]}" for key, word in _SHOWN.items() if key in meta]
    return f"; it says of itself: {', '.join(facts)}" if facts else ""


def missing_tables(version: str, tables: Collection[str]) -> list[str]:
    """Return the tables that a journal of this version has and this one has not."""
    return sorted(_TABLES[version] - set(tables))


def _advice(wrote: str | None) -> str:
    """Return which program reads it; one that is not yet released bears the number before it."""
    try:
        own = metadata.version("vrspray")
    except metadata.PackageNotFoundError:
        own = None
    if wrote in (None, "unknown", own):
        return "use a newer vrspray"
    return f"use vrspray {wrote}, which wrote it"


def migrated(meta: Mapping[str, str]) -> dict[str, str]:
    """Return `meta` as a file of today has it: what an old one does not say is worked out."""
    found = dict(meta)
    if "utc_offset_s" not in found:
        started_s = float(found["started_s"])
        utc_s = datetime.fromisoformat(found["started_utc"]).timestamp()
        found["utc_offset_s"] = repr(utc_s - started_s)
    found.setdefault("utc_source", "computer")
    return found
