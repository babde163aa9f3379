"""`vrspray ground` beside a vehicle on the wire, with a hand on a terminal or lines of a script."""

from __future__ import annotations

import asyncio
import json
import signal
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import pytest

from companion.cli.ground import in_words
from companion.ground.shell import GroundOutcome, perform
from companion.ground.work import GroundKind, GroundSetup, Hold, clicks, together
from companion.link.component import ComponentOptions
from companion.link.vehicle_link import VehicleLink
from companion.output.engine.wire import EngineSetup, Issued, Wiring
from companion.output.gpio import GpioExecutor
from companion.output.servo import ServoExecutor, ServoOptions
from tests import builders
from tests.companion.realtime.ground_bench import AUTO, example, session, standing
from tests.companion.wire_peer import WirePeer, free_port, over_udp

pytestmark = pytest.mark.sitl


async def test_a_held_space_bar_primes_and_ends_by_itself(tmp_path: Path) -> None:
    config = example(tmp_path)
    async with session(config, "prime", "--seconds", "2", "--water") as work:
        await work.until_told("Type spray")
        work.press(b"spray\n")
        await work.until_told("Hold the space bar")
        work.hold(b" ")
        code, result = await work.ended()
        assert code == 0, work.told.decode()
        assert work.peer.is_all_closed
    assert result["is_done"]
    assert result["open_s"] == pytest.approx(2.0, abs=1e-3)
    assert (result["training"], result["liquid"]) == ("ground", "water")
    assert {"Spray: training: ground", "Spray: ground work: prime"} <= set(work.peer.texts())
    assert {order.pulse_us for order in work.peer.orders} == {1000, 2000}
    record = (config.parent / "flights" / "ground-work.jsonl").read_text().splitlines()
    assert len(record) == 1
    assert json.loads(record[0])["kind"] == "prime"


async def test_nothing_opens_that_nobody_would_close_without_power(tmp_path: Path) -> None:
    peer = standing()
    peer.has_script = False
    async with session(example(tmp_path), "prime", "--seconds", "2", peer=peer) as work:
        await work.until_told("Type spray")
        work.press(b"spray\n")
        code, _ = await work.ended()
    assert code == 1
    assert b"no watchdog script or board" in work.told
    assert {order.pulse_us for order in peer.orders} == {1000}


@pytest.mark.parametrize(("ending", "code"), [("let go", 0), ("ctrl-c", 130)])
async def test_letting_go_closes_and_so_does_ctrl_c(tmp_path: Path, ending: str, code: int) -> None:
    async with session(example(tmp_path), "flush", "--together", "--seconds", "30") as work:
        peer = work.peer
        await work.until_told("Type spray")
        work.press(b"spray\n")
        await work.until_told("Hold the space bar")
        work.hold(b" ")
        await peer.until(lambda: len(peer.open_channels) == 6)
        if ending == "let go":
            await work.let_go()
            await peer.until(lambda: peer.is_all_closed)
            assert work.process.returncode is None, "the rest may follow"
            work.press(b"q")
        else:
            work.process.send_signal(signal.SIGINT)
        found, result = await work.ended()
        await peer.until(lambda: peer.is_all_closed)
    assert found == code, work.told.decode()
    assert b"Traceback" not in work.told
    assert result == {"error": "interrupted"} if code else result["reasons"] == ["another-key"]


async def test_lines_of_a_script_catch_for_an_exact_time(tmp_path: Path) -> None:
    arguments = ("catch", "--duty", "0.5", "--seconds", "1.5", "--valve", "2", "--valve", "3")
    async with session(example(tmp_path), *arguments, by_lines=True) as work:
        work.press(b"spray\n")
        await work.until_told("Lines hold")
        work.hold(b"hold\n")
        code, result = await work.ended()
    assert code == 0, work.told.decode()
    assert result["csv"] == "0.5,1.500,?,2 3"
    # Two of six valves at 3.276 L/min for 1.5 s, and what their lags add.
    assert result["expected_ml"] == pytest.approx(27.4, abs=0.1)
    opened = [order.channel for order in work.peer.orders if order.pulse_us == 1500]
    assert set(opened) == {10, 11}


class ScriptedHand:
    """Presses its key whenever it is asked."""

    def __init__(self) -> None:
        self.stopped: str | None = None
        self._hold = Hold()

    def begin(self) -> None:
        self._hold = Hold()

    @property
    def hold(self) -> Hold:
        self._hold = self._hold.renewed(builders.now())
        return self._hold


LONG = together(GroundKind.FLUSH, 6, range(6), duty=1.0, seconds=30.0)


