"""Inputs and decisions in the journal: one row a commit, packed, with a check sum over the text."""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field

from companion.record.packing import pack, unpack

# A second of a flight has a hundred rows; a simulation has thousands, which are several blocks.
ROWS_MAX = 1000
_INSERT = "INSERT INTO blocks VALUES (?, ?, ?, ?, ?, ?, ?)"
_SELECT = "SELECT first_sequence, from_s, until_s, crc32, body FROM blocks ORDER BY first_sequence"


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


@dataclass(slots=True)
class Block:
    """What has come since the last commit: number, time, line of JSON."""

    rows: list[tuple[int, float, str]] = field(default_factory=list)

    def add(self, sequence: int, at_s: float, body: str) -> None:
        """Take one row."""
        self.rows.append((sequence, at_s, body))

    @property
    def is_full(self) -> bool:
        """Whether it should be written before more comes."""
        return len(self.rows) >= ROWS_MAX

    def insert(self, connection: sqlite3.Connection) -> None:
        """Write the rows as one and forget them, whether that succeeds or not."""
        rows, self.rows = self.rows, []
        if not rows:
            return
        before, gaps = rows[0][0] - 1, []
        for sequence, _, _ in rows:
            gaps.append(sequence - before)
            before = sequence
        lines = [" ".join(map(str, gaps)), *(body for _, _, body in rows)]
        times = [at_s for _, at_s, _ in rows if abs(at_s) < float("inf")]
        connection.execute(
            _INSERT,
            (
                rows[0][0],
                rows[-1][0],
                len(rows),
                min(times, default=None),
                max(times, default=None),
                crc_of(lines),
                pack(lines),
            ),
        )


def crc_of(lines: Sequence[str]) -> int:
    """Return the check sum of a block's text."""
    return zlib.crc32("\n".join(lines).encode("ascii"))


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
    for first, from_s, until_s, crc, body in connection.execute(_SELECT):
        try:
            lines = unpack(body)
            if crc_of(lines) != crc:
                raise ValueError("the check sum does not fit")
            gaps = [int(gap) for gap in lines[0].split()]
            if len(gaps) != len(lines) - 1:
                raise ValueError("rows are missing")
        except (ValueError, TypeError, OverflowError) as error:
            text = f"rows from {first} on ({_span(from_s, until_s)}): {error}"
            if unread is None:
                raise ValueError(text) from error
            unread.append(text)
            continue
        sequence = first - 1
        for gap, line in zip(gaps, lines[1:], strict=True):
            sequence += gap
            if starts is None or line.startswith(starts):
                yield Entry(sequence, line[2 : line.find('"', 2)], line)


def _span(from_s: object, until_s: object) -> str:
    if isinstance(from_s, float) and isinstance(until_s, float):
        return f"{from_s:.3f} to {until_s:.3f} s"
    return "of an unknown time"
