"""A file appears whole or not at all, after a cut of power too."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

# Letters of the file's name in that of its draft: names have 255 bytes, a letter up to four.
_NAME_MAX = 40


def write_atomically(path: Path, content: bytes, *, mode: int | None = None) -> None:
    """Replace a file as a whole; an OSError where that is not possible, and `path` is as before.

    Content first, name second: without a sync in between, a cut of power can leave the new name
    on an empty file. The sync of the folder makes the new name last; a file system that has none
    (FAT by some drivers) keeps the old name or the new one. Without `mode`, who may read it is as
    of any new file.
    """
    path = path.resolve()  # a link stays one, as for any program that writes
    if path.exists() and not path.is_file():
        path.write_bytes(content)  # a pipe or a device: nothing there could be replaced
        return
    # Two programs do not meet in one draft. What a cut left of this name, or somebody put there
    # as a link to elsewhere, is not written through.
    draft = path.with_name(f".{path.name[:_NAME_MAX]}.{os.getpid()}.part")
    draft.unlink(missing_ok=True)
    try:
        file = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        try:
            left = memoryview(content)
            while left:
                left = left[os.write(file, left) :]
            if mode is not None:
                os.fchmod(file, mode)
            os.fsync(file)
        finally:
            os.close(file)
        os.replace(draft, path)  # noqa: PTH105 (beside the other calls of its kind)
    except OSError:
        with suppress(OSError):
            draft.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Make the names in a folder last; where the file system cannot, nothing is lost by trying."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
