"""A megabyte a second of bytes that look like starts of frames, beside a vehicle that flies.

    python -m tests.bench.flood [--seconds 20] [--only udp] [--bytes-s 1000000]

The companion is a process of its own, with link, core and servo output as `run` has them; its event
loop is probed every 5 ms. The operator enables and disables four times a second; the clock starts
when DISABLE is sent and stops when the last order to close has arrived. On UDP a stranger sends, on
TCP and serial the bytes stand between the vehicle's own. One JSON object on stdout.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import pty
import queue
import socket
import sys
import threading
import time
import tty
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.link.component import ComponentOptions
from companion.link.vehicle_link import VehicleLink
from companion.output.servo import ServoExecutor, ServoOptions
from companion.runtime import execute, run
from tests.bench.gate_frames import long_setup
from tests.companion.wire_peer import WirePeer, free_port

PROBE_S, STEP_S = 0.005, 0.01
LATE_MAX_MS, CLOSED_MAX_MS = 5.0, 20.0
CHANNELS = tuple(range(1, 7))
_OTHER = mavlink.MAVLink(None, srcSystem=9, srcComponent=190)
_BEAT = bytes(_OTHER.heartbeat_encode(6, 8, 0, 0, 4).pack(_OTHER))
# What is sent: nothing; starts; heads that can be; whole frames of somebody else.
KINDS = {
    "idle": b"",
    "starts": b"\xfe",
    "heads": b"\xfe\x18",
    "frames": _BEAT,
    "a guest's heads": _BEAT + b"\xfe\x18" * 700,  # of a stranger that is adopted
}
# By link: which of them, and in chunks of how many bytes.
RUNS = {
    "udp": (
        *(("idle", 0), ("starts", 65_507), ("heads", 1400), ("heads", 64)),
        *(("frames", 1400), ("a guest's heads", 1400)),
    ),
    "tcp": (("idle", 0), ("starts", 262_144), ("heads", 65_536), ("frames", 65_536)),
    "serial": (("idle", 0), ("starts", 4096), ("heads", 4096)),
}


# ------------------------------------------------------------------------------- the companion


async def _companion(url: str) -> int:
    """Fly until the signal; say how late the event loop was, and what came."""
    given = long_setup()
    link = VehicleLink(url, ComponentOptions())
    executor = ServoExecutor(ServoOptions(channels=CHANNELS), link.order)
    link.on_order_ack(executor.acknowledge)
    late_s: list[float] = []

    async def probe() -> None:
        while True:
            due_s = time.monotonic() + PROBE_S
            await asyncio.sleep(PROBE_S)
            late_s.append(time.monotonic() - due_s)

    probing = asyncio.create_task(probe())
    begun_s = time.process_time()
    await run(given, link=link, executor=executor)
    busy_s = time.process_time() - begun_s
    probing.cancel()
    assert link.statistics is not None
    told = {
        "late_ms": [round(1e3 * value, 3) for value in late_s[20:]],
        "positions": link.component.codec.vehicle_counts.get(33, 0),
        "busy_s": busy_s,
        "line": link.statistics.line(),
    }
    print(json.dumps(told))  # noqa: T201
    return 0


# --------------------------------------------------------------------------------- the vehicle


class Way:
    """A thread that sends the vehicle's frames at once, and the flood at its pace between them."""

    def __init__(self, vehicle: Any, stranger: Any, chunk: bytes, bytes_s: float) -> None:
        self.frames: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._vehicle, self._stranger, self._chunk = vehicle, stranger, chunk
        self._pause_s = len(chunk) / bytes_s if chunk else 3600.0
        self.flood_bytes = 0
        self.is_flooding = False
        self._thread = threading.Thread(target=self._send)
        self._thread.start()

    def _send(self) -> None:
        next_s = time.monotonic()
        while True:
            now_s = time.monotonic()
            if self.is_flooding and now_s >= next_s:
                self._stranger(self._chunk)
                self.flood_bytes += len(self._chunk)
                next_s = max(next_s + self._pause_s, now_s - 0.1)
            with contextlib.suppress(queue.Empty):
                wait_s = min(max(next_s - time.monotonic(), 0.0), STEP_S)
                frame = self.frames.get(timeout=wait_s) if wait_s else self.frames.get_nowait()
                if frame is None:
                    return
                with contextlib.suppress(ConnectionRefusedError):  # not there yet
                    self._vehicle(frame)

    def end(self) -> None:
        self.frames.put(None)
        self._thread.join()


