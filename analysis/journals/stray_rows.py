"""Rows of a damaged journal in pages that nothing leads to any more.

A table is a tree; with a page of it that leads to others these are out of SQLite's reach, whole as
they are. A leaf does not say which table it is of: here the number and the types of its columns
do, and where more than one table fits, it is left out. Rows that are known come not again, and
none whose values no flight has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from analysis.journals.kept_pages import KeptPages
from companion.journal.leaf_page import Cell, Row, cells_of, is_of, tables_of, values_of

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
