"""The journal of a flight: one file that is a GeoPackage, and a recorder that never waits.

The control loop only puts what it has into a bounded queue; everything else happens in the
writer's thread (`writer.py`). Rows that find the queue full are dropped and counted: a slow disk
may cost the record of a moment, never the moment itself.

A new journal's file is complete and empty before anybody sees it, then open for one flight.
"""

from __future__ import annotations

import logging
import math
import os
import platform
import queue
import re
import shutil
import sqlite3
import threading
import time
from collections.abc import Mapping
from contextlib import ExitStack, closing
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

from companion.core.setup import Setup
from companion.core.types import Decision, Input
from companion.errors import JournalError
from companion.journal.codec import calibration_sha256, setup_to_json
from companion.journal.geopackage import JOURNAL_VERSION, RESERVE, SCHEMA, write_layers
from companion.journal.rows import ValveOrder
from companion.journal.writer import Event, Item, LinkSample, Writer, write_treated
from companion.ports import COMMIT_EVERY_S
from companion.simulated import BECAUSE, NOT_ASKED, SIMULATED, Simulated

if TYPE_CHECKING:
    from companion.core.options.coverage import Coverage

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


_logger = logging.getLogger(__name__)

# A disk that hangs: a quarter of an hour of six valves, in 100 MB.
QUEUE_ROWS = 120_000
CLOSE_WITHIN_S = 30.0
# Of that: how long a full disk may take until there is room again.
ROOM_WITHIN_S = 20.0
STALL_MAX_S = 5.0  # a card that is busy with itself takes one or two

_Row = tuple[int, Item]


