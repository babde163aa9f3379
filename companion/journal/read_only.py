"""Opening a journal so that nothing of it changes: for readers, and before anything is mended."""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

from companion.errors import VrsprayError
from companion.journal.distrust import check_beside, distrust

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


def one_line(error: Exception) -> str:
    """Return an error's text in one line; SQLite's findings have several."""
    text = " ".join(str(error).split())
    if isinstance(error, sqlite3.Error | OSError | ValueError | VrsprayError) and text:
        return text
    return f"{type(error).__name__} {text}".strip()


def kept_log_of(path: Path) -> Path:
    """Return where the log of a journal is kept if it was damaged."""
    return path.with_name(path.name + "-wal.damaged")


def salvaged_name(path: Path) -> Path:
    """Return where the copy of a damaged journal is."""
    return path.with_name(path.stem + ".salvaged.gpkg")


def log_of(path: Path) -> Path:
    """Return where SQLite keeps what is not yet in a journal's file."""
    return path.with_name(path.name + "-wal")
