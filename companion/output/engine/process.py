"""The engine's process: its socket, its signals, its end.

One thread, one `select`: the next edge is its timeout. It ends, with everything closed, when the
companion says so, closes the socket or dies, and at SIGTERM.
"""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import time
from contextlib import suppress

from companion.errors import ActuatorError
from companion.output.engine.engine import Engine
from companion.output.engine.gpiod_lines import keeps_levels
from companion.output.engine.lines import open_lines
from companion.output.engine.realtime import be_on_time, die_with_parent
from companion.output.engine.selftest import self_test
from companion.output.engine.setup import EngineSetup
from companion.output.engine.wire import PACKET_MAX, Kind, RefusedError, pack, unpack
from companion.output.engine.wiring import hazards

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
