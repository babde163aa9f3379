"""Strangers at the page: what they hold, flood and guess keeps nobody from STOP; real sockets."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Iterator

import pytest
from starlette.types import Receive, Send
from starlette.types import Scope as Connection

from companion.web.entrance import Guarded
from companion.web.guard import API, Doors, Guard, Tokens
from companion.web.places import Places
from tests.companion.web_site import OPERATE, VIEW, in_process, served

JSON = "Host: localhost\r\nContent-Type: application/json\r\nContent-Length: 2\r\n\r\n"
HALF_A_STOP = f"POST {API}stop HTTP/1.1\r\n{JSON}".encode()
LOOK = f"GET {API}events HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {VIEW}\r\n\r\n"
WAITS = {
    "nothing": b"",
    "half a head": b"GET / HTTP/1.1\r\n",
    "half a body": HALF_A_STOP,
    "no reading": b"GET /large HTTP/1.1\r\nHost: localhost\r\n\r\n",
}


@contextlib.contextmanager
def held(port: int, count: int, said: bytes) -> Iterator[list[socket.socket]]:
    """Hold connections of a stranger, who has said so much in each."""
    with contextlib.ExitStack() as stack:
        found = []
        for _ in range(count):
            one = stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=30.0))
            with contextlib.suppress(ConnectionError):
                one.sendall(said)
            found.append(one)
        yield found


@pytest.mark.parametrize("how", ["nothing", "half a head", "half a body"])
async def test_whatever_a_stranger_holds_stop_and_sessions_get_in(how: str) -> None:
    async with served(is_local=False) as site:
        with socket.create_connection(("127.0.0.1", site.port), timeout=30.0) as looking:
            looking.sendall(LOOK.encode())
            assert b"200 OK" in await asyncio.to_thread(looking.recv, 15)
            with held(site.port, 450, WAITS[how]):
                assert (await site.asked("POST", "/api/v1/stop")).status == 200
                mine = {"Authorization": f"Bearer {VIEW}"}
                assert (await site.asked("GET", "/api/v1/state", headers=mine)).status == 200
                # Who looked before is told on.
                assert [await asyncio.to_thread(looking.recv, 1 << 16) for _ in range(3)][-1]
        # A STOP that is cut off is one.
        assert {order.name for order in site.orders} == {"stop"}


async def large(scope: Connection, receive: Receive, send: Send) -> None:
    """Answer with more than any buffer holds."""
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"x" * 50_000_000})


def guarded(places: Places) -> Guarded:
    guard = Guard(doors=Doors(is_local=True), tokens=Tokens(view=VIEW, operate=OPERATE))
    return Guarded(large, guard, places)


@pytest.mark.parametrize("how", WAITS)
async def test_who_does_not_go_on_is_let_go(how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("BODY_WITHIN_S", "SEND_WITHIN_S"):
        monkeypatch.setattr(f"companion.web.entrance.{name}", 0.1)
    places = Places(wait_s=0.1)
    async with in_process(guarded(places), places) as port, asyncio.timeout(30.0):
        reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=1)
        writer.write(WAITS[how])
        if how == "no reading":
            assert await reader.read(1)
            while places.count:  # noqa: ASYNC110
                await asyncio.sleep(0.01)
        with contextlib.suppress(ConnectionError):
            while await reader.read(1 << 20):
                pass
        writer.close()


async def test_one_address_holds_a_share_and_its_oldest_goes_first() -> None:
    places = Places(of_address=2)
    async with in_process(guarded(places), places) as port, asyncio.timeout(30.0):
        first, *more = [await asyncio.open_connection("127.0.0.1", port) for _ in range(3)]
        assert await first[0].read() == b""
        assert places.count == 2
        for _, writer in (first, *more):
            writer.close()
