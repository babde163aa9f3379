"""Opening a journal so that nothing of it changes: for readers, and before anything is mended."""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

from companion.errors import VrsprayError
from companion.record.distrust import allow_damaged_list, check_beside, distrust

# What a damaged journal may do to its reader: SQLite's findings, and values that are none.
DAMAGE = (
    sqlite3.Error,
    OSError,
    ValueError,
    TypeError,
    ArithmeticError,
    LookupError,
    AttributeError,
    RecursionError,
)
# Behind a damaged page the search goes on after so many rows, each time twice as many.
_SKIPS = 24
_UNKNOWN_BYTES = 1 << 30
_NOISE = "*** in database main ***"


@contextmanager
def read_only(path: Path, *, timeout_s: float = 1.0) -> Iterator[sqlite3.Connection]:
    """Open for reading only: what a crash left (the -wal file beside it) is read, not changed."""
    check_beside(path)
    log, index = log_of(path), path.with_name(path.name + "-shm")
    with ExitStack() as at_end:
        folder = at_end.enter_context(tempfile.TemporaryDirectory(prefix="vrspray-"))
        source = path
        if log.exists() and not index.exists():
            # SQLite makes one to read the log by, and leaves it; nobody needs it any more.
            at_end.callback(index.unlink, missing_ok=True)
        if log.exists() and not os.access(path.parent, os.W_OK):
            # SQLite needs a shared-memory file beside a log: read a copy.
            for file in (path, log):
                shutil.copy(file, folder)
            source = Path(folder) / path.name
        uri = f"{source.resolve().as_uri()}?mode=ro"
        connection = at_end.enter_context(
            closing(sqlite3.connect(uri, uri=True, timeout=timeout_s))
        )
        size_bytes = sum(file.stat().st_size for file in (path, log) if file.exists())
        distrust(connection, size_bytes)
        yield connection


def tolerate_damage(connection: sqlite3.Connection) -> None:
    """Read a file that is shorter than its header says, or whose list of tables is damaged.

    SQLite refuses such a file as a whole, unless its list of tables may be written; of a
    connection that is read only nothing is written all the same.
    """
    allow_damaged_list(connection)
    connection.execute("PRAGMA writable_schema = ON")


def one_line(error: Exception) -> str:
    """Return an error's text in one line; SQLite's findings have several."""
    text = " ".join(str(error).split())
    if isinstance(error, sqlite3.Error | OSError | ValueError | VrsprayError) and text:
        return text
    return f"{type(error).__name__} {text}".strip()


def _bytes_of(source: sqlite3.Connection) -> int:
    try:
        ((pages,), (page_bytes,)) = (
            source.execute(f"PRAGMA {name}").fetchone() for name in ("page_count", "page_size")
        )
    except sqlite3.DatabaseError:
        return _UNKNOWN_BYTES
    return int(pages) * int(page_bytes)


def readable_rows(
    source: sqlite3.Connection, name: str, whole: list[bool]
) -> Iterator[tuple[Any, ...]]:
    """Yield rowid and row of all that can be read; `whole[0]` becomes False where that is less."""
    last = -(2**62)
    # Pages that lead to each other would go on for ever: a row takes five bytes and more.
    rows_max = _bytes_of(source) // 5
    try:
        for count, row in enumerate(
            source.execute(f'SELECT rowid, * FROM "{name}" ORDER BY rowid')
        ):
            if count > rows_max:
                raise sqlite3.DatabaseError("its pages lead to each other")
            last = row[0]
            yield row
    except sqlite3.DatabaseError:
        whole[0] = False
    if whole[0]:
        return
    for power in range(_SKIPS):
        if last < 0:
            last = 0
        beyond = last + 2**power
        try:
            sql = f'SELECT rowid, * FROM "{name}" WHERE rowid >= ? ORDER BY rowid'
            for count, row in enumerate(source.execute(sql, (beyond,))):
                if count > rows_max:
                    return
                last = row[0]
                yield row
        except sqlite3.DatabaseError:
            continue
        break


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


def kept_log_of(path: Path) -> Path:
    """Return where the log of a journal is kept if it was damaged."""
    return path.with_name(path.name + "-wal.damaged")


def salvaged_name(path: Path) -> Path:
    """Return where the copy of a damaged journal is."""
    return path.with_name(path.stem + ".salvaged.gpkg")


def log_of(path: Path) -> Path:
    """Return where SQLite keeps what is not yet in a journal's file."""
    return path.with_name(path.name + "-wal")