class Journal:
    """Takes down a flight; a `ports.Recorder` that begins with `create` and ends with `close`."""

    def __init__(
        self,
        path: Path,
        connection: sqlite3.Connection,
        *,
        setup: Setup,
        utc_offset_s: float,
        queue_rows: int = QUEUE_ROWS,
        waits: bool = False,
        free_min_bytes: int = 0,
        commit_every_s: float = COMMIT_EVERY_S,
    ) -> None:
        self.path = path
        self._waits = waits
        self._free_min_bytes = free_min_bytes
        self._commit_every_s = commit_every_s
        self._free_bytes: int | None = None
        self._space_fault: str | None = None
        self._saved_s = time.monotonic()
        self._give_up_s = math.inf
        self._sequence = count(1)
        self._queue_rows = queue_rows
        self._rows: queue.SimpleQueue[_Row | None] = queue.SimpleQueue()
        self._dropped = 0
        self._coverage: Coverage | None = None
        self._closing = threading.Event()
        self._writer = Writer(
            connection,
            frame=setup.frame,
            utc_offset_s=utc_offset_s,
            next_sequence=self._sequence.__next__,
        )
        self._thread = threading.Thread(target=self._run, name="journal", daemon=True)
        self._thread.start()

    @classmethod
    def create(
        cls,
        folder: Path,
        *,
        setup: Setup,
        setup_text: Mapping[str, str] | None = None,
        started_s: float | None = None,
        queue_rows: int = QUEUE_ROWS,
        waits: bool = False,
        training: str | None = None,
        simulated: Simulated = NOT_ASKED,
        free_min_bytes: int = 0,
        commit_every_s: float = COMMIT_EVERY_S,
    ) -> Journal:
        """Begin the next flight's file in `folder`: flight-0001.gpkg, flight-0002.gpkg, ...

        Numbers and not dates: a board without a clock of its own does not know the date.

        Args:
            folder: made if it is not there.
            setup: kept whole, with its ground, so that replay needs no other file.
            setup_text: whatever else belongs to the record, such as `config_toml`.
            started_s: what the companion's clock shows now; a simulation has its own.
            queue_rows: how far the disk may fall behind.
            waits: for simulations, faster than any disk: wait rather than drop.
            free_min_bytes: with less room on the disk the journal has a fault.
            commit_every_s: what a power cut may lose.
            training: `no` for a product, else what it is: `water`, `dry`. None: nobody says.
            simulated: what is known at the start; an event of that kind says it later.
        """
        now_s = time.monotonic() if started_s is None else started_s
        started = datetime.now(UTC)
        meta = {**(setup_text or {}), **about(setup, started, now_s)}
        meta |= {SIMULATED: simulated.word, BECAUSE: simulated.because}
        if training is not None:
            meta["training"] = training
        try:
            folder.mkdir(parents=True, exist_ok=True)
            path = new_file(folder, setup, meta)
            connection = open_for_flight(path)
        except (OSError, sqlite3.Error) as error:
            raise JournalError(
                f"journal folder {folder}: cannot be written ({error}); "
                "set journal.folder to a folder that can"
            ) from error
        return cls(
            path,
            connection,
            setup=setup,
            utc_offset_s=started.timestamp() - now_s,
            queue_rows=queue_rows,
            waits=waits,
            free_min_bytes=free_min_bytes,
            commit_every_s=commit_every_s,
        )

    @property
    def lost(self) -> int:
        """Return how many rows are not in the file and never will be."""
        return self._dropped + self._writer.lost

    @property
    def committed(self) -> int:
        """Return how many rows are on the disk for good."""
        return self._writer.committed

    @property
    def fault(self) -> str | None:
        """Return why the record is not kept, or soon will not be; None while all is well."""
        if self._writer.fault is None and self.saved_age_s > STALL_MAX_S:
            return None if self._closing.is_set() else f"nothing was written for {STALL_MAX_S:g} s"
        return self._writer.fault or self._space_fault

    @property
    def saved_age_s(self) -> float:
        """Return how long ago all that there was reached the disk."""
        return time.monotonic() - self._saved_s

    @property
    def free_bytes(self) -> int | None:
        """Return what the disk had free at the last look; None before it."""
        return self._free_bytes

    def record_input(self, item: Input) -> None:
        """Take down one input as the core saw it."""
        self._put(item)

    def record_decision(self, decision: Decision) -> None:
        """Take down one decision."""
        self._put(decision)

    def record_event(self, at_s: float, kind: str, text: str) -> None:
        """Take down what happened besides."""
        self._put(Event(at_s=at_s, kind=kind, text=text))

    def expect_orders(self) -> None:
        """Take the valves' changes from `record_order`, not from the plans; before the flight."""
        self._writer.valves.from_orders = True

    def record_order(
        self, valve: int, duty: float, planned_s: float | None, given_s: float
    ) -> None:
        """Take down that an output was ordered so; the writer leaves out what changes nothing."""
        order = ValveOrder(valve=valve, duty=duty, planned_s=planned_s, given_s=given_s)
        self._put(order, is_numbered=False)

    def record_link(self, at_s: float, values: Mapping[str, float | None]) -> None:
        """Take down how the link to the vehicle does."""
        self._put(LinkSample(at_s=at_s, values=values), is_numbered=False)

    def record_coverage(self, coverage: Coverage) -> None:
        """Keep the newest ground that was treated; its changed tiles are in the next commit."""
        self._coverage = coverage

    def close(self) -> None:
        """Write what is left and make one closed file of it; may be called twice."""
        self._give_up_s = min(self._give_up_s, time.monotonic() + ROOM_WITHIN_S)
        self._closing.set()
        if self._writer.fault is not None:
            _logger.warning("journal: %s: make room within %g s", self.fault, ROOM_WITHIN_S)
        self._rows.put(None)  # wakes the writer at once
        self._thread.join(CLOSE_WITHIN_S)
        if self._thread.is_alive():
            _logger.warning("journal %s: the disk did not take it in time", self.path)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _put(self, item: Item, *, is_numbered: bool = True) -> None:
        # A gap in the numbers shows where a row is missing; what has none is counted only.
        row = (next(self._sequence) if is_numbered else 0, item)
        if self._closing.is_set() or not self._has_room():
            self._dropped += 1
        else:
            self._rows.put(row)

    def _has_room(self) -> bool:
        while not self._rows.qsize() < self._queue_rows:
            if not (self._waits and self._thread.is_alive()):
                return False
            time.sleep(0.001)  # in simulations only: the writer has thousands of rows to go
        return True

    def _run(self) -> None:
        due_s = time.monotonic() + self._commit_every_s
        try:
            while True:
                row = self._next(due_s)
                if row is not None:
                    self._writer.write(*row)
                elif self._closing.is_set() and self._rows.empty():
                    self._commit()
                    if not self._writer.waiting or time.monotonic() >= self._give_up_s:
                        break
                    time.sleep(self._commit_every_s)
                if time.monotonic() >= due_s:
                    self._commit()
                    due_s = time.monotonic() + self._commit_every_s
        finally:
            self._writer.finish(lost_before=self._dropped, coverage=self._coverage)

    def _commit(self) -> None:
        self._writer.commit(lost_before=self._dropped, coverage=self._coverage)
        self._look_at_space()
        if self._writer.fault is None:
            self._saved_s = time.monotonic()

    def _look_at_space(self) -> None:
        """Note in time that the disk fills up."""
        try:
            free_bytes = self._free_bytes = shutil.disk_usage(self.path.parent).free
        except OSError as error:
            self._free_bytes = None
            self._space_fault = str(error) if self._free_min_bytes else None
            return
        is_short = free_bytes < self._free_min_bytes
        self._space_fault = f"only {free_bytes / 1e6:.0f} MB are free" if is_short else None

    def _next(self, due_s: float) -> _Row | None:
        """Return the next row; None when the commit is due or the end has come."""
        try:
            if self._closing.is_set():
                return self._rows.get_nowait()
            return self._rows.get(timeout=max(due_s - time.monotonic(), 0.001))
        except queue.Empty:
            return None
