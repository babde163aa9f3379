"""Traffic that others recorded, byte by byte: nothing opens, and every reason is right.

An attack on a simulated copter, and missions of a real one whose positions come once a second,
heard by a ground station. Of the recording only the framing (a stamp of eight bytes, a frame) and
what is asked about below is read, here and by itself.
"""

from __future__ import annotations

import asyncio
import logging
import os
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
import shapely
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from analysis.journals.content import read_journal
from companion.cli.record_parts import follow
from companion.core.frame import LocalFrame
from companion.core.prescription import Prescription, Zone
from companion.core.safety import Limits
from companion.core.setup import Setup
from companion.core.types import Decision, Fix, Inhibit
from companion.journal.journal import Journal
from companion.link.component import ComponentOptions
from companion.output.servo import ServoExecutor, ServoOptions
from companion.runtime import STEP_MAX_S, run
from tests import builders
from tests.virtual_time import Delivery, WireLink, now_s

REAL = Path(os.environ.get("VRSPRAY_REAL", ""))
pytestmark = [
    pytest.mark.virtual_time,
    pytest.mark.skipif(
        "VRSPRAY_REAL" not in os.environ, reason="no recorded traffic: set VRSPRAY_REAL"
    ),
]
CHANNELS = tuple(range(9, 15))
AUTOPILOT, COMPANION = (1, 1), (1, 191)
ARMED, ACTIVE, AUTO = 128, 4, 3
# A frame takes half a millisecond to arrive.
EDGE_S = 0.002


@dataclass(frozen=True)
class Frame:
    """A frame as it was heard, and when: seconds since the first."""

    at_s: float
    data: bytes

    @property
    def sender(self) -> tuple[int, int]:
        at = 3 if self.data[0] == 0xFE else 5
        return self.data[at], self.data[at + 1]

    @property
    def number(self) -> int:
        if self.data[0] == 0xFE:
            return self.data[5]
        return int.from_bytes(self.data[7:10], "little")


def recorded(name: str, from_s: float = 0.0, until_s: float = 1e9) -> list[Frame]:
    """Return the frames of a stretch of a .tlog, from its beginning on."""
    data, at, frames, begin_us = (REAL / name).read_bytes(), 0, list[Frame](), 0
    while at + 10 < len(data):
        stamp_us = int.from_bytes(data[at : at + 8], "big")
        begin_us = begin_us or stamp_us
        at += 8
        length = data[at + 1] + 8
        if data[at] == 0xFD:
            length = data[at + 1] + 12 + 13 * (data[at + 2] & 1)
        frames.append(Frame((stamp_us - begin_us) / 1e6, data[at : at + length]))
        at += length
    return [
        replace(frame, at_s=frame.at_s - from_s)
        for frame in frames
        if from_s <= frame.at_s < until_s
    ]


def parsed(frame: Frame) -> Any:
    mav = mavlink.MAVLink(None)
    return mav.decode(bytearray(frame.data))


@dataclass
class Heard:
    """What a replay gave: what was decided, ordered and told; each with its time of the log."""

    decisions: list[tuple[float, Decision]] = field(default_factory=list)
    sent: list[tuple[float, Any]] = field(default_factory=list)
    journal: Path = Path()
    link: WireLink | None = None

    def of(self, kind: str) -> list[Any]:
        return [message for _, message in self.sent if message.get_type() == kind]


def field_around(frames: Sequence[Frame], **limits: Any) -> Setup:
    """Return a set-up whose one zone has all places of the log in it."""
    places = [
        (m.lat / 1e7, m.lon / 1e7)
        for m in (parsed(f) for f in frames if (f.number, f.sender) == (33, AUTOPILOT))
        if m.lat
    ]
    frame = LocalFrame(*places[0])
    flown = shapely.MultiPoint([frame.to_local(*place) for place in places])
    ground = shapely.box(*flown.buffer(50.0).bounds)
    return builders.setup(
        frame=frame,
        prescription=Prescription(
            [Zone(name="all", polygon=ground, rate_l_ha=20.0)], boundary=ground
        ),
        limits=Limits(**limits),
    )


def answer_of(message: Any, boot_s: float) -> Any:
    """Return what an autopilot answers, where it does: orders, requests, the time."""
    if message.get_type() == "COMMAND_LONG":
        return mavlink.MAVLink_command_ack_message(message.command, 0, 0, 0, *COMPANION)
    if message.get_type() == "TIMESYNC" and message.tc1 == 0:
        return mavlink.MAVLink_timesync_message(round(boot_s * 1e9), message.ts1)
    return None


