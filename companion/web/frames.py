"""What the page is told by the control loop: a frame for each decision worth showing, and the map.

Pure. A frame is one small JSON object; what is no number is null in it. Places are metres in the
flight's frame.

The newest frames pass to the page's process in shared memory, written without waiting and never
full. The writer overwrites the oldest slot; a reader that falls behind loses the oldest values and
nothing else. Each slot has its number and a checksum, so that a reader that is overtaken while it
reads notices it: there is no lock that anybody could hold.
"""

from __future__ import annotations

import json
import math
import mmap
import os
import struct
import zlib
from collections.abc import Iterator
from typing import Any

import shapely
from shapely import Geometry

from companion.core.setup import Setup
from companion.core.types import Decision, VehicleState

# A frame that does not fit its slot goes without what stands for each valve.
_LONG = ("duty", "rates_l_ha")


def number(value: float | None, digits: int = 2) -> float | None:
    """Return a number for JSON; None for what is none.

    >>> number(1.2345), number(math.nan), number(None)
    (1.23, None, None)
    """
    if value is None or not math.isfinite(value):
        return None
    return round(value, digits)


def shown_key(decision: Decision) -> tuple[object, ...]:
    """Return what the operator sees at once when it changes: valves, state and reasons."""
    state = decision.state
    return (
        tuple(duty > 0.0 for duty in decision.plan.duty),
        decision.sprayer,
        decision.inhibits,
        state is not None and (state.enabled, state.estop, state.armed),
        len(decision.findings),
    )


def frame_of(decision: Decision, *, horizon_s: float) -> dict[str, Any]:
    """Return what the page shows of a decision; `horizon_s` is how far the orders look ahead."""
    state = decision.state
    found: dict[str, Any] = {
        "now_s": round(decision.now_s, 3),
        "state": decision.sprayer.value,
        "inhibits": sorted(reason.value for reason in decision.inhibits),
        "duty": [round(duty, 3) for duty in decision.plan.duty],
        "rates_l_ha": [number(rate) for rate in decision.rate_l_ha],
        "target_l_min": number(decision.target_flow_l_min, 3),
        "flow_l_min": number(decision.flow_l_min, 3),
        "out_of_range": decision.out_of_range_count,
        "findings": [
            {"kind": finding.kind.value, "text": finding.text, "valve": finding.valve}
            for finding in decision.findings[:8]
        ],
    }
    if state is not None:
        found["vehicle"] = _vehicle(state, decision.now_s, horizon_s)
        found["liquid"] = _liquid(state, decision.now_s)
    return found


def _vehicle(state: VehicleState, now_s: float, horizon_s: float) -> dict[str, Any]:
    heard_s = state.heartbeat_received_s
    return {
        "east_m": number(state.east_m),
        "north_m": number(state.north_m),
        "ahead_east_m": number(state.east_m + state.velocity_east_m_s * horizon_s),
        "ahead_north_m": number(state.north_m + state.velocity_north_m_s * horizon_s),
        "heading_deg": number(state.heading_deg, 1),
        "speed_m_s": number(math.hypot(state.velocity_east_m_s, state.velocity_north_m_s)),
        "height_m": number(state.height_m),
        "armed": state.armed,
        "mode": state.mode,
        "in_air": state.in_air,
        "enabled": state.enabled,
        "estop": state.estop,
        "fix": None if state.fix is None else int(state.fix),
        "accuracy_m": number(state.horizontal_accuracy_m, 3),
        "wind_m_s": number(state.wind_m_s, 1),
        "position_age_s": number(now_s - state.position_received_s),
        "heartbeat_age_s": None if heard_s is None else number(now_s - heard_s),
        "link_up": state.link_up,
        "rate_percent": number(state.rate_percent, 1),
    }


def _liquid(state: VehicleState, now_s: float) -> dict[str, Any]:
    flow, pressure, tank = state.flow, state.pressure, state.tank
    return {
        "meter_ml": None if flow is None else number(flow.volume_ml, 1),
        "meter_s": None if flow is None else number(flow.received_s, 3),
        "meter_age_s": None if flow is None else number(now_s - flow.received_s),
        "meter_fault": "" if flow is None else flow.fault,
        "pressure_kpa": None if pressure is None else number(pressure.pressure_kpa, 1),
        "pressure_fault": "" if pressure is None else pressure.fault,
        "tank_l": None if tank is None else number(tank.level_l),
        "tank_fault": "" if tank is None else tank.fault,
    }


