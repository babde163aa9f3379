"""A new journal's file: complete and empty before anybody sees it, then open for one flight."""

from __future__ import annotations

import os
import platform
import re
import sqlite3
import threading
from collections.abc import Mapping
from contextlib import ExitStack, closing
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from companion.core.setup import Setup
from companion.journal.coverage_table import write_treated
from companion.journal.geopackage import JOURNAL_VERSION, RESERVE, SCHEMA
from companion.journal.layers import write_layers
from companion.journal.setup_json import calibration_sha256, setup_to_json

_LIBRARIES = ("vrspray", "numpy", "shapely", "pyproj")


def about(setup: Setup, started: datetime, started_s: float) -> dict[str, str]:
    """Return what the file says of itself."""
    about = {
        "journal_version": JOURNAL_VERSION,
        "closed": "no",
        "lost": "0",
        "valve_changes": "plans",
        "started_utc": started.isoformat(),
        "started_s": repr(started_s),
        "utc_source": "computer",
        "utc_offset_s": repr(started.timestamp() - started_s),
        "origin_latitude_deg": repr(setup.frame.latitude_deg),
        "origin_longitude_deg": repr(setup.frame.longitude_deg),
        "map_sha256": setup.prescription.sha256,
        "calibration_sha256": calibration_sha256(setup),
        "method": str(setup.method),
        "platform": platform.platform(),
        "setup": setup_to_json(setup),
    }
    return about | computing()


def computing() -> dict[str, str]:
    """Return what the last bit of a decision may depend on: processor, Python and libraries."""
    here = {"machine": platform.machine(), "python": platform.python_version()}
    for name in _LIBRARIES:
        try:
            here[f"version_{name}"] = version(name)
        except PackageNotFoundError:
            here[f"version_{name}"] = "unknown"
    return here


# The first time that a table outgrows its page, SQLite moves all its rows to a new page at the end
# of the file, the part that a cut takes first. So `meta`, with the set-up in it, has outgrown its
# page (4,096 bytes) from the start: by a row that fills nearly all of one and says nothing.
RESERVE_BYTES = 3_900


def new_file(folder: Path, setup: Setup, meta: Mapping[str, str]) -> Path:
    """Make a complete, empty journal beside its place and move it there under the next number.

    A link refuses a name that exists, so two processes never share a file, and whoever looks
    sees a valid GeoPackage or nothing.
    """
    draft = folder / f".new-{os.getpid()}-{threading.get_ident()}.gpkg"
    draft.unlink(missing_ok=True)
    try:
        _write_schema(draft, setup, meta)
        while True:
            path = folder / f"flight-{_next_number(folder):04d}.gpkg"
            try:
                os.link(draft, path)
            except FileExistsError:
                continue
            except OSError:  # a file system without links, such as a FAT card
                draft.rename(path)
            return path
    finally:
        draft.unlink(missing_ok=True)


def _next_number(folder: Path) -> int:
    numbers = (re.fullmatch(r"flight-(\d+)\.gpkg.*", entry.name) for entry in folder.iterdir())
    return max((int(found[1]) for found in numbers if found), default=0) + 1


def _write_schema(path: Path, setup: Setup, meta: Mapping[str, str]) -> None:
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        # Nobody knows the draft yet: one sync at its end instead of one a statement.
        connection.execute("PRAGMA synchronous = OFF")
        connection.execute("PRAGMA journal_mode = MEMORY").fetchall()
        connection.executescript(SCHEMA)
        write_layers(connection, setup.frame, setup.prescription)
        write_treated(connection, setup.treated)
        rows = [*meta.items(), (RESERVE, " " * RESERVE_BYTES)]
        connection.executemany("INSERT INTO meta (key, value) VALUES (?, ?)", rows)
    with path.open("rb") as file:
        os.fsync(file.fileno())


def open_for_flight(path: Path) -> sqlite3.Connection:
    """Open for the flight: a log that survives a cut, and nobody else on the file meanwhile.

    EXCLUSIVE before WAL: no second connection can race with a checkpoint (a bug of SQLite before
    3.51.3 could corrupt the file then), and there is no shared-memory file.
    """
    with ExitStack() as on_failure:
        connection = on_failure.enter_context(
            closing(sqlite3.connect(path, isolation_level=None, check_same_thread=False))
        )
        for pragma in (
            "locking_mode = EXCLUSIVE",
            "journal_mode = WAL",
            "synchronous = FULL",
            "wal_autocheckpoint = 0",
        ):
            connection.execute(f"PRAGMA {pragma}").fetchall()
        on_failure.pop_all()
        return connection
