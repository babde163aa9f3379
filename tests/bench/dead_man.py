"""How fast the outputs close when the companion is killed while it sprays.

`python -m tests.bench.dead_man [kills] [seed]`. Each time the real process, `vrspray run`, sprays
over loopback and gets SIGKILL. What it sent goes to two layers, each by itself: the watchdog script
under Lua 5.3 on a faked autopilot, and the driver board that wants its orders to move.
"""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely

from companion.config import load
from companion.core.frame import LocalFrame
from sitl.outputs import DriverBoard
from sitl.profile import load_profile
from tests.companion.wire_peer import WirePeer, free_port, over_udp
from tests.lua_bindings import FakeAutopilot

EXAMPLE = Path(__file__).parents[2] / "examples" / "anyang"
DITHER_US = 8
_AFTER_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Closing:
    """When all was closed, after the kill and after the last sign of life."""

    script_s: float
    script_after_life_s: float
    board_s: float


def children_of(pid: int) -> list[int]:
    """Return the processes that a process has started, such as its guardian."""
    lists = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(child) for each in lists for child in each.read_text().split()]


def frames_of(data: bytes) -> Iterator[bytes]:
    """Yield the MAVLink 2 frames of a datagram."""
    while len(data) >= 12 and data[0] == 0xFD:
        length = 12 + data[1] + (13 if data[2] & 1 else 0)
        yield data[:length]
        data = data[length:]


class Layers:
    """The two layers, fed with what arrives at the autopilot; their clock is the wall's."""

    def __init__(self, channels: tuple[int, ...], *, seed: int) -> None:
        self.begin_s = time.monotonic()
        profile = load_profile("wang-2024")
        self.board = DriverBoard(
            profile.pwm, len(channels), seed=seed, start_s=0.0, dither_us=DITHER_US
        )
        first, last = min(channels), max(channels)
        self.autopilot = FakeAutopilot(
            set_output=self._written,
            parameters={"SPRW_FIRST": first, "SPRW_LAST": last},
            boot_ms=0,
        )
        # Scripts run as they please: not in step with anything else.
        self.autopilot.stall(float(np.random.default_rng(seed).uniform(0.0, 20.0)))
        self._channels = channels
        self._open: dict[int, bool] = {}
        self.closed_s = 0.0
        self.life_s = 0.0

    def now_s(self) -> float:
        return time.monotonic() - self.begin_s

    @property
    def are_all_open(self) -> bool:
        return sum(self._open.values()) == len(self._channels)

    def _written(self, channel: int, pulse_us: int) -> None:
        if self._open.get(channel) and pulse_us == 1000:
            self.closed_s = self.autopilot.now_ms / 1000.0
        self._open[channel] = pulse_us != 1000

    def message(self, frame: bytes) -> None:
        self.autopilot.on_message(frame, self.now_s())
        if b"SPR_LIVE" in frame:
            self.life_s = self.now_s()

    def order(self, channel: int, pulse_us: int) -> None:
        now_s = self.now_s()
        self.autopilot.update(now_s)
        self.autopilot.order(channel, pulse_us)
        self._open[channel] = pulse_us != 1000
        self.board.order(now_s, self._channels.index(channel), pulse_us)
        self.board.advance(now_s - 0.1)

    def finish(self, killed_s: float) -> Closing:
        """Let both go on alone, and return when each had closed its last valve."""
        before = sum(self._open.values())
        self.autopilot.update(killed_s + _AFTER_S)
        edges = self.board.advance(killed_s + _AFTER_S)
        assert before, "nothing was open when it was killed"
        assert not any(self._open.values()), "the script left a valve open"
        assert not any(self.board.duty), "the board left a valve open"
        return Closing(
            script_s=self.closed_s - killed_s,
            script_after_life_s=self.closed_s - self.life_s,
            board_s=max(edge.at_s for edge in edges if not edge.is_open) - killed_s,
        )


def peer_in_the_middle() -> WirePeer:
    """Return a vehicle that crosses the middle of the example's field."""
    text = (EXAMPLE / "boundary.geojson").read_text(encoding="utf-8")
    middle = shapely.from_geojson(json.dumps(json.loads(text))).centroid
    return WirePeer(LocalFrame(latitude_deg=middle.y, longitude_deg=middle.x), east_m=-6.0)


async def kill_once(seed: int) -> Closing:
    """Start `vrspray run`, have it spray, kill it, and see what closes when."""
    with tempfile.TemporaryDirectory(prefix="dead-man-") as name:
        folder = Path(name) / "anyang"
        shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("flights"))
        config = folder / "config.toml"
        channels = tuple(valve.channel or 0 for valve in load(config).valve)
        port, peer = free_port(), peer_in_the_middle()
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "companion", "run", "--config", str(config)),
            *("--set", f"link.url=udpin:127.0.0.1:{port}"),
            *("--set", f"output.dither_us={DITHER_US}"),
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.DEVNULL,
        )
        try:
            return await _fly_and_kill(process, peer, port, Layers(channels, seed=seed), seed)
        finally:
            if process.returncode is None:
                process.kill()
            await process.wait()


async def _fly_and_kill(
    process: asyncio.subprocess.Process, peer: WirePeer, port: int, layers: Layers, seed: int
) -> Closing:
    feed = peer.feed

    def listen(data: bytes) -> None:
        known = len(peer.orders)
        feed(data)
        for frame in frames_of(data):
            layers.message(frame)
        for order in peer.orders[known:]:
            layers.order(order.channel, order.pulse_us)

    peer.feed = listen  # type: ignore[method-assign]
    async with over_udp(peer, port):
        await peer.until(lambda: peer.is_ready, within_s=30.0)
        peer.place(east_m=-6.0)
        peer.enable()
        await peer.until(lambda: len(peer.open_channels) == len(peer.outputs))
        await asyncio.sleep(float(np.random.default_rng(seed).uniform(0.3, 0.8)))
        # On a busy computer the script may just have closed what was silent for too long.
        await peer.until(lambda: layers.are_all_open)
        for child in children_of(process.pid):  # the guardian: no layer beside this computer
            os.kill(child, signal.SIGKILL)
        process.kill()
        killed_s = layers.now_s()
        await process.wait()
        await asyncio.sleep(0.05)  # what it had sent before arrives
    return layers.finish(killed_s)


def main(kills: int = 20, seed: int = 0) -> int:
    """Kill it again and again, and say how long each layer took."""
    closings = [asyncio.run(kill_once(seed + number)) for number in range(kills)]
    for what in ("script_s", "script_after_life_s", "board_s"):
        took = np.array([getattr(closing, what) for closing in closings])
        sys.stdout.write(
            f"{what:22s} mean {took.mean():.3f}  worst {took.max():.3f}  least {took.min():.3f}"
            f"  ({kills} kills)\n"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])))
