"""A look at the whole file before anything is made of it: damage that no reader would meet.

Who evaluates a flight reads some tables; a page that is gone elsewhere would go without a word.
"""

from __future__ import annotations

import sqlite3
from pathlib import Path

from companion.record.blocks import span_text
from companion.record.content_hash import log_of
from companion.record.read_only import one_line
from companion.record.unpacking import inflated

_NOISE = "*** in database main ***"
_BLOCKS = (
    "SELECT first_sequence, from_s, until_s, dictionary, body, decisions FROM blocks "
    "ORDER BY first_sequence"
)


def damages(connection: sqlite3.Connection) -> list[str]:
    """Return in a line each what is damaged in the file's pages and in its packed rows."""
    return [*damaged_pages(connection), *damaged_blocks(connection)]


def damaged_pages(connection: sqlite3.Connection) -> list[str]:
    """Return what SQLite finds in the file's own order: one line, or none where it is sound."""
    if _ends_within_a_page(connection):
        return ["the file is shorter than it was: it ends within a page"]
    try:
        (verdict,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    except sqlite3.DatabaseError as error:
        verdict = one_line(error)
    if verdict == "ok":
        return []
    found = " ".join(str(verdict).replace(_NOISE, "").split())
    return [f"a part of the file is damaged ({found})"]


def damaged_blocks(connection: sqlite3.Connection) -> list[str]:
    """Return which packed rows are damaged, in one line; they are inflated and not unpacked.

    Each is a stream with a check sum of its own (RFC 1950): what SQLite cannot see shows there.
    """
    if not _has_blocks(connection):
        return []
    bad: list[str] = []
    count = 0
    try:
        dictionaries = {None: b""} | {
            number: inflated(body, b"")
            for number, body in connection.execute("SELECT id, body FROM block_dictionaries")
        }
        for first, from_s, until_s, dictionary, *parts in connection.execute(_BLOCKS):
            count += 1
            try:
                for part in parts:
                    inflated(part, dictionaries[dictionary])
            except (ValueError, TypeError, LookupError):
                bad.append(f"from row {first} on ({span_text(from_s, until_s)})")
    except (sqlite3.DatabaseError, ValueError, TypeError) as error:
        return [f"inputs and decisions behind the first {count} blocks: {one_line(error)}"]
    if not bad:
        return []
    return [f"inputs and decisions: {len(bad)} of {count} blocks are damaged, the first {bad[0]}"]


def _ends_within_a_page(connection: sqlite3.Connection) -> bool:
    """Whether the last page is not whole: SQLite takes what is missing of it for zeros.

    By the file's size alone: to open it here would give up SQLite's locks. A log beside it may
    still have that page.
    """
    try:
        (page_bytes,) = connection.execute("PRAGMA page_size").fetchone()
        ((_, _, name),) = connection.execute("PRAGMA database_list").fetchall()
        path = Path(name)
        return bool(path.stat().st_size % page_bytes) and not log_of(path).exists()
    except (sqlite3.DatabaseError, OSError, ValueError):
        return False


def _has_blocks(connection: sqlite3.Connection) -> bool:
    sql = "SELECT count(*) FROM sqlite_master WHERE name IN ('blocks', 'block_dictionaries')"
    try:
        return bool(connection.execute(sql).fetchone()[0] == 2)
    except sqlite3.DatabaseError:
        return False
