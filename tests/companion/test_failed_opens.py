"""What cannot be opened, and what is closed in a hurry, leaves no file and no socket open."""

from __future__ import annotations

import asyncio
import socket
import sqlite3
from collections.abc import Callable
from pathlib import Path

import pytest

from companion.journal.journal import open_for_flight
from companion.output.child import Child
from companion.output.engine.lines import FileLines, SpiDevice
from sitl.stub.protocol import Channel
from sitl.stub.server import open_link


def open_files() -> list[str]:
    """Return what our descriptors lead to."""
    found = []
    for link in Path("/proc/self/fd").iterdir():
        try:
            found.append(str(link.readlink()))
        except FileNotFoundError:  # the one by which we look
            continue
    return sorted(found)


def test_a_journal_that_cannot_be_opened_is_not_left_open(tmp_path: Path) -> None:
    path = tmp_path / "flight-0001.gpkg"
    path.write_text("no database at all, but a text of some length\n" * 99)
    # The error keeps what was at hand where it happened, so nothing closes by collection.
    with pytest.raises(sqlite3.DatabaseError) as _kept:
        open_for_flight(path)
    assert str(path) not in open_files()


@pytest.mark.parametrize(
    "start",
    [
        lambda: Child(["/nowhere/engine"]),
        lambda: FileLines("/dev/full", levels=0),
        lambda: SpiDevice("/dev/null", 1_000_000),
    ],
    ids=["engine", "file", "spi"],
)
def test_outputs_that_cannot_be_had_are_let_go(start: Callable[[], object]) -> None:
    before = open_files()
    with pytest.raises(OSError) as _kept:
        start()
    assert open_files() == before


class Hub:
    """Keeps the ways to send to its peers."""

    def __init__(self) -> None:
        self.sends: asyncio.Queue[Callable[[bytes], None]] = asyncio.Queue()

    def attach(self, name: str, send: Callable[[bytes], None]) -> Channel:
        self.sends.put_nowait(send)
        return Channel(name=name, send=send)

    def detach(self, channel: Channel) -> None:
        pass

    def received(self, channel: Channel, received: bytes) -> None:
        pass


async def test_the_stub_lets_a_peer_go_that_does_not_read() -> None:
    hub = Hub()
    link = await open_link("tcpin:127.0.0.1:0", hub)
    with socket.create_connection(("127.0.0.1", link.port)):
        send = await hub.sends.get()
        here = open_files()
        for _ in range(200):
            send(bytes(64 * 1024))
        async with asyncio.timeout(5.0):
            await link.close()
        # Its listening socket and its end of the connection are gone; ours is there.
        assert len(open_files()) == len(here) - 2
