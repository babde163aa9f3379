"""The operator's page as a process beside the control loop: what it is told, what it orders."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import pytest_asyncio

from companion.core.controller import Memory, step
from companion.core.types import Decision, FaultKind, Finding, Inhibit, SprayerState
from companion.errors import ConfigError
from companion.link.component import Component, ComponentOptions
from companion.web import OperatorPage, Order, Outcome, listen
from companion.web.live import (
    ADVICE,
    BoomTrace,
    Live,
    actual_rate,
    map_parts,
    quads_between,
    reasons_of,
    wanted_rate,
)
from companion.web.page import (
    ORDER_BYTES_MAX,
    PAYLOAD_MAX,
    SLOTS,
    RingReader,
    RingWriter,
    frame_of,
    new_memory,
    packed,
    parse_order,
)
from companion.web.parts import Limits, run_child
from tests import builders
from tests.companion.web_site import SETUP, Site, about, aged, served, until

IN_LOOP = pytest.mark.asyncio(loop_scope="module")  # one page for all: it starts slowly


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def site() -> AsyncIterator[Site]:
    async with served() as found:
        yield found


# ------------------------------------------------------------------------- its process


@pytest.mark.asyncio
async def test_a_script_in_the_users_folder_is_never_run_in_place_of_a_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("uvicorn", "click", "typer"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('not the library')\n")
    monkeypatch.chdir(tmp_path)
    async with served() as site:
        assert (await site.asked("GET", "/api/v1/state")).status == 200
    ours = await run_child(
        ("examples", "list", "--json"),
        tmp_path,
        Limits(cpu_s=30, wait_s=120.0),
        flying=lambda: None,
    )
    assert ours.error is None


# ------------------------------------------------------------------------- shared memory


def test_the_ring_gives_each_value_once_and_loses_the_oldest_only() -> None:
    memory = new_memory()
    writer, reader = RingWriter(memory), RingReader(memory)
    assert list(reader.news()) == []
    assert writer.put(b"a")
    assert writer.put(b"")
    assert list(reader.news()) == [b"a", b""]
    assert list(reader.news()) == []
    for number in range(3 * SLOTS):
        writer.put(str(number).encode())
    found = [int(payload) for payload in reader.news()]
    assert found == list(range(2 * SLOTS + 1, 3 * SLOTS))
    assert not writer.put(b"x" * (PAYLOAD_MAX + 1))
    assert list(reader.news()) == []
    writer.close()
    os.close(memory)


def test_a_value_that_is_overwritten_while_it_is_read_is_left_out() -> None:
    memory = new_memory()
    writer, reader = RingWriter(memory), RingReader(memory)
    writer.put(b"whole")
    os.pwrite(memory, b"torn!", 64 + 8192 + 16)  # the payload of slot 1
    assert list(reader.news()) == []
    os.close(memory)


# --------------------------------------------------------------------------------- frames


def test_a_frame_has_no_nan_and_fits_its_slot_with_any_boom(site: Site) -> None:
    decision = site.show(height_m=float("nan"), heading_deg=None)
    frame = frame_of(decision, horizon_s=0.5)
    assert frame["vehicle"]["height_m"] is None
    wide = dataclasses.replace(
        decision,
        plan=dataclasses.replace(decision.plan, duty=(0.123,) * 256, changes=()),
        rate_l_ha=(123.45,) * 2000,
    )
    data = packed(frame_of(wide, horizon_s=0.5), PAYLOAD_MAX)
    assert len(data) <= PAYLOAD_MAX
    assert json.loads(data)["state"] == decision.sprayer.value


@pytest.mark.parametrize("length", [100, 1_000, 100_000])
def test_a_frame_fits_its_slot_however_long_the_names_of_valves_are(
    site: Site, length: int
) -> None:
    decision = site.show()
    found = tuple(
        Finding(kind=FaultKind.LEAK, at_s=1.0, text="ä" * length, valve=number)
        for number in range(8)
    )
    frame = frame_of(dataclasses.replace(decision, findings=found), horizon_s=0.5)
    frame["events"] = [(1.0, "link", "ä" * 200)] * 6
    frame["more"] = {"é" * length: "ü" * length}
    told = json.loads(packed(frame, PAYLOAD_MAX))
    assert len(packed(frame, PAYLOAD_MAX)) <= PAYLOAD_MAX
    assert told["state"] == decision.sprayer.value
    assert told["vehicle"] == frame["vehicle"]


def test_every_reason_says_what_to_do() -> None:
    assert set(ADVICE) == set(Inhibit)
    found = reasons_of(["not-enabled", "leak", "no-such"])
    assert [one["code"] for one in found] == ["leak", "not-enabled"]


def test_the_applied_rate_follows_flow_width_and_speed() -> None:
    valves = ((-1.0, 0.0, 2.0), (1.0, 0.0, 2.0))
    frame = {"vehicle": {"speed_m_s": 5.0}, "duty": [0.5, 0.0], "flow_l_min": 1.2}
    # 1.2 L/min over 2 m at 5 m/s: 600 m2 a minute.
    assert actual_rate(frame, valves) == pytest.approx(20.0)
    assert actual_rate(frame | {"duty": [0.0, 0.0]}, valves) is None


def test_what_is_wanted_is_the_maps_rate_under_the_open_valves() -> None:
    valves = ((-1.0, 0.0, 2.0), (1.0, 0.0, 1.0), (2.0, 0.0, 1.0))
    frame = {"duty": [0.5, 0.4, 0.0], "rates_l_ha": [10.0, 40.0, 90.0]}
    assert wanted_rate(frame, valves) == pytest.approx(20.0)  # twice as wide at 10 L/ha
    assert wanted_rate(frame | {"duty": [0.0, 0.0, 0.0]}, valves) is None
    assert wanted_rate(frame | {"rates_l_ha": [None, None, None]}, valves) is None


def test_in_the_air_an_enabled_sprayer_over_no_zone_holds_and_says_why() -> None:
    live = Live(about(), way_file=None, utc_s=0.0)

    def shown(*, in_air: bool, rates: list[float | None]) -> tuple[str, str]:
        frame = _frame(1.0, 0.0, bits="000000") | {"state": "armed", "rates_l_ha": rates}
        frame["vehicle"]["in_air"] = in_air  # type: ignore[index]
        live.take(json.dumps(frame).encode())
        return live.state["word"], live.state["line"]

    assert shown(in_air=False, rates=[None, None])[0] == "ENABLED"
    word, line = shown(in_air=True, rates=[None, None])
    assert (word, line[:15]) == ("HOLD", "Outside the map")
    assert shown(in_air=True, rates=[0.0, None]) == ("HOLD", shown(in_air=False, rates=[None])[1])


def test_reasons_and_alarms_say_since_when_they_hold() -> None:
    live = Live(about(), way_file=None, utc_s=0.0)

    def since(now_s: float, *codes: str, fault: str | None = None) -> dict[str, float]:
        leak = {"kind": "leak", "text": "leak", "valve": None}
        frame = _frame(now_s, 0.0) | {"inhibits": codes, "findings": [leak]}
        live.take(json.dumps(frame | {"journal": {"fault": fault}}).encode())
        found = {one["code"]: one["since_s"] for one in live.state["reasons"]}
        assert live.state["findings"][0]["since_s"] == 1.0
        return found | live.state["since_s"]

    assert since(1.0, "not-armed") == {"not-armed": 1.0}
    found = since(2.0, "not-armed", "no-flow", fault="disk full")
    assert found == {"not-armed": 1.0, "no-flow": 2.0, "record": 2.0}
    assert since(3.0, "no-flow", fault="disk full") == {"no-flow": 2.0, "record": 2.0}
    assert since(4.0, "not-armed") == {"not-armed": 4.0}  # it came back


def test_the_ground_between_two_points_lies_under_the_open_valves() -> None:
    valves = ((-1.0, 0.5, 2.0), (1.0, 0.5, 2.0))
    north = [[0.0, 10.0, 20.0, 0.0, "10", None], [1.0, 10.0, 25.0, 0.0, "10", None]]
    (quad,) = quads_between(valves, *north)
    assert sorted((round(e, 6), round(n, 6)) for e, n in quad) == [
        (8.0, 20.5), (8.0, 25.5), (10.0, 20.5), (10.0, 25.5)
    ]  # fmt: skip


def _frame(
    now_s: float, east_m: float, *, bits: str = "11", flow: float = 6.0
) -> dict[str, object]:
    return {
        "now_s": now_s,
        "state": "spraying",
        "duty": [float(bit) for bit in bits],
        "flow_l_min": flow if "1" in bits else 0.0,
        "vehicle": {
            "east_m": east_m,
            "north_m": 0.0,
            "heading_deg": 90.0,
            "speed_m_s": 5.0,
            "in_air": True,
        },
    }


def test_the_way_has_a_point_a_metre_and_at_each_change_and_sums_area_and_volume() -> None:
    way = BoomTrace(valves=((-1.0, 0.0, 2.0), (1.0, 0.0, 2.0)))
    for k in range(101):  # 10 s at 5 m/s, ten times a second
        way.take(_frame(0.1 * k, 0.5 * k, bits="11" if k < 80 else "10" if k < 100 else "00"))
    assert len(way.points) == pytest.approx(51, abs=2)
    assert way.area_ha * 1e4 == pytest.approx(40 * 4 + 10 * 2, abs=2.0)
    assert way.volume_l == pytest.approx(1.0, rel=0.02)
    before = len(way.points)
    for k in range(50):  # closed: nothing is drawn
        way.take(_frame(10.1 + 0.1 * k, 50.0 + 0.5 * k, bits="00"))
    assert len(way.points) == before
    way.take(_frame(20.0, 500.0))  # a jump treats nothing
    assert way.area_ha * 1e4 == pytest.approx(180, abs=2.0)


def test_a_page_that_starts_again_shows_the_flight_so_far(tmp_path: Path) -> None:
    path, utc_s = tmp_path / "flights" / "track.jsonl", 1.7e9
    first = Live(about(), way_file=path, utc_s=utc_s)
    for k in range(40):
        first.take(json.dumps(_frame(0.1 * k, 0.5 * k, bits="111111")).encode())
    with path.open("a") as file:
        file.write("[1, 2, torn")
    first.close()
    again = Live(about(), way_file=path, utc_s=utc_s + 60.0)
    assert again.way.points == first.way.points
    assert again.way_id == first.way_id
    assert again.way.area_ha == pytest.approx(first.way.area_ha)
    assert again.way.volume_l == pytest.approx(first.way.volume_l, rel=0.1)
    again.take(json.dumps(_frame(5.0, 25.0, bits="111111")).encode())
    assert len(again.way.points) == len(first.way.points) + 1
    again.close()
    later = Live(about(), way_file=path, utc_s=utc_s + 13 * 3600)
    assert not later.way.points  # another day
    later.close()


def test_a_way_of_another_map_is_not_taken_up(tmp_path: Path) -> None:
    path = tmp_path / "track.jsonl"
    live = Live(about(), way_file=path, utc_s=1.7e9)
    for k in range(20):
        live.take(json.dumps(_frame(0.1 * k, 0.5 * k, bits="111111")).encode())
    other = about()
    other["map"] = other["map"] | {"sha256": "other"}
    live.close()
    assert live.way.points
    later = Live(other, way_file=path, utc_s=1.7e9)
    assert not later.way.points
    later.close()


def test_many_zones_come_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = map_parts(about()["map"])[2][0]["features"]
    assert len(whole) == 4
    monkeypatch.setattr("companion.web.live.ZONES_AT_ONCE", 3)
    summary, _, places = map_parts(about()["map"])
    assert summary["zone_parts"] == 2
    assert [len(part["features"]) for part in places] == [3, 1]
    assert [one for part in places for one in part["features"]] == whole
    none = about()["map"] | {"zones": []}
    assert map_parts(none)[0]["zone_parts"] == 1


def test_a_real_flight_and_a_simulated_one_have_ways_of_their_own(tmp_path: Path) -> None:
    path, utc_s = tmp_path / "track.jsonl", 1.7e9

    def flown(seconds: float, *, simulated: bool, begin_s: float) -> Live:
        live = Live(about(), way_file=path, utc_s=utc_s + begin_s)
        waiting = _frame(begin_s, 0.0, bits="000000") | {"simulated": simulated}
        waiting["vehicle"] = {**waiting["vehicle"], "in_air": False}  # type: ignore[dict-item]
        live.take(json.dumps(waiting).encode())
        for k in range(round(10 * seconds)):
            frame = _frame(begin_s + 0.1 * k, 0.5 * k, bits="111111") | {"simulated": simulated}
            live.take(json.dumps(frame).encode())
        live.close()
        return live

    first = flown(4.0, simulated=True, begin_s=0.0)
    again = flown(4.0, simulated=True, begin_s=60.0)
    assert again.way_id == first.way_id
    assert len(again.way.points) > len(first.way.points)
    real = flown(2.0, simulated=False, begin_s=120.0)
    assert real.way_id != first.way_id
    assert 0 < len(real.way.points) < len(first.way.points)
    # Nothing of the simulation is left in the file either, and a glance at it on the ground keeps.
    looked = Live(about(), way_file=path, utc_s=utc_s + 180.0)
    assert looked.way.points == real.way.points
    assert looked.way_id == real.way_id
    looked.close()
    assert len(flown(1.0, simulated=True, begin_s=240.0).way.points) < len(real.way.points)


# ---------------------------------------------------------------------------- over the wire


@IN_LOOP
async def test_the_state_is_what_was_decided_and_its_age_is_told(site: Site) -> None:
    decision = site.show()
    await until(lambda: site.ask("GET", "/api/v1/state").json["now_s"] == round(decision.now_s, 3))
    state = (await site.asked("GET", "/api/v1/state")).json
    assert state["state"] == decision.sprayer.value == SprayerState.SPRAYING
    assert state["word"] == "SPRAYING"
    assert state["target_l_ha"] == pytest.approx(20.0)
    assert 0.0 <= state["age_s"] < 5.0


@IN_LOOP
async def test_the_map_comes_in_metres_of_the_frame(site: Site) -> None:
    ground = (await site.asked("GET", "/api/v1/map")).json
    assert ground["origin"] == {"latitude_deg": 36.0, "longitude_deg": 114.5}
    assert (ground["zone_count"], ground["rates_l_ha"]) == (4, [15.0, 20.0, 25.0])
    zones = (await site.asked("GET", "/api/v1/zones")).json
    assert [zone["rate_l_ha"] for zone in zones] == [20.0, 25.0, 15.0, 20.0]
    assert min(zones[0]["areas"][0][0][::2]) == 0.0
    places = (await site.asked("GET", "/api/v1/zones.geojson")).json["features"]
    for zone, place in zip(zones, places, strict=True):
        for ring, there in zip(zone["areas"][0], place["geometry"]["coordinates"][0], strict=True):
            longitude_deg, latitude_deg = there[2]
            found = SETUP.frame.to_local(latitude_deg, longitude_deg)
            assert found == pytest.approx((ring[4], ring[5]), abs=0.01)
    assert ground["zone_parts"] == 1
    assert (await site.asked("GET", "/api/v1/zones.geojson?part=1")).status == 404
    packed_map = await site.asked("GET", "/api/v1/map", headers={"Accept-Encoding": "gzip"})
    assert packed_map.headers["content-encoding"] == "gzip"


@IN_LOOP
async def test_a_stream_begins_at_once_and_a_change_comes_at_once(site: Site) -> None:
    reader, writer = await asyncio.open_connection("127.0.0.1", site.port)
    writer.write(f"GET /api/v1/events HTTP/1.1\r\nHost: 127.0.0.1:{site.port}\r\n\r\n".encode())

    async def state() -> dict[str, object]:
        while True:
            line = await asyncio.wait_for(reader.readline(), 10.0)
            if line.startswith(b"data: "):
                found: dict[str, object] = json.loads(line[6:])["state"]
                return found

    await state()
    site.show()
    site.show(enabled=False)
    async with asyncio.timeout(5.0):
        while (await state())["state"] != "ready":
            pass
    site.show()
    writer.close()
    await writer.wait_closed()


@IN_LOOP
async def test_orders_reach_the_loop_and_its_answer_the_browser(site: Site) -> None:
    site.orders.clear()
    reply = await site.asked("POST", "/api/v1/stop")
    assert reply.json == {"accepted": True, "text": "stop done"}
    assert [order.name for order in site.orders] == ["stop"]


@IN_LOOP
async def test_a_companion_that_stands_still_is_told_of(site: Site) -> None:
    site.is_deaf = True
    reply = await site.asked("POST", "/api/v1/stop")
    site.is_deaf = False
    assert reply.status == 503
    assert "transmitter" in reply.json["detail"]


@IN_LOOP
async def test_blueos_finds_the_page(site: Site) -> None:
    found = (await site.asked("GET", "/register_service")).json
    assert found["works_in_relative_paths"] is True
    assert found["version"] == "1.2.3"


async def test_a_page_that_dies_is_started_again_and_goes_on(tmp_path: Path) -> None:
    async with served(tmp_path) as site:
        child = site.page._child
        assert child is not None
        child.send_signal(signal.SIGKILL)
        await asyncio.to_thread(child.wait)
        site.page._started_s = float("-inf")  # no need to wait here
        await until(lambda: site.page._child is not child and site.page._orders is not None)
        site.show()
        assert (await site.asked("GET", "/api/v1/state")).status == 200
        assert (await site.asked("POST", "/api/v1/stop")).json["accepted"]


async def test_a_page_ends_with_its_companion() -> None:
    script = (
        "import asyncio, sys, os\n"
        "from companion.web import OperatorPage, listen\n"
        "from tests.companion.web_site import about\n"
        "async def main():\n"
        "    page = OperatorPage(listen('127.0.0.1', 0), about(), obey=None, horizon_s=0.5)\n"
        "    await page.open(lambda: None)\n"
        "    print(page._child.pid, flush=True)\n"
        "    await asyncio.sleep(60)\n"
        "asyncio.run(main())\n"
    )
    companion = await asyncio.create_subprocess_exec(
        sys.executable, "-c", script, stdout=asyncio.subprocess.PIPE
    )
    assert companion.stdout is not None
    pid = int(await companion.stdout.readline())
    companion.kill()
    await companion.wait()

    def is_gone() -> bool:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            return True
        return state == "Z"

    await until(is_gone)


# ---------------------------------------------------------------------------- at the loop's end


class Loop:
    """An `OperatorPage` without its process: packets are put in by hand."""

    def __init__(self) -> None:
        self.obeyed: list[Order] = []
        self.boot_s = 100.0
        self.page = OperatorPage(
            listen("127.0.0.1", 0),
            about(),
            obey=self.obey,
            horizon_s=0.5,
            boot_clock=lambda: self.boot_s,
        )
        ours, self.browser = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setblocking(False)
        self.browser.setblocking(False)
        self.page._orders = ours

    def obey(self, order: Order, now_s: float) -> Outcome:
        self.obeyed.append(order)
        return Outcome(accepted=True, text="done")

    def put(self, name: str, *, boot_s: float = 100.0, **more: object) -> None:
        packet = {"number": 1, "name": name, "boot_s": boot_s, **more}
        self.browser.send(json.dumps(packet).encode())

    async def close(self) -> None:
        self.browser.close()
        await self.page.close()


@pytest_asyncio.fixture(loop_scope="module")
async def loop() -> AsyncIterator[Loop]:
    found = Loop()
    yield found
    await found.close()


@IN_LOOP
async def test_an_enable_that_waited_is_not_carried_out_and_a_stop_is(loop: Loop) -> None:
    loop.put("enable", boot_s=98.0)
    loop.put("stop", boot_s=10.0)
    loop.put("enable", boot_s=100.5)  # from the future: no clock of this computer
    loop.page.read(1.0)
    assert [order.name for order in loop.obeyed] == ["stop"]
    assert json.loads(loop.browser.recv(999))["accepted"] is False
    loop.put("enable", boot_s=99.5)
    loop.page.read(1.0)
    assert loop.obeyed[-1].name == "enable"
    assert aged(loop.obeyed[-1], 1.0).boot_s == 98.5


@pytest.mark.parametrize(
    "packet",
    [b"{}", b"[]", b"\xff", b"null", b'{"name":"open","number":1,"boot_s":1}', b"[" * 500,
     b'{"name":"stop","number":"x","boot_s":1}', b'{"name":["stop"],"number":1,"boot_s":1}'],
)  # fmt: skip
@IN_LOOP
async def test_what_is_no_order_does_nothing(loop: Loop, packet: bytes) -> None:
    assert parse_order(packet) is None
    loop.browser.send(packet)
    assert list(loop.page.read(1.0)) == []
    assert not loop.obeyed


@IN_LOOP
async def test_a_flood_of_orders_costs_a_few_a_step_and_stop_passes(loop: Loop) -> None:
    for _ in range(60):
        loop.put("disable")
    for step_number in range(15):
        loop.page.read(1.0 + 0.01 * step_number)
    assert len(loop.obeyed) == 20
    for _ in range(30):
        loop.put("stop")
    for step_number in range(15):
        loop.page.read(1.9 + 0.01 * step_number)
    assert [order.name for order in loop.obeyed[20:]] == ["stop"] * 30
    # And stops keep no other order away.
    loop.put("disable")
    loop.page.read(2.2)
    assert loop.obeyed[-1].name == "disable"
    loop.browser.send(b"x" * 4 * ORDER_BYTES_MAX)
    assert list(loop.page.read(1.3)) == []


@IN_LOOP
async def test_showing_never_waits_for_a_page_that_reads_nothing(loop: Loop) -> None:
    site = Site(loop.page, 0)
    for number in range(3 * SLOTS):
        site.show(enabled=bool(number % 2))
    assert loop.page._ring._count == 3 * SLOTS


@IN_LOOP
async def test_steady_states_are_shown_ten_times_a_second(loop: Loop) -> None:
    site = Site(loop.page, 0)
    decision = site.show()
    count = loop.page._ring._count
    for k in range(1, 51):  # a second at 50 Hz
        loop.page.show(dataclasses.replace(decision, now_s=decision.now_s + 0.02 * k))
    assert 9 <= loop.page._ring._count - count <= 11


# ------------------------------------------------------------- the same way as a command's


class Wire:
    """A component that speaks into a list."""

    def __init__(self, **options: bool) -> None:
        self.sent: list[bytes] = []
        self.component = Component(ComponentOptions(**options), self._take)

    def _take(self, frame: bytes) -> bool:
        self.sent.append(frame)
        return True


def test_the_pages_stop_is_the_commands_stop_and_is_told_to_the_ground_station() -> None:
    wire = Wire(page_may_enable=True)
    events: list[tuple[float, str, str]] = []
    wire.component.on_event = lambda *event: events.append(event)
    (stop,) = wire.component.obey_page("stop", None, 5.0).inputs
    assert (stop.source, stop.pressed) == ("command", True)  # type: ignore[union-attr]
    assert events == [(5.0, "command", "emergency stop")]
    wire.component.tick(None, 5.1)
    assert any(b"emergency stop" in frame for frame in wire.sent)
    (wish,) = wire.component.obey_page("disable", None, 6.0).inputs
    assert (wish.enable, wish.source) == (False, "web")  # type: ignore[union-attr]


def test_stops_are_a_row_a_change_and_repeated_ones_are_counted() -> None:
    component = Wire(page_may_enable=True).component
    events: list[str] = []
    component.on_event = lambda _at_s, kind, text: (
        events.append(text) if kind == "command" else None
    )
    decision, state = stopped(5.1), builders.flying(5.1, 6.0)

    def stop(times: int) -> list[object]:
        found = []
        for _ in range(times):
            found += component.obey_page("stop", None, 5.0).inputs
            component.tick(decision, 5.1)
        return found

    assert len(stop(174)) == 1
    assert events == ["emergency stop", *(f"emergency stop, {n} times" for n in (10, 100))]
    component.obey_page("disable", None, 6.0)
    assert events.pop() == "emergency stop, 174 times"
    # The next is news again, and so is one that the core knows nothing of.
    assert len(stop(3)) == 1
    for unknown in (None, step(SETUP, state, Memory(), 5.1)[0]):
        component.tick(unknown, 7.0)
        assert len(stop(1)) == 1
    assert events[3:] == ["emergency stop"] * 3


def stopped(now_s: float) -> Decision:
    """Return a decision of a sprayer that was stopped."""
    decision, _ = step(SETUP, builders.flying(now_s, 6.0, estop=True), Memory(), now_s)
    return decision


def test_the_page_enables_only_where_the_configuration_lets_it() -> None:
    refused = Wire(may_enable=True).component.obey_page("enable", None, 5.0)
    assert (refused.result, refused.inputs) == (2, ())
    (wish,) = (
        Wire(may_enable=False, page_may_enable=True).component.obey_page("enable", None, 5.0).inputs
    )
    assert (wish.enable, wish.source) == (True, "web")  # type: ignore[union-attr]


def test_the_page_notes_a_filling() -> None:
    component = Wire().component
    assert component.obey_page("refilled", 12.5, 5.0).result == 0
    assert component.tank_l == 12.5
    assert component.obey_page("refilled", float("nan"), 5.0).result == 2
    assert component.tank_l == 12.5


def test_a_dry_run_goes_on_with_no_way_of_a_product(tmp_path: Path) -> None:
    def of(training: str) -> Live:
        told = about(facts={"training": training})
        return Live(told, way_file=tmp_path / "way.jsonl", utc_s=1000.0)

    flown = of("no")
    for east_m in range(20):
        flown.take(json.dumps(_frame(float(east_m), float(east_m))).encode())
    flown.close()
    assert flown.way.points
    again, dry = of("no"), of("dry")
    assert len(again.way.points) == len(flown.way.points)
    assert not dry.way.points
    for one in (again, dry):
        one.close()


def test_a_port_that_is_taken_is_refused_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.web.page.BIND_TRIES_S", 0.0)
    said = r"web\.port: cannot listen .* in use; write another"
    with listen("127.0.0.1", 0) as taken, pytest.raises(ConfigError, match=said):
        listen("127.0.0.1", taken.getsockname()[1])


def test_a_run_without_the_page_imports_none_of_it() -> None:
    code = (
        "import sys, companion.cli.run\n"
        "print([m for m in ('fastapi', 'starlette', 'uvicorn', 'segno') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
