"""What is done to whom: the kinds of fault, the ways to the valves, and a campaign of them.

Limits are the requirement's: from the message of a fault that is told, from the moment at which
another one can be seen, from the death or stop of a process, or of its only way to the valves.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Literal

import numpy as np

TOLD_S, SEEN_S = 0.15, 0.1
# So many flights come to the border while they are watched.
LEAVES_SHARE = 0.5
GPIO_DEAD_S, SERVO_DEAD_S = 0.35, 0.45
# A process that goes on after a stop: between these, and both sides of a withdrawn consent (2 s).
STANDS_MIN_S, STANDS_MAX_S = 1.0, 8.0

Output = Literal["gpio", "script", "dither"]
LinkKind = Literal["udp", "tcp", "pty"]


class Kind(StrEnum):
    """Everything that is done to a flight."""

    KILL_COMPANION = "SIGKILL companion"
    KILL_ENGINE = "SIGKILL engine"
    KILL_BOTH = "SIGKILL both"
    STOP_COMPANION = "SIGSTOP companion"
    STOP_ENGINE = "SIGSTOP engine"
    STOP_BOTH = "SIGSTOP both"
    CONT_COMPANION = "SIGSTOP, SIGCONT companion"
    CONT_ENGINE = "SIGSTOP, SIGCONT engine"
    CONT_BOTH = "SIGSTOP, SIGCONT both"
    TERM_COMPANION = "SIGTERM companion"
    TERM_ENGINE = "SIGTERM engine"
    TERM_BOTH = "SIGTERM both"
    DISABLED = "STOP of the operator"
    DISARMED = "disarmed"
    MODE = "mode left"
    LANDING = "landing"
    ABSENT = "positions absent"
    FROZEN = "positions frozen, no velocity"
    STUCK = "positions frozen, velocity goes on"
    STALE = "positions 1.2 s old"
    JUMP = "positions jump"
    ZERO = "positions 0, 0"
    NO_HEARTBEAT = "heartbeats absent"
    SILENCE = "vehicle silent"
    REBOOT = "autopilot reboots"
    DISK_FULL = "disk full"
    LINK_TCP = "TCP connection closed"
    LINK_PTY = "serial device gone"
    CHIP_GONE = "GPIO chip gone"


PROCESS_KINDS = frozenset(kind for kind in Kind if kind.value.startswith("SIG"))
ENGINE_KINDS = frozenset(k for k in PROCESS_KINDS if not k.value.endswith("companion"))
CONT_KINDS = frozenset({Kind.CONT_COMPANION, Kind.CONT_ENGINE, Kind.CONT_BOTH})
LOST_KINDS = frozenset({Kind.LINK_TCP, Kind.LINK_PTY, Kind.CHIP_GONE})
_GPIO_ONLY = ENGINE_KINDS | {Kind.CHIP_GONE}
# A flight that is told or shown something does not depend on what watches a dead companion.
_DITHER = frozenset(
    {
        Kind.KILL_COMPANION,
        Kind.STOP_COMPANION,
        Kind.CONT_COMPANION,
        Kind.TERM_COMPANION,
        Kind.LINK_TCP,
        Kind.LINK_PTY,
    }
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One kind of flight: what happens, with which outputs, over which link."""

    kind: Kind
    output: Output

    @property
    def link(self) -> LinkKind:
        """Return how companion and vehicle speak."""
        links: dict[Kind, LinkKind] = {Kind.LINK_TCP: "tcp", Kind.LINK_PTY: "pty"}
        return links.get(self.kind, "udp")

    @property
    def dead_s(self) -> float:
        """Return within which time outputs close when nobody is there to close them."""
        return GPIO_DEAD_S if self.output == "gpio" else SERVO_DEAD_S

    @property
    def limit_s(self) -> float:
        """Return within which time of its cause everything has to be closed."""
        if self.kind in PROCESS_KINDS or self.kind is Kind.CHIP_GONE:
            return self.dead_s
        if self.kind in LOST_KINDS:
            # What can still be ordered is told by the kernel; with servo outputs nothing can.
            return TOLD_S if self.output == "gpio" else SERVO_DEAD_S
        told = (Kind.DISABLED, Kind.DISARMED, Kind.MODE, Kind.LANDING, Kind.DISK_FULL)
        return TOLD_S if self.kind in told else SEEN_S

    @property
    def watched_s(self) -> float:
        """Return for how long the flight is watched after the fault, or after its end."""
        if self.kind in CONT_KINDS:
            return 3.5
        return {
            Kind.NO_HEARTBEAT: 2.9,
            Kind.SILENCE: 1.3,
            Kind.ABSENT: 1.3,
            Kind.STALE: 1.9,
            Kind.REBOOT: 2.6,
            Kind.DISK_FULL: 2.4,
        }.get(self.kind, 0.9)


