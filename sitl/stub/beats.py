"""What comes by itself: heartbeats, requests of the clock, MISSION_CURRENT, strangers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sitl.stub import mission, services
from sitl.stub.protocol import dialect

if TYPE_CHECKING:
    from sitl.stub.autopilot import Autopilot
    from sitl.stub.strangers import Strangers

_HEARTBEAT_S = 1.0
_CURRENT_S = 10.0


class Beats:
    """Keeps what is due when."""

    def __init__(self, strangers: Strangers, *, timesync_s: float, start_s: float) -> None:
        self.heartbeat_due_s = start_s
        self._strangers = strangers
        self._timesync_s = timesync_s
        self._timesync_due_s = start_s + timesync_s
        # The last MISSION_CURRENT: of how many items which one, and when.
        self._current: tuple[int, int, float] = (0, -1, start_s)

    def tick(self, autopilot: Autopilot, now_s: float) -> None:
        """Send what is due."""
        if self.heartbeat_due_s <= now_s:
            self.heartbeat_due_s = max(self.heartbeat_due_s + _HEARTBEAT_S, now_s)
            autopilot.broadcast(autopilot.firmware.heartbeat(autopilot, now_s))
            for frame in self._strangers.heartbeats(now_s):
                autopilot.relay(frame)
        for frame in self._strangers.positions(now_s):
            autopilot.relay(frame)
        if self._timesync_due_s <= now_s:
            self._timesync_due_s = max(self._timesync_due_s + self._timesync_s, now_s)
            autopilot.broadcast(services.timesync_request(autopilot, now_s))
        if dialect.MAVLINK_MSG_ID_MISSION_CURRENT not in autopilot.firmware.builders:
            self._tell_current(autopilot, now_s)

    def _tell_current(self, autopilot: Autopilot, now_s: float) -> None:
        """Send MISSION_CURRENT on a change and every ten seconds: here it is no stream."""
        count, sequence = len(autopilot.flight.items), autopilot.flight.sequence
        if (count, sequence) != self._current[:2] or now_s - self._current[2] >= _CURRENT_S:
            self._current = (count, sequence, now_s)
            autopilot.broadcast(mission.current(autopilot))
