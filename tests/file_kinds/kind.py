"""A kind of file, and what may be made of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.file_kinds import writers
from tests.file_kinds.ground import Ground

# What may come of a file: read as it is meant, without or with a word; read otherwise, with a
# word; refused. What is never allowed has no name: a rate or an outline that is not the file's,
# and not a word.
RIGHT, SAID, WARNED, REFUSED = "right", "said", "warned", "refused"
UNIT = ("--unit", "L/ha")
# Where the sprayer stands, for a map that may lie elsewhere.
HERE = (*UNIT, "--home", "48.0002,11.0004")
SURE = frozenset({RIGHT, SAID})
SILENT = frozenset({RIGHT})
HEEDED = frozenset({RIGHT, SAID, WARNED, REFUSED})
TOLD = frozenset({SAID, WARNED, REFUSED})
ASKED = frozenset({REFUSED})
OR_ASKED = frozenset({RIGHT, SAID, REFUSED})


@dataclass(frozen=True, kw_only=True)
class Kind:
    """One way in which files differ, and what may come of it.

    Args:
        make: the ground.
        may: the outcomes that are right.
        formats: those that can carry it; None: all of polygons.
        options: what the user gives.
        spoil: what is done to the bytes afterwards.
        row: what the table of kinds calls it together with its like; empty: its own name.
        outline: it is the outline of a field, given to `plan`.
        writer: who writes it, where that is not the format's own writer.
    """

    name: str
    make: Callable[[], Ground]
    may: frozenset[str] = SILENT
    formats: tuple[str, ...] | None = None
    options: tuple[str, ...] = UNIT
    spoil: Callable[[Path], object] | None = None
    outline: bool = False
    row: str = ""
    writer: Callable[[Ground, Path], Path] | None = None

    def writers(self) -> dict[str, writers.Writer]:
        """Return who writes this kind, by the name of the format."""
        if self.writer is not None:
            return {self.formats[0] if self.formats else "file": self.writer}
        return {
            name: write
            for name, write in writers.VECTOR.items()
            if self.formats is None or name in self.formats
        }