async def replay(
    frames: Sequence[Frame], setup: Setup, folder: Path, *, offset_s: float | None = None
) -> Heard:
    """Have the companion hear the frames at their pace, each as a datagram.

    With `offset_s`, when the autopilot's clock began, orders and questions of the time are
    answered, which no recording can do.
    """
    heard, begin_s = Heard(), now_s()
    link = WireLink("udpin:127.0.0.1:14550", ComponentOptions(), clock=now_s)
    executor = ServoExecutor(ServoOptions(channels=CHANNELS), link.order)
    link.on_order_ack(executor.acknowledge)
    parser = mavlink.MAVLink(None)

    wire = Delivery(link.arrive)
    autopilot = mavlink.MAVLink(None, *AUTOPILOT)

    def deliver(data: bytes) -> None:
        for message in parser.parse_buffer(data) or []:
            assert (message.get_srcSystem(), message.get_srcComponent()) == COMPANION
            heard.sent.append((now_s() - begin_s, message))
            answer = None if offset_s is None else answer_of(message, now_s() - begin_s - offset_s)
            if answer is not None:
                wire.send(bytes(answer.pack(autopilot)))

    def watch(decision: Decision) -> None:
        heard.decisions.append((decision.now_s - begin_s, decision))

    link.deliver = deliver
    with Journal.create(folder, setup=setup, started_s=begin_s, waits=True) as journal:
        follow(journal, link, executor)
        companion = asyncio.create_task(
            run(
                setup,
                link=link,
                executor=executor,
                recorder=journal,
                clock=now_s,
                boot_clock=now_s,
                watch=watch,
                duration_s=frames[-1].at_s + 5.0,
            )
        )
        for frame in frames:
            await asyncio.sleep(max(0.0, begin_s + frame.at_s - now_s()))
            wire.send(frame.data)
        assert await companion == 0
    heard.journal, heard.link = journal.path, link
    return heard


class Told:
    """What the autopilot has said last of each kind, as time goes on."""

    def __init__(self, frames: Sequence[Frame], *numbers: int) -> None:
        self._coming = deque(
            (frame.at_s, frame.number, parsed(frame))
            for frame in frames
            if frame.sender == AUTOPILOT and frame.number in numbers
        )
        self.last: dict[int, tuple[float, Any]] = {}
        # The quickest arrival of all has the least of the way in it.
        self.offset_s = min(
            at_s - place.time_boot_ms / 1e3 for at_s, n, place in self._coming if n == 33
        )

    def at(self, at_s: float) -> bool:
        """Go on to a time; return whether something is on the wire just then."""
        while self._coming and self._coming[0][0] < at_s - EDGE_S:
            said_s, number, message = self._coming.popleft()
            self.last[number] = said_s, message
        return bool(self._coming) and self._coming[0][0] <= at_s


def due(told: Told, at_s: float) -> dict[Inhibit, bool | None]:
    """Return which reasons there have to be by what the autopilot said; None: either."""

    def is_over(number: int, limit_s: float, late_s: float = 0.0) -> bool | None:
        age_s = at_s - told.last[number][0]
        return (
            True
            if age_s > limit_s + EDGE_S
            else None
            if age_s + late_s > limit_s - EDGE_S
            else False
        )

    (_, beat), (heard_s, place), (_, fix) = (told.last[number] for number in (0, 33, 24))
    # How long it was on its way counts for its age, as far as that shows.
    late_s = heard_s - place.time_boot_ms / 1e3 - told.offset_s
    return {
        Inhibit.STALE_POSITION: is_over(33, 0.8, late_s),
        Inhibit.STALE_HEARTBEAT: is_over(0, 2.5, EDGE_S),
        Inhibit.NOT_ARMED: not beat.base_mode & ARMED,
        Inhibit.NOT_ACTIVE: beat.system_status != ACTIVE,
        Inhibit.WRONG_MODE: beat.custom_mode != AUTO,
        # Stays for a second after it was last said.
        Inhibit.FIX_TOO_LOW: True if fix.fix_type < Fix.RTK_FLOAT else None,
        # The margin, and how it climbs on between two positions, are the core's.
        Inhibit.HEIGHT_ABOVE_MAX: True if place.relative_alt > 15_000 else None,
    }