@dataclass
class Bench:
    """`perform` in this process, with servo outputs, beside a vehicle on the wire."""

    peer: WirePeer = field(default_factory=standing)
    hand: ScriptedHand = field(default_factory=ScriptedHand)

    async def perform(self, port: int) -> GroundOutcome:
        link = VehicleLink(f"udpin:127.0.0.1:{port}", ComponentOptions(watch_mission=True))
        executor = ServoExecutor(ServoOptions(channels=tuple(range(9, 15))), link.order)
        link.on_order_ack(executor.acknowledge)
        return await perform(
            LONG,
            GroundSetup(has_servo_outputs=True),
            link=link,
            executor=executor,
            hand=self.hand,
            wait_s=1.5,
            settle_s=0.1,
        )


@pytest.mark.parametrize(
    ("reason", "change"),
    [
        ("armed", {"armed": True}),
        ("mission-mode", {"mode": AUTO}),
        ("not-landed", {"landed_state": 2}),
        ("not-landed", {"landed_state": 3}),
        ("not-landed", {"landed_state": 4}),
        ("landed-unknown", {"is_landed_told": False}),
        ("mission-active", {"mission_state": 3}),
        ("outputs-need-arming", {"autopilot": 12, "mode": 1 << 16}),
        ("another companion is using 1/191", {"twin": True}),
    ],
)
async def test_beside_a_vehicle_that_may_not_nothing_is_opened(
    reason: str, change: dict[str, object]
) -> None:
    bench, port = Bench(), free_port()
    for name, value in change.items():
        setattr(bench.peer, name, value)
    async with over_udp(bench.peer, port):
        outcome = await bench.perform(port)
    assert not outcome.has_begun
    assert reason in outcome.reasons
    assert not any(order.pulse_us > 1000 for order in bench.peer.orders)
    assert in_words(outcome.reasons, outcome.text)


@pytest.mark.parametrize(
    "ending", ["armed", "stopped", "mission-mode", "not-landed", "output-fault", "terminal-gone"]
)
async def test_whatever_is_lost_closes_all_valves(ending: str) -> None:
    bench, port = Bench(), free_port()
    peer = bench.peer
    async with over_udp(peer, port):
        task = asyncio.create_task(bench.perform(port))
        await peer.until(lambda: len(peer.open_channels) == 6)
        if ending == "armed":
            peer.armed = True
        elif ending == "stopped":
            peer.command_companion(31014, 1.0)
        elif ending == "mission-mode":
            peer.mode = AUTO
        elif ending == "not-landed":
            peer.landed_state = 3
        elif ending == "output-fault":
            peer.servo_result = 4  # of the orders to close too; refused ones are not carried out
            peer.command_companion(31014, 1.0)
        else:
            bench.hand.stopped = ending
        async with asyncio.timeout(10.0):
            outcome = await task
        if ending != "output-fault":
            await peer.until(lambda: peer.is_all_closed)
    assert outcome.has_begun
    assert not outcome.is_done
    assert outcome.reasons & {ending, "stopped"}
    assert all(order.pulse_us == 1000 for order in peer.orders[-6:])


async def test_on_own_lines_each_valve_clicks_twice_for_a_fifth_of_a_second(tmp_path: Path) -> None:
    setup, port = builders.setup(), free_port()
    link = VehicleLink(f"udpin:127.0.0.1:{port}", ComponentOptions(watch_mission=True))
    levels = tmp_path / "levels"
    executor = GpioExecutor(
        EngineSetup(
            wiring=Wiring(valves=tuple(range(6))), pwm=setup.pwm, backend="file", device=str(levels)
        )
    )
    edges: list[Issued] = []
    executor.on_issued = edges.extend
    async with over_udp(standing(), port):
        outcome = await perform(
            clicks(6, range(6)),
            GroundSetup(),
            link=link,
            executor=executor,
            hand=ScriptedHand(),
            settle_s=0.1,
        )
    assert outcome.is_done, outcome
    assert not any(levels.read_bytes())
    for valve in range(6):
        own = [edge for edge in edges if edge.output == valve]
        # An edge that repeats the state only tells of its duty, and a plan that arrives just after
        # a change may order it again: what is shorter than a fiftieth of a second is no click.
        turns = [b for a, b in pairwise(own) if a.is_open != b.is_open]
        opened_s = [
            a.planned_s
            for a, b in pairwise(turns)
            if a.is_open and b.planned_s - a.planned_s > 0.02
        ]
        assert len(opened_s) == 2
        assert opened_s[1] - opened_s[0] == pytest.approx(0.4, abs=0.06)
        open_s = sum(b.planned_s - a.planned_s for a, b in pairwise(turns) if a.is_open)
        assert open_s == pytest.approx(0.4, abs=0.06)
