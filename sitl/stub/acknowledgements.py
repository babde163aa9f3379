"""COMMAND_ACK: once, late, twice, in two steps or not at all, as the faults will have it."""

from __future__ import annotations

import heapq
from itertools import count
from typing import TYPE_CHECKING

from sitl.stub.faults import FaultKind
from sitl.stub.protocol import Message, dialect

if TYPE_CHECKING:
    from sitl.stub.autopilot import Autopilot
    from sitl.stub.channel import Channel


class Acknowledgements:
    """Sends them, and keeps those that come late."""

    def __init__(self) -> None:
        self._late: list[tuple[float, int, Channel, Message]] = []
        self._number = count()

    def send(
        self,
        autopilot: Autopilot,
        channel: Channel,
        answer: tuple[int, int],
        *,
        to: tuple[int, int],
        now_s: float,
    ) -> None:
        """Answer a command; `answer` is its number and the result."""
        command, result = answer
        message = dialect.MAVLink_command_ack_message(command, result, 0, 0, *to)
        if autopilot.strikes(FaultKind.ACK_LOST, now_s, command=command):
            return
        late = autopilot.strikes(FaultKind.ACK_LATE, now_s, command=command)
        if late is None:
            late = autopilot.strikes(FaultKind.ACK_IN_PROGRESS, now_s, command=command)
            if late is not None:
                begun = (command, dialect.MAV_RESULT_IN_PROGRESS, 0, 0, *to)
                autopilot.send(channel, dialect.MAVLink_command_ack_message(*begun))
        if late is not None:
            due_s = now_s + late.delay_s
            heapq.heappush(self._late, (due_s, next(self._number), channel, message))
            return
        autopilot.send(channel, message)
        if autopilot.strikes(FaultKind.ACK_DOUBLED, now_s, command=command):
            autopilot.send(channel, message)

    def tick(self, autopilot: Autopilot, now_s: float) -> None:
        """Send the late ones that are due."""
        while self._late and self._late[0][0] <= now_s:
            _, _, channel, message = heapq.heappop(self._late)
            autopilot.send(channel, message)

    def next_due_s(self) -> float:
        """Return when the next late one is due; infinite without one."""
        return self._late[0][0] if self._late else float("inf")
