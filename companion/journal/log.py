"""The log beside a journal, read without SQLite: which frames count, and what lies behind damage.

After https://www.sqlite.org/fileformat2.html, section 4. A frame counts where it has the salts of
the log's header, and its check sum follows from the frame before; SQLite takes all up to the last
commit before the first frame that does not.

A cut of power tears the end of a log in the ordinary way: of the transaction that was being
written, some pages reach the disk and others do not, in any order; its commit may have come and a
page before it not. But no transaction begins before the one before is on the disk (`synchronous =
FULL`). So a commit behind the first bad frame that yet another frame follows was once safe, and
the log is damaged. Damage within the very last transaction looks like an ordinary cut.

Of a damaged log is told where it is damaged, and how much of the flight went with that.
"""

from __future__ import annotations

import math
import os
import shutil
import sqlite3
import struct
import sys
import tempfile
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from companion.atomic_write import sync_folder
from companion.journal.geopackage import PAGE_BYTES, time_text
from companion.journal.leaf_page import Cell, cells_of, is_of, tables_of, values_of
from companion.journal.read_only import kept_log_of, log_of
from companion.journal.writer import SET_META

_MAGIC = 0x377F0682  # its last bit: the words of the check sums are big-endian
_VERSION = 3_007_000
_HEADER = struct.Struct(">IIIIIIII")
_FRAME = struct.Struct(">IIIIII")
_WORD = 0xFFFFFFFF

Sums = tuple[int, int]
FILE_MAGIC = b"SQLite format 3\x00"
# SQLite knows no less room in a page.
_USABLE_MIN = 480


@dataclass(frozen=True, slots=True)
class Frame:
    """A page in the log: its number, where its content begins, and whether it is a commit."""

    page: int
    at: int
    is_commit: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Log:
    """What is in a log: the frames of whole transactions, and whole ones behind damage.

    `damage_at` is the first byte of the first bad frame where the log goes on behind it; None for
    a log that is whole, or torn at its end by a cut.
    """

    content: bytes
    page_bytes: int
    counted: tuple[Frame, ...] = ()
    behind: tuple[Frame, ...] = ()
    damage_at: int | None = None

    def page(self, frame: Frame) -> bytes:
        """Return the content of a frame."""
        return self.content[frame.at : frame.at + self.page_bytes]


