"""A reader of missions with a vehicle that answers, for its tests."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.core.types import LegReport
from companion.link.encode import Encoder
from companion.link.messages import (
    MissionCurrent,
    MissionItem,
    MissionStep,
    MissionTransfer,
)
from companion.link.mission_reader import MissionReader

WAYPOINT, LOITER_TURNS, LOITER_TIME, RTL, LAND, TAKE_OFF, SPLINE = 16, 18, 19, 20, 21, 22, 82
JUMP, SPEED, SERVO = 177, 178, 183
A, B, C, AHEAD = (36.0, 114.0), (36.001, 114.0), (36.001, 114.001), (36.002, 114.00001)
VEHICLE, OURS = (1, 1), (1, 191)


def item(command: int, place: tuple[float, float] | None = None, **more: float) -> MissionItem:
    return MissionItem(command=command, place=place, **({"param1": 0.0, "param2": 0.0} | more))


MISSION = (
    item(WAYPOINT, A),
    item(TAKE_OFF),
    item(SPEED, param1=1.0, param2=5.0),
    item(WAYPOINT, B),
    item(SERVO),
    item(WAYPOINT, C),
    item(RTL),
)


class Bench:
    """A reader, and an autopilot that answers as it is told to."""

    def __init__(
        self,
        *,
        is_used: bool = True,
        is_needed: bool = False,
        is_streamed: bool = True,
        items: Sequence[MissionItem] = MISSION,
    ) -> None:
        self.sent: list[tuple[float, Any]] = []
        self.warnings: list[str] = []
        self.legs: list[LegReport] = []  # that came with an item, and not with MISSION_CURRENT
        self.flagged: int | None = None  # the item that says it is flown to
        self.flies_mission = True
        self.items = items
        self.now_s = 100.0
        self.is_armed = False
        self.answers = True
        self._parser = mavlink.MAVLink(None)
        encoder = Encoder(system_id=1, component_id=191)
        self.reader = MissionReader(
            encoder, self._send, self.warnings.append, is_used=is_used, is_needed=is_needed
        )
        self.reader.meet(1, is_streamed=is_streamed)

    def _send(self, frame: bytes) -> bool:
        self.sent.extend((self.now_s, message) for message in self._parser.parse_buffer(frame))
        return True

    def transfer(self, step: MissionStep, number: int = 0, **more: Any) -> None:
        about = {"sender": VEHICLE, "to": OURS} | more
        item_ = self.items[number] if step is MissionStep.ITEM else None
        message = MissionTransfer(
            received_s=self.now_s,
            system_id=about["sender"][0],
            component_id=about["sender"][1],
            target_system=about["to"][0],
            target_component=about["to"][1],
            step=step,
            number=number,
            item=item_,
            is_current=step is MissionStep.ITEM and number == self.flagged,
        )
        self.legs += self.reader.take(message)

    def current(self, sequence: int = 5, **more: Any) -> tuple[LegReport, ...]:
        told = {"total": len(self.items) - 1} | more
        return self.reader.take(MissionCurrent(received_s=self.now_s, sequence=sequence, **told))

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s / 0.02)):
            self.now_s += 0.02
            before = len(self.sent)
            self.reader.tick(self.now_s, is_armed=self.is_armed, flies_mission=self.flies_mission)
            for _, message in self.sent[before:] if self.answers else ():
                match message.get_type():
                    case "MISSION_REQUEST_LIST":
                        self.transfer(MissionStep.COUNT, len(self.items))
                    case "MISSION_REQUEST_INT":
                        self.transfer(MissionStep.ITEM, message.seq)

    def of(self, kind: str) -> list[float]:
        return [at_s for at_s, message in self.sent if message.get_type() == kind]


def known(**options: Any) -> Bench:
    bench = Bench(**options)
    bench.current()
    bench.run(5.0)
    return bench
