"""The guardian beside the whole process: the companion dies or stands still while it sprays."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from pathlib import Path

import pytest

from analysis.journals.content import read_journal
from companion.guardian import AFTER_S
from companion.guardian.__main__ import LINK_NUMBER
from tests.bench.dead_man import EXAMPLE, children_of, peer_in_the_middle
from tests.companion.wire_peer import TcpHost, WirePeer, free_port, over_udp

pytestmark = pytest.mark.sitl
KEY = bytes(range(32))


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """Return the example's configuration, in a folder that the journal may be written to."""
    folder = tmp_path / "anyang"
    shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("flights"))
    return folder / "config.toml"


class Spraying:
    """A companion that sprays, and the vehicle that its orders reach."""

    def __init__(self, process: asyncio.subprocess.Process, peer: WirePeer) -> None:
        self.process, self.peer = process, peer

    @property
    def guardian(self) -> int:
        """Return the guardian's process id."""
        (found,) = [pid for pid in children_of(self.process.pid) if "guardian" in words(pid)]
        return found

    async def closed_s(self, act: Callable[[], object]) -> float:
        """Return how long after `act` the last valve is closed."""
        acted_s = time.monotonic()
        act()
        await self.peer.until(lambda: self.peer.is_all_closed)
        return time.monotonic() - acted_s

    async def opens_again(self) -> None:
        """Wait until it sprays, above the middle of the field."""
        self.peer.place(east_m=-6.0)
        await self.peer.until(lambda: len(self.peer.open_channels) == len(self.peer.outputs))


def words(pid: int) -> str:
    """Return the command line of a process; nothing where it has ended."""
    with suppress(FileNotFoundError):
        return Path(f"/proc/{pid}/cmdline").read_text()
    return ""


def readers_of(pid: int) -> list[int]:
    """Return the processes of a companion that read its map."""
    return [child for child in children_of(pid) if "map" in words(child).split("\0")]


def sockets_of(pid: int) -> int:
    """Return how many sockets a process has open."""
    files = [str(file.readlink()) for file in Path(f"/proc/{pid}/fd").iterdir()]
    return sum(file.startswith("socket:") for file in files)