@contextlib.contextmanager
def _line(kind: str) -> Iterator[tuple[str, Any, Any, Any]]:
    """Yield a link's URL, what sends the vehicle's and the stranger's bytes, and what to read."""
    with contextlib.ExitStack() as stack:
        if kind == "udp":
            port = free_port()
            ours, other = (
                stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
                for _ in range(2)
            )
            ours.connect(("127.0.0.1", port))
            to = ("127.0.0.1", port)
            url = f"udpin:127.0.0.1:{port}"
            yield url, ours.send, lambda chunk: other.sendto(chunk, to), ours.fileno
        elif kind == "tcp":
            server = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
            accepted: list[socket.socket] = []

            def there() -> socket.socket:
                if not accepted:
                    accepted.append(stack.enter_context(server.accept()[0]))
                    accepted[0].setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                return accepted[0]

            def send(data: bytes) -> None:
                there().sendall(data)

            yield f"tcp:127.0.0.1:{server.getsockname()[1]}", send, send, lambda: there().fileno()
        else:
            far, near = pty.openpty()
            tty.setraw(near)
            name = os.ttyname(near)
            stack.callback(os.close, far)
            stack.callback(os.close, near)

            def write(data: bytes) -> None:
                while data:
                    data = data[os.write(far, data) :]

            yield f"serial:{name}:921600", write, write, lambda: far


async def _measure(kind: str, what: str, size: int, seconds: float, bytes_s: float) -> Any:
    pattern = KINDS[what]
    chunk = (pattern * (size // len(pattern) + 1))[:size] if size else b""
    with _line(kind) as (url, vehicle, stranger, fileno):
        child = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "tests.bench.flood", "--companion", url),
            stdout=asyncio.subprocess.PIPE,
        )
        way = Way(vehicle, stranger, chunk, bytes_s)
        peer = WirePeer(long_setup().frame, east_m=20.0)
        sent = [0]

        def write(frame: bytes) -> None:
            sent[0] += frame[7:10] == b"\x21\x00\x00"
            way.frames.put(frame)

        peer.write = write
        loop = asyncio.get_running_loop()
        descriptor = await loop.run_in_executor(None, fileno)
        os.set_blocking(descriptor, True)

        def read() -> None:
            with contextlib.suppress(OSError):
                peer.feed(os.read(descriptor, 65_536))

        peer.begin()
        loop.add_reader(descriptor, read)
        closed_s: list[float] = []
        try:
            await peer.until(lambda: len(peer.outputs) == len(CHANNELS), within_s=30.0)
            # A ground station says something each second: whom a flood finds here is known already.
            peer.enable(False)
            await asyncio.sleep(0.5)
            way.is_flooding = True
            until_s = loop.time() + seconds
            while loop.time() < until_s:
                await _toggle(peer, closed_s)
            way.is_flooding = False
            await asyncio.sleep(1.0)
        finally:
            loop.remove_reader(descriptor)
            await peer.end()
            await asyncio.sleep(0.5)
            child.terminate()
            out, _ = await child.communicate()
            way.end()
    told = json.loads(out)
    return {
        "flood": f"{what}, {size} B" if size else what,
        "flood_bytes_s": round(way.flood_bytes / seconds),
        "late_p99_ms": _p99(told["late_ms"]),
        "late_max_ms": max(told["late_ms"]),
        "closed_p99_ms": _p99([1e3 * one for one in closed_s]),
        "closed_max_ms": round(1e3 * max(closed_s), 1),
        "disabled": len(closed_s),
        "positions_lost": sent[0] - told["positions"],
        "busy_share": round(told["busy_s"] / (seconds + 2.0), 3),
        "link": told["line"],
    }


async def _toggle(peer: WirePeer, closed_s: list[float]) -> None:
    """Enable, wait until all are open, disable, and take the time until all are ordered closed."""
    peer.enable()
    await peer.until(lambda: len(peer.open_channels) == len(CHANNELS), within_s=60.0)
    await asyncio.sleep(0.1)
    count, sent_s = len(peer.orders), time.monotonic()
    peer.enable(False)
    await peer.until(lambda: peer.is_all_closed, within_s=60.0)
    assert len(peer.orders) > count
    closed_s.append(peer.orders[-1].at_s - sent_s)
    await asyncio.sleep(0.1)


def _p99(values: Sequence[float]) -> float:
    return round(float(np.percentile(values, 99)), 2)


def main() -> None:
    """Measure each link idle and flooded."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--bytes-s", type=float, default=1e6)
    parser.add_argument("--only", choices=RUNS)
    parser.add_argument("--companion", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.companion:
        execute(lambda: _companion(given.companion))
        return
    found: dict[str, Any] = {"load": os.getloadavg()[0]}
    for kind in [given.only] if given.only else RUNS:
        rows = [
            asyncio.run(_measure(kind, what, size, given.seconds, given.bytes_s))
            for what, size in RUNS[kind]
        ]
        for row in rows:
            row["late_above_idle_ms"] = round(row["late_p99_ms"] - rows[0]["late_p99_ms"], 2)
            row["holds"] = (
                row["late_above_idle_ms"] <= LATE_MAX_MS
                and row["closed_p99_ms"] <= CLOSED_MAX_MS
                and row["positions_lost"] == 0
            )
        found[kind] = rows
    print(json.dumps(found, indent=2))  # noqa: T201


if __name__ == "__main__":
    main()
