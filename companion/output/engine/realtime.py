"""What a process asks of Linux to be on time: priority, memory that stays, a fine timer."""

from __future__ import annotations

import ctypes
import gc
import os
import signal
import struct

FIFO_PRIORITY = 50
SLICE_NS = 100_000
# The call has no name in the C libraries of today's distributions.
_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274, "armv7l": 380}
# linux/prctl.h and sys/mman.h.
_PR_SET_PDEATHSIG, _PR_SET_TIMERSLACK = 1, 29
_MCL_CURRENT, _MCL_FUTURE = 1, 2


def die_with_parent(parent: int) -> bool:
    """Have SIGTERM sent to us when the parent dies; False if it has died already."""
    _libc().prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    return os.getppid() == parent


def be_on_time(*, realtime: bool) -> list[str]:
    """Ask for all that helps; return what was refused, in words for the operator."""
    refused = []
    gc.collect()
    gc.freeze()
    gc.disable()
    libc = _libc()
    # Of 50 us otherwise: every wake-up would be late by as much.
    libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    # The way out where real time is not allowed; no right is needed for it.
    _ask_for_short_slice(libc)
    if not realtime:
        return []
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
    except OSError:
        refused.append(
            "no real-time priority for the valves: edges may be some ms late; allow it with "
            "LimitRTPRIO=50 in the service, or rtprio in /etc/security/limits.conf"
        )
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
        refused.append(
            "the valve engine's memory may be swapped out: allow LimitMEMLOCK=infinity in the "
            "service"
        )
    return refused


def _ask_for_short_slice(libc: ctypes.CDLL) -> None:
    """Ask for short turns that come soon (Linux >= 6.12); older kernels refuse, or do nothing."""
    number = _SCHED_SETATTR.get(os.uname().machine)
    if number is not None:
        # struct sched_attr: size, policy, flags, nice, priority, runtime, deadline, period.
        what = struct.pack("<IIQiIQQQ", 48, os.SCHED_OTHER, 0, 0, 0, SLICE_NS, 0, 0)
        libc.syscall(number, 0, what, 0)


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)