def status_kb(pid: int, name: str) -> int:
    """Return a figure of a process's memory."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{name}:"))


def oom_score(pid: int) -> int:
    """Return how soon the kernel ends a process when memory is short."""
    return int(Path(f"/proc/{pid}/oom_score").read_text())


async def is_gone(pid: int) -> None:
    """Wait for the end of a process that is not our child."""
    async with asyncio.timeout(AFTER_S + 5.0):
        while words(pid):  # noqa: ASYNC110
            await asyncio.sleep(0.02)


@asynccontextmanager
async def started(
    config: Path, url: str, *settings: str
) -> AsyncIterator[asyncio.subprocess.Process]:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "companion", "run", "--config", str(config)),
        *(word for each in (f"link.url={url}", *settings) for word in ("--set", each)),
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        yield process
    finally:
        if process.returncode is None:
            process.kill()
        await process.communicate()


async def begun(process: asyncio.subprocess.Process, peer: WirePeer) -> Spraying:
    found = Spraying(process, peer)
    await peer.until(lambda: peer.is_ready, within_s=20.0)
    if peer.clock is not None:  # signed: the first question of the time has its answer by then
        await peer.until(lambda: len(peer.of("TIMESYNC")) >= 2, within_s=20.0)
    peer.place(east_m=-6.0)
    peer.enable()
    await found.opens_again()
    return found


@asynccontextmanager
async def spraying(config: Path, *settings: str) -> AsyncIterator[Spraying]:
    port, peer = free_port(), peer_in_the_middle()
    async with (
        started(config, f"udpin:127.0.0.1:{port}", *settings) as process,
        over_udp(peer, port),
    ):
        yield await begun(process, peer)


async def test_a_killed_companion_is_closed_at_once_and_nothing_is_left_of_it(
    config: Path,
) -> None:
    async with spraying(config) as flight:
        guardian = flight.guardian
        assert await flight.closed_s(flight.process.kill) <= 0.5
        before = len(flight.peer.orders)
        await is_gone(guardian)
        after = flight.peer.orders[before:]
    # Again and again, to each output, and nothing but closed.
    assert {order.pulse_us for order in after} == {1000}
    assert len(after) >= 6 * 5


async def test_one_that_stands_still_is_closed_and_opens_after_it_has_taken_note(
    config: Path,
) -> None:
    async with spraying(config) as flight:
        stop = lambda: flight.process.send_signal(signal.SIGSTOP)  # noqa: E731
        assert await flight.closed_s(stop) <= 0.5
        rounds = len(flight.peer.orders)
        await flight.peer.until(lambda: len(flight.peer.orders) >= rounds + 12)
        flight.process.send_signal(signal.SIGCONT)
        await flight.opens_again()
        await flight.peer.until(
            lambda: "Spray: guardian closed all: companion silent" in flight.peer.texts()
        )
        flight.process.terminate()
        await flight.process.communicate()
    found = next((config.parent / "flights").glob("*.gpkg"))
    told = [event.text for event in read_journal(found).events]
    assert "guardian closed all: companion silent" in told


async def test_a_second_kill_after_a_standstill_is_closed_too(config: Path) -> None:
    async with spraying(config) as flight:
        await flight.closed_s(lambda: flight.process.send_signal(signal.SIGSTOP))
        flight.process.send_signal(signal.SIGCONT)
        await flight.opens_again()
        assert await flight.closed_s(flight.process.kill) <= 0.5


async def test_without_its_guardian_nothing_is_sprayed(config: Path) -> None:
    async with spraying(config) as flight:
        guardian = flight.guardian
        assert await flight.closed_s(lambda: os.kill(guardian, signal.SIGKILL)) <= 0.5
        await flight.peer.until(
            lambda: any("guardian ended" in text for text in flight.peer.texts())
        )
        flight.peer.enable()
        flight.peer.place(east_m=-6.0)
        beats = len(flight.peer.of("HEARTBEAT"))
        await flight.peer.until(lambda: len(flight.peer.of("HEARTBEAT")) >= beats + 2)
        assert flight.peer.is_all_closed


async def test_a_guardian_that_stands_still_closes(config: Path) -> None:
    async with spraying(config) as flight:
        guardian = flight.guardian
        assert await flight.closed_s(lambda: os.kill(guardian, signal.SIGSTOP)) <= 2.0
        flight.process.terminate()
        await flight.process.communicate()
        assert flight.process.returncode == 0
        await is_gone(guardian)


async def test_without_script_or_board_nothing_is_sprayed_unless_the_file_says_so(
    config: Path,
) -> None:
    async def opens(*settings: str) -> bool:
        port, peer = free_port(), peer_in_the_middle()
        peer.has_script = False
        async with (
            started(config, f"udpin:127.0.0.1:{port}", *settings) as process,
            over_udp(peer, port),
        ):
            await peer.until(lambda: peer.is_ready, within_s=20.0)
            peer.place(east_m=-6.0)
            peer.enable()
            refused = "Spray off: no watchdog script or board"
            await peer.until(lambda: peer.is_spraying or refused in peer.texts(), within_s=20.0)
            process.terminate()
            await process.communicate()
            return any(order.pulse_us > 1000 for order in peer.orders)

    assert not await opens()
    assert await opens("output.dither_us=8")
    assert await opens("output.guard=none-on-power-loss")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
async def test_an_end_in_order_leaves_no_guardian(config: Path, number: signal.Signals) -> None:
    async with spraying(config) as flight:
        guardian = flight.guardian
        flight.process.send_signal(number)
        await flight.process.communicate()
        assert flight.process.returncode == 0
        await is_gone(guardian)
        assert flight.peer.is_all_closed
    assert not (config.parent / "state" / "guardian.json").exists()


async def test_a_guardian_that_is_asked_to_end_closes_first(config: Path) -> None:
    """systemd asks all processes of a service; here the companion was not."""
    async with spraying(config) as flight:
        guardian = flight.guardian
        assert await flight.closed_s(lambda: os.kill(guardian, signal.SIGTERM)) <= 0.5
        await flight.peer.until(lambda: any("told to end" in text for text in flight.peer.texts()))
        flight.process.kill()
        await is_gone(guardian)
        assert flight.peer.is_all_closed


async def test_a_new_start_finds_the_port_and_tells_what_happened(config: Path) -> None:
    port, peer = free_port(), peer_in_the_middle()
    url = f"udpin:127.0.0.1:{port}"
    async with over_udp(peer, port), started(config, url) as process:
        await begun(process, peer)
        process.kill()
        await process.wait()
        # Whoever says little is reached late: what there is to tell waits for that.
        peer.forget_streams()
        async with started(config, url) as second:
            heard = len(peer.of("HEARTBEAT"))
            await peer.until(lambda: len(peer.of("HEARTBEAT")) > heard, within_s=20.0)
            await peer.until(
                lambda: any("last run was killed" in text for text in peer.texts()),
                within_s=20.0,
            )
            assert peer.is_all_closed
            second.terminate()
            await second.communicate()
            assert second.returncode == 0


async def test_a_new_start_closes_before_it_reads_a_map(config: Path, tmp_path: Path) -> None:
    """The map is one that cannot be opened for as long as nobody writes to it."""
    pipe = tmp_path / "slow.geojson"
    port, peer = free_port(), peer_in_the_middle()
    peer.outputs = dict.fromkeys(range(9, 15), 1700)
    os.mkfifo(pipe)
    async with (
        started(config, f"udpin:127.0.0.1:{port}", f"prescription.file={pipe}") as process,
        over_udp(peer, port),
    ):
        try:
            await peer.until(lambda: peer.is_all_closed, within_s=20.0)
            async with asyncio.timeout(20.0):  # the reader of the map comes after
                while not (readers := readers_of(process.pid)):  # noqa: ASYNC110
                    await asyncio.sleep(0.02)
            (reader,) = readers
        finally:
            for pid in (*children_of(process.pid), process.pid):
                os.kill(pid, signal.SIGKILL)
    await is_gone(reader)


async def test_one_that_is_killed_before_it_heard_the_vehicle_leaves_it_to_the_next_start(
    config: Path,
) -> None:
    """Whom to close, and how, nobody has said by then; the next start finds the port at once."""
    port, peer = free_port(), peer_in_the_middle()
    peer.outputs = dict.fromkeys(range(9, 15), 1700)
    peer.is_silent = True
    url = f"udpin:127.0.0.1:{port}"
    async with over_udp(peer, port):
        async with started(config, url) as first:
            async with asyncio.timeout(20.0):
                while not (guardians := children_of(first.pid)):  # noqa: ASYNC110
                    await asyncio.sleep(0.01)
            first.kill()
            await is_gone(guardians[0])
        assert peer.outputs[9] == 1700
        peer.is_silent = False
        async with started(config, url):
            await peer.until(lambda: peer.is_all_closed, within_s=20.0)


MEMORY = Path("/sys/fs/cgroup/memory")
HOG = """
import pathlib
pathlib.Path({procs!r}).write_text("0")
held = []
while True:
    held.append(bytearray(1 << 20))
