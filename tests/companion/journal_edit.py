"""Changes single rows of a journal, as damage and mistakes would."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from pathlib import Path

from analysis.journals.unpacking import Entry, read_blocks
from companion.journal.rows import Block


def edit_rows(path: Path, edit: Callable[[list[Entry]], list[Entry]]) -> None:
    """Write the rows of a closed journal anew, as `edit` returns them."""
    connection = sqlite3.connect(path)
    try:
        with connection:
            entries = edit(list(read_blocks(connection)))
            connection.execute("DELETE FROM blocks")
            block = Block()
            for entry in sorted(entries, key=lambda entry: entry.sequence):
                block.add(entry.sequence, 0.0, entry.body)
            block.insert(connection)
    finally:
        connection.close()


def with_body(path: Path, sequence: int, body: str) -> None:
    """Give one row another text."""
    edit_rows(
        path,
        lambda entries: [
            Entry(entry.sequence, entry.kind, body) if entry.sequence == sequence else entry
            for entry in entries
        ],
    )
