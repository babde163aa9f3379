"""Long searches: they tell how far they are, and end early with the best that they have found.

Who looks on is known to the context alone: the search stays a function of its input, and without
anyone looking on it runs to its end.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

# Steps are told and looked up so many times in a search.
TOLD = 200


@dataclass(slots=True, kw_only=True)
class Watch:
    """Who looks on: `tell` is given what is done, how many steps of it, and of how many.

    From `has_lines` on a search that is `stopped` still leads to a plan.
    """

    tell: Callable[[str, int, int], None] = lambda _what, _done, _total: None
    has_lines: bool = False
    stopped: bool = False


_WATCH: ContextVar[Watch | None] = ContextVar("watch", default=None)


@contextmanager
def watched(watch: Watch) -> Iterator[None]:
    """Have someone look on at all searches meanwhile."""
    token = _WATCH.set(watch)
    try:
        yield
    finally:
        _WATCH.reset(token)


def lines_are_drawn() -> None:
    """Note that any search may be stopped from now on."""
    watch = _WATCH.get()
    if watch is not None:
        watch.has_lines = True


def is_stopped() -> bool:
    """Return whether a search that has found something is to end with it."""
    watch = _WATCH.get()
    return watch is not None and watch.stopped


def steps(what: str, count: int) -> Iterator[int]:
    """Yield the steps of a search, until it is stopped.

    >>> watch = Watch(tell=lambda what, done, total: print(what, done, total))
    >>> with watched(watch):
    ...     for step in steps("sorties", 3):
    ...         watch.stopped = step == 1
    sorties 0 3
    sorties 1 3
    sorties 2 3
    """
    watch = _WATCH.get()
    if watch is None:
        yield from range(count)
        return
    every = max(count // TOLD, 1)
    for number in range(count):
        if number % every == 0:
            watch.tell(what, number, count)
            if watch.stopped:
                return
        yield number


def below(draw: random.Random, limit: int) -> int:
    """Return a whole number below a limit as `randrange` does, in half of its time.

    >>> below(random.Random(7), 10) == random.Random(7).randrange(10)
    True
    """
    wide = limit.bit_length()
    found = draw.getrandbits(wide)
    while found >= limit:
        found = draw.getrandbits(wide)
    return found
