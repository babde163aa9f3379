"""Replay: feed the recorded inputs to the core again and compare every decision.

The core is a function of set-up, inputs and times, and the journal has all three; so the same
program must decide the same, to the last bit. A difference means that the core has changed, that
rows are missing, or, with overrides, what would have been decided otherwise. What that would have
put on the ground is in `what_if.py`; whether the same ground is treated, `replayed_ground.py` says.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from analysis.flown.read_applied import read_applied
from analysis.overrides import override
from analysis.replayed_ground import ReplayedGround
from analysis.what_if import Moved, Orders, Sprayed, compared
from companion.core.controller import Memory, step
from companion.core.estimator import Track, estimate, observe
from companion.core.setup import Setup
from companion.core.types import Decision, Input
from companion.errors import UnreadableError
from companion.record.codec import FIELD_NAMES, FieldNames, encode
from companion.record.coverage_table import read_coverage
from companion.record.new_file import computing
from companion.record.reader import Entry, JournalContent, opened, read_journal

SAY_EVERY = 5000


class Core(Protocol):
    """What is replayed: it observes inputs and decides at given times."""

    def observe(self, item: Input) -> None:
        """Take in one input."""

    def decide(self, now_s: float) -> Decision:
        """Return the decision of `now_s`."""


class FlownCore:
    """The core as `vrspray run` drives it."""

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._track = Track()
        self._memory = Memory()
        self.ground = ReplayedGround(setup)

    def observe(self, item: Input) -> None:
        """Take in one input."""
        self._track = observe(self._track, item, self._setup)

    def decide(self, now_s: float) -> Decision:
        """Return the decision of `now_s`."""
        state = estimate(self._track, now_s)
        decision, self._memory = step(self._setup, state, self._memory, now_s)
        self.ground.take(self._memory, state, now_s)
        return decision


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayResult:
    """How many decisions were made again, and how many came out differently.

    `coverage_differs` is how many cells of treated ground did; None where they are not compared: a
    what-if, or a journal that keeps none. `unread` says in a line each what of it is damaged.
    `elsewhere` says what flew where that is another computer, Python or version than here.
    """

    inputs: int
    decisions: int
    differences: int
    first_difference: str | None
    lost: int
    is_closed: bool
    is_what_if: bool
    training: str | None = None
    recorded: Sprayed | None = None
    what_if: Sprayed | None = None
    moved_m: Moved | None = None
    coverage_differs: int | None = None
    unread: tuple[str, ...] = ()
    elsewhere: tuple[str, ...] = ()


def replay(
    path: Path,
    *,
    overrides: Sequence[str] = (),
    core: Callable[[Setup], Core] = FlownCore,
    say: Callable[[str], None] = lambda _: None,
) -> ReplayResult:
    """Return what the core decides today on the inputs of `path`.

    `overrides` ("lag.on_s=0.12") change the set-up first: a what-if, whose result is what would
    have been sprayed. JournalError for a file that cannot be used, ConfigError for a wrong
    override.
    """
    content = _content(path)
    unread = list(content.unread)
    flown = core(override(content.setup, overrides))
    ways = (Orders(), Orders()) if overrides else None
    inputs = decisions = differences = 0
    first: str | None = None
    for entry in content.entries:
        if not entry.is_decision:
            item = _value(content, entry, unread)
            if item is not None and not isinstance(item, Decision):
                flown.observe(item)
            inputs += 1
            continue
        decisions += 1
        if not decisions % SAY_EVERY:
            say(f"{decisions} decisions, {differences} different")
        recorded, decided = _both(_value(content, entry, unread), flown)
        if ways is not None and recorded is not None and decided is not None:
            ways[0].take(recorded)
            ways[1].take(decided)
        difference = _difference(content, entry, decided)
        if difference is not None:
            differences += 1
            first = first or f"decision {decisions}: {difference}"
    what_if = None if ways is None or unread else compared(read_applied(path), *ways)
    apart = None
    if isinstance(flown, FlownCore) and not overrides:
        apart = _coverage_differs(content, flown.ground, unread)
    return ReplayResult(
        inputs=inputs,
        decisions=decisions,
        differences=differences,
        first_difference=first,
        lost=content.lost,
        is_closed=content.is_closed,
        is_what_if=bool(overrides),
        training=content.training,
        recorded=None if what_if is None else what_if.recorded,
        what_if=None if what_if is None else what_if.what_if,
        moved_m=None if what_if is None else what_if.moved_m,
        coverage_differs=apart,
        unread=tuple(unread),
        elsewhere=tuple(_elsewhere(content.meta)),
    )


def _elsewhere(meta: Mapping[str, str]) -> Iterator[str]:
    """Yield what flew, and what replays in its place."""
    for name, here in computing().items():
        flew = meta.get(name)
        if flew is not None and flew != here:
            yield f"{name.removeprefix('version_')} {flew} (here {here})"


def _content(path: Path) -> JournalContent:
    """Return the journal; of a damaged one what can be read."""
    try:
        return read_journal(path)
    except UnreadableError:
        return read_journal(path, is_lenient=True)


def _value(content: JournalContent, entry: Entry, unread: list[str]) -> Input | Decision | None:
    """Return what a row says; None where it is damaged in a file that is known to be."""
    try:
        return content.value(entry)
    except UnreadableError as error:
        if not content.unread:
            raise
        unread.append(str(error).removeprefix(f"{content.path}: "))
        return None


def _coverage_differs(
    content: JournalContent, ground: ReplayedGround, unread: list[str]
) -> int | None:
    """Return how many cells of treated ground differ from those in the journal."""
    with opened(content.path, is_lenient=True) as journal:
        kept = read_coverage(journal.connection, unread=unread)
    return None if kept is None else ground.differing(kept, is_closed=content.is_closed)


def _both(recorded: Input | Decision | None, core: Core) -> tuple[Decision | None, Decision | None]:
    """Return the recorded decision and the one made now."""
    if not isinstance(recorded, Decision):
        return None, None
    return recorded, core.decide(recorded.now_s)


def _difference(content: JournalContent, entry: Entry, decided: Decision | None) -> str | None:
    """Return where the decision made now differs from the recorded one; None where it does not."""
    if decided is None:
        return "is no decision"
    text = encode(decided)
    if text == entry.body:
        return None
    was = _named(json.loads(entry.body), content.field_names)
    found = first_difference(was, _named(json.loads(text), FIELD_NAMES))
    return None if found is None else f"at {decided.now_s!r} s, {found}"


def _named(plain: Any, names: FieldNames) -> Any:
    """Return the journal's plain form with the names of the fields in it."""
    if isinstance(plain, list):
        return [_named(item, names) for item in plain]
    if not isinstance(plain, dict):
        return plain
    ((kind, content),) = plain.items()
    if kind in names:
        return dict(zip(names[kind], (_named(item, names) for item in content), strict=True))
    return _named(content, names)


def first_difference(was: Any, now: Any, path: str = "") -> str | None:
    """Return the first place where two plain values differ; NaN equals NaN, 0.0 is not -0.0.

    A field that only one of them has is a difference of versions, not of decisions.

    >>> first_difference({"a": [1.0, 2.0]}, {"a": [1.0, 2.5]})
    'a[1] was 2.0, is 2.5'
    """
    if isinstance(was, dict) and isinstance(now, dict):
        pairs = [(was[key], now[key], f"{path}.{key}".strip(".")) for key in was if key in now]
    elif isinstance(was, list) and isinstance(now, list) and len(was) == len(now):
        pairs = [(a, b, f"{path}[{i}]") for i, (a, b) in enumerate(zip(was, now, strict=True))]
    else:
        return None if _same(was, now) else f"{path} was {_short(was)}, is {_short(now)}"
    return next((found for pair in pairs if (found := first_difference(*pair)) is not None), None)


def _same(was: Any, now: Any) -> bool:
    if isinstance(was, float) and isinstance(now, float):
        if math.isnan(was) or math.isnan(now):
            return math.isnan(was) and math.isnan(now)
        return was == now and math.copysign(1.0, was) == math.copysign(1.0, now)
    return type(was) is type(now) and bool(was == now)


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
