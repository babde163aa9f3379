"""Small files of numbers that outlive a run: parameters that a station set, the signing stamp."""

from __future__ import annotations

import json
import stat
from collections.abc import Mapping
from pathlib import Path

from companion.atomic_write import write_atomically
from companion.errors import LinkError

_SIZE_MAX_BYTES = 100_000


class DamagedStateError(LinkError):
    """The file can be read, but is none that this program wrote."""


def read_state(path: Path) -> dict[str, float]:
    """Return the numbers in `path`, nothing where there is no file.

    Raises:
        LinkError: where the file is there and is no such file.
    """
    try:
        found = path.stat()
        if not stat.S_ISREG(found.st_mode):
            raise LinkError(f"{path}: no file; remove it, or give another link.state_folder")
        if found.st_size > _SIZE_MAX_BYTES:
            raise DamagedStateError(f"{path}: too large for what it should be; delete it")
        content = json.loads(path.read_text("utf-8"))
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise LinkError(f"{path}: {(error.strerror or 'cannot be read').lower()}") from error
    except ValueError as error:
        raise DamagedStateError(f"{path}: damaged; delete it and set its values again") from error
    if not isinstance(content, dict) or not all(
        isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e18
        for value in content.values()
    ):
        raise DamagedStateError(
            f"{path}: not names with numbers; delete it and set its values again"
        )
    return {name: float(value) for name, value in content.items()}


def write_state(path: Path, values: Mapping[str, float]) -> bool:
    """Replace the file as a whole; return whether that worked: a full disk stops no flight."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, json.dumps(dict(values), indent=1).encode())
    except OSError:
        return False
    return True
