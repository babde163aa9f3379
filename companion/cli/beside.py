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
from companion.commands import Haste

_NAME = "vrspray-run-"
_SOCKETS = Path("/proc/net/unix")
# Against 0, the companion's: a tenth of the time where both want the same core.
NICENESS = 10


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


def give_way(arguments: Sequence[str], haste: Haste) -> None:
    """Lower this process's priority, if its command can wait.

    Where a companion runs, what computes for long says so.
    """
    if haste == "at-once":
        return
    os.nice(max(NICENESS - os.nice(0), 0))
    flying = () if haste == "quick" or "--help" in arguments else running()
    if flying:
        numbers = ", ".join(str(number) for number in flying)
        note(
            f"note: vrspray run is active on this computer (process {numbers}); this command "
            "gives way to it"
        )
