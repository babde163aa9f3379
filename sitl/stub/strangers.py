"""The others on the link: a gimbal, a transponder, a ground station, a second of each of us."""

from __future__ import annotations

from sitl.stub.faults import FaultClock, FaultKind
from sitl.stub.protocol import (
    AUTOPILOT_SYSTEM,
    COMPANION_COMPONENT,
    GROUND_COMPONENT,
    GROUND_SYSTEM,
    Message,
    Speaker,
    dialect,
)

_SECOND_SYSTEM = 2
_NONE = dialect.MAV_AUTOPILOT_INVALID
_ARMED = dialect.MAV_MODE_FLAG_SAFETY_ARMED
_POSITION_S = 0.1
_NEAR_E7 = 3000  # 33 m north of home: a place in the same field


class Strangers:
    """Gives their frames as far as a fault puts them on the link."""

    def __init__(self, faults: FaultClock, *, home_e7: tuple[int, int], autopilot: int) -> None:
        self._faults = faults
        self._home_e7 = home_e7
        self._autopilot = autopilot
        self._gimbal = Speaker(AUTOPILOT_SYSTEM, dialect.MAV_COMP_ID_GIMBAL)
        self._transponder = Speaker(AUTOPILOT_SYSTEM, dialect.MAV_COMP_ID_ADSB)
        self._ground = Speaker(GROUND_SYSTEM, GROUND_COMPONENT)
        self._companion = Speaker(AUTOPILOT_SYSTEM, COMPANION_COMPONENT)
        self._second = Speaker(_SECOND_SYSTEM, dialect.MAV_COMP_ID_AUTOPILOT1)
        self._position_due_s = 0.0

    def heartbeats(self, now_s: float) -> list[bytes]:
        """Return what they send once a second."""
        frames: list[bytes] = []
        if self._faults.active(FaultKind.FOREIGN, now_s):
            frames += self._foreign()
        if self._faults.active(FaultKind.SECOND_COMPANION, now_s):
            beat = _heartbeat(dialect.MAV_TYPE_ONBOARD_CONTROLLER, _NONE)
            frames.append(self._companion.frame(beat))
        if self._faults.active(FaultKind.SECOND_VEHICLE, now_s):
            beat = _heartbeat(dialect.MAV_TYPE_QUADROTOR, self._autopilot, armed=True, mode=3)
            frames.append(self._second.frame(beat))
        if self._faults.active(FaultKind.STATION_RATES, now_s):
            frames.append(self._ground.frame(_heartbeat(dialect.MAV_TYPE_GCS, _NONE)))
        return frames

    def positions(self, now_s: float) -> list[bytes]:
        """Return where the second vehicle flies, ten times a second."""
        if now_s < self._position_due_s:
            return []
        if not self._faults.active(FaultKind.SECOND_VEHICLE, now_s):
            return []
        self._position_due_s = now_s + _POSITION_S
        latitude_e7, longitude_e7 = self._home_e7
        place = (latitude_e7 + _NEAR_E7, longitude_e7, 63_000, 3_000)
        return [self._second.frame(_position(place))]

    def _foreign(self) -> list[bytes]:
        far = (473_977_420, 85_455_940, 488_000, 10_000)
        second = _heartbeat(dialect.MAV_TYPE_QUADROTOR, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA)
        return [
            self._gimbal.frame(_heartbeat(dialect.MAV_TYPE_GIMBAL, _NONE)),
            self._transponder.frame(_heartbeat(dialect.MAV_TYPE_ADSB, _NONE)),
            self._ground.frame(_heartbeat(dialect.MAV_TYPE_GCS, _NONE)),
            self._second.frame(second),
            self._second.frame(_position(far)),
        ]


def _heartbeat(kind: int, autopilot: int, *, armed: bool = False, mode: int = 0) -> Message:
    flags = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (_ARMED if armed else 0)
    return dialect.MAVLink_heartbeat_message(
        kind, autopilot, flags, mode, dialect.MAV_STATE_ACTIVE, 3
    )


def _position(place: tuple[int, int, int, int]) -> Message:
    return dialect.MAVLink_global_position_int_message(1000, *place, 900, 900, 0, 4500)
