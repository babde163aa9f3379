"""A map appears whole or not at all; what the system refuses is told as a map's error."""

from __future__ import annotations

from pathlib import Path

from companion.atomic_write import write_atomically
from companion.errors import MapError
from missions.maps.model import map_error


def write_whole(path: Path, content: bytes) -> None:
    """Write a file beside `path` and move it there, so that nobody ever sees half of it."""
    try:
        write_atomically(path, content)
    except OSError as error:
        raise not_written(path, error) from None


def check_folder(path: Path) -> None:
    """Refuse a file that no folder is there for, before there is anything to write.

    Raises:
        MapError: as `write_whole` would.
    """
    if not path.parent.is_dir():
        raise map_error(
            path,
            f"cannot be written (no folder {path.parent})",
            fix="make the folder first, or name another",
            code="not-written",
        )


def not_written(path: Path, error: OSError) -> MapError:
    """Return the refusal of a file that the system does not let us write."""
    return map_error(
        path,
        f"cannot be written ({error.strerror or error})",
        fix="check folder, rights and free space",
        code="not-written",
    )