def read_log(path: Path, page_bytes: int) -> Log:
    """Return what a log holds; nothing where there is none. `page_bytes`: those of the journal."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        content = b""
    return log_from(content, page_bytes)


def log_from(content: bytes, page_bytes: int) -> Log:
    """Return what a log holds that lies in memory."""
    salts, sums, is_big = _begun(content, page_bytes)
    counted: list[Frame] = []
    at, step = _HEADER.size, _FRAME.size + page_bytes
    is_good = salts is not None
    while is_good and at + step <= len(content):
        found = _frame(content, at, page_bytes, salts, sums, is_big=is_big)
        if found is None:
            break
        frame, sums = found
        counted.append(frame)
        at += step
    behind = _behind(content, at, page_bytes, salts, is_big=is_big)
    commits = [number for number, frame in enumerate(behind) if frame.is_commit]
    is_damaged = bool(commits) and commits[0] < len(behind) - 1
    return Log(
        content=content,
        page_bytes=page_bytes,
        counted=_up_to_commit(counted),
        behind=_up_to_commit(behind) if is_damaged else (),
        damage_at=(at if is_good else 0) if is_damaged else None,
    )


def _begun(content: bytes, page_bytes: int) -> tuple[Sums | None, Sums, bool]:
    """Return the salts of the header, its check sums, their order; no salts: it is damaged."""
    is_big = sys.byteorder == "big"
    if len(content) < _HEADER.size:
        return None, (0, 0), is_big
    magic, version, log_page_bytes, _, *salts, first, second = _HEADER.unpack_from(content)
    if magic | 1 != _MAGIC | 1 or version != _VERSION or log_page_bytes != page_bytes:
        return None, (0, 0), is_big
    is_big = bool(magic & 1)
    if summed(content[: _HEADER.size - 8], (0, 0), is_big=is_big) != (first, second):
        return None, (0, 0), is_big
    return (salts[0], salts[1]), (first, second), is_big


def _frame(
    content: bytes, at: int, page_bytes: int, salts: Sums | None, sums: Sums, *, is_big: bool
) -> tuple[Frame, Sums] | None:
    """Return the frame there and its check sums; None where it does not follow from `sums`.

    Without `salts` any will do.
    """
    page, pages, *has, first, second = _FRAME.unpack_from(content, at)
    if not page or (salts is not None and tuple(has) != salts):
        return None
    begin = at + _FRAME.size
    sums = summed(content[at : at + 8], sums, is_big=is_big)
    sums = summed(content[begin : begin + page_bytes], sums, is_big=is_big)
    return (Frame(page, begin, bool(pages)), sums) if sums == (first, second) else None


def _behind(
    content: bytes, bad_at: int, page_bytes: int, salts: Sums | None, *, is_big: bool
) -> list[Frame]:
    """Return the good frames behind a bad one, of its log.

    The check sum of a frame follows from that in the header of the one before, of which no more
    has to be whole.
    """
    found: list[Frame] = []
    step = _FRAME.size + page_bytes
    for at in range(bad_at + step, len(content) - step + 1, step):
        before = _FRAME.unpack_from(content, at - step)
        has = _FRAME.unpack_from(content, at)[2:4]
        # Behind the end of a log lies, as a rule, what an earlier one left: other salts.
        if before[2:4] != has or (salts is not None and has != salts):
            continue
        good = _frame(content, at, page_bytes, has, before[4:6], is_big=is_big)
        if good is not None:
            found.append(good[0])
    return found


def _up_to_commit(frames: list[Frame]) -> tuple[Frame, ...]:
    """Return the frames without those of a transaction that has no commit."""
    commits = [number for number, frame in enumerate(frames, 1) if frame.is_commit]
    return tuple(frames[: commits[-1]]) if commits else ()


def summed(data: bytes, sums: Sums, *, is_big: bool) -> Sums:
    """Return the check sums after some more data, a multiple of eight bytes.

    >>> summed(bytes([1, 0, 0, 0, 2, 0, 0, 0]), (0, 0), is_big=False)
    (1, 3)
    """
    words = array("I", data)
    if is_big != (sys.byteorder == "big"):
        words.byteswap()
    first, second = sums
    each = iter(words)
    for word, following in zip(each, each, strict=True):
        first = (first + word + second) & _WORD
        second = (second + following + first) & _WORD
    return first, second


def newest(log: Log) -> Iterator[Frame]:
    """Yield all good frames of whole transactions, the last written first."""
    yield from reversed(log.behind)
    yield from reversed(log.counted)


def page_bytes_of(path: Path) -> int:
    """Return how large the pages of a journal are: as its head says, or as this program has them.

    Not of a journal that this process writes: closing a file gives up the locks on it (POSIX).
    """
    with path.open("rb") as file:
        return page_bytes_in(head_of(file))


def head_of(file: BinaryIO) -> bytes:
    """Return the first bytes of a database; nothing where they are damaged."""
    head = file.read(100)
    if len(head) < 100 or not head.startswith(FILE_MAGIC):
        return b""
    size = int.from_bytes(head[16:18], "big")
    is_sound = 512 <= size <= 32768 and not size & (size - 1) and size - head[20] >= _USABLE_MIN
    return head if is_sound else b""


def page_bytes_in(head: bytes) -> int:
    """Return how large the pages are, by the first bytes of a file."""
    return int.from_bytes(head[16:18], "big") if head else PAGE_BYTES


EVENT_KIND = "log-damaged"
META_KEY = "log_damaged"
# Tables whose rows have a time and lie in one page, and its column.
_TIMES_S = {"applied": 3, "link_stats": 1, "events": 2}
_LAST_S = {
    "applied": "SELECT max(time_s) FROM applied",
    "blocks": "SELECT max(until_s) FROM blocks",
    "link_stats": "SELECT max(time_s) FROM link_stats",
}
_NUMBERS = {
    "events": "SELECT max(sequence) FROM events",
    "applied": "SELECT max(sequence) FROM applied",
    "blocks": "SELECT max(last_sequence) FROM blocks",
    "records": "SELECT max(sequence) FROM records",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class LogDamage:
    """The first bad byte of a log that goes on behind it; `until_s`: how far it goes, if known."""

    at: int
    size: int
    until_s: float | None

    def text(self, last_s: float | None) -> str:
        """Return it in words; `last_s` is the last time in what is left of the journal."""
        lost = ""
        if self.until_s is not None and last_s is not None:
            lost = f", at most about {math.ceil(self.until_s - last_s)} s,"
        return (
            f"the log is damaged at byte {self.at} of {self.size}: "
            f"what was committed behind it{lost} is lost"
        )


def log_damage(path: Path) -> LogDamage | None:
    """Return where the log of a journal is damaged; None where it is whole or ordinarily torn."""
    log = read_log(log_of(path), page_bytes_of(path))
    if log.damage_at is None:
        return None
    return LogDamage(
        at=log.damage_at, size=len(log.content), until_s=max(_times_s(log), default=None)
    )


def _times_s(log: Log) -> Iterator[float]:
    """Yield the times of the rows behind the damage."""
    for frame in log.behind:
        page = log.page(frame)
        try:
            cells = cells_of(page, log.page_bytes)
        except ValueError:
            continue
        for table in tables_of(cells) & _TIMES_S.keys():
            # The newest row is the last one.
            at_s = _time_s(cells[-1], table, log.page_bytes)
            if at_s is not None:
                yield at_s


def _time_s(cell: Cell, table: str, usable: int) -> float | None:
    """Return the time of a row that lies in one page."""
    try:
        row = (cell.rowid, *values_of(cell, lambda _: None, usable)[1:])
    except ValueError:
        return None
    at_s = row[_TIMES_S[table]] if is_of(table, row) else None
    return float(at_s) if isinstance(at_s, int | float) else None


def keep_log(path: Path) -> None:
    """Copy the log beside the journal: recovery takes of it what counts, and removes it."""
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".new-") as folder:
        draft = Path(folder) / "log"
        shutil.copyfile(log_of(path), draft)
        with draft.open("rb") as file:
            os.fsync(file.fileno())
        draft.replace(kept_log_of(path))
    sync_folder(path.parent)


def mark(connection: sqlite3.Connection, damage: LogDamage) -> str | None:
    """Write it into `meta` and `events`, within the caller's transaction; return it in words.

    None where nothing is lost: all of the log was in the file already.
    """
    tables = {row[0] for row in connection.execute("SELECT name FROM sqlite_master")}
    # Where nothing is left, all since the start is lost.
    last_s = max(_asked(connection, tables, _LAST_S), default=_told_s(connection, "started_s"))
    number = int(max(_asked(connection, tables, _NUMBERS), default=0)) + 1
    if damage.until_s is not None and last_s is not None and damage.until_s <= last_s:
        return None
    text = damage.text(last_s)
    offset_s = _told_s(connection, "utc_offset_s")
    time = None if offset_s is None or last_s is None else time_text(offset_s + last_s)
    connection.execute(
        "INSERT INTO events VALUES (?, ?, ?, ?, ?)", (number, time, last_s, EVENT_KIND, text)
    )
    for fact in ((META_KEY, text), ("closed", "recovered")):
        connection.execute(SET_META, fact)
    return text


def _asked(
    connection: sqlite3.Connection, tables: set[str], questions: dict[str, str]
) -> Iterator[float]:
    for table, sql in questions.items():
        (found,) = connection.execute(sql).fetchone() if table in tables else (None,)
        if isinstance(found, int | float):
            yield found


def _told_s(connection: sqlite3.Connection, key: str) -> float | None:
    """Return a time that `meta` says; None where it says none."""
    found = connection.execute("SELECT value FROM meta WHERE key = ?", (key,)).fetchone()
    try:
        time_s = float(found[0])
    except (TypeError, ValueError):
        return None
    return time_s if math.isfinite(time_s) else None
