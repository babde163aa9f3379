"""Commands that compute for long beside a companion that flies: they give way to it, and say so.

A run shows itself by a socket in Linux's abstract namespace, which the kernel takes away with the
process, however that ends: nothing stale is ever left, and every user of the computer sees it. A
container with a network of its own does not.
"""

from __future__ import annotations

import contextlib
import os
import re
import socket
from collections.abc import Iterator, Sequence
from pathlib import Path

from companion.cli.answer import note

_NAME = "vrspray-run-"
_SOCKETS = Path("/proc/net/unix")
# Against 0, the companion's: a tenth of the time where both want the same core.
NICENESS = 10
# What computes for long and is in no hurry. What flies, serves or tries hardware is not among them.
PATIENT = frozenset(
    {"demo", "config", "map", "plan", "calibrate", "report", "flights", "replay", "export", "wsp"}
)
# A flight waits for it to begin.
URGENT = frozenset({("map", "compile")})
# Of these, what is done before a line about it could be read.
QUICK = frozenset(
    {
        *(("config", name) for name in ("check", "show", "schema")),
        *(("map", name) for name in ("rate", "new", "offset")),
        *(("flights", name) for name in ("list", "show", "pin", "unpin", "prune")),
        ("calibrate", "mission"),
    }
)


@contextlib.contextmanager
def shown() -> Iterator[None]:
    """Show that a companion runs in this process, for as long as it does."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sign:
        # Taken already by a run of this process, or no Linux: nobody is kept from flying by it.
        with contextlib.suppress(OSError):
            sign.bind(f"\0{_NAME}{os.getpid()}")
        yield


def running(sockets: Path = _SOCKETS) -> tuple[int, ...]:
    """Return the processes of this computer in which a companion runs, without this one."""
    try:
        text = sockets.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ()
    found = {int(number) for number in re.findall(rf"@{_NAME}(\d+)$", text, re.MULTILINE)}
    return tuple(sorted(found - {os.getpid()}))


def is_quick(arguments: Sequence[str]) -> bool:
    """Whether a patient command is done before a line about its priority could be read."""
    return "--help" in arguments or tuple(arguments[:2]) in QUICK


def give_way(arguments: Sequence[str]) -> None:
    """Lower this process's priority, if its command can wait.

    Where a companion runs, what computes for long says so.
    """
    is_flight = list(arguments[:2]) == ["sitl", "fly"]
    if tuple(arguments[:2]) in URGENT:
        return
    if not arguments or (arguments[0] not in PATIENT and not is_flight):
        return
    os.nice(max(NICENESS - os.nice(0), 0))
    flying = () if is_quick(arguments) else running()
    if flying:
        numbers = ", ".join(str(number) for number in flying)
        note(f"note: vrspray run flies on this computer (process {numbers}); this gives way to it")
