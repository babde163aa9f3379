"""What a record is known by: the SHA-256 of all that is in it.

Of a flight that was cut, a part is in the log beside the file, until it is recovered; so the log
counts too. `cat flight-0001.gpkg flight-0001.gpkg-wal | sha256sum` gives the same, without a log
`sha256sum flight-0001.gpkg`.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

_CHUNK_BYTES = 1 << 20


def log_of(path: Path) -> Path:
    """Return where SQLite keeps what is not yet in a journal's file."""
    return path.with_name(path.name + "-wal")


def content_sha256(path: Path) -> str:
    """Return the SHA-256 of a journal and of the log beside it; OSError if it cannot be read.

    Not in the process that still writes it: closing a file gives up the locks on it (POSIX).
    """
    found = hashlib.sha256()
    log = log_of(path)
    for part in (path, log) if log.exists() else (path,):
        with part.open("rb") as file:
            while chunk := file.read(_CHUNK_BYTES):
                found.update(chunk)
    return found.hexdigest()
