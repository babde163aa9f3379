"""Is this computer fit to fly: judged from facts alone."""

from __future__ import annotations

import ctypes
import os
import platform
import resource
import sqlite3
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from companion.doctor.check import Check, fail, not_applicable, ok, warn
from companion.link.transport import parse_url

# A journal takes about 200 MB an hour with six valves (docs/explanation/flight-record.md).
FREE_WARN_BYTES, FREE_MIN_BYTES = 1_000_000_000, 100_000_000
# It is written once a second by a thread of its own; slower than this it falls behind.
SYNC_MAX_S = 1.0
# bcm2835_wdt counts to 16 s; kernels take longer requests modulo 16, or refuse them.
WATCHDOG_MAX_S = 15
# Raspberry Pi's get_throttled: what is so now, and in the upper half what has been.
_THROTTLED = {0: "under-voltage", 1: "clock capped", 2: "throttled", 3: "too hot"}


def computer_checks(found: Computer, *, needs_engine: bool) -> Iterator[Check]:
    """Yield all checks; `needs_engine` where this computer itself makes the valves' edges."""
    yield _python(found)
    yield _sqlite(found)
    for folder in found.folders:
        yield _folder(folder)
    yield _clock(found)
    yield _real_time(found, needs_engine=needs_engine)
    yield _memory(found, needs_engine=needs_engine)
    yield _governor(found)
    yield _throttling(found)
    yield hardware_watchdog_check(found)


def _python(found: Computer) -> Check:
    version = ".".join(map(str, found.python))
    text = f"Python {version}, {found.system} {found.machine}"
    if not found.python >= (3, 11, 0):
        return fail("system", text, "install Python 3.11 or newer")
    if not found.is_64_bit:
        fix = "install the 64-bit system: nothing else is tested, and libraries are missing"
        return warn("system", f"{text}, 32-bit", fix)
    if found.system != "Linux":
        return warn("system", text, "use Linux: nothing else is tested")
    return ok("system", text)


def _sqlite(found: Computer) -> Check:
    version = ".".join(map(str, found.sqlite))
    if not found.sqlite >= (3, 22, 0):
        fix = "install a newer SQLite"
        return fail("sqlite", f"SQLite {version} cannot read the journal of a crashed flight", fix)
    return ok("sqlite", f"SQLite {version}; safe for journals")


def _folder(folder: Folder) -> Check:
    name = folder.name
    if folder.problem is not None or folder.free_bytes is None:
        text = folder.problem or f"{folder.path}: free space unknown"
        return fail(name, text, "give this user write access, or choose another folder")
    free = f"{folder.path}: {folder.free_bytes / 1e9:.1f} GB free"
    if not folder.free_bytes >= FREE_MIN_BYTES:
        return fail(name, free, "move old flights away")
    if not folder.free_bytes >= FREE_WARN_BYTES:
        return warn(name, free, "a flight takes 200 MB per hour: move old ones away")
    if folder.sync_s is not None and not folder.sync_s <= SYNC_MAX_S:
        text = f"{folder.path}: a write takes {folder.sync_s:.1f} s to reach the disk"
        return warn(name, text, "use a faster card, or find out what else writes to it")
    return ok(name, free)


def _clock(found: Computer) -> Check:
    if found.is_clock_synchronised is None:
        return not_applicable("clock", "this kernel does not report whether it is synchronised")
    if not found.is_clock_synchronised:
        return warn(
            "clock",
            "not synchronised: records will have the wrong time of day (valves do not use it)",
            "connect to a time server before the flight, or fit a battery-backed clock",
        )
    return ok("clock", "synchronised")


def _real_time(found: Computer, *, needs_engine: bool) -> Check:
    name = "real-time"
    if not needs_engine:
        return not_applicable(name, "no real-time valve engine is configured")
    if not found.may_fifo:
        return warn(
            name,
            "this user has no real-time priority: valves may switch some ms late",
            "for the service: vrspray service install; else set rtprio 50 in limits.conf",
        )
    return ok(name, "SCHED_FIFO is permitted")


def _memory(found: Computer, *, needs_engine: bool) -> Check:
    name = "memory-lock"
    if not needs_engine:
        return not_applicable(name, "no real-time valve engine is configured")
    if not found.may_lock_memory:
        return warn(
            name,
            "the valve engine's memory can be swapped out",
            "for the service: vrspray service install; else set memlock in limits.conf",
        )
    return ok(name, "permitted")


def _governor(found: Computer) -> Check:
    if not found.governors:
        return not_applicable("cpu-governor", "this computer does not report clock frequencies")
    names = ", ".join(found.governors)
    if found.governors != ("performance",):
        fix = "set it to performance: cpupower frequency-set -g performance"
        return warn(
            "cpu-governor", f"{names}: the clock speeds up only after the load has come", fix
        )
    return ok("cpu-governor", names)


