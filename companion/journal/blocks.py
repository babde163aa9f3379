"""Inputs and decisions in the journal: one row a commit, packed, with check sums over the text.

Inputs (`body`) and decisions lie apart: who wants a sensor's values does not unpack decisions,
which are ten times as much. Decisions may refer to numbers of the inputs before them.
"""

from __future__ import annotations

import sqlite3
import zlib

from companion.journal.packing import Packer, deflated

# A second of a flight has a hundred rows; a simulation has thousands, which are several blocks.
ROWS_MAX = 1000
# A block that serves others as their dictionary is chosen anew so often: what they save is ten
# times what it costs.
_DICTIONARY_EVERY = 120
_DICTIONARY_FIRST = 5
_DICTIONARY_BYTES = 32_000
_INSERT = "INSERT INTO blocks VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)"
_INSERT_DICTIONARY = "INSERT INTO block_dictionaries VALUES (?, ?)"
_DECISION = "Decision"
_DECISION_START = f'{{"{_DECISION}":'


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
