"""The whole process, `vrspray run`, against an autopilot on the wire."""

from __future__ import annotations

import asyncio
import contextlib
import json
import shutil
import signal
import socket
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
import shapely

from companion.core.frame import LocalFrame
from tests.bench.bad_frames import READ, extreme_frames
from tests.companion.wire_peer import WirePeer, free_port, over_udp

pytestmark = pytest.mark.sitl

KEY = bytes(range(100, 132))
EXAMPLE = Path(__file__).parents[3] / "examples" / "anyang"


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """Return the example's configuration, in a folder that the journal may be written to."""
    folder = tmp_path / "anyang"
    shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("flights"))
    return folder / "config.toml"


def peer_over_the_middle() -> WirePeer:
    """Return a vehicle that crosses the middle of the example's field."""
    text = (EXAMPLE / "boundary.geojson").read_text()
    middle = shapely.from_geojson(json.dumps(json.loads(text))).centroid
    frame = LocalFrame(latitude_deg=middle.y, longitude_deg=middle.x)
    return WirePeer(frame, east_m=-6.0)


@asynccontextmanager
async def companion(
    config: Path, port: int, *overrides: str
) -> AsyncIterator[asyncio.subprocess.Process]:
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "companion",
        "run",
        "--config",
        str(config),
        "--set",
        f"link.url=udpin:127.0.0.1:{port}",
        *(word for override in overrides for word in ("--set", override)),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        yield process
    finally:
        if process.returncode is None:
            process.kill()
        await process.communicate()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
async def test_a_signal_closes_every_valve_and_ends_the_process(
    config: Path, number: signal.Signals
) -> None:
    port = free_port()
    peer = peer_over_the_middle()
    async with companion(config, port) as process, over_udp(peer, port):
        await peer.until(lambda: peer.is_ready, within_s=20.0)
        peer.place(east_m=-6.0)
        peer.enable()
        await peer.until(lambda: len(peer.open_channels) == 6)
        process.send_signal(number)
        _, stderr = await asyncio.wait_for(process.communicate(), 10.0)
        assert process.returncode == 0, stderr.decode()
        assert b"Traceback" not in stderr
        await peer.until(lambda: peer.is_all_closed)
        assert [order.pulse_us for order in peer.orders[-12:]] == [1000] * 12


async def test_no_extreme_of_any_message_ends_the_process(config: Path) -> None:
    port = free_port()
    peer = peer_over_the_middle()
    async with companion(config, port) as process, over_udp(peer, port):
        await peer.until(lambda: peer.is_ready, within_s=20.0)
        peer.place(east_m=-6.0)
        peer.enable()
        await peer.until(lambda: len(peer.open_channels) == 6)
        for message_id in READ:
            for _, frame in extreme_frames(message_id):
                peer.write(frame)
            await asyncio.sleep(0.02)  # the socket's buffer is finite
        beats = len(peer.of("HEARTBEAT"))
        await peer.until(lambda: len(peer.of("HEARTBEAT")) >= beats + 2)
        process.send_signal(signal.SIGTERM)
        _, stderr = await asyncio.wait_for(process.communicate(), 10.0)
        assert process.returncode == 0, stderr.decode()
        assert b"Traceback" not in stderr
        await peer.until(lambda: peer.is_all_closed)


async def test_a_port_in_use_is_one_line_and_exit_two(config: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        async with companion(config, port) as process:
            _, stderr = await asyncio.wait_for(process.communicate(), 20.0)
    assert process.returncode == 2
    lines = [line for line in stderr.decode().splitlines() if "in use" in line]
    assert len(lines) == 1
    assert "Traceback" not in stderr.decode()


async def test_a_signed_enable_of_before_a_kill_opens_nothing_after_it(
    config: Path, tmp_path: Path
) -> None:
    """Sent again by anybody, as soon as the next process listens and after it has asked."""
    port, key = free_port(), tmp_path / "signing.key"
    key.write_bytes(KEY)
    key.chmod(0o600)
    signed = f"link.signing_key_file={key}"
    peer, captured = peer_over_the_middle(), list[bytes]()
    peer.sign(KEY)
    peer.answers_time = True

    async def asked() -> None:
        """Wait for the second question of the time: the first has its answer then."""
        await peer.until(lambda: len(peer.of("TIMESYNC")) >= 2, within_s=20.0)

    async with companion(config, port, signed) as process, over_udp(peer, port):
        await asked()
        send = peer.write
        peer.write = lambda data: (captured.append(data), send(data))[1]
        peer.place(east_m=-6.0)
        peer.enable()
        await peer.until(lambda: len(peer.open_channels) == 6)
        process.kill()
        await process.wait()
    enables = [frame for frame in captured if frame[7] == 76 and frame[5] == 255]
    assert enables
    peer.messages.clear()
    peer.outputs.clear()
    async with companion(config, port, signed) as process, over_udp(peer, port):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as anybody:

            async def say_again() -> None:
                while True:
                    for frame in enables:
                        with contextlib.suppress(OSError):  # nobody listens yet
                            anybody.sendto(frame, ("127.0.0.1", port))
                    await asyncio.sleep(0.02)

            again = asyncio.create_task(say_again())
            await asked()
            await peer.until(lambda: peer.is_all_closed)
            peer.place(east_m=-6.0)
            beats = len(peer.of("HEARTBEAT"))
            await peer.until(lambda: len(peer.of("HEARTBEAT")) >= beats + 3)
            assert peer.is_all_closed
            again.cancel()
            await asyncio.gather(again, return_exceptions=True)
        peer.place(east_m=-6.0)
        peer.enable()
        await peer.until(lambda: len(peer.open_channels) == 6)
        process.send_signal(signal.SIGTERM)
        await asyncio.wait_for(process.communicate(), 10.0)
