"""Inputs and decisions of a journal, read back from its packed blocks."""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass

from analysis.journals.unpacking import Part, inflated, part_of

_DECISION = "Decision"
_SELECT = (
    "SELECT first_sequence, from_s, until_s, dictionary, crc32, body, {} FROM blocks "
    "ORDER BY first_sequence"
)


@dataclass(frozen=True, slots=True)
class Entry:
    """One input or decision as it lies in the file; `kind` is the name of its type."""

    sequence: int
    kind: str
    body: str

    @property
    def is_decision(self) -> bool:
        """Whether this is a decision, and not an input."""
        return self.kind == _DECISION


def read_blocks(
    connection: sqlite3.Connection,
    *,
    kinds: Collection[str] | None = None,
    unread: list[str] | None = None,
) -> Iterator[Entry]:
    """Yield all entries in their order, or those of some kinds.

    What is damaged is a ValueError; with `unread` it is said there, and left out.
    """
    with_decisions = kinds is None or _DECISION in kinds
    starts = None if kinds is None else tuple(f'{{"{kind}":' for kind in kinds)
    dictionaries = _Dictionaries(connection)
    sql = _SELECT.format("decisions_crc32, decisions" if with_decisions else "NULL, NULL")
    for first, from_s, until_s, dictionary, *parts in connection.execute(sql):
        rows: list[tuple[int, str]] = []
        inputs: Part | None = None
        try:
            inputs = _checked(parts[0], parts[1], dictionaries.get(dictionary), None)
            rows += inputs.rows(first)
            if with_decisions:
                decisions = _checked(parts[2], parts[3], dictionaries.get(dictionary), inputs)
                rows += decisions.rows(first)
                rows.sort()
        except (ValueError, TypeError, OverflowError) as error:
            what = "rows" if inputs is None else "decisions"
            text = f"{what} from {first} on ({span_text(from_s, until_s)}): {error}"
            if unread is None:
                raise ValueError(text) from error
            unread.append(text)
        for sequence, line in rows:
            if starts is None or line.startswith(starts):
                yield Entry(sequence, line[2 : line.find('"', 2)], line)


def _checked(crc: int, packed: bytes, dictionary: bytes, leader: Part | None) -> Part:
    part = part_of(inflated(packed, dictionary), leader)
    if zlib.crc32("".join(part.lines).encode("ascii")) != crc:
        raise ValueError("the check sum does not fit")
    return part


class _Dictionaries:
    """The blocks' dictionaries by their numbers, each read once."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection
        self._found: dict[int | None, bytes] = {None: b""}

    def get(self, number: int | None) -> bytes:
        """Return a dictionary; ValueError where it is gone."""
        if number not in self._found:
            sql = "SELECT body FROM block_dictionaries WHERE id = ?"
            row = self._connection.execute(sql, (number,)).fetchone()
            if row is None:
                raise ValueError(f"the dictionary {number} is missing")
            self._found[number] = inflated(row[0], b"")
        return self._found[number]


def span_text(from_s: object, until_s: object) -> str:
    """Return from when until when a block is, for a person."""
    if isinstance(from_s, float) and isinstance(until_s, float):
        return f"{from_s:.3f} to {until_s:.3f} s"
    return "of an unknown time"
