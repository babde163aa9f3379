"""What passes between companion and engine: one packet a message, checked as a whole.

A packet is a head (magic, version, kind, length and checksum of the body) and a body. The socket
keeps packets apart; the length tells one that was cut. What does not decode is refused whole.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterable
from enum import IntEnum
from typing import NamedTuple

from companion.core.types import SprayPlan, TimedChange

MAGIC, VERSION = 0x5652, 1
_HEAD = struct.Struct("<HBBII")
_PLAN = struct.Struct("<qddHH")
_CHANGE = struct.Struct("<ddHH")
_EDGE = struct.Struct("<ddfBB")
_STATUS = struct.Struct("<dq9IB")

# A field of small cells orders some hundred changes a second for 24 valves.
CHANGES_MAX = 4096
PACKET_MAX = 100_000
# As many edges as one packet of reports carries.
EDGES_MAX = 256


class Kind(IntEnum):
    """What a packet is."""

    SETUP = 1
    PLAN = 2
    STOP = 3
    READY = 16
    STATUS = 17
    EDGES = 18
    FAULT = 19


class RefusedError(ValueError):
    """A packet that is not to be acted on."""


class Issued(NamedTuple):
    """An edge that was written to its line: when it was to be, and when it was."""

    planned_s: float
    actual_s: float
    output: int
    is_open: bool
    duty: float


class Status(NamedTuple):
    """How the engine is, some twenty times a second: its sign of life."""

    at_s: float = 0.0
    sequence: int = -1
    accepted: int = 0
    rejected: int = 0
    edges: int = 0
    dropped_reports: int = 0
    lease_ends: int = 0
    stops: int = 0
    writes: int = 0
    late: int = 0
    worst_late_us: int = 0
    is_alive: bool = False


def pack(kind: Kind, body: bytes = b"") -> bytes:
    """Return a packet."""
    return _HEAD.pack(MAGIC, VERSION, kind, len(body), zlib.crc32(body)) + body


def unpack(packet: bytes) -> tuple[Kind, bytes]:
    """Return kind and body; RefusedError for what is no whole packet.

    >>> unpack(pack(Kind.STOP, b"x"))
    (<Kind.STOP: 3>, b'x')
    """
    if not _HEAD.size <= len(packet) <= PACKET_MAX:
        raise RefusedError(f"a packet of {len(packet)} bytes")
    magic, version, kind, length, checksum = _HEAD.unpack_from(packet)
    body = packet[_HEAD.size :]
    if (magic, version, length) != (MAGIC, VERSION, len(body)) or checksum != zlib.crc32(body):
        raise RefusedError("a packet that is not ours, or not whole")
    try:
        return Kind(kind), body
    except ValueError as error:
        raise RefusedError(f"a packet of kind {kind}") from error


def pack_plan(plan: SprayPlan) -> bytes:
    """Return the packet of a plan."""
    if not len(plan.changes) <= CHANGES_MAX:
        raise RefusedError(f"{len(plan.changes)} changes, at most {CHANGES_MAX}")
    head = _PLAN.pack(
        plan.sequence, plan.issued_s, plan.lease_until_s, len(plan.duty), len(plan.changes)
    )
    changes = [
        _CHANGE.pack(change.at_s, change.duty, change.valve, change.restart)
        for change in plan.changes
    ]
    return pack(
        Kind.PLAN, head + struct.pack(f"<{len(plan.duty)}d", *plan.duty) + b"".join(changes)
    )


def plan_from(body: bytes) -> SprayPlan:
    """Return the plan of a packet; what the plan itself checks (NaN, order, range) is checked."""
    try:
        sequence, issued_s, lease_s, valves, changes = _PLAN.unpack_from(body)
        if not changes <= CHANGES_MAX:
            raise RefusedError(f"{changes} changes, at most {CHANGES_MAX}")
        if not math.isfinite(issued_s):
            raise RefusedError(f"a plan made at {issued_s}")
        first = _PLAN.size + 8 * valves
        if len(body) != first + changes * _CHANGE.size:
            raise RefusedError("a plan of the wrong length")
        return SprayPlan(
            sequence=sequence,
            issued_s=issued_s,
            duty=struct.unpack_from(f"<{valves}d", body, _PLAN.size),
            changes=tuple(
                TimedChange(at_s=at_s, valve=valve, duty=duty, restart=restart != 0)
                for at_s, duty, valve, restart in _CHANGE.iter_unpack(body[first:])
            ),
            lease_until_s=lease_s,
        )
    except (struct.error, ValueError) as error:
        raise RefusedError(str(error)) from error


def pack_edges(edges: Iterable[tuple[float, float, int, bool, float]]) -> bytes:
    """Return the packet of some edges, at most `EDGES_MAX`; each has what `Issued` has."""
    parts = [
        _EDGE.pack(planned_s, actual_s, duty, output, is_open)
        for planned_s, actual_s, output, is_open, duty in edges
    ]
    return pack(Kind.EDGES, b"".join(parts))


def edges_from(body: bytes) -> list[Issued]:
    """Return the edges of a packet; duties come back in single precision, rounded to 1e-6."""
    try:
        return [
            Issued(planned_s, actual_s, output, is_open != 0, round(duty, 6))
            for planned_s, actual_s, duty, output, is_open in _EDGE.iter_unpack(body)
        ]
    except struct.error as error:
        raise RefusedError(str(error)) from error


def pack_status(status: Status) -> bytes:
    """Return the packet of a status."""
    return pack(Kind.STATUS, _STATUS.pack(*status))


def status_from(body: bytes) -> Status:
    """Return the status of a packet."""
    try:
        status = Status(*_STATUS.unpack(body))
    except struct.error as error:
        raise RefusedError(str(error)) from error
    return status._replace(is_alive=status.is_alive != 0)
