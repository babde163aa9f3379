"""The systemd of this computer: where units lie, and what `systemctl` says."""

from __future__ import annotations

import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

from companion.atomic_write import write_atomically
from companion.cli.service import is_ours
from companion.errors import VrsprayError

NAME = "vrspray.service"
_PROPERTIES = "LoadState,UnitFileState,ActiveState,SubState,Result,NRestarts,WatchdogUSec"
_WAIT_S = 30.0


class ServiceError(VrsprayError):
    """The service cannot be installed or removed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """What a call of `systemctl` came to; code None where there is no systemd to ask."""

    code: int | None
    text: str


def unit_path(*, is_user: bool) -> Path:
    """Return where the unit lies."""
    if not is_user:
        return Path("/etc/systemd/system") / NAME
    base = os.environ.get("XDG_CONFIG_HOME") or str(Path.home() / ".config")
    return Path(base) / "systemd" / "user" / NAME


def systemctl(*arguments: str, is_user: bool) -> Answer:
    """Call `systemctl` and return what it says; never raises."""
    program = shutil.which("systemctl")
    if program is None:
        return Answer(code=None, text="there is no systemctl")
    words = [program, *(["--user"] if is_user else []), *arguments]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=_WAIT_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return Answer(code=None, text=str(error))
    text = " ".join((done.stdout if done.returncode == 0 else done.stderr or done.stdout).split())
    return Answer(code=done.returncode, text=text)


def properties(*, is_user: bool) -> dict[str, str] | None:
    """Return what systemd knows of the unit; None where there is no systemd to ask."""
    found = systemctl("show", NAME, f"--property={_PROPERTIES}", is_user=is_user)
    if found.code != 0:
        return None
    pairs = (word.partition("=") for word in found.text.split())
    return {key: value for key, _, value in pairs}


def read_unit(path: Path) -> str | None:
    """Return the unit's text; None where there is none."""
    try:
        return path.read_text()
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise ServiceError(f"{path}: cannot be read; {_advice(error)}") from error


def write_unit(path: Path, text: str) -> None:
    """Write the unit in one piece; one that somebody else wrote is not replaced."""
    refuse_foreign(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, text.encode(), mode=0o644)
    except OSError as error:
        raise ServiceError(f"{path}: cannot be written; {_advice(error)}") from error


def remove_unit(path: Path) -> None:
    """Remove the unit, if it is ours."""
    refuse_foreign(path)
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise ServiceError(f"{path}: cannot be removed; {_advice(error)}") from error


def refuse_foreign(path: Path) -> None:
    """Raise a `ServiceError` where the file is not one of ours."""
    text = read_unit(path)
    if text is not None and not is_ours(text):
        raise ServiceError(f"{path}: not written by vrspray service install; move it away first")


def _advice(error: Exception) -> str:
    if isinstance(error, PermissionError):
        return "use sudo, or --user for a service of your own"
    return str(getattr(error, "strerror", None) or error).lower()
