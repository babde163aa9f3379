"""The parameter protocol's answers, one after the other and slowly enough for a slow wire."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from companion.link.commands import Answer, Desk, rate_override
from companion.link.encode import REAL32, Encoder
from companion.link.messages import ParamAsked, ParamSet
from companion.link.parameters import RATE_PERCENT, TANK_L, VALUES_HZ

# A PARAM_VALUE is 37 bytes: this is 740 bytes a second, an eighth of 57600 baud.
PACE_S = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Values:
    """Places of parameters whose values are to be told at once, and what was said besides."""

    indices: tuple[int, ...] = ()
    answer: Answer | None = None


class ParameterServer:
    """Answers for `desk`; a list that is asked for again begins anew and waits in no queue."""

    def __init__(self, desk: Desk, encoder: Encoder) -> None:
        self._desk = desk
        self._encoder = encoder
        self._next: int | None = None
        self._next_s = float("-inf")

    def ask(self, asked: ParamAsked) -> Values:
        """Take a request; a list is told by `due`."""
        parameters = self._desk.parameters
        if asked.is_all:
            self._next = 0
            return Values()
        index = parameters.index(asked.name) if asked.index < 0 else asked.index
        if index is None or parameters.at(index) is None:
            return Values()
        return Values(indices=(index,))

    def set(self, wanted: ParamSet) -> Values:
        """Take a value or keep the old one; either way the one that holds is told."""
        desk = self._desk
        index = desk.parameters.index(wanted.name)
        if index is None:
            return Values()
        told = (index,)
        if wanted.kind != REAL32:
            text = f"{wanted.name}: type REAL32 only"
            return Values(indices=told, answer=Answer(result=0, text=text))
        if wanted.name == RATE_PERCENT:
            return Values(indices=told, answer=rate_override(desk, wanted.value, wanted.received_s))
        before = desk.parameters.get(wanted.name, 0.0)
        refusal = desk.parameters.set(
            wanted.name, wanted.value, is_frozen=desk.is_armed or desk.is_open
        )
        if refusal is not None:
            return Values(indices=told, answer=Answer(result=0, text=f"{wanted.name}: {refusal}"))
        after = desk.parameters.get(wanted.name, 0.0)
        if after == before:
            return Values(indices=told)
        take_over(desk)
        when = ", at next start" if wanted.name not in (VALUES_HZ, TANK_L) else ""
        text = f"{wanted.name} {after:g}{when}"
        return Values(indices=told, answer=Answer(result=0, text=text, event=text))

    def due(self, now_s: float) -> Iterator[bytes]:
        """Yield the next value of a list, if it is its turn."""
        if self._next is None or now_s < self._next_s:
            return
        self._next_s = now_s + PACE_S
        frame = self.value(self._next)
        self._next += 1
        if self._next >= len(self._desk.parameters):
            self._next = None
        if frame is not None:
            yield frame

    def value(self, index: int) -> bytes | None:
        """Return PARAM_VALUE of the parameter at `index`; None where there is none."""
        found = self._desk.parameters.at(index)
        if found is None:
            return None
        name, value = found
        return self._encoder.param_value(name, value, len(self._desk.parameters), index)


def take_over(desk: Desk) -> None:
    """Have the parameters that act at once act."""
    desk.values_hz = desk.parameters.get(VALUES_HZ, 1.0)
    desk.tank.capacity_l = desk.parameters.get(TANK_L, 0.0) or None
