"""What is known of a flight when it is over: all that the judge looks at, and nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from tests.bench.faults.cases import Draw
from tests.bench.faults.place import Pass
from tests.bench.faults.wire import Sent


class Opening(NamedTuple):
    """A valve, or what stands for it, was open from when to when, with how much of its flow.

    `is_ordered` says that the one whose affair it is has closed it: the engine by an edge, the
    companion by an order. Otherwise something else did.
    """

    valve: int
    from_s: float
    to_s: float
    share: float = 1.0
    is_ordered: bool = True


class Struck(NamedTuple):
    """What was done: a signal was sent, or the only way to the valves was taken away."""

    at_s: float
    what: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """A flight: what was sent and done, what the outputs did, how the companion ended.

    `openings` are what counts for the time of closing, the ALIVE monostable and boards included;
    `own` are what engine or companion did without them. `late_s` is how late the vehicle itself
    was at worst from the fault on, and `waited_s` how long the companion's loop waited for a core
    in all: they say how busy the computer was.
    """

    draw: Draw
    path: Pass
    enabled_s: float
    fault_s: float
    until_s: float
    sent: Sequence[Sent]
    struck: Sequence[Struck]
    openings: Sequence[Opening]
    own: Sequence[Opening]
    late_s: float
    waited_s: float
    exit_code: int | None
    ended_s: float | None
    lost_rows: int
    errors: str
    engine_left: bool = False
