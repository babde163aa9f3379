"""What happens once when a fault begins or ends, and what another ground station does meanwhile."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sitl.stub.faults import FaultKind
from sitl.stub.modes import AUTO

if TYPE_CHECKING:
    from sitl.stub.autopilot import Autopilot


class Incidents:
    """Looks at each tick what has begun and what is over."""

    def __init__(self) -> None:
        self._in_force: set[FaultKind] = set()
        self._station_due_s = 0.0

    def tick(self, autopilot: Autopilot, now_s: float) -> None:
        """Do what is due."""
        if self._begins(autopilot, FaultKind.REBOOT, now_s):
            autopilot.reboot(now_s)
        if self._begins(autopilot, FaultKind.MODE, now_s):
            mode = autopilot.faults.active(FaultKind.MODE, now_s)
            if mode is not None:
                autopilot.flight.set_mode(mode.mode, now_s)
        if self._ends(autopilot, FaultKind.MODE, now_s):
            autopilot.flight.set_mode(AUTO, now_s)
        self._overwrite_rates(autopilot, now_s)

    def _begins(self, autopilot: Autopilot, kind: FaultKind, now_s: float) -> bool:
        if kind in self._in_force or autopilot.faults.active(kind, now_s) is None:
            return False
        self._in_force.add(kind)
        return True

    def _ends(self, autopilot: Autopilot, kind: FaultKind, now_s: float) -> bool:
        if kind not in self._in_force or autopilot.faults.active(kind, now_s) is not None:
            return False
        self._in_force.discard(kind)
        return True

    def _overwrite_rates(self, autopilot: Autopilot, now_s: float) -> None:
        """Set all rates again and again, as ground stations do on a link they share.

        On ArduPilot by REQUEST_DATA_STREAM for all groups; on PX4, which has none, message by
        message.
        """
        fault = autopilot.faults.active(FaultKind.STATION_RATES, now_s)
        if fault is None or now_s < self._station_due_s:
            return
        self._station_due_s = now_s + max(fault.delay_s, 0.1)
        grouped = {number for group in autopilot.firmware.groups.values() for number in group}
        interval_s = 1.0 / fault.rate_hz if fault.rate_hz > 0.0 else None
        for channel in autopilot.channels:
            for message_id in grouped | set(channel.streams):
                channel.ask(message_id, interval_s, now_s=now_s)