def packed(frame: dict[str, Any], most_bytes: int) -> bytes:
    """Return a frame as JSON of at most `most_bytes`, without the valves where it needs be."""
    data = json.dumps(frame, separators=(",", ":"), allow_nan=False).encode()
    if len(data) <= most_bytes:
        return data
    return packed({key: value for key, value in frame.items() if key not in _LONG}, most_bytes)


def map_object(setup: Setup) -> dict[str, Any]:
    """Return the ground and the boom as the page draws them, in metres of the flight's frame."""
    prescription, boom = setup.prescription, setup.boom
    return {
        "origin": {
            "latitude_deg": setup.frame.latitude_deg,
            "longitude_deg": setup.frame.longitude_deg,
        },
        "bounds_m": [round(side, 2) for side in prescription.bounds_m],
        "sha256": prescription.sha256,
        "field": _rings(prescription.field),
        "field_m2": round(prescription.field.area, 1),
        "zones": [
            {
                "name": zone.name,
                "rate_l_ha": round(zone.rate_l_ha, 3),
                "areas": _rings(zone.polygon),
            }
            for zone in prescription.zones
        ],
        # How far orders lead the ground.
        "ahead_s": round(setup.longest_s, 3),
        "default_rate_l_ha": prescription.default_rate_l_ha,
        "boom": {
            "width_m": boom.width_m,
            "valves": [
                {
                    "name": valve.name,
                    "right_m": round(valve.right_m, 3),
                    "forward_m": round(valve.forward_m, 3),
                    "width_m": round(valve.width_m, 3),
                }
                for valve in boom.valves
            ],
        },
    }


def _rings(geometry: Geometry) -> list[list[list[float]]]:
    """Return polygons as lists of rings, a ring as east, north, east, north, ... in metres."""
    found = []
    for part in shapely.get_parts(geometry):
        rings = [part.exterior, *part.interiors]
        found.append([shapely.get_coordinates(ring).round(2).ravel().tolist() for ring in rings])
    return found


SLOTS = 256
SLOT_BYTES = 8192
_COUNT = struct.Struct("<Q")
_HEAD = struct.Struct("<QII")  # number, length, CRC-32
_BEGIN = 64
PAYLOAD_MAX = SLOT_BYTES - _HEAD.size
SIZE = _BEGIN + SLOTS * SLOT_BYTES


def new_memory() -> int:
    """Return a descriptor of anonymous memory for a ring; whoever inherits it may map it."""
    descriptor = os.memfd_create("vrspray-page", os.MFD_CLOEXEC)
    os.ftruncate(descriptor, SIZE)
    return descriptor


class RingWriter:
    """Puts values into a ring; a call copies some bytes and does nothing else."""

    def __init__(self, descriptor: int) -> None:
        self._map = mmap.mmap(descriptor, SIZE)
        (self._count,) = _COUNT.unpack_from(self._map, 0)

    def put(self, payload: bytes) -> bool:
        """Add a value; False where it is too large for a slot."""
        if len(payload) > PAYLOAD_MAX:
            return False
        number = self._count + 1
        at = _BEGIN + (number % SLOTS) * SLOT_BYTES
        _HEAD.pack_into(self._map, at, 0, 0, 0)  # a reader of the old value sees that it goes
        begin = at + _HEAD.size
        self._map[begin : begin + len(payload)] = payload
        _HEAD.pack_into(self._map, at, number, len(payload), zlib.crc32(payload))
        self._count = number
        _COUNT.pack_into(self._map, 0, number)
        return True

    def close(self) -> None:
        """Let go of the memory."""
        self._map.close()


class RingReader:
    """Takes values out of a ring that another process writes; begins with the newest."""

    def __init__(self, descriptor: int) -> None:
        self._map = mmap.mmap(descriptor, SIZE, access=mmap.ACCESS_READ)
        self._read = max(self._written() - 1, 0)

    def _written(self) -> int:
        (count,) = _COUNT.unpack_from(self._map, 0)
        return int(count)

    def news(self) -> Iterator[bytes]:
        """Yield what was written since the last call, oldest first; without what is overwritten."""
        count = self._written()
        # The slot that is overwritten next is not worth a race.
        for number in range(max(self._read + 1, count - SLOTS + 2), count + 1):
            payload = self._at(number)
            if payload is not None:
                yield payload
        self._read = max(count, self._read)

    def _at(self, number: int) -> bytes | None:
        at = _BEGIN + (number % SLOTS) * SLOT_BYTES
        found, length, checksum = _HEAD.unpack_from(self._map, at)
        if found != number or length > PAYLOAD_MAX:
            return None
        begin = at + _HEAD.size
        payload = bytes(self._map[begin : begin + length])
        return payload if zlib.crc32(payload) == checksum else None
