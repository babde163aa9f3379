"""Is this computer fit to fly: judged from facts alone."""

from __future__ import annotations

from collections.abc import Iterator

from companion.doctor.check import Check, fail, not_applicable, ok, warn
from companion.doctor.computer_facts import Computer, Folder

# A journal takes about 200 MB an hour with six valves (docs/flight-record.md).
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
    if found.system != "Linux":
        return warn("system", text, "fly with Linux: nothing else is tested")
    return ok("system", text)


def _sqlite(found: Computer) -> Check:
    version = ".".join(map(str, found.sqlite))
    if not found.sqlite >= (3, 22, 0):
        fix = "install a newer SQLite"
        return fail("sqlite", f"SQLite {version} cannot read a journal that a crash left", fix)
    return ok("sqlite", f"SQLite {version}; a journal has one connection, so its WAL is safe")


def _folder(folder: Folder) -> Check:
    name = folder.name
    if folder.problem is not None or folder.free_bytes is None:
        text = folder.problem or f"{folder.path}: free space unknown"
        return fail(name, text, "give this user the right to write there, or name another folder")
    free = f"{folder.path}: {folder.free_bytes / 1e9:.1f} GB free"
    if not folder.free_bytes >= FREE_MIN_BYTES:
        return fail(name, free, "move old flights away")
    if not folder.free_bytes >= FREE_WARN_BYTES:
        return warn(name, free, "a flight takes 200 MB an hour: move old ones away")
    if folder.sync_s is not None and not folder.sync_s <= SYNC_MAX_S:
        text = f"{folder.path}: a write takes {folder.sync_s:.1f} s to reach the disk"
        return warn(name, text, "use a faster card, or see what else writes to it")
    return ok(name, free)


def _clock(found: Computer) -> Check:
    if found.is_clock_synchronised is None:
        return not_applicable("clock", "this kernel does not say whether it is synchronised")
    if not found.is_clock_synchronised:
        return warn(
            "clock",
            "not synchronised: records carry a wrong time of day (valves do not use it)",
            "connect to a time server before the flight, or fit a clock with a battery",
        )
    return ok("clock", "synchronised")


def _real_time(found: Computer, *, needs_engine: bool) -> Check:
    name = "real-time"
    if not needs_engine:
        return not_applicable(name, "no valve engine is asked to be in real time")
    if not found.may_fifo:
        return warn(
            name,
            "no real-time priority for this user: edges may be some ms late",
            "vrspray service install allows it for the service; or rtprio 50 in limits.conf",
        )
    return ok(name, "SCHED_FIFO is permitted")


def _memory(found: Computer, *, needs_engine: bool) -> Check:
    name = "memory-lock"
    if not needs_engine:
        return not_applicable(name, "no valve engine is asked to be in real time")
    if not found.may_lock_memory:
        return warn(
            name,
            "the valve engine's memory may be swapped out",
            "vrspray service install allows it for the service; or memlock in limits.conf",
        )
    return ok(name, "permitted")


def _governor(found: Computer) -> Check:
    if not found.governors:
        return not_applicable("cpu-governor", "this computer shows no clock frequencies")
    names = ", ".join(found.governors)
    if found.governors != ("performance",):
        fix = "set it to performance: cpupower frequency-set -g performance"
        return warn("cpu-governor", f"{names}: the clock follows the load, after it", fix)
    return ok("cpu-governor", names)


def _throttling(found: Computer) -> Check:
    name, bits = "throttling", found.throttled
    if bits is None:
        return not_applicable(name, "not a Raspberry Pi, or its firmware does not say")
    now = [text for bit, text in _THROTTLED.items() if bits >> bit & 1]
    before = [text for bit, text in _THROTTLED.items() if bits >> bit + 16 & 1]
    fix = "give it 5.1 V by a short thick cable, and air"
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
        return not_applicable(name, "this computer shows none")
    if not dog.is_active:
        return warn(name, f"{dog.identity} does not run: a hung kernel stays hung", fix)
    is_pi = "bcm2835" in dog.identity.lower() or "broadcom" in dog.identity.lower()
    if is_pi and dog.timeout_s is not None and not dog.timeout_s <= WATCHDOG_MAX_S:
        return warn(name, f"{dog.timeout_s} s is more than its counter holds", fix)
    return ok(name, f"{dog.identity} runs")
