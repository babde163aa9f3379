"""All pages of a journal that are left, each in its newest version: of its log, or of its file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

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