def _throttling(found: Computer) -> Check:
    name, bits = "throttling", found.throttled
    if bits is None:
        return not_applicable(name, "not a Raspberry Pi, or its firmware does not report it")
    now = [text for bit, text in _THROTTLED.items() if bits >> bit & 1]
    before = [text for bit, text in _THROTTLED.items() if bits >> bit + 16 & 1]
    fix = "supply 5.1 V through a short, thick cable, and cool it"
    if now:
        return fail(name, f"now: {', '.join(now)}", fix)
    if before:
        return warn(name, f"since the start: {', '.join(before)}", fix)
    return ok(name, "none since the start")


def hardware_watchdog_check(found: Computer) -> Check:
    """Return whether the computer's own watchdog runs, and within what its counter holds."""
    name, dog = "hardware-watchdog", found.watchdog
    fix = "write RuntimeWatchdogSec=15 into /etc/systemd/system.conf"
    if dog is None:
        return not_applicable(name, "this computer has none")
    if not dog.is_active:
        return warn(name, f"{dog.identity} does not run: nothing restarts a hung kernel", fix)
    is_pi = "bcm2835" in dog.identity.lower() or "broadcom" in dog.identity.lower()
    if is_pi and dog.timeout_s is not None and not dog.timeout_s <= WATCHDOG_MAX_S:
        return warn(name, f"{dog.timeout_s} s is longer than its counter allows", fix)
    return ok(name, f"{dog.identity} runs")


# The facts of this computer: read here, judged in `computer.py`. What cannot be read is None.

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
    is_64_bit: bool = True


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
        # Of Python itself: a 64-bit kernel may run a 32-bit system.
        is_64_bit=sys.maxsize > 2**32,
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


# The serial device of a link: is it there, and may this user open it.


@dataclass(frozen=True, slots=True, kw_only=True)
class Device:
    """What is known of a device without opening it."""

    path: str
    exists: bool
    is_permitted: bool
    group: str


def read_device(url: str) -> Device | None:
    """Return the facts of the device; None for a link that has none."""
    parts = parse_url(url)
    if parts.kind != "serial":
        return None
    path = Path(parts.place)
    try:
        group = path.group()
    except (OSError, KeyError):
        group = "dialout"
    return Device(
        path=str(path),
        exists=path.exists(),
        is_permitted=os.access(path, os.R_OK | os.W_OK),
        group=group,
    )


def serial_check(device: Device | None) -> Check:
    """Return whether the device can be used."""
    name = "serial-port"
    if device is None:
        return not_applicable(name, "the link is not serial")
    if not device.exists:
        fix = "plug it in, or correct link.url; on a Raspberry Pi: enable_uart=1 in config.txt"
        return fail(name, f"{device.path} does not exist", fix)
    if not device.is_permitted:
        fix = f"sudo usermod -aG {device.group} $USER, then log in again"
        return fail(name, f"{device.path}: permission denied", fix)
    return ok(name, f"{device.path} can be opened")


# Is the service installed, started with the computer, and watched: facts in, checks out.


@dataclass(frozen=True, slots=True, kw_only=True)
class Service:
    """The unit as it was found; `state` is None where there is no systemd to ask."""

    is_installed: bool
    is_user: bool
    is_watched: bool
    config: str
    uses_config: bool
    state: Mapping[str, str] | None


def service_checks(found: Service) -> Iterator[Check]:
    """Yield the checks of the service and of its watchdog."""
    rest = ("service-watchdog",)
    if found.state is None and not found.is_installed:
        why = "no systemd on this computer"
        yield from (not_applicable(name, why) for name in ("service", *rest))
        return
    if not found.is_installed:
        yield warn(
            "service",
            "not installed: nothing starts or watches the companion",
            f"sudo vrspray service install --config {found.config}",
        )
        yield from (not_applicable(name, "the service is not installed") for name in rest)
        return
    yield _enabled(found)
    if not found.is_watched:
        fix = "run vrspray service install again"
        yield warn("service-watchdog", "the unit has no WatchdogSec", fix)
    else:
        yield ok("service-watchdog", "fed by the control loop")


def _enabled(found: Service) -> Check:
    call = "systemctl --user" if found.is_user else "sudo systemctl"
    if not found.uses_config:
        fix = f"vrspray service install --config {found.config}"
        return warn("service", "it uses a different configuration", fix)
    if found.state is None:
        fix = "try again on a computer where systemd runs"
        return warn("service", "installed; systemd does not answer", fix)
    if not found.state.get("UnitFileState", "").startswith("enabled"):
        fix = f"{call} enable vrspray"
        return warn("service", "installed, but does not start with the computer", fix)
    active = found.state.get("ActiveState", "unknown")
    if active == "failed":
        result = found.state.get("Result", "unknown")
        return warn("service", f"its last run failed ({result})", "see journalctl -u vrspray")
    if active == "active":
        fix = f"{call} stop vrspray, so that link and GPIO lines can be checked"
        return warn("service", "it is running, and uses the link and the GPIO lines", fix)
    return ok("service", f"installed and enabled, {active} now")