def assert_every_reason_right(heard: Heard, frames: Sequence[Frame]) -> Counter[Inhibit]:
    """Compare each decision's reasons with the recording; return how often each was due."""
    told, counts = Told(frames, 0, 24, 33), Counter[Inhibit]()
    for at_s, decision in heard.decisions:
        if told.at(at_s) or decision.state is None or len(told.last) < 3:
            continue
        for reason, is_due in due(told, at_s).items():
            if is_due is not None:
                assert (reason in decision.inhibits) is is_due, (at_s, reason)
                counts[reason] += is_due
    return counts


FLOOD, MISSIONS = "hostile/flood.tlog", "flights/phoenix-mission1.tlog"


@pytest.mark.parametrize(
    ("name", "from_s", "until_s"),
    [(FLOOD, 0.0, 60.0), (MISSIONS, 0.0, 100.0), (MISSIONS, 240.0, 400.0)],
    ids=["attack", "on-the-ground", "mission"],
)
async def test_nothing_opens_every_reason_is_right_and_nobody_is_flooded(
    name: str, from_s: float, until_s: float, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    frames = recorded(name, from_s, until_s)
    heard = await replay(frames, field_around(frames), tmp_path)
    # Who belongs to whom, among all who speak.
    assert len({frame.sender for frame in frames}) >= 3
    assert heard.link is not None
    vehicle = heard.link.component.codec.vehicle
    assert vehicle is not None
    assert (vehicle.system_id, vehicle.is_ardupilot) == (1, True)
    assert heard.link.component.address == COMPANION
    # Closed throughout, by the plans, by the orders and by the sign of life.
    assert not any(decision.plan.opens for _, decision in heard.decisions)
    orders = [m for m in heard.of("COMMAND_LONG") if m.command == 183]
    assert orders
    assert {m.param2 for m in orders} == {1000.0}
    assert "SPR_LIVE" not in {m.name for m in heard.of("NAMED_VALUE_FLOAT")}
    counts = assert_every_reason_right(heard, frames)
    if name == MISSIONS:
        assert counts[Inhibit.STALE_POSITION] > 100
    # What the operator and the service's log are told: on change, and not once a second.
    seconds = frames[-1].at_s
    assert 2 <= len(heard.of("STATUSTEXT")) <= 0.4 * seconds
    assert len(caplog.records) <= 8 + seconds / 20.0
    # The record is whole.
    content = read_journal(heard.journal)
    kept = [item for item in content.items() if isinstance(item, Decision)]
    assert [d.inhibits for d in kept] == [d.inhibits for _, d in heard.decisions]


async def test_where_all_else_permits_it_is_open_only_while_a_position_is_young(
    tmp_path: Path,
) -> None:
    """A mission with positions once a second, and an operator who goes on enabling."""
    frames = recorded(MISSIONS, 265.0, 370.0)
    told, others = Told(frames, 0, 33), list[Frame]()
    autopilot, operator = mavlink.MAVLink(None, *AUTOPILOT), mavlink.MAVLink(None, 254, 190)
    for turn in range(200):
        flies = mavlink.MAVLink_extended_sys_state_message(0, 2).pack(autopilot)
        others.append(Frame(turn * 0.5, bytes(flies)))
        if turn % 20 == 0:
            operator.seq += 1
            enable = mavlink.MAVLink_command_long_message(*COMPANION, 216, 0, 1, 0, 0, 0, 0, 0, 0)
            others.append(Frame(turn * 0.5, bytes(enable.pack(operator))))
    both = sorted([*frames, *others], key=lambda frame: frame.at_s)
    setup = field_around(frames, fix=Fix.FIX_3D, height_max_m=200.0)
    heard = await replay(both, setup, tmp_path, offset_s=told.offset_s)
    assert sum(decision.plan.opens for _, decision in heard.decisions) > 20
    open_channels, orders = set[int](), deque(heard.sent)
    for at_s, decision in heard.decisions:
        while orders and orders[0][0] <= at_s:
            message = orders.popleft()[1]
            if message.get_type() == "COMMAND_LONG" and message.command == 183:
                change = open_channels.add if message.param2 > 1000 else open_channels.discard
                change(int(message.param1))
        if told.at(at_s) or len(told.last) < 2 or not (open_channels or decision.plan.opens):
            continue
        beat, age_s = told.last[0][1], at_s - told.last[33][0]
        assert beat.custom_mode == AUTO
        assert beat.base_mode & ARMED
        # A turn of the loop later everything is closed.
        assert age_s <= 0.8 + STEP_MAX_S + EDGE_S
        assert age_s <= 0.8 + EDGE_S or not decision.plan.opens
