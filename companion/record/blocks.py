"""Inputs and decisions in the journal: one row a commit, packed, with check sums over the text.

Inputs (`body`) and decisions lie apart: who wants a sensor's values does not unpack decisions,
which are ten times as much. Decisions may refer to numbers of the inputs before them.
"""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass

from companion.record.packing import Packer, deflated
from companion.record.unpacking import Part, inflated, part_of

# A second of a flight has a hundred rows; a simulation has thousands, which are several blocks.
ROWS_MAX = 1000
# A block that serves others as their dictionary is chosen anew so often: what they save is ten
# times what it costs.
_DICTIONARY_EVERY = 120
_DICTIONARY_FIRST = 5
_DICTIONARY_BYTES = 32_000
_INSERT = "INSERT INTO blocks VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)"
_INSERT_DICTIONARY = "INSERT INTO block_dictionaries VALUES (?, ?)"
_SELECT = (
    "SELECT first_sequence, from_s, until_s, dictionary, crc32, body, {} FROM blocks "
    "ORDER BY first_sequence"
)
_DECISION = "Decision"
_DECISION_START = f'{{"{_DECISION}":'


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


class _Rows:
    """The inputs of a block, or its decisions."""

    def __init__(self, follower: _Rows | None = None) -> None:
        self.packer: Packer = Packer(follower=None if follower is None else follower.packer)
        self.crc = 0
        self.last: int | None = None

    def add(self, sequence: int, first: int, body: str) -> None:
        self.packer.add(body, sequence - (first - 1 if self.last is None else self.last))
        self.last = sequence
        self.crc = zlib.crc32(body.encode("ascii"), self.crc)


class Block:
    """What has come since the last commit: number, time, line of JSON."""

    def __init__(self) -> None:
        self._dictionary = b""
        self._dictionary_id: int | None = None
        self._written = 0
        self._clear()

    def _clear(self) -> None:
        self._decisions = _Rows()
        self._inputs = _Rows(self._decisions)
        self._first: int | None = None
        self._last = 0
        self._times_s: list[float] = []
        self.row_count = 0

    def add(self, sequence: int, at_s: float, body: str) -> None:
        """Take one row."""
        self._first = sequence if self._first is None else self._first
        rows = self._decisions if body.startswith(_DECISION_START) else self._inputs
        rows.add(sequence, self._first, body)
        self._last = sequence
        self.row_count += 1
        if abs(at_s) < float("inf"):
            self._times_s.append(at_s)

    @property
    def is_full(self) -> bool:
        """Whether it should be written before more comes."""
        return self.row_count >= ROWS_MAX

    def insert(self, connection: sqlite3.Connection) -> None:
        """Write the rows as one and forget them.

        Where that, or the commit, fails: begin with a new `Block`, for a dictionary may be lost.
        """
        if self._first is None:
            return
        contents = [rows.packer.content() for rows in (self._inputs, self._decisions)]
        inputs, decisions = (deflated(content, self._dictionary) for content in contents)
        connection.execute(
            _INSERT,
            (
                self._first,
                self._last,
                self.row_count,
                min(self._times_s, default=None),
                max(self._times_s, default=None),
                self._dictionary_id,
                self._inputs.crc,
                inputs,
                self._decisions.crc,
                decisions,
            ),
        )
        self._written += 1
        if self._written % _DICTIONARY_EVERY == _DICTIONARY_FIRST:
            self._dictionary = b"".join(contents)[-_DICTIONARY_BYTES:]
            self._dictionary_id = self._first
            packed = zlib.compress(self._dictionary)
            connection.execute(_INSERT_DICTIONARY, (self._first, packed))
        self._clear()


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
