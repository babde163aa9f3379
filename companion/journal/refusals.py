"""What a file is that cannot be read as a journal: in words, and by its class with an exit code.

A JournalError is exit 2: no file, no journal, or one that cannot be had now. An UnreadableError is
exit 1: a journal, of which what is asked for cannot be read. All commands refuse by these words.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Collection
from pathlib import Path

from companion.errors import JournalError, UnreadableError
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
