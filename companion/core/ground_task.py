"""Pieces of ground work as a course of duties over time: prime, flush, rinse, catch, click.

A piece is at most `PIECE_MAX_S` long: what takes longer is done in several, each begun anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise

from companion.core.nozzle import NozzleSet
from companion.core.schedule import LagModel

PIECE_MAX_S = 30.0
# Long enough to be heard and felt, and for the slowest valve to open; twice, to be sure of it.
CLICK_S = 0.2
CLICK_TIMES = 2


class GroundKind(StrEnum):
    """What is done on the ground with valves open."""

    PRIME = "prime"  # fill the lines: all valves, fully open
    FLUSH = "flush"  # push out what is in the lines
    RINSE = "rinse"  # the same with so much clean water
    CATCH = "catch"  # an exact time at one duty, over cups
    CLICK = "click"  # dry: each valve in turn, to be heard


@dataclass(frozen=True, slots=True, kw_only=True)
class Phase:
    """From `at_s` of the work on, each valve has its duty."""

    at_s: float
    duty: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundTask:
    """One piece of ground work; `is_whole` where an interruption makes it worthless.

    `drives` are what pump and atomisers do meanwhile, as in a plan.
    """

    kind: GroundKind
    phases: tuple[Phase, ...]
    seconds: float
    is_whole: bool = False
    drives: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not 0.0 < self.seconds <= PIECE_MAX_S:
            raise ValueError(f"takes {self.seconds:.3g} s; one piece lasts {PIECE_MAX_S:g} s")
        times = [phase.at_s for phase in self.phases]
        rising = all(a < b for a, b in pairwise(times))
        if not times or times[0] != 0.0 or not rising or not times[-1] < self.seconds:
            raise ValueError(f"phases must rise from 0 to below {self.seconds}, got {times}")
        counts = {len(phase.duty) for phase in self.phases}
        if len(counts) != 1 or counts == {0}:
            raise ValueError("every phase needs one duty for each valve")
        if not all(0.0 <= duty <= 1.0 for phase in self.phases for duty in phase.duty):
            raise ValueError("duties must lie in [0, 1]")
        if not all(0.0 <= fraction <= 1.0 for fraction in self.drives):
            raise ValueError("drives must lie in [0, 1]")

    @property
    def valve_count(self) -> int:
        """Return how many valves the sprayer has."""
        return len(self.phases[0].duty)


def _duties(count: int, valves: Sequence[int], duty: float) -> tuple[float, ...]:
    return tuple(duty if valve in valves else 0.0 for valve in range(count))


def together(
    kind: GroundKind, count: int, valves: Sequence[int], *, duty: float, seconds: float
) -> GroundTask:
    """Return the work that has some of `count` valves open at the same time."""
    return GroundTask(
        kind=kind,
        phases=(Phase(at_s=0.0, duty=_duties(count, valves, duty)),),
        seconds=seconds,
        is_whole=kind is GroundKind.CATCH,
    )


def in_turn(
    kind: GroundKind, count: int, valves: Sequence[int], *, duty: float, seconds: float
) -> GroundTask:
    """Return the work that has one valve open after the other, all for the same time.

    >>> task = in_turn(GroundKind.FLUSH, 3, (0, 2), duty=1.0, seconds=8.0)
    >>> [(phase.at_s, phase.duty) for phase in task.phases]
    [(0.0, (1.0, 0.0, 0.0)), (4.0, (0.0, 0.0, 1.0))]
    """
    each_s = seconds / max(len(valves), 1)
    phases = tuple(
        Phase(at_s=number * each_s, duty=_duties(count, (valve,), duty))
        for number, valve in enumerate(valves)
    )
    return GroundTask(kind=kind, phases=phases, seconds=seconds)


def clicks(count: int, valves: Sequence[int]) -> GroundTask:
    """Return the dry click: each valve in turn opens twice for a fifth of a second.

    >>> round(clicks(6, range(6)).seconds, 9)
    4.8
    """
    closed = (0.0,) * count
    phases = []
    for number, valve in enumerate(v for v in valves for _ in range(CLICK_TIMES)):
        phases.append(Phase(at_s=2 * number * CLICK_S, duty=_duties(count, (valve,), 1.0)))
        phases.append(Phase(at_s=(2 * number + 1) * CLICK_S, duty=closed))
    seconds = 2 * CLICK_TIMES * len(valves) * CLICK_S
    return GroundTask(kind=GroundKind.CLICK, phases=tuple(phases), seconds=seconds)


def flow_of(sets: Sequence[NozzleSet], valves: Sequence[int], duty: float) -> float:
    """Return what the measured curves say of these valves at one duty [L/min].

    By the set of just these valves, else by their share of the smallest set that has them all, else
    of the largest one.
    """
    wanted = frozenset(valves)
    if not wanted or not sets:
        return 0.0
    holding = [nozzles for nozzles in sets if wanted <= frozenset(nozzles.valves)]
    nozzles = min(holding or [sets[-1]], key=lambda each: len(each.valves))
    return nozzles.curve.flow_for(duty) * len(wanted) / len(nozzles.valves)


def expected_ml(flow_l_min: float, *, open_s: float, lag: LagModel) -> float:
    """Return what falls into the cups: the flow begins `on_s` late and ends `off_s` late."""
    flowing_s = max(open_s - lag.on_s + lag.off_s, 0.0) if open_s > 0.0 else 0.0
    return flow_l_min * flowing_s / 60.0 * 1000.0
