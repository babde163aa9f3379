"""Files that come to the office together, and one that is arriving when the vehicle is armed."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import socket

import pytest

from missions.web import office as module
from tests.companion.web_site import Site, until
from tests.missions.test_web_office import FOLDERS, IN_LOOP, OFFICE, load, on_ground, site

__all__ = ["site"]
pytestmark = pytest.mark.timeout(300)


def begun(site: Site, name: str, size: int, data: bytes) -> socket.socket:
    """Begin to send a file of so many bytes, of which some come."""
    found = socket.create_connection(("127.0.0.1", site.port), timeout=30.0)
    head = f"POST {OFFICE}/files/{name} HTTP/1.1\r\nHost: localhost:{site.port}\r\nOrigin: "
    head += f"http://localhost:{site.port}\r\nContent-Type: application/octet-stream\r\n"
    found.sendall(f"{head}Content-Length: {size}\r\n\r\n".encode() + data)
    return found


def status_of(connection: socket.socket) -> int:
    reply = http.client.HTTPResponse(connection)
    reply.begin()
    return reply.status


@IN_LOOP
async def test_files_that_come_together_have_the_room_of_all(site: Site) -> None:
    size = module.FILE_BYTES_MAX
    with contextlib.ExitStack() as stack:
        arriving = [
            stack.enter_context(begun(site, f"part-{number}.csv", size, b"x" * 100_000))
            for number in range(module.ALL_BYTES_MAX // size)
        ]
        folder = FOLDERS[site.port] / "office"
        await until(lambda: len([*folder.glob("*.part")]) == len(arriving))
        assert (await load(site, "more.csv", b"x" * 1_000_000)).status == 413
        # One that is given up leaves its room.
        arriving.pop().close()
        await until(lambda: len([*folder.glob("*.part")]) == len(arriving))
        assert (await load(site, "more.csv", b"x" * 1_000_000)).status == 200
    await until(lambda: not [*folder.glob("*.part")])


@IN_LOOP
async def test_a_file_that_is_arriving_is_given_up_when_the_vehicle_is_armed(site: Site) -> None:
    folder = FOLDERS[site.port] / "office"
    with begun(site, "a.csv", 1_000_000, b"x" * 100_000) as arriving:
        await until(lambda: bool([*folder.glob("*.part")]))
        await on_ground(site, armed=True)
        assert await asyncio.to_thread(status_of, arriving) == 409
    assert not [*folder.glob("*.part")]
    await on_ground(site)
    assert "a.csv" not in [one["name"] for one in (await site.asked("GET", OFFICE)).json["files"]]
