"""Small files of numbers that outlive a run: parameters that a station set, the signing stamp."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from companion.errors import LinkError

_SIZE_MAX_BYTES = 100_000


def read_state(path: Path) -> dict[str, float]:
    """Return the numbers in `path`, nothing where there is no file.

    Raises:
        LinkError: where the file is there and is no such file.
    """
    try:
        if path.stat().st_size > _SIZE_MAX_BYTES:
            raise LinkError(f"{path}: too large for what it should be; delete it")
        content = json.loads(path.read_text("utf-8"))
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise LinkError(f"{path}: {(error.strerror or 'cannot be read').lower()}") from error
    except ValueError as error:
        raise LinkError(f"{path}: damaged; delete it and set its values again") from error
    if not isinstance(content, dict) or not all(
        isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e18
        for value in content.values()
    ):
        raise LinkError(f"{path}: not names with numbers; delete it and set its values again")
    return {name: float(value) for name, value in content.items()}


def write_state(path: Path, values: Mapping[str, float], *, is_synced: bool = True) -> bool:
    """Replace the file as a whole; return whether that worked: a full disk stops no flight."""
    scratch = path.with_name(f".{path.name}.new")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with scratch.open("w", encoding="utf-8") as file:
            json.dump(dict(values), file, indent=1)
            file.flush()
            if is_synced:
                os.fsync(file.fileno())
        scratch.replace(path)
    except OSError:
        with suppress(OSError):
            scratch.unlink(missing_ok=True)
        return False
    return True
