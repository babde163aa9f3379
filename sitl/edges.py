"""What reaches a valve: electrical edges, from whatever makes them."""

from __future__ import annotations

from typing import NamedTuple, Protocol


class Edge(Protocol):
    """One valve is to be open or closed from `at_s`; `duty` is the one in force.

    An edge that repeats the state of its valve tells of a new duty: an open valve that stays open,
    or one that rests in its gap and is now closed for good (`duty` 0).
    """

    @property
    def at_s(self) -> float: ...  # noqa: D102
    @property
    def valve(self) -> int: ...  # noqa: D102
    @property
    def is_open(self) -> bool: ...  # noqa: D102
    @property
    def duty(self) -> float: ...  # noqa: D102


class BoardEdge(NamedTuple):
    """An edge that the driver board makes."""

    at_s: float
    valve: int
    is_open: bool
    duty: float
