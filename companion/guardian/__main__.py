"""The guardian's process; started by the companion, with the socket to hear it through.

The first packet says what closed is, each later one how the vehicle is reached, with the link's
file where that is another one. It orders all outputs closed every `ROUND_S`, from its start until
the companion has taken note of that, and again as soon as no packet came for a lease, the socket
has ended, or SIGTERM or SIGABRT came (systemd's watchdog sends that to all of a service). After the
last two it goes on for `AFTER_S`, and ends. The word "end", which the companion says when it has
closed everything itself, ends it at once.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import os
import select
import signal
import socket
import struct
import sys
import termios
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from companion.guardian import AFTER_S

# Between two rounds of closing orders, and between two signs of life to the companion.
ROUND_S, ALIVE_S = 0.2, 0.1
# A frame that the companion began is at most this much longer: zeros end it, and none begins one.
PAD = bytes(280)
PENDING_MAX = 1024
PACKET_MAX = 4096
# MAVLink 2: COMMAND_LONG with its CRC_EXTRA, and the two commands.
COMMAND_LONG, EXTRA = 76, 152
DO_SET_SERVO, DO_SET_ACTUATOR = 183, 187
ACTUATORS, AUTOPILOT = 6, 1
# Signed, it is a stream of its own beside the companion's link 0: neither makes the other's old.
SIGNED, LINK_NUMBER, STAMPS_PER_S = 1, 1, 100_000
# Later than all that the companion sent until this was told, and while it was on its way: 0.1 s.
LEAD = STAMPS_PER_S // 10
MCL_CURRENT, MCL_FUTURE = 1, 2


def checksum(data: bytes) -> int:
    """Return MAVLink's CRC-16/MCRF4XX.

    >>> hex(checksum(b"123456789"))
    '0x6f91'
    """
    value = 0xFFFF
    for byte in data:
        mixed = (byte ^ value) & 0xFF
        mixed ^= mixed << 4 & 0xFF
        value = value >> 8 ^ mixed << 8 ^ mixed << 3 ^ mixed >> 4
    return value & 0xFFFF


def boot_s() -> float:
    """Return the clock that also runs while the computer sleeps."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class Closer:
    """Has the closing orders, and the link to send them by."""

    def __init__(self, setup: dict[str, Any]) -> None:
        self._outputs: list[tuple[int, int]] = setup["closed_us"]
        self._ends_us: tuple[int, int] = setup["ends_us"]
        self._component: int = setup["component"]
        self._key = bytes.fromhex(setup["key"])
        self._is_udp: bool = setup["is_udp"]
        self._file = -1
        self._pending = b""
        self._cuts = False
        self._sequence = self._stamp = 0
        self._told: dict[str, Any] = {"is_px4": None}
        self._told_s = 0.0

    def hear(self, told: dict[str, Any], files: list[int]) -> None:
        """Take how the vehicle is reached; a link that is down must not be kept open here."""
        self._told, self._told_s = told, boot_s()
        if self._file >= 0 and (files or not told["is_up"]):
            os.close(self._file)
            self._file = -1
        if files:
            self._file, self._pending = files[0], b""

    def begin(self) -> None:
        """Begin anew to close: what the companion has begun to send may be half a frame."""
        self._cuts = not self._is_udp

    @property
    def can_close(self) -> bool:
        """Whether there is a link, and the vehicle was heard on it."""
        return self._file >= 0 and self._told["is_px4"] is not None

    def close(self) -> None:
        """Order all outputs closed, once."""
        if not self.can_close:
            return
        if self._cuts:
            self._cuts = False
            with suppress(termios.error):  # no serial line: what waits there cannot be recalled
                termios.tcflush(self._file, termios.TCOFLUSH)
            self._pending = PAD
        for command, values in self.orders(is_px4=self._told["is_px4"]):
            self._send(self.frame(command, values))

    def orders(self, *, is_px4: bool) -> list[tuple[int, list[float]]]:
        """Return command and parameters of the closing orders; PX4 has one for all actuators."""
        if not is_px4:
            return [(DO_SET_SERVO, [*map(float, output)]) for output in self._outputs]
        low_us, high_us = sorted(self._ends_us)
        closed_us = dict.fromkeys(range(1, ACTUATORS + 1), self._ends_us[0])
        closed_us |= {number: us for number, us in self._outputs if number in closed_us}
        shares = [(us - low_us) / (high_us - low_us) for us in closed_us.values()]
        return [(DO_SET_ACTUATOR, [min(max(2.0 * share - 1.0, -1.0), 1.0) for share in shares])]

    def frame(self, command: int, values: list[float]) -> bytes:
        """Return a COMMAND_LONG to the autopilot, signed where the link is."""
        system = self._told["system"]
        filled = (*values, *[0.0] * (7 - len(values)))
        payload = struct.pack("<7fHBBB", *filled, command, system, AUTOPILOT, 0)
        flags = SIGNED if self._key else 0
        head = bytes((len(payload), flags, 0, self._sequence, system, self._component))
        body = head + COMMAND_LONG.to_bytes(3, "little") + payload
        self._sequence = (self._sequence + 1) % 256
        found = b"\xfd" + body + checksum(body + bytes((EXTRA,))).to_bytes(2, "little")
        if not self._key:
            return found
        since = round((boot_s() - self._told_s) * STAMPS_PER_S)
        self._stamp = max(self._stamp, self._told["stamp"] + since + LEAD) + 1
        found += bytes((LINK_NUMBER,)) + self._stamp.to_bytes(6, "little")
        return found + hashlib.sha256(self._key + found).digest()[:6]

    def _send(self, data: bytes) -> None:
        """Send now; what a stream does not take whole goes ahead of the next."""
        if self._told["peers"]:
            with socket.socket(fileno=os.dup(self._file)) as out:
                for peer in self._told["peers"]:
                    with suppress(OSError):
                        out.sendto(data, socket.MSG_DONTWAIT, tuple(peer))
            return
        if len(self._pending) < PENDING_MAX:
            self._pending += data
        with suppress(OSError):
            self._pending = self._pending[os.write(self._file, self._pending) :]