@dataclass(frozen=True, slots=True, kw_only=True)
class Draw:
    """What chance decides in one flight.

    `after_s` is how long it has been over the field when the fault comes, `leaves_s` when after
    the fault it leaves it (None: not while it is watched), `apart_s` is between two signals,
    `engine_first` which of two processes gets it first; the shares are for whatever else there is.
    """

    number: int
    seed: int
    case: Case
    after_s: float
    apart_s: float
    engine_first: bool
    leaves_s: float | None
    share: float
    second_share: float

    @property
    def stands_s(self) -> float:
        """Return how long a stopped process stands before it goes on; 0 for other faults."""
        if self.case.kind not in CONT_KINDS:
            return 0.0
        # Evenly on a scale of ratios: half of them are short enough to spray on by themselves.
        return STANDS_MIN_S * (STANDS_MAX_S / STANDS_MIN_S) ** self.share

    @property
    def watched_s(self) -> float:
        """Return for how long the flight is watched after the fault."""
        return self.stands_s + self.case.watched_s

    def field_m(self, speed_m_s: float) -> float:
        """Return how long the field is, along the pass."""
        leaves_s = self.watched_s + 0.5 if self.leaves_s is None else self.leaves_s
        return speed_m_s * (self.after_s + leaves_s)


def cases() -> list[Case]:
    """Return every kind with every output that it can happen to."""
    found = [Case(kind=kind, output="gpio") for kind in Kind]
    found += [Case(kind=kind, output="script") for kind in Kind if kind not in _GPIO_ONLY]
    return found + [Case(kind=kind, output="dither") for kind in Kind if kind in _DITHER]


def campaign(flights: int, seed: int, *, only: str = "") -> Iterator[Draw]:
    """Yield the flights: signals as often as all else together, each kind as often as another.

    Every kind comes before one comes again; the order within a round is drawn.
    """
    rng = np.random.default_rng((seed, 7))
    wanted = [case for case in cases() if only.lower() in f"{case.kind} {case.output}".lower()]
    if not wanted:
        return
    queue: list[Case] = []
    for number in range(flights):
        if not queue:
            signals = [case for case in wanted if case.kind in PROCESS_KINDS]
            often = signals if len(signals) < len(wanted) else []
            queue = [*wanted, *often]
            rng.shuffle(queue)
        case = queue.pop()
        leaves = rng.random() < LEAVES_SHARE and case.kind is not Kind.DISK_FULL
        leaves_s = float(rng.uniform(0.1, case.watched_s))
        draw = Draw(
            number=number,
            seed=int(rng.integers(1, 2**31)),
            case=case,
            after_s=float(rng.uniform(0.2, 1.3)),
            apart_s=float(rng.uniform(0.0, 0.02)),
            engine_first=bool(rng.random() < 0.5),
            leaves_s=leaves_s if leaves else None,
            share=float(rng.random()),
            second_share=float(rng.random()),
        )
        if draw.leaves_s is not None:
            # Anywhere in the time of a standstill and after it.
            scale = draw.watched_s / case.watched_s
            draw = replace(draw, leaves_s=draw.leaves_s * scale)
        yield draw
