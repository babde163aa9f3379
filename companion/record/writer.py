"""The journal's side of the disk: owns the connection, lives in its own thread.

One commit a second, so that a cut of power costs a second. Whatever the disk does, it does to
this thread: a failure costs the rows of that second, is counted, and the next second is tried anew.
"""

from __future__ import annotations

import json
import logging
import math
import sqlite3
from collections.abc import Callable
from dataclasses import dataclass

from companion.core.frame import LocalFrame, course_deg
from companion.core.types import Decision, Input, VehicleState
from companion.record.codec import encode
from companion.record.geopackage import point_blob, time_text
from companion.record.layers import set_box

_logger = logging.getLogger(__name__)

_RECORD = "INSERT INTO records VALUES (?, ?, ?, ?)"
_EVENT = "INSERT INTO events VALUES (?, ?, ?, ?, ?)"
_APPLIED = "INSERT INTO applied VALUES (" + ", ".join("?" * 15) + ")"
_SET_META = (
    "INSERT INTO meta (key, value) VALUES (?, ?) "
    "ON CONFLICT (key) DO UPDATE SET value = excluded.value"
)
_CHECKPOINT_EVERY = 60  # commits
# A full disk, a removed card, a value that JSON does not know: rows are lost, the flight goes on.
_FAILURES = (sqlite3.Error, ValueError, TypeError, OverflowError)


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """What happened besides inputs and decisions."""

    at_s: float
    kind: str
    text: str


class Writer:
    """Writes what it is given; never raises for what a disk can do.

    `next_sequence` numbers the writer's own events; `utc_offset_s` makes a time since 1970 of the
    companion's monotonic one.
    """

    def __init__(
        self,
        connection: sqlite3.Connection,
        *,
        frame: LocalFrame,
        utc_offset_s: float,
        next_sequence: Callable[[], int],
    ) -> None:
        # A projection of its own: pyproj's are not to be shared between threads.
        self._frame = LocalFrame(frame.latitude_deg, frame.longitude_deg)
        self._connection = connection
        self._utc_offset_s = utc_offset_s
        self._next_sequence = next_sequence
        self._pending = 0
        self._commits = 0
        self._reported = 0
        self._last_s = 0.0
        self._box: tuple[float, float, float, float] | None = None
        self.committed = 0
        self.lost = 0
        self.fault: str | None = None

    def write(self, sequence: int, item: Input | Decision | Event) -> None:
        """Take one row into the open second."""
        try:
            if not self._connection.in_transaction:
                self._connection.execute("BEGIN")
                self._pending = 0
            self._insert(sequence, item)
            self._pending += 1
        except _FAILURES as error:
            self._fail(error, rows=1)

    def commit(self, *, lost_before: int) -> None:
        """Make the open second last; `lost_before` rows never reached this thread."""
        try:
            lost = self.lost + lost_before
            self._report(lost)
            if self._connection.in_transaction:
                self._connection.execute("COMMIT")
                self.committed += self._pending
                self._pending = 0
                self._reported = lost
                self._commits += 1
                self.fault = None
                if self._commits % _CHECKPOINT_EVERY == 0:
                    self._connection.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchall()
        except _FAILURES as error:
            self._fail(error, rows=0)

    def finish(self, *, lost_before: int) -> None:
        """Make one file of it and mark it closed."""
        self.commit(lost_before=lost_before)
        try:
            set_box(self._connection, "applied", self._box)
            self._connection.execute(_SET_META, ("closed", "yes"))
            self._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
            self._connection.execute("PRAGMA journal_mode = DELETE").fetchall()
        except _FAILURES as error:
            self._fail(error, rows=0)
        finally:
            self._connection.close()

    def _fail(self, error: Exception, *, rows: int) -> None:
        """Count what is gone; SQLite rolls back by itself where it must."""
        lost = rows
        if isinstance(error, sqlite3.Error):
            lost += self._pending
            self._pending = 0
            if self._connection.in_transaction:
                self._connection.rollback()
        self.lost += lost
        if self.fault is None:
            _logger.warning("journal: %s; %d rows lost", error, lost)
        self.fault = str(error)

    def _report(self, lost: int) -> None:
        if lost == self._reported:
            return
        text = f"{lost - self._reported} rows lost, {lost} in all"
        if self.fault:
            text += f": {self.fault}"
        if not self._connection.in_transaction:
            self._connection.execute("BEGIN")
        self._insert(self._next_sequence(), Event(at_s=self._last_s, kind="rows-lost", text=text))
        self._connection.execute(_SET_META, ("lost", str(lost)))

    def _insert(self, sequence: int, item: Input | Decision | Event) -> None:
        execute = self._connection.execute
        if isinstance(item, Event):
            execute(_EVENT, (sequence, self._time(item.at_s), item.at_s, item.kind, item.text))
            return
        at_s = item.now_s if isinstance(item, Decision) else item.received_s
        self._last_s = at_s
        body = encode(item)
        if isinstance(item, Decision):
            execute(_APPLIED, self._applied(sequence, item))
        execute(_RECORD, (sequence, at_s, type(item).__name__, body))

    def _time(self, at_s: float) -> str | None:
        return time_text(at_s + self._utc_offset_s)

    def _applied(self, sequence: int, decision: Decision) -> tuple[object, ...]:
        state, duty = decision.state, decision.plan.duty
        rates = [rate for rate in decision.rate_l_ha if rate is not None]
        motion: tuple[float | None, ...] = (None, None, None, None)
        if state is not None:
            east, north = state.velocity_east_m_s, state.velocity_north_m_s
            speed_m_s = math.hypot(east, north)
            motion = (speed_m_s, course_deg(east, north), state.heading_deg, state.height_m)
        return (
            sequence,
            None if state is None else self._point(state),
            self._time(decision.now_s),
            decision.now_s,
            sum(rates) / len(rates) if rates else None,
            decision.target_flow_l_min,
            decision.flow_l_min,
            sum(duty) / len(duty) if duty else 0.0,
            *motion,
            " ".join(sorted(decision.inhibits)),
            json.dumps(decision.rate_l_ha),
            json.dumps(duty),
        )

    def _point(self, state: VehicleState) -> bytes | None:
        latitude, longitude = self._frame.to_geographic(state.east_m, state.north_m)
        if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
            return None
        west, south, east, north = self._box or (longitude, latitude, longitude, latitude)
        self._box = (
            min(west, longitude),
            min(south, latitude),
            max(east, longitude),
            max(north, latitude),
        )
        return point_blob(longitude, latitude)