class Guardian:
    """When to close: from the start, and whenever the companion is silent, gone, or to end."""

    def __init__(self, control: socket.socket, wake: int) -> None:
        setup = json.loads(control.recv(PACKET_MAX))
        control.setblocking(False)
        self._control, self._wake = control, wake
        self._closer = Closer(setup)
        self._lease_s: float = setup["lease_s"]
        self._note: str = setup["note"]
        self._closings, self._taken, self.rounds = 1, 0, 0
        self._heard_s = self._alive_s = self._round_s = boot_s()
        self._is_gone, self._why = False, "start"
        self.ends_s = float("inf")

    @property
    def _is_closing(self) -> bool:
        return self._taken != self._closings or self.ends_s < float("inf")

    def serve(self) -> None:
        """Go on until the companion has said that all is closed, or for a while after its end."""
        ends, control = False, self._control.fileno()
        while boot_s() < self.ends_s:
            due_s = self._round_s if self._is_closing else self._heard_s + self._lease_s
            wait_s = max(min(due_s, self._alive_s) - boot_s(), 0.0)
            files = [*([] if ends else [self._wake]), *([] if self._is_gone else [control])]
            ready = select.select(files, (), (), wait_s)[0]
            if control in ready and not self._hear():
                return
            ends = ends or self._is_gone or self._wake in ready
            self._turn(ends=ends)
        if self._is_gone and self._note and self._closer.can_close:
            told = {"closed_s": time.time(), "rounds": self.rounds}
            with suppress(OSError):
                Path(self._note).write_text(json.dumps(told), encoding="utf-8")

    def _hear(self) -> bool:
        """Take all that the companion said; return False at its last word."""
        while not self._is_gone:
            try:
                packet, files, _, _ = socket.recv_fds(self._control, PACKET_MAX, 1)
            except BlockingIOError:
                return True
            except ConnectionResetError:
                continue  # it has ended without reading us: what it said before is still there
            except OSError:
                packet, files = b"", []
            self._is_gone = not packet
            told = json.loads(packet or "{}")
            if told == "end":
                return False
            if told:
                self._closer.hear(told, files)
                self._heard_s = boot_s()
                if told["taken"] != self._taken:
                    self._taken, self._alive_s = told["taken"], self._heard_s
        return True

    def _turn(self, *, ends: bool) -> None:
        """Close if it is time, and give the sign of life."""
        now_s = boot_s()
        is_silent = not now_s - self._heard_s <= self._lease_s
        if not self._is_closing and (ends or is_silent):
            self._closings += 1
            self._why = "told to end" if ends else "companion silent"
            self._alive_s = self._round_s = now_s
            self._closer.begin()
        if ends and not self.ends_s < float("inf"):
            # A start that heard nobody has nobody to close: the next one needs the port.
            is_idle = self._is_gone and not self._closer.can_close
            self.ends_s, self._round_s = now_s + AFTER_S * (not is_idle), now_s
        if self._is_closing and not now_s < self._round_s:
            self._round_s = now_s + ROUND_S
            self.rounds += 1
            self._closer.close()
        if not now_s < self._alive_s:
            self._alive_s = now_s + ALIVE_S
            alive = json.dumps([self._closings, self._is_closing, self._why]).encode()
            with suppress(OSError):
                self._control.send(alive, socket.MSG_NOSIGNAL)


def stay() -> None:
    """Ask Linux not to end this process for want of memory, and not to swap it out."""
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("-1000")
    ctypes.CDLL(None).mlockall(MCL_CURRENT | MCL_FUTURE)


def main(file: int) -> None:
    """Run as `python -P -m companion.guardian FILE`."""
    wake, waker = os.pipe()
    os.set_blocking(waker, False)
    signal.set_wakeup_fd(waker, warn_on_full_buffer=False)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGABRT):
        signal.signal(number, lambda *_: None)
    stay()
    with socket.socket(fileno=file) as control:
        control.setblocking(True)
        # A start that died before its first word has opened nothing.
        if control.recv(1, socket.MSG_PEEK):
            Guardian(control, wake).serve()


if __name__ == "__main__":
    main(int(sys.argv[1]))
