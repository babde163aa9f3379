"""A running operator's page for tests: the real process, with a stand-in for the control loop."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import time
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from companion.core.controller import Memory, step
from companion.core.types import Decision, VehicleState
from companion.web import OperatorPage, Order, Outcome, listen, map_object
from companion.web.entrance import Guarded, server_of
from companion.web.places import Places
from tests import builders

VIEW, OPERATE = "v" * 43, "o" * 43
SETUP = builders.setup()
FACTS = {"training": "no", "may_enable": True, "enable_by": ["web"], "tank_l": 40.0}


@dataclass(frozen=True, slots=True)
class Reply:
    """An answer over HTTP."""

    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


@dataclass
class Site:
    """A page that is served, what it ordered, and how to ask it."""

    page: OperatorPage
    port: int
    orders: list[Order] = field(default_factory=list)
    memory: Memory = field(default_factory=Memory)
    is_deaf: bool = False

    def obey(self, order: Order, now_s: float) -> Outcome:
        self.orders.append(order)
        return Outcome(accepted=True, text=f"{order.name} done")

    def show(self, east_m: float = 6.0, **change: object) -> Decision:
        now_s = time.monotonic()
        state: VehicleState = builders.flying(now_s, east_m, **change)
        decision, self.memory = step(SETUP, state, self.memory, now_s)
        self.page.show(decision)
        return decision

    def ask(self, *arguments: Any, **options: Any) -> Reply:
        return ask(self.port, *arguments, **options)

    async def asked(self, *arguments: Any, **options: Any) -> Reply:
        return await asyncio.to_thread(self.ask, *arguments, **options)


async def until(done: Callable[[], bool]) -> None:
    """Wait for another process, of which nobody tells."""
    async with asyncio.timeout(30.0):
        while not await asyncio.to_thread(done):  # noqa: ASYNC110
            await asyncio.sleep(0.02)


def about(folder: Path | None = None, **change: object) -> dict[str, Any]:
    """Return what the page is told of its flight."""
    found: dict[str, Any] = {
        "map": map_object(SETUP),
        "facts": FACTS,
        "is_local": True,
        "names": [],
        "frame_ancestors": [],
        "login_s": 3600,
        "tokens": {"view": VIEW, "operate": OPERATE},
        "is_tls": False,
        "tls_certificate": "",
        "tls_key": "",
        "way_file": "" if folder is None else str(folder / "page-track.jsonl"),
        "doctor": [],
        "host": {
            "folder": str(folder or "/dev/null"),
            "config": [],
            "upload_link": "",
            "journals": "",
        },
        "version": "1.2.3",
    }
    return found | change


@contextlib.asynccontextmanager
async def served(folder: Path | None = None, **change: object) -> AsyncIterator[Site]:
    """Serve a page, and read its orders as the control loop does."""
    listener = listen("127.0.0.1", 0)
    port = listener.getsockname()[1]
    sites: list[Site] = []
    page = OperatorPage(
        listener,
        about(folder, **change),
        obey=lambda order, now_s: sites[0].obey(order, now_s),
        horizon_s=0.5,
    )
    site = Site(page, port)
    sites.append(site)

    async def turn() -> None:
        while True:
            if not site.is_deaf:
                page.read(time.monotonic())
            await asyncio.sleep(0.01)

    # One thread, begun here: none is left behind by a single test.
    executor = ThreadPoolExecutor(1)
    asyncio.get_running_loop().set_default_executor(executor)
    await asyncio.to_thread(time.monotonic)
    await page.open(lambda: None)
    turning = asyncio.create_task(turn())
    try:
        site.show()
        await until(lambda: site.ask("GET", "/api/v1/session").status == 200)
        yield site
    finally:
        turning.cancel()
        await asyncio.gather(turning, return_exceptions=True)
        await page.close()
        executor.shutdown()


@contextlib.asynccontextmanager
async def in_process(app: Guarded, places: Places) -> AsyncIterator[int]:
    """Serve an application in this process, whose limits and clocks a test may change."""
    executor = ThreadPoolExecutor(1)
    asyncio.get_running_loop().set_default_executor(executor)
    await asyncio.to_thread(time.monotonic)
    with listen("127.0.0.1", 0) as listener:
        port = listener.getsockname()[1]
        server = server_of(app, tls=None, shutdown_within_s=1)
        serving = asyncio.create_task(server.serve(sockets=[places.listening(listener)]))
        try:
            yield port
        finally:
            server.should_exit = True
            await serving
            executor.shutdown()


def ask(
    port: int,
    method: str,
    path: str,
    body: object = None,
    headers: dict[str, str] | None = None,
    *,
    host: str | None = None,
) -> Reply:
    """Ask over a new connection; a POST comes from the page itself, unless told otherwise."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=250.0)
    given = {"Host": f"127.0.0.1:{port}" if host is None else host}
    data = None
    if method == "POST":
        given |= {"Origin": f"http://127.0.0.1:{port}", "Content-Type": "application/json"}
        data = body if isinstance(body, bytes) else json.dumps(body or {}).encode()
    given |= headers or {}
    with contextlib.closing(connection):
        connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
        if data is not None and "Content-Length" not in given:
            given["Content-Length"] = str(len(data))
        for name, value in given.items():
            if value:
                connection.putheader(name, value)
        connection.endheaders(data)
        reply = connection.getresponse()
        found = {name.lower(): value for name, value in reply.getheaders()}
        return Reply(reply.status, found, reply.read())


def aged(order: Order, seconds: float) -> Order:
    """Return an order that was given earlier."""
    return replace(order, boot_s=order.boot_s - seconds)
