"""The engine's process: its socket, its signals, its end.

One thread, one `select`: the next edge is its timeout. It ends, with everything closed, when the
companion says so, closes the socket or dies, and at SIGTERM.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import select
import signal
import socket
import struct
import time
from contextlib import suppress

from companion.errors import ActuatorError
from companion.output.engine.engine import Engine
from companion.output.engine.lines import keeps_levels, open_lines
from companion.output.engine.selftest import self_test
from companion.output.engine.wire import (
    PACKET_MAX,
    EngineSetup,
    Kind,
    RefusedError,
    hazards,
    pack,
    unpack,
)

# What the socket holds is read in this many packets at most before edges are looked at again.
_PACKETS_AT_ONCE = 2


def serve(connection: socket.socket, *, parent: int) -> int:
    """Be the engine at this end of a socket pair; return the exit code."""
    if not die_with_parent(parent):
        return 0
    wake = _end_wakes()
    try:
        kind, body = unpack(connection.recv(PACKET_MAX))
        if kind is not Kind.SETUP:
            raise RefusedError("no set-up")
        setup = EngineSetup.from_bytes(body)
        connection.setblocking(False)
        lines = open_lines(setup)
    except (ActuatorError, ValueError, TypeError, KeyError) as error:
        _send(connection, pack(Kind.FAULT, str(error).encode()))
        return 1
    warnings = be_on_time(realtime=setup.realtime)
    found = self_test(
        lines, setup.wiring, late_max_s=setup.late_max_s, clock=time.monotonic, sleep=time.sleep
    )
    engine = Engine(
        setup,
        lines,
        clock=time.monotonic,
        boot_clock=boot_s,
        send=lambda packet: _send(connection, packet),
    )
    try:
        if found.fault:
            engine.fail(found.fault)
        keeps = keeps_levels() if setup.backend == "gpiod" else None
        warnings += hazards(setup.wiring, keeps_levels=keeps)
        ready = {"warnings": warnings, "self_test": found.as_object()}
        _send(connection, pack(Kind.READY, json.dumps(ready).encode()))
        _run(engine, connection, wake)
    finally:
        # A device that is gone takes no order; that it is gone has been told.
        with suppress(OSError):
            engine.close()
    engine.report()
    return 0


def boot_s() -> float:
    """Return the clock that also runs while the computer sleeps."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def _run(engine: Engine, connection: socket.socket, wake: int) -> None:
    clock = time.monotonic
    files: tuple[socket.socket | int, ...] = (connection, wake)
    while True:
        timeout_s = max(engine.next_s - clock(), 0.0)
        ready = select.select(files, (), (), timeout_s)[0]
        engine.turn()
        if wake in ready or (connection in ready and not _receive(engine, connection)):
            return


def _receive(engine: Engine, connection: socket.socket) -> bool:
    """Take what the companion sent; return False if it is the end."""
    for _ in range(_PACKETS_AT_ONCE):
        try:
            packet = connection.recv(PACKET_MAX + 1)
        except BlockingIOError:
            return True
        except OSError:
            return False
        if not packet:
            return False
        try:
            kind, body = unpack(packet)
        except RefusedError as refused:
            engine.refuse(str(refused))
            continue
        if kind is Kind.STOP:
            return False
        engine.receive(kind, body)
        engine.turn()
    return True


def _send(connection: socket.socket, packet: bytes) -> bool:
    """Hand over a packet; False if the companion does not read, or is gone."""
    try:
        connection.send(packet, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
    except OSError:
        return False
    return True


def _end_wakes() -> int:
    """Have SIGTERM and SIGHUP make a file readable; SIGINT is the companion's affair."""
    ours, theirs = os.pipe()
    os.set_blocking(theirs, False)
    signal.set_wakeup_fd(theirs, warn_on_full_buffer=False)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: None)
    return ours


def main(arguments: list[str]) -> int:
    """Run as `python -P -m companion.output.engine FD PARENT`."""
    file, parent = (int(text) for text in arguments)
    with socket.socket(fileno=file) as connection:
        os.set_inheritable(file, False)
        return serve(connection, parent=parent)


# What a process asks of Linux to be on time: priority, memory that stays, a fine timer.

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
            "the valve engine's memory can be swapped out: allow LimitMEMLOCK=infinity in the "
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
