"""What faults do to bytes, acknowledgements and the clock, with a seeded hand."""

from __future__ import annotations

import random

from sitl.stub.faults import Fault, FaultClock, FaultKind
from sitl.stub.protocol import (
    AUTOPILOT_SYSTEM,
    GROUND_COMPONENT,
    GROUND_SYSTEM,
    Message,
    Speaker,
    dialect,
)

_WRAP_MS = 2**32
_SECOND_SYSTEM = 2

# The start bytes of MAVLink 2 and 1, so that garbage looks like frames that begin.
_STARTS = b"\xfd\xfe"


class Impairment:
    """Damages what the autopilot sends, as far as a fault is in force."""

    def __init__(self, faults: FaultClock, *, seed: int) -> None:
        self._faults = faults
        # Not for secrets: the same seed must give the same damage.
        self._random = random.Random(seed)
        self._gimbal = Speaker(AUTOPILOT_SYSTEM, dialect.MAV_COMP_ID_GIMBAL)
        self._transponder = Speaker(AUTOPILOT_SYSTEM, dialect.MAV_COMP_ID_ADSB)
        self._ground = Speaker(GROUND_SYSTEM, GROUND_COMPONENT)
        self._second = Speaker(_SECOND_SYSTEM, dialect.MAV_COMP_ID_AUTOPILOT1)

    def strikes(self, kind: FaultKind, now_s: float) -> Fault | None:
        """Return the fault of a kind that is in force and strikes this time."""
        fault = self._faults.active(kind, now_s)
        if fault is None or self._random.random() >= fault.fraction:
            return None
        return fault

    def apply(self, frame: bytes, now_s: float) -> bytes:
        """Return what goes out in place of a frame; nothing while the link is silent."""
        if self._faults.active(FaultKind.SILENCE, now_s):
            return b""
        if self.strikes(FaultKind.CORRUPT, now_s):
            place = self._random.randrange(len(frame))
            changed = frame[place] ^ self._random.randrange(1, 256)
            frame = frame[:place] + bytes((changed,)) + frame[place + 1 :]
        if self.strikes(FaultKind.GARBAGE, now_s):
            burst = bytearray(self._random.randbytes(self._random.randrange(1, 280)))
            burst[self._random.randrange(len(burst))] = self._random.choice(_STARTS)
            frame = bytes(burst) + frame
        return frame

    def boot_ms(self, uptime_s: float, now_s: float) -> int:
        """Return the 32 bits of milliseconds since boot, wrapped or set back by a fault."""
        uptime_ms = round(uptime_s * 1000.0)
        wrap = self._faults.active(FaultKind.CLOCK_WRAP, now_s)
        if wrap is not None:
            begin_s = self._faults.elapsed_s(wrap, now_s)
            uptime_ms = int((begin_s - wrap.delay_s) * 1000.0)
        back = self._faults.active(FaultKind.CLOCK_BACKWARDS, now_s)
        if back is not None:
            uptime_ms = max(uptime_ms - int(back.delay_s * 1000.0), 0)
        return uptime_ms % _WRAP_MS

    def foreign(self, now_s: float) -> list[bytes]:
        """Return the heartbeats of others, among them a second vehicle that flies elsewhere."""
        if not self._faults.active(FaultKind.FOREIGN, now_s):
            return []
        none = dialect.MAV_AUTOPILOT_INVALID
        copter = dialect.MAV_AUTOPILOT_ARDUPILOTMEGA
        far = dialect.MAVLink_global_position_int_message(
            self.boot_ms(1.0, now_s), 473_977_420, 85_455_940, 488_000, 10_000, 900, 900, 0, 4500
        )
        return [
            self._gimbal.frame(_heartbeat(dialect.MAV_TYPE_GIMBAL, none)),
            self._transponder.frame(_heartbeat(dialect.MAV_TYPE_ADSB, none)),
            self._ground.frame(_heartbeat(dialect.MAV_TYPE_GCS, none)),
            self._second.frame(_heartbeat(dialect.MAV_TYPE_QUADROTOR, copter)),
            self._second.frame(far),
        ]


def _heartbeat(kind: int, autopilot: int) -> Message:
    """Return a heartbeat of somebody else: disarmed, mode 0."""
    mode = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    return dialect.MAVLink_heartbeat_message(kind, autopilot, mode, 0, dialect.MAV_STATE_ACTIVE, 3)
