"""Inputs and decisions in the journal: one row a commit, packed, with a check sum over the text."""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from itertools import pairwise

from companion.record.packing import Packer, deflated
from companion.record.unpacking import inflated, unpack

# A second of a flight has a hundred rows; a simulation has thousands, which are several blocks.
ROWS_MAX = 1000
# A block that serves others as their dictionary is chosen anew so often: what they save is ten
# times what it costs.
_DICTIONARY_EVERY = 120
_DICTIONARY_FIRST = 5
_DICTIONARY_BYTES = 32_000
_INSERT = "INSERT INTO blocks VALUES (?, ?, ?, ?, ?, ?, ?, ?)"
_INSERT_DICTIONARY = "INSERT INTO block_dictionaries VALUES (?, ?)"
_SELECT = (
    "SELECT first_sequence, from_s, until_s, crc32, dictionary, body FROM blocks "
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
        return self.kind == "Decision"


class Block:
    """What has come since the last commit: number, time, line of JSON."""

    def __init__(self) -> None:
        self._dictionary = b""
        self._dictionary_id: int | None = None
        self._written = 0
        self._clear()

    def _clear(self) -> None:
        self._packer = Packer()
        self._sequences: list[int] = []
        self._times_s: list[float] = []
        self._crc = 0

    @property
    def row_count(self) -> int:
        """Return how many rows wait."""
        return len(self._sequences)

    def add(self, sequence: int, at_s: float, body: str) -> None:
        """Take one row."""
        self._packer.add(body)
        self._crc = zlib.crc32(body.encode("ascii"), self._crc)
        self._sequences.append(sequence)
        if abs(at_s) < float("inf"):
            self._times_s.append(at_s)

    @property
    def is_full(self) -> bool:
        """Whether it should be written before more comes."""
        return len(self._sequences) >= ROWS_MAX

    def insert(self, connection: sqlite3.Connection) -> None:
        """Write the rows as one and forget them.

        Where that, or the commit, fails: begin with a new `Block`, for a dictionary may be lost.
        """
        if not self._sequences:
            return
        first, last = self._sequences[0], self._sequences[-1]
        gaps = [b - a for a, b in pairwise([first - 1, *self._sequences])]
        self._packer.add(" ".join(map(str, gaps)))
        content = self._packer.content()
        connection.execute(
            _INSERT,
            (
                first,
                last,
                len(self._sequences),
                min(self._times_s, default=None),
                max(self._times_s, default=None),
                self._crc,
                self._dictionary_id,
                deflated(content, self._dictionary),
            ),
        )
        self._written += 1
        if self._written % _DICTIONARY_EVERY == _DICTIONARY_FIRST:
            self._dictionary, self._dictionary_id = content[-_DICTIONARY_BYTES:], first
            packed = zlib.compress(self._dictionary)
            connection.execute(_INSERT_DICTIONARY, (first, packed))
        self._clear()


def read_blocks(
    connection: sqlite3.Connection,
    *,
    kinds: Collection[str] | None = None,
    unread: list[str] | None = None,
) -> Iterator[Entry]:
    """Yield all entries in their order, or those of some kinds.

    A block that is damaged is a ValueError; with `unread` it is said there, and left out.
    """
    starts = None if kinds is None else tuple(f'{{"{kind}":' for kind in kinds)
    dictionaries = _Dictionaries(connection)
    for first, from_s, until_s, crc, dictionary, body in connection.execute(_SELECT):
        try:
            *lines, gap_line = unpack(body, dictionaries.get(dictionary))
            gaps = [int(gap) for gap in gap_line.split()]
            if len(gaps) != len(lines) or zlib.crc32("".join(lines).encode("ascii")) != crc:
                raise ValueError("the check sum does not fit")
        except (ValueError, TypeError, OverflowError) as error:
            text = f"rows from {first} on ({_span(from_s, until_s)}): {error}"
            if unread is None:
                raise ValueError(text) from error
            unread.append(text)
            continue
        sequence = first - 1
        for gap, line in zip(gaps, lines, strict=True):
            sequence += gap
            if starts is None or line.startswith(starts):
                yield Entry(sequence, line[2 : line.find('"', 2)], line)


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


def _span(from_s: object, until_s: object) -> str:
    if isinstance(from_s, float) and isinstance(until_s, float):
        return f"{from_s:.3f} to {until_s:.3f} s"
    return "of an unknown time"
