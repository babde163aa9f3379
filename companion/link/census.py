"""Who speaks on the link, and which one of them is the vehicle that we belong to."""

from __future__ import annotations

from dataclasses import dataclass

from companion.flight_modes import COPTER, PLANE, PX4_AUTO, PX4_MAIN, ROVER

AUTOPILOT_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
_AUTOPILOT_INVALID = 8
# MAV_TYPE of what is no vehicle although some of them claim an autopilot: antenna tracker, ground
# station, onboard controller, gimbal, ADS-B, camera.
_NAMES = {5: "antenna tracker", 6: "ground station", 18: "onboard computer", 26: "gimbal"} | {
    27: "ADS-B",
    30: "camera",
}
_NO_VEHICLE = frozenset(_NAMES)
# A second vehicle counts as gone after this; its heartbeats come every second.
GONE_S = 10.0
_HEARD_MAX = 64


@dataclass(frozen=True, slots=True, kw_only=True)
class Vehicle:
    """The autopilot that the link belongs to."""

    system_id: int
    autopilot: int

    @property
    def is_ardupilot(self) -> bool:
        """Whether it runs ArduPilot."""
        return self.autopilot == ARDUPILOT

    @property
    def is_px4(self) -> bool:
        """Whether it runs PX4."""
        return self.autopilot == PX4


@dataclass(slots=True)
class _Seen:
    """The last heartbeat of a component."""

    kind: int
    autopilot: int
    at_s: float


class Census:
    """Remembers the first autopilot and never changes it; the others are counted.

    `wanted_system_id` 0 takes the first autopilot; another number waits for that one.
    """

    def __init__(self, wanted_system_id: int = 0) -> None:
        self.wanted_system_id = wanted_system_id
        self.vehicle: Vehicle | None = None
        self.vehicle_heard_s: float | None = None
        self._seen: dict[tuple[int, int], _Seen] = {}

    def heartbeat(
        self, system_id: int, component_id: int, *, kind: int, autopilot: int, now_s: float
    ) -> None:
        """Take a heartbeat, whoever sent it."""
        sender = (system_id, component_id)
        self._seen.pop(sender, None)
        self._seen[sender] = _Seen(kind, autopilot, now_s)
        if len(self._seen) > _HEARD_MAX:
            del self._seen[next(iter(self._seen))]
        if not self._is_autopilot(sender):
            return
        if self.vehicle is None and self.wanted_system_id in (0, system_id):
            self.vehicle = Vehicle(system_id=system_id, autopilot=autopilot)
        if self.vehicle is not None and self.vehicle.system_id == system_id:
            self.vehicle_heard_s = now_s

    def _is_autopilot(self, sender: tuple[int, int]) -> bool:
        seen = self._seen[sender]
        return (
            sender[1] == AUTOPILOT_COMPONENT
            and seen.autopilot != _AUTOPILOT_INVALID
            and seen.kind not in _NO_VEHICLE
            and sender[0] != 0
        )

    def autopilots(self, now_s: float) -> list[int]:
        """Return the systems whose autopilots were heard of late, in their order."""
        return sorted(
            sender[0]
            for sender, seen in self._seen.items()
            if now_s - seen.at_s <= GONE_S and self._is_autopilot(sender)
        )

    def rivals(self, now_s: float) -> list[int]:
        """Return the other autopilots, if the configuration does not say which one is ours."""
        if self.wanted_system_id != 0 or self.vehicle is None:
            return []
        return [number for number in self.autopilots(now_s) if number != self.vehicle.system_id]

    def is_heard(self, system_id: int, component_id: int, now_s: float) -> bool:
        """Whether a component has sent a heartbeat of late."""
        seen = self._seen.get((system_id, component_id))
        return seen is not None and now_s - seen.at_s <= GONE_S

    def who(self, now_s: float) -> str:
        """Return in words who is there, four at most."""
        there = [
            f"{sender[0]}/{sender[1]} ({_NAMES.get(seen.kind, 'other')})"
            for sender, seen in self._seen.items()
            if now_s - seen.at_s <= GONE_S
        ]
        more = f" and {len(there) - 4} more" if len(there) > 4 else ""
        return ", ".join(there[:4]) + more


# MAV_TYPE: quadrotor, coaxial, helicopter, hexa-, octo-, tri-, dodeca-, decarotor.
_COPTER_TYPES = frozenset({2, 3, 4, 13, 14, 15, 29, 35})
_ROVER_TYPES = frozenset({10, 11})  # ground rover, surface boat
_PLANE_TYPES = frozenset({1, 19, 20, 21, 22, 23, 24, 25})  # fixed wing and the VTOLs

ARDUPILOT = 3  # MAV_AUTOPILOT_ARDUPILOTMEGA
PX4 = 12  # MAV_AUTOPILOT_PX4


def autopilot_name(autopilot: int) -> str:
    """Return the firmware's name.

    >>> autopilot_name(12)
    'px4'
    """
    return {ARDUPILOT: "ardupilot", PX4: "px4"}.get(autopilot, f"autopilot {autopilot}")


def mode_name(autopilot: int, vehicle_type: int, custom_mode: int) -> str:
    """Return the mode's name as its firmware has it, `MODE n` where it is not known.

    >>> mode_name(3, 2, 3), mode_name(3, 10, 3), mode_name(12, 2, (4 << 16) | (4 << 24))
    ('AUTO', 'STEERING', 'MISSION')
    """
    if autopilot == PX4:
        return _px4_mode(custom_mode)
    table: dict[int, str] = {}
    if autopilot == ARDUPILOT and vehicle_type in _COPTER_TYPES:
        table = COPTER
    elif autopilot == ARDUPILOT and vehicle_type in _PLANE_TYPES:
        table = PLANE
    elif autopilot == ARDUPILOT and vehicle_type in _ROVER_TYPES:
        table = ROVER
    return table.get(custom_mode, f"MODE {custom_mode}")


def _px4_mode(custom_mode: int) -> str:
    main, sub = (custom_mode >> 16) & 0xFF, (custom_mode >> 24) & 0xFF
    unknown = f"MODE {main}.{sub}"
    if main == 4:
        return PX4_AUTO.get(sub, unknown)
    return PX4_MAIN.get(main, unknown)
