"""The page of a whole `vrspray run`: what it prints and what it records."""

from __future__ import annotations

import asyncio
import http.client
import json
import signal
from contextlib import closing
from pathlib import Path

import pytest

from analysis.journals.content import read_journal
from tests.companion.realtime.test_run_process import companion, config, peer_over_the_middle
from tests.companion.wire_peer import free_port, over_udp

pytestmark = pytest.mark.sitl
__all__ = ["config"]

HEAD = {"Content-Type": "application/json"}


def stop_often(port: int, times: int) -> list[int]:
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=30.0)) as connection:
        found = []
        for _ in range(times):
            connection.request("POST", "/api/v1/stop", b"{}", HEAD)
            reply = connection.getresponse()
            reply.read()
            found.append(reply.status)
        return found


async def test_no_token_is_printed_and_a_hundred_stops_are_one_row(config: Path) -> None:
    port, page = free_port(), free_port()
    peer = peer_over_the_middle()
    serve_page(config, page)
    async with companion(config, port) as process, over_udp(peer, port):
        await peer.until(lambda: peer.is_all_closed, within_s=20.0)
        while not await asyncio.to_thread(answers, page):  # noqa: ASYNC110
            await asyncio.sleep(0.02)
        peer.place(east_m=-6.0)
        peer.enable()
        await peer.until(lambda: len(peer.open_channels) == 6)
        assert set(await asyncio.to_thread(stop_often, page, 120)) == {200}
        await peer.until(lambda: peer.is_all_closed)
        process.send_signal(signal.SIGTERM)
        stdout, stderr = await asyncio.wait_for(process.communicate(), 10.0)
    said = (stdout + stderr).decode()
    for token in json.loads(next(config.parent.rglob("page-tokens.json")).read_text()).values():
        assert token not in said
    assert "\u2580" not in said, "a QR code"
    assert f"vrspray token show --config {config}" in said
    content = read_journal(next(config.parent.rglob("*.gpkg")))
    stops = [entry for entry in content.entries if entry.kind == "EstopReport"]
    assert len(stops) == 1
    told = [event.text for event in content.events if "emergency stop" in event.text]
    assert told == ["emergency stop", *(f"emergency stop, {n} times" for n in (10, 100))]


def serve_page(config: Path, port: int) -> None:
    text = config.read_text().replace("[link]\n", "[link]\nstate_folder = 'state'\n")
    config.write_text(f"{text}\n[web]\nenabled = true\nhost = '0.0.0.0'\nport = {port}\n")


def answers(port: int) -> bool:
    try:
        with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=30.0)) as connection:
            connection.request("GET", "/api/v1/session")
            return connection.getresponse().status == 200
    except OSError:
        return False
