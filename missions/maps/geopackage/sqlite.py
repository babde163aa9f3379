"""SQLite files that nobody vouches for: from memory, plain tables only, with a bounded effort.

A database is more than data: views, triggers and constraints are programs, a journal beside it
is a part of it, and opening one can write. Nothing here touches the disk or runs what the file
defines; what is read has been checked for damage first, since SQLite passes over some of it.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from missions.maps.model import map_error

Cell = str | int | float | bytes | None
Row = tuple[Cell, ...]

_MAGIC = b"SQLite format 3\0"
_HEADER_BYTES = 100
# The versions for reading and writing: 2 is write-ahead logging, which a database in memory
# cannot have (https://www.sqlite.org/fileformat.html, section 1.3).
_VERSIONS = slice(18, 20)
_JOURNAL_MAGIC = bytes.fromhex("d9d505f920a163d7")
# Steps of SQLite's machine; it takes some 50 million a second on a small computer. A table of a
# million records and ten columns needs 20 million.
_STEPS_PER_CALL = 100_000
_STEPS_MAX = 500_000_000
# One value: as many as all vertices that a map may have, and their heights.
_VALUE_BYTES_MAX = 128 * 1024 * 1024
_ALLOWED = (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ)
_PRAGMAS = ("table_xinfo", "quick_check")
_FIX = "copy it again, or export the map again"


@dataclass(frozen=True, slots=True)
class Database:
    """The plain tables of a file, by their names in lower case."""

    path: Path
    tables: dict[str, str]
    _connection: sqlite3.Connection

    def rows(self, sql: str) -> Iterator[Row]:
        """Return the rows of a query; names of the file go through `quoted` first."""
        return self._connection.execute(sql)

    def columns(self, table: str) -> list[tuple[str, str, bool]]:
        """Return name, declared type, and whether it is part of the key, of every column."""
        found = self.rows(f"PRAGMA table_xinfo({quoted(table)})")
        columns = []
        for _, name, kind, _, _, key, hidden in found:
            if hidden:
                raise not_a_table(self.path, f"{table} has a computed column ({str(name)[:40]})")
            columns.append((str(name), str(kind), bool(key)))
        return columns

    def check(self, table: str) -> None:
        """Refuse a table with damaged pages, which could lose records without a word.

        Computed columns are refused before, since the check would compute them.
        """
        self.columns(table)
        for (text,) in self.rows(f"PRAGMA quick_check({quoted(table)})"):
            if text != "ok":
                raise _damaged(self.path, f"its table {table} is damaged ({str(text)[:120]})")


def quoted(name: str) -> str:
    """Return a name as SQL can hold it.

    In backquotes: what stands in double quotes and is no name counts as text.

    >>> quoted("rate"), quoted("a`b")
    ('`rate`', '`a``b`')
    """
    return "`" + name.replace("`", "``") + "`"


@contextmanager
def open_database(content: bytes, path: Path) -> Iterator[Database]:
    """Yield the database in `content`; all that SQLite says inside becomes a `MapError`."""
    if len(content) < _HEADER_BYTES:
        raise _damaged(path, f"the file ends after {len(content)} bytes")
    if not content.startswith(_MAGIC):
        raise map_error(
            path,
            "this is no SQLite database, or it is encrypted",
            fix="export the map again",
            code="unknown-format",
        )
    steps = iter(range(_STEPS_MAX // _STEPS_PER_CALL))
    try:
        with closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
            connection.text_factory = _text
            connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _VALUE_BYTES_MAX)
            connection.execute("PRAGMA trusted_schema = OFF")
            connection.execute("PRAGMA ignore_check_constraints = ON")
            connection.execute("PRAGMA cell_size_check = ON")
            connection.deserialize(_without_log(content))
            connection.execute("PRAGMA query_only = ON")
            connection.set_authorizer(_authorized)
            connection.set_progress_handler(lambda: next(steps, None) is None, _STEPS_PER_CALL)
            yield Database(path, _tables(connection), connection)
    except (sqlite3.Error, OverflowError, UnicodeError) as error:
        if getattr(error, "sqlite_errorname", "") == "SQLITE_INTERRUPT":
            raise map_error(
                path,
                "reading it takes too long",
                fix="cut the map to one field",
                code="too-large",
            ) from None
        raise _damaged(path, f"the database cannot be read ({str(error)[:120]})") from None


def not_a_table(path: Path, text: str) -> Exception:
    """Return the error for what SQLite would have to compute by the file's own program."""
    return map_error(path, text, fix="export the layer to a file of its own", code="not-a-table")


def check_closed(path: Path) -> None:
    """Refuse a database beside which another program keeps changes that are not in it yet."""
    for suffix, magic in (("-wal", b""), ("-journal", _JOURNAL_MAGIC)):
        beside = path.with_name(path.name + suffix)
        try:
            with beside.open("rb") as file:
                head = file.read(len(_JOURNAL_MAGIC))
        except FileNotFoundError:
            continue
        except (OSError, ValueError) as error:
            raise map_error(
                beside, f"cannot be read ({error})", fix="check path and rights"
            ) from None
        # An empty or wiped file is what a program leaves that has done its work.
        if head and head.startswith(magic):
            raise map_error(
                path,
                f"there are changes in {beside.name} that are not in the file yet",
                fix="close the program that has it open, and try again",
                code="file-in-use",
            )


def _tables(connection: sqlite3.Connection) -> dict[str, str]:
    """Return the tables that are nothing else: a virtual one has no page of its own."""
    listed = connection.execute("SELECT name, type, rootpage FROM sqlite_master")
    return {
        str(name).casefold(): str(name) for name, kind, page in listed if kind == "table" and page
    }


def _authorized(action: int, name: str | None, function: str | None, *_: str | None) -> int:
    allowed = (
        action in _ALLOWED
        or (action == sqlite3.SQLITE_PRAGMA and name in _PRAGMAS)
        or (action == sqlite3.SQLITE_FUNCTION and function == "count")
    )
    return sqlite3.SQLITE_OK if allowed else sqlite3.SQLITE_DENY


def _without_log(content: bytes) -> bytes:
    if content[_VERSIONS] != b"\2\2":
        return content
    return content[: _VERSIONS.start] + b"\1\1" + content[_VERSIONS.stop :]


def _text(content: bytes) -> str:
    return content.decode("utf-8", errors="replace")


def _damaged(path: Path, text: str) -> Exception:
    return map_error(path, text, fix=_FIX, code="truncated")
