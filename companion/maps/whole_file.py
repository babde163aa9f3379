"""A file appears whole or not at all."""

from __future__ import annotations

from pathlib import Path

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
        raise map_error(
            path,
            f"cannot be written ({error.strerror or error})",
            fix="check folder, rights and free space",
            code="not-written",
        ) from None