"""


def end_first(pid: int) -> None:
    """Have the kernel end a process before others when memory is short."""
    Path(f"/proc/{pid}/oom_score_adj").write_text("1000")


@contextmanager
def short_of_memory(pid: int, *others: int) -> Iterator[list[str]]:
    """Have processes in a control group of 64 MB; yield a command that takes these."""
    group = MEMORY / f"vrspray-test-{pid}"
    group.mkdir()
    try:
        for each in (pid, *others):
            (group / "cgroup.procs").write_text(str(each))
        (group / "memory.limit_in_bytes").write_text(str(64 << 20))
        yield [sys.executable, "-c", HOG.format(procs=str(group / "cgroup.procs"))]
    finally:
        for each in (group / "cgroup.procs").read_text().split():
            with suppress(OSError):
                (MEMORY / "cgroup.procs").write_text(each)
        group.rmdir()


@pytest.mark.skipif(
    not os.access(MEMORY / "memory.limit_in_bytes", os.W_OK) and not os.access(MEMORY, os.W_OK),
    reason="no control group of memory that may be made",
)
async def test_short_of_memory_the_kernel_ends_the_companion_and_the_guardian_closes(
    config: Path,
) -> None:
    async with spraying(config) as flight:
        companion, guardian = flight.process.pid, flight.guardian
        with short_of_memory(companion, guardian) as command:
            # Of two that may end, the companion: elsewhere the one that wants most.
            end_first(companion)
            hog = await asyncio.create_subprocess_exec(*command)
            try:
                await flight.peer.until(lambda: flight.peer.is_all_closed, within_s=20.0)
            finally:
                with suppress(ProcessLookupError):
                    hog.kill()
                await hog.wait()
        assert await flight.process.wait() == -signal.SIGKILL
        await is_gone(guardian)
    assert (config.parent / "state" / "guardian.json").exists(), "it was not ended with them"


async def test_on_a_signed_link_its_orders_are_signed_and_newer_than_the_companions(
    config: Path,
) -> None:
    """The vehicle takes no frame that is unsigned, or older than one before on its stream."""
    key = config.parent / "key"
    key.write_text(KEY.hex())
    key.chmod(0o600)
    port, peer = free_port(), peer_in_the_middle()
    peer.sign(KEY)
    peer.answers_time = True
    taken: list[tuple[int, int]] = []
    feed = peer.feed

    def look(data: bytes) -> None:
        before = len(peer.orders)
        feed(data)
        if len(peer.orders) > before:
            taken.append((data[-13], int.from_bytes(data[-12:-6], "little")))

    peer.feed = look  # type: ignore[method-assign]
    url = f"udpin:127.0.0.1:{port}"
    async with (
        started(config, url, f"link.signing_key_file={key}") as process,
        over_udp(peer, port),
    ):
        flight = await begun(process, peer)
        newest = max(stamp for _, stamp in taken)
        before = len(taken)
        assert await flight.closed_s(process.kill) <= 0.5
        after = [(link, stamp) for link, stamp in taken[before:] if link == LINK_NUMBER]
    assert after
    assert newest < min(stamp for _, stamp in after)


async def test_over_tcp_and_after_half_a_frame(config: Path) -> None:
    peer = peer_in_the_middle()
    host = TcpHost(peer)
    await host.listen()
    try:
        async with started(config, f"tcp:127.0.0.1:{host.port}") as process:
            await host.connected.wait()
            peer.begin()
            flight = await begun(process, peer)
            # As if the companion had been killed in the middle of a write.
            peer.feed(bytes((0xFD, 200, 0, 0, 1, 1, 191, 0, 0, 0)))
            guardian = flight.guardian
            assert await flight.closed_s(process.kill) <= 0.5
            await is_gone(guardian)
    finally:
        await peer.end()
        await host.close()


async def test_a_lost_tcp_link_is_not_kept_open_by_the_guardian(config: Path) -> None:
    peer = peer_in_the_middle()
    host = TcpHost(peer)
    await host.listen()
    try:
        async with started(config, f"tcp:127.0.0.1:{host.port}") as process:
            await host.connected.wait()
            peer.begin()
            flight = await begun(process, peer)
            guardian = flight.guardian
            await host.hang_up()
            host.connected.clear()
            await asyncio.wait_for(host.connected.wait(), 10.0)
            # The pair to the companion, and the one connection.
            async with asyncio.timeout(10.0):
                while sockets_of(guardian) != 2:  # noqa: ASYNC110
                    await asyncio.sleep(0.02)
    finally:
        await peer.end()
        await host.close()


async def test_it_is_light_and_stays(config: Path) -> None:
    async with spraying(config) as flight:
        guardian, companion = flight.guardian, flight.process.pid
        assert status_kb(guardian, "VmRSS") <= 24_000
        assert oom_score(guardian) < oom_score(companion)
        if os.geteuid() == 0:
            assert status_kb(guardian, "VmLck") > 0
        flight.process.kill()
