"""The facts of this computer: read here, judged in `computer.py`. What cannot be read is None."""

from __future__ import annotations

import ctypes
import os
import platform
import resource
import sqlite3
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

_FIFO_PRIORITY = 50
_MEMLOCK_ENOUGH = 64 * 1024 * 1024
_TIME_ERROR = 5  # adjtimex(2): the clock is not synchronised


@dataclass(frozen=True, slots=True, kw_only=True)
class Folder:
    """A folder that a run writes to; `problem` says why it cannot."""

    name: str
    path: str
    problem: str | None = None
    free_bytes: int | None = None
    sync_s: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class HardwareWatchdog:
    """The computer's own watchdog, as the kernel shows it."""

    identity: str
    timeout_s: int | None
    is_active: bool | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Computer:
    """All that `computer.py` judges."""

    python: tuple[int, int, int]
    system: str
    machine: str
    sqlite: tuple[int, int, int]
    folders: tuple[Folder, ...] = ()
    is_clock_synchronised: bool | None = None
    may_fifo: bool | None = None
    may_lock_memory: bool | None = None
    governors: tuple[str, ...] = ()
    throttled: int | None = None
    watchdog: HardwareWatchdog | None = None


def read_computer(folders: dict[str, Path], *, root: Path = Path("/")) -> Computer:
    """Return the facts; `root` is where /sys is looked for."""
    return Computer(
        python=sys.version_info[:3],
        system=platform.system(),
        machine=platform.machine(),
        sqlite=sqlite3.sqlite_version_info,
        folders=tuple(try_folder(name, path) for name, path in folders.items()),
        is_clock_synchronised=_is_synchronised(),
        may_fifo=_may_fifo(),
        may_lock_memory=_may_lock_memory(),
        governors=_governors(root),
        throttled=_throttled(root),
        watchdog=_watchdog(root),
    )


def try_folder(name: str, path: Path) -> Folder:
    """Write to a folder, or to the nearest one above it that exists: a run makes the rest."""
    place = path
    while not place.exists() and place != place.parent:
        place = place.parent
    try:
        status = os.statvfs(place)
        with tempfile.NamedTemporaryFile(dir=place, prefix=".vrspray-") as file:
            began_s = time.monotonic()
            file.write(bytes(4096))
            file.flush()
            os.fsync(file.fileno())
            sync_s = time.monotonic() - began_s
    except OSError as error:
        reason = (error.strerror or "cannot be written").lower()
        return Folder(name=name, path=str(path), problem=f"{place}: {reason}")
    free = status.f_bavail * status.f_frsize
    return Folder(name=name, path=str(path), free_bytes=free, sync_s=sync_s)


def _is_synchronised() -> bool | None:
    """Ask the kernel, which knows it whichever time service runs."""
    adjtimex = getattr(ctypes.CDLL(None), "adjtimex", None)
    if adjtimex is None:
        return None
    state = adjtimex(ctypes.create_string_buffer(512))
    return None if state < 0 else state != _TIME_ERROR


def _may_fifo() -> bool:
    """Try it for a moment: limits and capabilities are too many to be read."""
    policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_FIFO_PRIORITY))
    except OSError:
        return False
    os.sched_setscheduler(0, policy, parameter)
    return True


def _may_lock_memory() -> bool:
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    return os.geteuid() == 0 or soft == resource.RLIM_INFINITY or soft >= _MEMLOCK_ENOUGH


def _governors(root: Path) -> tuple[str, ...]:
    files = root.glob("sys/devices/system/cpu/cpu[0-9]*/cpufreq/scaling_governor")
    return tuple(sorted({text for file in files if (text := _text(file))}))


def _throttled(root: Path) -> int | None:
    """Return the bits of Raspberry Pi's firmware: under-voltage, capped, throttled, hot."""
    text = _text(root / "sys/devices/platform/soc/soc:firmware/get_throttled")
    try:
        return None if text is None else int(text, 16)
    except ValueError:
        return None


def _watchdog(root: Path) -> HardwareWatchdog | None:
    folder = root / "sys/class/watchdog/watchdog0"
    identity = _text(folder / "identity")
    if identity is None:
        return None
    timeout, state = _text(folder / "timeout"), _text(folder / "state")
    return HardwareWatchdog(
        identity=identity,
        timeout_s=int(timeout) if timeout is not None and timeout.isdecimal() else None,
        is_active=None if state is None else state == "active",
    )


def _text(file: Path) -> str | None:
    try:
        return file.read_text().strip()
    except (OSError, UnicodeDecodeError):
        return None
