"""Writing the files of a report: all of them or none, and nothing half made stays behind.

They are written into a folder beside their places, which goes away whatever happens, and are moved
when all are complete. Where that fails, or is interrupted, what was there before is put back.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

from companion.errors import ConfigError

# The figures of a report, by the names of their files.
FIGURES = ("map", "deviation", "flow", "lags", "histogram", "causes", "duty", "treated")


def check_folder(folder: Path) -> None:
    """Refuse a folder that cannot be written, before any work is done for it; none is made."""
    try:
        with tempfile.TemporaryFile(dir=_there(folder)):
            pass
    except OSError as error:
        raise _refused(folder, error) from error


def earlier_files(folder: Path, files: Mapping[str, bytes]) -> list[Path]:
    """Return what an earlier report left in a folder that this one does not write anew.

    Names that a report makes and no others: whatever else lies there is somebody's.
    """
    own = ("report.html", "report.json", "report.pdf", "application-*.json", "application-*.csv")
    drawn = [f"figures/{name}.{kind}" for name in FIGURES for kind in ("png", "svg")]
    new = {folder / name for name in files}
    found = (each for pattern in (*own, *drawn) for each in folder.glob(pattern))
    return sorted(each for each in found if each.is_file() and each not in new)


def write_files(folder: Path, files: Mapping[str, bytes], *, without: Sequence[Path] = ()) -> None:
    """Write every file, in the place of an earlier one; afterwards all are there, or none.

    `without` are files of the folder that go; where anything fails they come back.
    """
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
                    for number, old in enumerate(without):
                        kept = Path(name) / f"removed-{number}"
                        old.rename(kept)
                        moved.callback(kept.replace, old)
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
