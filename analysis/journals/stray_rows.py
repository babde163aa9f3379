"""Rows of a damaged journal in pages that nothing leads to any more.

A table is a tree; with a page of it that leads to others these are out of SQLite's reach, whole as
they are. A leaf does not say which table it is of: here the number and the types of its columns
do, and where more than one table fits, it is left out. Rows that are known come not again, and
none whose values no flight has.

All pages of a journal that are left, each in its newest version: of its log, or of its file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from companion.journal.leaf_page import Cell, Row, cells_of, is_of, tables_of, values_of
from companion.journal.log import (
    FILE_MAGIC,
    Frame,
    Log,
    head_of,
    newest,
    page_bytes_in,
    read_log,
)
from companion.journal.read_only import log_of


class KeptPages:
    """Pages by their numbers, from 1 on; what is behind a cut is None."""

    def __init__(self, file: BinaryIO, head: bytes, log: Log) -> None:
        self._file = file
        self._log = log
        self.page_bytes = log.page_bytes
        self.usable = self.page_bytes - (head[20] if head else 0)
        self._in_log: dict[int, Frame] = {}
        for frame in newest(log):
            self._in_log.setdefault(frame.page, frame)
        self._in_file, self._torn_bytes = divmod(file.seek(0, 2), self.page_bytes)

    def page(self, number: int) -> bytes | None:
        """Return the newest version of a page; None where there is none."""
        frame = self._in_log.get(number)
        if frame is not None:
            return self._log.page(frame)
        if not 0 < number <= self._in_file:
            return None
        self._file.seek((number - 1) * self.page_bytes)
        return self._file.read(self.page_bytes)

    def torn(self) -> tuple[int, bytes, int] | None:
        """Return the page that the file ends in: its number, itself, how much of it is there.

        As SQLite sees it, which takes zeros for the rest; None where the file ends with a page, or
        the log has a newer version.
        """
        number = self._in_file + 1
        if not self._torn_bytes or number in self._in_log:
            return None
        self._file.seek(self._in_file * self.page_bytes)
        rest = self._file.read(self._torn_bytes)
        return number, rest.ljust(self.page_bytes, b"\x00"), self._torn_bytes

    def used(self) -> Iterator[bytes]:
        """Yield each page behind the first that is not given up."""
        free = self._free()
        for number in sorted({*range(2, self._in_file + 1), *self._in_log} - free - {1}):
            page = self.page(number)
            if page is not None:
                yield page

    def _free(self) -> set[int]:
        """Return the pages that were given up, as far as the list of them is left.

        What stood there is somewhere else by now, or is to be nowhere.
        """
        found: set[int] = set()
        head = self.page(1) or b""
        number = int.from_bytes(head[32:36], "big") if head.startswith(FILE_MAGIC) else 0
        while number and number not in found:
            found.add(number)
            trunk = self.page(number)
            if trunk is None:
                break
            count = min(int.from_bytes(trunk[4:8], "big"), self.usable // 4 - 2)
            found |= {
                int.from_bytes(trunk[at : at + 4], "big") for at in range(8, 8 + 4 * count, 4)
            }
            number = int.from_bytes(trunk[:4], "big")
        return found


@contextmanager
def kept_pages(path: Path) -> Iterator[KeptPages]:
    """Open a file for its pages; to be left later than a connection to the same file."""
    with path.open("rb") as file:
        head = head_of(file)
        yield KeptPages(file, head, read_log(log_of(path), page_bytes_in(head)))


# Columns with a time of the companion's clock, in seconds; in microseconds.
_TIMES_S = {"applied": (3,), "blocks": (3, 4), "link_stats": (1,), "events": (2,)}
_TIMES_US = {"valve_changes": (1, 2)}
# All of a flight is nearer than this to its middle.
_LONGEST_S = 86_400.0

Found = tuple[str, Row]


def stray_rows(pages: KeptPages, known: Mapping[str, set[int]]) -> list[Found]:
    """Return table and row of what is not in `known`, the numbers of rows; it grows by these.

    Only of the tables in `known`, and none whose time is far from that of the others.
    """
    found = list(_found(pages, known))
    times_s = sorted(at_s for table, row in found for at_s in _times_s(table, row))
    middle_s = times_s[len(times_s) // 2] if times_s else 0.0
    return [
        (table, row)
        for table, row in found
        if all(abs(at_s - middle_s) <= _LONGEST_S for at_s in _times_s(table, row))
    ]


def torn_rows(pages: KeptPages) -> set[tuple[object, object]]:
    """Return the tables and numbers of rows that a cut of the file went through."""
    found = pages.torn()
    if found is None:
        return set()
    number, page, kept_bytes = found
    try:
        cells = cells_of(page, pages.usable)
    except ValueError:
        return set(_torn_behind(pages, number, kept_bytes))
    torn = [cell for cell in cells if cell.end > kept_bytes]
    return {(table, cell.rowid) for table in tables_of(cells) for cell in torn}


def _torn_behind(pages: KeptPages, number: int, kept_bytes: int) -> Iterator[tuple[object, object]]:
    """Yield the rows that go on in the torn page, behind what of it is there."""
    for page in pages.used():
        try:
            cells = cells_of(page, pages.usable)
        except ValueError:
            continue
        for cell in cells:
            if _is_torn(cell, pages, number, kept_bytes):
                yield from ((table, cell.rowid) for table in tables_of(cells))


def _is_torn(cell: Cell, pages: KeptPages, torn: int, kept_bytes: int) -> bool:
    missing, number = cell.size - len(cell.local), cell.overflow_page
    while missing > 0 and number:
        here = min(missing, pages.usable - 4)
        if number == torn:
            return 4 + here > kept_bytes
        page = pages.page(number)
        if page is None:
            return False  # SQLite finds no way to it either
        missing -= here
        number = int.from_bytes(page[:4], "big")
    return False


def _found(pages: KeptPages, known: Mapping[str, set[int]]) -> Iterator[Found]:
    once = _once(pages)
    for page in pages.used():
        try:
            cells = cells_of(page, pages.usable)
        except ValueError:
            continue
        fitting = tables_of(cells)
        for cell in cells if fitting & known.keys() else ():
            if len(fitting) == 1 and cell.rowid in known[min(fitting)]:
                continue
            try:
                row = (cell.rowid, *values_of(cell, once, pages.usable)[1:])
            except ValueError:
                continue
            tables = [table for table in fitting if is_of(table, row)]
            if len(tables) == 1 and cell.rowid not in known.get(tables[0], {cell.rowid}):
                known[tables[0]].add(cell.rowid)
                yield tables[0], row


def _once(pages: KeptPages) -> Callable[[int], bytes | None]:
    """Return a way to the pages that gives each once.

    A page belongs to one row: so chains that bite their own tails, or that thousands of rows claim,
    cost no more than the file has pages.
    """
    given: set[int] = set()

    def page(number: int) -> bytes | None:
        if number in given:
            return None
        given.add(number)
        return pages.page(number)

    return page


def _times_s(table: str, row: Row) -> Iterator[float]:
    """Yield the times of a row, in seconds of the companion's clock."""
    for columns, per_second in ((_TIMES_S, 1.0), (_TIMES_US, 1e6)):
        for column in columns.get(table, ()):
            value = row[column]
            if isinstance(value, int | float):
                yield value / per_second
