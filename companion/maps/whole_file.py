"""A file appears whole or not at all."""

from __future__ import annotations

from pathlib import Path

from companion.errors import MapError
from companion.maps.model import map_error


def write_whole(path: Path, content: bytes) -> None:
    """Write a file beside `path` and move it there, so that nobody ever sees half of it."""
    part = path.with_name(f".{path.name}.part")
    try:
        try:
            part.write_bytes(content)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise not_written(path, error) from None


def not_written(path: Path, error: OSError) -> MapError:
    """Return the refusal of a file that the system does not let us write."""
    return map_error(
        path,
        f"cannot be written ({error.strerror or error})",
        fix="check folder, rights and free space",
        code="not-written",
    )
