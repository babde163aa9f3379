"""`python -m companion.web`: the page's process, as `OperatorPage` starts it.

It ends when the companion does: the socket between them closes then.
"""

from __future__ import annotations

import asyncio
import json
import os
import socket
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from companion.web.entrance import Guarded, server_of
from companion.web.guard import Doors, Guard, Tokens
from companion.web.live import Live
from companion.web.page import RingReader
from companion.web.parts import registered, uploads
from companion.web.places import Places
from companion.web.server import Orders, Site, build_app

# The control loop comes first.
NICENESS = 5


def main(arguments: list[str]) -> int:
    """Serve until the companion ends."""
    memory, wake, orders_fd, listener_fd, about_fd, parent = map(int, arguments)
    if os.getppid() != parent:
        return 0
    os.nice(NICENESS)
    with suppress(OSError):
        # Waking up, it takes no core from whoever computes: it waits for the next free one.
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    with os.fdopen(about_fd, "rb") as file:
        file.seek(0)
        about: dict[str, Any] = json.load(file)
    ring = RingReader(memory)
    asyncio.run(_serve(about, ring, wake, orders_fd, listener_fd))
    return 0


async def _serve(
    about: dict[str, Any], ring: RingReader, wake: int, orders_fd: int, listener_fd: int
) -> None:
    way = about["way_file"]
    live = Live(about, way_file=Path(way) if way else None, utc_s=time.time())
    orders = Orders(socket.socket(fileno=orders_fd))
    listener = socket.socket(fileno=listener_fd)
    names, port = tuple(about["names"]), listener.getsockname()[1]
    doors = Doors(is_local=about["is_local"], names=names, port=port)
    parts = registered()
    guard = Guard(doors=doors, tokens=Tokens(**about["tokens"]), uploads=uploads(parts))
    site = Site(live, orders, guard, about)
    places, ancestors = Places(), tuple(about["frame_ancestors"])
    app = Guarded(build_app(site, parts), guard, places, ancestors=ancestors)
    certificate, key = about["tls_certificate"], about["tls_key"]
    tls = (certificate, key) if certificate else None
    server = server_of(app, tls=tls)

    def read() -> None:
        os.eventfd_read(wake)
        for payload in ring.news():
            live.take(payload)
        site.told()

    def end() -> None:
        # Streams never end by themselves: nothing here is worth waiting for.
        os._exit(0)

    os.set_blocking(wake, False)
    asyncio.get_running_loop().add_reader(wake, read)
    orders.attach(end)
    await server.serve(sockets=[places.listening(listener)])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
