"""What journals of each version have where; nothing is ever changed in a file that is read.

1: every input and decision a row of `records`, in plain JSON; a row of `applied` a decision.
2: packed rows in `blocks`, `applied` thinned, tables `valve_changes` and `link_stats`, in `meta`
   `utc_source`, `utc_offset_s` and `calibration_sha256`.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator, Mapping
from datetime import datetime
from importlib import metadata

from companion.errors import JournalError
from companion.record.blocks import Entry, read_blocks

JOURNAL_VERSION = "2"
_TABLES = {
    "1": frozenset({"meta", "records", "events", "zones", "field"}),
    "2": frozenset({"meta", "blocks", "events", "zones", "field"}),
}


class OtherVersionError(JournalError):
    """A journal of a version that this program does not know: only `meta` can be read."""

    def __init__(self, text: str, meta: Mapping[str, str]) -> None:
        super().__init__(text)
        self.meta = meta


def check_version(
    name: object, meta: Mapping[str, str], tables: Collection[str], *, is_lenient: bool = False
) -> str:
    """Return the version of a journal; a JournalError where it is none, or none that is known.

    `is_lenient` allows that tables are missing.
    """
    version = meta.get("journal_version")
    if version is None:
        raise JournalError(f"{name}: is a GeoPackage, but no journal of a flight")
    if version not in _TABLES:
        raise OtherVersionError(
            f"{name}: is a journal of version {version}, this program reads versions "
            f"{' and '.join(_TABLES)}; {_advice(meta.get('version_vrspray'))}",
            meta,
        )
    if not is_lenient and missing_tables(version, tables):
        raise JournalError(f"{name}: is a GeoPackage, but no journal of a flight")
    return version


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


def read_entries(
    connection: sqlite3.Connection,
    version: str,
    *,
    kinds: Collection[str] | None = None,
    unread: list[str] | None = None,
) -> Iterator[Entry]:
    """Yield inputs and decisions in their order, or those of some kinds.

    What is damaged is a ValueError; with `unread` it is said there, and left out.
    """
    if version != "1":
        yield from read_blocks(connection, kinds=kinds, unread=unread)
        return
    rows = connection.execute("SELECT sequence, kind, body FROM records ORDER BY sequence")
    for row in rows:
        entry = Entry(*row)
        if kinds is None or entry.kind in kinds:
            yield entry
