"""A link that does not work says in one line why, within five seconds, and goes on trying."""

from __future__ import annotations

import asyncio
import logging
import os
import pty
import socket
import tty
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

import companion.link.transport as transport_module
from companion.core.types import Input
from companion.errors import LinkError
from companion.link.component import ComponentOptions
from companion.link.serial_port import devices
from companion.link.signing import Signing
from companion.link.vehicle_link import VehicleLink
from tests.companion.wire_peer import free_port

KEY = bytes(range(32))


def heartbeat(system: int = 1, component: int = 1, kind: int = 2, autopilot: int = 3) -> bytes:
    mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    return bytes(mav.heartbeat_encode(kind, autopilot, 0, 0, 4).pack(mav))


class Bench:
    """A link with a clock of its own, and what it says."""

    def __init__(self, url: str, *, system_id: int = 0, signing: Signing | None = None) -> None:
        self.now_s = 100.0
        self.link = VehicleLink(
            url,
            ComponentOptions(system_id=system_id),
            signing=signing,
            clock=lambda: self.now_s,
        )
        self.events: list[str] = []
        self.link.on_event(lambda at_s, kind, text: self.events.append(text))
        self.inputs: list[Input] = []
        self._news = asyncio.Event()

    async def open(self) -> None:
        await self.link.open(self._news.set)

    async def until(self, done: Callable[[], bool]) -> None:
        """Wait for something that arrives."""
        async with asyncio.timeout(5.0):
            while True:
                self.inputs += self.link.receive()
                if done():
                    return
                self._news.clear()
                await self._news.wait()

    def pass_time(self, duration_s: float, given: bytes = b"") -> None:
        """Turn the loop for some seconds; `given` arrives once a second."""
        for turn in range(round(duration_s * 10)):
            if given and turn % 10 == 0:
                self.link._on_bytes(given)
            self.inputs += self.link.receive()
            self.link.tell(None, self.now_s)
            self.now_s += 0.1

    def said(self, log: pytest.LogCaptureFixture) -> list[str]:
        return [record.getMessage() for record in log.records if record.levelno >= logging.WARNING]


@pytest.fixture
async def opened() -> Any:
    """Return a function that opens a link on UDP; it is closed afterwards."""
    made: list[Bench] = []

    async def make(url: str = "", **options: Any) -> Bench:
        bench = Bench(url or f"udpin:127.0.0.1:{free_port()}", **options)
        await bench.open()
        made.append(bench)
        return bench

    yield make
    for bench in made:
        await bench.link.close()


Opener = Callable[..., Awaitable[Bench]]


async def test_silence_is_said_once_within_five_seconds(
    opened: Opener, caplog: pytest.LogCaptureFixture
) -> None:
    bench = await opened()
    bench.pass_time(1.9)
    assert not bench.said(caplog)
    bench.pass_time(20.0)
    (said,) = bench.said(caplog)
    assert "nothing arrives; make the autopilot or its router send to port" in said
    assert bench.events == [said]
    bench.pass_time(50.0)
    assert len(bench.said(caplog)) == 2  # again after a minute


async def test_wrong_baud_is_bytes_without_frames(
    terminal: tuple[int, str], opened: Opener, caplog: pytest.LogCaptureFixture
) -> None:
    far, device = terminal
    bench = await opened(f"serial:{device}:57600")
    os.write(far, bytes((37 * k) % 251 for k in range(400)))
    await bench.until(lambda: bench.link.component.codec.counts.bytes_in == 400)
    bench.pass_time(4.0)
    (said,) = bench.said(caplog)
    assert "400 bytes arrive but no MAVLink" in said
    assert "a baud rate other than 57600" in said
    os.write(far, heartbeat())
    await bench.until(lambda: bench.link.component.is_vehicle_known)


async def test_a_wire_with_some_noise_is_called_silent(
    terminal: tuple[int, str], opened: Opener, caplog: pytest.LogCaptureFixture
) -> None:
    far, device = terminal
    bench = await opened(f"serial:{device}:57600")
    os.write(far, b"\x00\xff\x00")
    await bench.until(lambda: bench.link.component.codec.counts.bytes_in == 3)
    bench.pass_time(4.0)
    (said,) = bench.said(caplog)
    assert "nothing arrives; check that TX is wired to RX" in said


async def test_bytes_of_another_program_are_named(
    opened: Opener, caplog: pytest.LogCaptureFixture
) -> None:
    bench = await opened()
    bench.pass_time(4.0, b"GET / HTTP/1.1\r\n")
    assert "no MAVLink: another program sends to this port" in bench.said(caplog)[0]


