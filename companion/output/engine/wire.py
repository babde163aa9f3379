"""What passes between companion and engine: its set-up first, then one packet a message.

A packet is a head (magic, version, kind, length and checksum of the body) and a body. The socket
keeps packets apart; the length tells one that was cut. What does not decode is refused whole.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from enum import IntEnum
from typing import Any, Literal, NamedTuple, get_args

from companion.core.types import PwmLimits, SprayPlan, TimedChange

# --------------------------------------------------------------------------------------- the set-up

# What hangs on the lines: which level opens, which one is safe, what remains without a program.
#
# Outputs are numbered: the valves from the left, the return valve behind them if there is one, the
# ALIVE line last if there is one. Their levels travel as the bits of one integer.

# Lines that one request of the kernel's GPIO interface can hold, and outputs of 8 registers.
OUTPUTS_MAX = 64


@dataclass(frozen=True, slots=True, kw_only=True)
class Wiring:
    """Lines (or register outputs), kinds of valve, and the drivers' polarity.

    A coil that draws current opens a normally closed valve and shuts a normally open one. With
    `active_low` a driver sends current while its line is low.
    """

    valves: tuple[int, ...]
    return_line: int | None = None
    alive_line: int | None = None
    normally_open: bool = False
    return_normally_open: bool = True
    active_low: bool = False

    def __post_init__(self) -> None:
        if not self.valves or len(set(self.lines)) != len(self.lines):
            raise ValueError(f"each output needs a line of its own, got {self.lines}")
        if not len(self.lines) <= OUTPUTS_MAX:
            raise ValueError(f"at most {OUTPUTS_MAX} outputs, got {len(self.lines)}")
        if not all(0 <= line <= 1023 for line in self.lines):
            raise ValueError(f"lines are 0 to 1023, got {self.lines}")

    @property
    def lines(self) -> tuple[int, ...]:
        """Return the line of each output, by its number."""
        more = (self.return_line, self.alive_line)
        return self.valves + tuple(line for line in more if line is not None)

    @property
    def has_return(self) -> bool:
        """Return whether there is a return valve."""
        return self.return_line is not None

    @property
    def alive(self) -> int | None:
        """Return the number of the ALIVE output."""
        return None if self.alive_line is None else len(self.lines) - 1

    def level(self, output: int, *, is_open: bool) -> bool:
        """Return the level that opens or shuts the valve at an output.

        >>> Wiring(valves=(17,)).level(0, is_open=True)
        True
        >>> Wiring(valves=(17,), normally_open=True).level(0, is_open=True)
        False
        """
        opens_idle = self.normally_open if output < len(self.valves) else self.return_normally_open
        has_current = is_open != opens_idle
        return has_current != self.active_low

    @property
    def safe_levels(self) -> int:
        """Return the levels of the safe state: valves shut, return open, ALIVE low.

        >>> bin(Wiring(valves=(17, 18), normally_open=True).safe_levels)
        '0b11'
        """
        levels = 0
        for output in range(len(self.valves) + self.has_return):
            levels |= self.level(output, is_open=output >= len(self.valves)) << output
        return levels


def hazards(wiring: Wiring, *, keeps_levels: bool | None) -> list[str]:
    """Return what happens to these valves when the program dies or the power fails.

    `keeps_levels` is whether this kernel leaves a released line at its last level (Raspberry Pi's
    without `strict_gpiod`); None where the driver does not say.
    """
    found = []
    if wiring.normally_open:
        found.append(
            "normally open valves spray when their power fails: only the pump's cut-off stops them"
        )
        if keeps_levels is False:
            found.append(
                "lines become inputs when the engine ends, so normally open valves open: remove "
                "strict_gpiod from config.txt"
            )
    elif keeps_levels:
        found.append(
            "a killed engine leaves its valves as they were: add dtparam=strict_gpiod to config.txt"
        )
    if wiring.alive_line is None:
        found.append("no ALIVE line: a stopped computer leaves its valves as they were")
    return found


Backend = Literal["gpiod", "spi595", "memory", "file"]

# A lease that reaches farther is a mistake of clocks: the configuration allows 2 s.
LEASE_MAX_S = 2.5
# Wake-ups later than this at the 99th percentile: 30 mm at 6 m/s.
WAKE_LATE_MAX_S = 0.005


@dataclass(frozen=True, slots=True, kw_only=True)
class EngineSetup:
    """Wiring, limits of the valves, the device, and what of the system to ask for.

    `device` is a chip's name, path or label, the file of an SPI device, or a file of levels.
    `overrun_s` is how much longer a valve delivers than its pulse lasts, where it is known.
    `wake_late_max_s` is what the self-test allows; None is `WAKE_LATE_MAX_S` for real outputs, and
    no limit for those in memory or a file, which move nothing.
    """

    wiring: Wiring
    pwm: PwmLimits
    backend: Backend = "gpiod"
    device: str = "gpiochip0"
    overrun_s: float = 0.0
    lease_max_s: float = LEASE_MAX_S
    realtime: bool = True
    spi_hz: int = 1_000_000
    wake_late_max_s: float | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.overrun_s <= self.pwm.min_off_s:
            raise ValueError(f"overrun_s must lie in [0, min_off_s], got {self.overrun_s}")
        if not 0.0 < self.lease_max_s <= 10.0:
            raise ValueError(f"lease_max_s must lie in (0, 10], got {self.lease_max_s}")
        if not 10_000 <= self.spi_hz <= 20_000_000:
            raise ValueError(f"spi_hz must lie in [10000, 20000000], got {self.spi_hz}")
        if self.wake_late_max_s is not None and not self.wake_late_max_s >= 0.0:
            raise ValueError(f"wake_late_max_s must be at least 0, got {self.wake_late_max_s}")
        if self.backend not in get_args(Backend):
            raise ValueError(f"no such lines: {self.backend}")

    @property
    def late_max_s(self) -> float:
        """Return how late wake-ups may be, at the 99th percentile, for the self-test to pass."""
        if self.wake_late_max_s is not None:
            return self.wake_late_max_s
        return WAKE_LATE_MAX_S if self.backend in ("gpiod", "spi595") else math.inf

    def as_bytes(self) -> bytes:
        """Return the set-up as text of JSON."""
        return json.dumps(asdict(self)).encode()

    @classmethod
    def from_bytes(cls, data: bytes) -> EngineSetup:
        """Return the set-up of `as_bytes`; ValueError or TypeError for anything else."""
        found: dict[str, Any] = json.loads(data)
        wiring, pwm = dict(found.pop("wiring")), found.pop("pwm")
        wiring["valves"] = tuple(wiring["valves"])
        return cls(wiring=Wiring(**wiring), pwm=PwmLimits(**pwm), **found)


# ------------------------------------------------------------------------------------------ packets

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
