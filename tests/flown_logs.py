"""Logs of a made-up flight, in the forms in which autopilots and ground stations write them."""

from __future__ import annotations

import struct
from functools import cache
from pathlib import Path

import numpy as np

from sitl.earth import Earth
from sitl.stub.protocol import Speaker, dialect
from sitl.trajectory import Leg, Route, Trajectory
from sitl.vehicle import Vehicle

HOME = Earth(latitude_deg=36.0, longitude_deg=114.5)
HEIGHT_M = 5.0
AUTO, LOITER = 3, 5
TOLD_HZ = 10.0
# The receiver's stamp against the estimate's.
BEHIND_S = 0.09


@cache
def flown() -> Trajectory:
    """Two legs with a turn between them, through gusts, from 100 s after boot on."""
    legs = (
        Leg(east_m=0.0, north_m=45.0, speed_m_s=5.5),
        Leg(east_m=45.0, north_m=45.0, speed_m_s=5.5),
    )
    route = Route(start_east_m=0.0, start_north_m=0.0, legs=legs, height_m=HEIGHT_M)
    vehicle = Vehicle(route, start_s=100.0, seed=4, corners="ardupilot")
    return vehicle.fly_to_end()


def told() -> np.ndarray:
    """Time, latitude, longitude, velocity north and east, heading: off by 2 cm and 2 cm/s."""
    path = flown()
    at = path.at(np.arange(path.time_s[0], path.time_s[-1], 1.0 / TOLD_HZ))
    off = np.random.default_rng(7).normal(0.0, 0.02, (4, len(at.time_s)))
    place = HOME.to_geographic_all(at.east_m + off[0], at.north_m + off[1])
    moves = at.velocity_north_m_s + off[2], at.velocity_east_m_s + off[3]
    return np.column_stack((at.time_s, *place, *moves, at.heading_deg % 360.0))


def telemetry(path: Path, *, skip_s: tuple[float, float] = (0.0, 0.0), mode: int = AUTO) -> Path:
    """Write a telemetry log; nothing is heard between two times."""
    vehicle, other = Speaker(1, 1), Speaker(2, 1)
    raw = bytearray()

    def put(at_s: float, speaker: Speaker, message: object) -> None:
        raw.extend(struct.pack(">Q", round(at_s * 1e6)) + speaker.frame(message))

    for number, (at_s, lat, lon, north, east, heading) in enumerate(told().tolist()):
        if skip_s[0] <= at_s < skip_s[1]:
            continue
        if number % 10 == 0:
            for speaker in (vehicle, other):
                put(at_s, speaker, dialect.MAVLink_heartbeat_message(2, 3, 0x81, mode, 4, 3))
            fixed_us = round((at_s + BEHIND_S) * 1e6)
            fix = (fixed_us, 6, round(lat * 1e7), round(lon * 1e7), 0, 60, 90, 0, 0, 20)
            put(at_s, vehicle, dialect.MAVLink_gps_raw_int_message(*fix))
        for speaker, shift in ((vehicle, 0), (other, 90_000)):
            position = dialect.MAVLink_global_position_int_message(
                round(at_s * 1e3), round(lat * 1e7) + shift, round(lon * 1e7), 60_000,
                round(HEIGHT_M * 1e3), round(north * 100), round(east * 100), 0,
                round(heading * 100) % 36_000,
            )  # fmt: skip
            put(at_s, speaker, position)
    path.write_bytes(raw)
    return path


_ULOG_TOPICS = {
    "vehicle_local_position": (
        "uint64_t timestamp;double ref_lat;double ref_lon;float x;float y;float z;float vx;"
        "float vy;float vz;float heading;bool xy_global;",
        "<Qddfffffff?",
    ),
    "vehicle_status": ("uint64_t timestamp;uint8_t nav_state;uint8_t arming_state;", "<QBB"),
    "vehicle_gps_position": (
        "uint64_t timestamp;int32_t lat;int32_t lon;uint8_t fix_type;", "<QiiB",
    ),
}  # fmt: skip


def ulog(path: Path) -> Path:
    """Write a log as PX4 does: definitions, what is logged, rows."""
    raw = bytearray(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0))

    def put(kind: str, body: bytes) -> None:
        raw.extend(struct.pack("<HB", len(body), ord(kind)) + body)

    put("B", bytes(40))
    for name, (fields, _) in _ULOG_TOPICS.items():
        put("F", f"{name}:{fields}".encode())
    for number, name in enumerate(_ULOG_TOPICS):
        put("A", struct.pack("<BH", 0, number) + name.encode())

    def row(number: int, *values: object) -> None:
        layout = list(_ULOG_TOPICS.values())[number][1]
        put("D", struct.pack("<H", number) + struct.pack(layout, *values))

    for i, (at_s, lat, lon, north_m_s, east_m_s, heading) in enumerate(told().tolist()):
        at_us = round(at_s * 1e6)
        east_m, north_m = HOME.to_local(lat, lon)
        nose = float(np.radians((heading + 180.0) % 360.0 - 180.0))
        place = (HOME.latitude_deg, HOME.longitude_deg, north_m, east_m, -HEIGHT_M)
        row(0, at_us, *place, north_m_s, east_m_s, 0.0, nose, True)
        if i % 5 == 0:
            row(1, at_us, 3, 2)
            row(2, at_us, round(lat * 1e7), round(lon * 1e7), 6)
    path.write_bytes(raw)
    return path
