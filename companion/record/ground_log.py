"""The record of ground work: one line of JSON for each piece, beside the journals."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from companion.errors import JournalError

NAME = "ground-work.jsonl"


def ready_log(folder: Path) -> Path:
    """Return the file in `folder`; a `JournalError` where it cannot be written."""
    path = folder / NAME
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with path.open("a"):
            pass
    except OSError as error:
        raise JournalError(
            f"journal folder {folder}: cannot be written ({error}); "
            "set journal.folder to a folder that can"
        ) from error
    return path


def append(path: Path, entry: Mapping[str, Any]) -> str | None:
    """Write one piece down for good; return why it could not be, None where it could."""
    try:
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry, allow_nan=False) + "\n")
            file.flush()
            os.fsync(file.fileno())
    except (OSError, ValueError) as error:
        return f"{path}: not written: {error}"
    return None