async def test_without_an_autopilot_those_who_speak_are_named(
    opened: Opener, caplog: pytest.LogCaptureFixture
) -> None:
    bench = await opened()
    others = heartbeat(255, 190, 6, 8) + heartbeat(1, 154, 26, 8) + heartbeat(1, 156, 27, 8)
    bench.pass_time(4.5, others)
    (said,) = bench.said(caplog)
    assert "no autopilot" in said
    for name in ("255/190 (ground station)", "1/154 (gimbal)", "1/156 (ADS-B)"):
        assert name in said
    assert bench.link.fault is None  # nothing to order, nobody to order it to


async def test_a_configured_system_that_is_not_there_is_said_with_the_one_that_is(
    opened: Opener, caplog: pytest.LogCaptureFixture
) -> None:
    bench = await opened(system_id=7)
    bench.pass_time(4.5, heartbeat(3))
    (said,) = bench.said(caplog)
    assert "no autopilot with system 7, but one with 3: set link.system_id = 3" in said
    assert not bench.link.component.is_vehicle_known


async def test_two_autopilots_keep_everything_closed_until_one_is_gone(opened: Opener) -> None:
    bench = await opened()
    bench.pass_time(1.0, heartbeat(1))
    assert bench.link.fault is None
    bench.pass_time(0.1, heartbeat(2))
    assert bench.link.fault is not None
    assert "systems 1, 2): set link.system_id" in bench.link.fault
    bench.pass_time(5.0, heartbeat(1) + heartbeat(2))
    assert bench.link.fault is not None
    bench.pass_time(12.0, heartbeat(1))
    assert bench.link.fault is None
    bench.pass_time(15.0, heartbeat(2))
    assert bench.link.fault is not None  # the first one went away: it is never changed for another
    assert bench.link.component.codec.vehicle is not None
    assert bench.link.component.codec.vehicle.system_id == 1


async def test_the_operator_s_line_of_two_autopilots_fits_his_screen(opened: Opener) -> None:
    bench = await opened()
    bench.pass_time(1.0, b"".join(heartbeat(system) for system in range(100, 112)))
    texts: list[str] = []
    parser = mavlink.MAVLink(None)

    def take(frame: bytes) -> bool:
        heard = parser.parse_buffer(frame) or []
        texts.extend(message.text for message in heard if message.get_type() == "STATUSTEXT")
        return True

    bench.link.component._transport_send = take
    fault = bench.link.fault
    assert fault is not None
    bench.link.tell_fault(fault)
    bench.pass_time(0.5)
    assert any("set link.system_id" in text for text in texts)
    assert all(len(text) <= 50 for text in texts)


async def test_with_a_configured_system_a_second_vehicle_is_no_matter(opened: Opener) -> None:
    bench = await opened(system_id=2)
    bench.pass_time(5.0, heartbeat(1) + heartbeat(2))
    assert bench.link.fault is None
    assert bench.link.component.codec.vehicle is not None
    assert bench.link.component.codec.vehicle.system_id == 2


@pytest.mark.parametrize("autopilot", [0, 4, 13])
async def test_a_firmware_that_we_do_not_know_keeps_everything_closed(
    opened: Opener, autopilot: int
) -> None:
    bench = await opened()
    bench.pass_time(1.0, heartbeat(autopilot=autopilot))
    assert bench.link.fault is not None
    assert f"firmware {autopilot}" in bench.link.fault
    assert "neither ArduPilot nor PX4" in bench.link.fault


async def test_another_component_with_our_number_is_said_once(
    opened: Opener, caplog: pytest.LogCaptureFixture
) -> None:
    bench = await opened()
    bench.pass_time(10.0, heartbeat() + heartbeat(1, 191, 18, 8))
    told = [text for text in bench.said(caplog) if "1/191" in text]
    assert len(told) == 1
    assert "set link.component_id" in told[0]


async def test_a_heartbeat_that_ends_is_said_and_so_is_its_return(
    opened: Opener, caplog: pytest.LogCaptureFixture
) -> None:
    bench = await opened()
    bench.link.component.is_answered = True
    bench.pass_time(5.0, heartbeat())
    assert "system 1, ardupilot" in bench.events[0]
    bench.link.component.is_answered = True
    bench.pass_time(5.0, heartbeat(255, 190, 6, 8))
    assert any("system 1 has stopped sending heartbeats" in text for text in bench.said(caplog))


async def test_a_heartbeat_that_comes_and_goes_is_said_every_ten_seconds_at_most(
    opened: Opener, caplog: pytest.LogCaptureFixture
) -> None:
    bench = await opened()
    for _ in range(12):
        bench.link.component.is_answered = True
        bench.pass_time(1.0, heartbeat())
        bench.pass_time(4.0)
    told = [text for text in bench.said(caplog) if "has stopped sending heartbeats" in text]
    assert 5 <= len(told) <= 6


