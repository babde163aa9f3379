"""Writing the files of a report: all of them or none, and nothing half made stays behind.

They are written into a folder beside their places, which goes away whatever happens, and are moved
when all are complete. Where that fails, or is interrupted, what was there before is put back.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path

from companion.errors import ConfigError


def check_folder(folder: Path) -> None:
    """Refuse a folder that cannot be written, before any work is done for it; none is made."""
    try:
        with tempfile.TemporaryFile(dir=_there(folder)):
            pass
    except OSError as error:
        raise _refused(folder, error) from error


def write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write every file, in the place of an earlier one; afterwards all are there, or none."""
    try:
        with ExitStack() as made:
            _make(folder, made)
            with tempfile.TemporaryDirectory(
                prefix=".report-", dir=folder, ignore_cleanup_errors=True
            ) as name:
                drafts = _drafts(Path(name), files)
                with ExitStack() as moved:
                    for number, (draft, place) in enumerate(drafts.items()):
                        target = folder / place
                        _make(target.parent, made)
                        _move(draft, target, Path(name) / f"replaced-{number}", moved)
                    moved.pop_all()
                made.pop_all()
    except OSError as error:
        raise _refused(folder, error) from error


def _there(folder: Path) -> Path:
    """Return the folder, or the nearest one above it that is there."""
    return next((each for each in (folder, *folder.parents) if each.exists()), folder)


def _make(folder: Path, made: ExitStack) -> None:
    """Make a folder and those above it; what is made goes away with `made`."""
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    for each in reversed(missing):
        each.mkdir()
        made.callback(_remove, each)


def _remove(folder: Path) -> None:
    with suppress(OSError):  # somebody else's file is in it
        folder.rmdir()


def _drafts(folder: Path, files: Mapping[str, bytes]) -> dict[Path, str]:
    """Write the files under numbers; return the place of each."""
    drafts = {folder / f"new-{number}": name for number, name in enumerate(files)}
    for draft, name in drafts.items():
        draft.write_bytes(files[name])
        with draft.open("rb") as file:
            os.fsync(file.fileno())  # before the name that makes it count
    return drafts


def _move(draft: Path, target: Path, replaced: Path, moved: ExitStack) -> None:
    """Move a file to its place; with `moved` it goes, and what was there comes back."""
    if target.is_dir():
        raise IsADirectoryError(None, f"{target.name} in it is a folder")
    if target.exists():
        target.rename(replaced)
        moved.callback(replaced.replace, target)
    draft.rename(target)
    moved.callback(target.unlink)


def _refused(folder: Path, error: OSError) -> ConfigError:
    reason = (error.strerror or "cannot be written").lower()
    return ConfigError(f"--out {folder}: {reason}; give a folder that can be written")
