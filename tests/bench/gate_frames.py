"""A healthy vehicle as frames, flying eastwards over one long zone; the companion's loop on them.

Beside the loop stand an oracle of its own and a follower of the plans.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import shapely
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.core.controller import Memory, step
from companion.core.estimator import Track, estimate, observe
from companion.core.prescription import Prescription, Zone
from companion.core.safety import Limits
from companion.core.setup import Setup
from companion.core.types import Decision
from companion.link.component import Component, ComponentOptions
from sitl.outputs import PlanFollower
from tests.bench.oracle import Oracle, open_under
from tests.builders import setup

STEP_S = 0.05
SPEED_M_S = 5.0
EASTWARDS_DEG = 90.0


def long_setup(length_m: float = 20_000.0, **limits: Any) -> Setup:
    """Return a set-up with one zone, long enough to fly for an hour."""
    zone = shapely.box(-10.0, -10.0, length_m, 20.0)
    given = {"speed_check_required": True} | limits
    return setup(
        prescription=Prescription([Zone(name="1", polygon=zone, rate_l_ha=20.0)], boundary=zone),
        limits=Limits(**given),
    )


class Vehicle:
    """Says what a healthy ArduCopter in a mission says, each message at its own rate."""

    def __init__(self, given: Setup, *, system_id: int = 1, begin_s: float = 100.0) -> None:
        self._frame = given.frame
        self._begin_s = begin_s
        self.sender = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=1)
        self.station = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)

    def pack(self, message: Any) -> bytes:
        """Return a message of the vehicle as bytes."""
        return bytes(message.pack(self.sender))

    def enable(self, wish: float = 1.0) -> bytes:
        """Return the operator's wish."""
        message = self.station.command_long_encode(
            self.sender.srcSystem, 191, 216, 0, wish, 0, 0, 0, 0, 0, 0
        )
        return bytes(message.pack(self.station))

    def position(self, now_s: float, **change: Any) -> bytes:
        """Return the position; `change` names fields of the message."""
        latitude, longitude = self._frame.to_geographic(SPEED_M_S * (now_s - self._begin_s), 3.0)
        fields = {
            "time_boot_ms": round((now_s - self._begin_s) * 1000) + 5000,
            "lat": round(latitude * 1e7),
            "lon": round(longitude * 1e7),
            "alt": 60_000,
            "relative_alt": 3500,
            "vx": 0,
            "vy": round(SPEED_M_S * 100),
            "vz": 0,
            "hdg": round(EASTWARDS_DEG * 100),
        } | change
        return self.pack(self.sender.global_position_int_encode(**fields))

    def said(self, number: int, now_s: float) -> Iterator[bytes]:
        """Yield what step `number` of 20 a second brings; the position comes last."""
        encode = self.sender
        if number % 20 == 0:
            yield self.pack(encode.heartbeat_encode(2, 3, 128 + 1, 3, 4))
        if number % 10 == 1:
            yield self.pack(encode.ekf_status_report_encode(831, 0.1, 0.1, 0.1, 0.1, 0.0))
            yield self.pack(encode.extended_sys_state_encode(0, 2))
        if number % 4 == 2:
            yield self.pack(encode.gps_raw_int_encode(0, 6, 0, 0, 0, 80, 100, 500, 0, 20))
            yield self.pack(encode.rc_channels_encode(0, 8, *([1900] * 8), *([65535] * 10), 255))
        if number % 2 == 0:
            yield self.pack(encode.vfr_hud_encode(0.0, SPEED_M_S, 90, 40, 60.0, 0.0))
        yield self.position(now_s)


@dataclass(slots=True)
class Loop:
    """Frames to inputs to decisions, as the runtime does it, judged at every step."""

    setup: Setup
    component: Component = field(
        default_factory=lambda: Component(ComponentOptions(), lambda frame: len(frame) > 0)
    )
    oracle: Oracle = field(default_factory=Oracle)
    wrong: list[str] = field(default_factory=list)
    open_count: int = 0
    step_count: int = 0
    track: Track = field(default_factory=Track)
    memory: Memory = field(default_factory=Memory)
    follower: PlanFollower = field(init=False)

    def __post_init__(self) -> None:
        self.follower = PlanFollower(len(self.setup.boom.valves))

    def turn(self, data: bytes, now_s: float) -> Decision:
        """Take bytes and decide."""
        for item in self.component.receive(data, now_s):
            self.oracle.hear(item)
            self.track = observe(self.track, item, self.setup)
        decision, self.memory = step(self.setup, estimate(self.track, now_s), self.memory, now_s)
        self.component.tick(decision, now_s)
        self._judge(decision, now_s)
        return decision

    def _judge(self, decision: Decision, now_s: float) -> None:
        self.follower.submit(decision.plan, now_s=now_s)
        self.follower.orders.clear()
        self.step_count += 1
        self.open_count += any(self.follower.duty)
        problem = open_under(decision, self.oracle)
        if problem is None and decision.inhibits and any(self.follower.duty):
            problem = f"{now_s}: a valve stays open under {sorted(decision.inhibits)}"
        if problem is not None and len(self.wrong) < 20:
            self.wrong.append(problem)