async def test_an_autopilot_that_never_answers_points_to_our_wire(
    opened: Opener, caplog: pytest.LogCaptureFixture
) -> None:
    bench = await opened()
    bench.pass_time(5.0, heartbeat())
    (said,) = bench.said(caplog)
    assert "heard but does not answer: our messages do not reach it" in said


async def test_frames_that_are_not_signed_with_our_key_are_said_so(
    opened: Opener, caplog: pytest.LogCaptureFixture
) -> None:
    bench = await opened(signing=Signing(KEY))
    bench.pass_time(5.0, heartbeat())
    assert "none signed with our key" in bench.said(caplog)[0]
    assert not bench.link.component.is_vehicle_known


# ------------------------------------------------------------------------ links that are not there


@pytest.fixture
def quick_back_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport_module, "BACK_OFF_MIN_S", 0.01)
    monkeypatch.setattr(transport_module, "BACK_OFF_MAX_S", 0.02)


@pytest.mark.usefixtures("quick_back_off")
async def test_a_device_that_is_plugged_in_later_is_waited_for(
    tmp_path: Path, opened: Opener, caplog: pytest.LogCaptureFixture
) -> None:
    name = tmp_path / "ttyACM0"
    bench = await opened(f"serial:{name}:57600")
    assert bench.link.fault == "link is down"
    (said,) = bench.said(caplog)
    assert f"there is no device {name}" in said
    assert said.endswith("; trying again")
    far, near = pty.openpty()
    tty.setraw(near)
    name.symlink_to(os.ttyname(near))
    os.close(near)
    await bench.until(lambda: bench.link.fault != "link is down")
    os.write(far, heartbeat())
    await bench.until(lambda: bool(bench.inputs))
    bench.link.tell(None, bench.now_s)
    assert bench.link.fault is None
    os.close(far)


@pytest.mark.usefixtures("quick_back_off")
async def test_a_busy_port_is_taken_once_it_is_free(
    terminal: tuple[int, str], opened: Opener, caplog: pytest.LogCaptureFixture
) -> None:
    _, device = terminal
    first = await opened(f"serial:{device}:57600")
    second = await opened(f"serial:{device}:57600")
    assert "is in use by another program; stop that program" in second.said(caplog)[0]
    await first.link.close()
    await second.until(lambda: second.link.fault != "link is down")


@pytest.mark.usefixtures("quick_back_off")
async def test_a_router_that_is_started_later_is_waited_for(
    opened: Opener, caplog: pytest.LogCaptureFixture
) -> None:
    port = free_port(socket.SOCK_STREAM)
    bench = await opened(f"tcp:127.0.0.1:{port}")
    assert "connection refused; nobody listens" in bench.said(caplog)[0]
    connected = asyncio.Event()
    writers: list[asyncio.StreamWriter] = []

    async def serve(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writers.append(writer)
        connected.set()

    server = await asyncio.start_server(serve, "127.0.0.1", port)
    async with asyncio.timeout(5.0):
        await connected.wait()
    await bench.until(lambda: bench.link.fault != "link is down")
    assert len([text for text in bench.said(caplog) if "refused" in text]) == 1
    await bench.link.close()
    writers[0].close()
    await writers[0].wait_closed()
    server.close()
    await server.wait_closed()


@pytest.mark.usefixtures("quick_back_off")
async def test_a_link_that_never_opened_is_closed_without_a_trace(tmp_path: Path) -> None:
    bench = Bench(f"serial:{tmp_path / 'nothing'}:57600")
    await bench.open()
    await bench.link.close()
    assert len(asyncio.all_tasks()) == 1


@pytest.mark.parametrize("url", ["serial:/dev/null:57600", "udpin:192.0.2.1:14550"])
async def test_where_waiting_cannot_help_the_run_is_refused(url: str) -> None:
    with pytest.raises(LinkError):
        await Bench(url).open()


def test_devices_are_named_by_their_lasting_names(tmp_path: Path) -> None:
    by_id = tmp_path / "serial" / "by-id"
    by_id.mkdir(parents=True)
    for name in ("ttyACM0", "ttyUSB1", "tty1", "null"):
        (tmp_path / name).touch()
    (by_id / "usb-Autopilot_1234-if00").symlink_to(tmp_path / "ttyACM0")
    assert devices(tmp_path) == [
        str(by_id / "usb-Autopilot_1234-if00"),
        str(tmp_path / "ttyUSB1"),
    ]
