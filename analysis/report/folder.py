"""Writing the files of a report: all of them, each whole, or an error in one line."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from pathlib import Path

from companion.errors import ConfigError


def check_folder(folder: Path) -> None:
    """Refuse a folder that cannot be written, before any work is done for it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise _refused(folder, error) from error


def write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write every file, in the place of an earlier one; each is there as a whole or not at all."""
    try:
        for name, content in files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            _write(path, content)
    except OSError as error:
        raise _refused(folder, error) from error


def _write(path: Path, content: bytes) -> None:
    handle, draft = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}-")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        Path(draft).chmod(0o644)
        Path(draft).replace(path)
    except BaseException:
        Path(draft).unlink(missing_ok=True)
        raise


def _refused(folder: Path, error: OSError) -> ConfigError:
    reason = (error.strerror or "cannot be written").lower()
    return ConfigError(f"--out {folder}: {reason}; give a folder that can be written")
