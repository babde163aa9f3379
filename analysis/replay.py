"""Replay: feed the recorded inputs to the core again and compare every decision.

The core is a function of set-up, inputs and times, and the journal has all three; so the same
program must decide the same, to the last bit. A difference means that the core has changed, that
rows are missing, or, with overrides, what would have been decided otherwise. What that would have
put on the ground, and whether the same ground is treated, is below.
"""

from __future__ import annotations

import difflib
import json
import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from enum import Enum
from itertools import chain
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    TYPE_CHECKING,
    Any,
    Literal,
    Protocol,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np

from analysis.dose import zone_volumes
from analysis.evaluation import Distances, Evaluation, evaluate_strips
from analysis.flown.applied_flight import ValveChanges
from analysis.flown.applied_record import EvaluationError, record_of
from analysis.flown.read_applied import read_applied
from analysis.journals.content import JournalContent, read_journal
from analysis.journals.unpacking import Entry
from analysis.strips import strips_of
from companion.core.controller import Memory, expected_coverage, step
from companion.core.estimator import Track, estimate, observe
from companion.core.options.coverage import Coverage
from companion.core.setup import Setup
from companion.core.types import Decision, Input
from companion.errors import ConfigError, UnreadableError
from companion.journal.codec import FIELD_NAMES, FieldNames, encode
from companion.journal.coverage import read_coverage
from companion.journal.journal import computing
from companion.journal.reader import opened
from companion.journal.rows import Row, ValveRows
from companion.runtime import COVERAGE_EVERY_S, STEP_MAX_S
from companion.simulated import Word

if TYPE_CHECKING:
    from analysis.flown.applied_flight import AppliedFlight
    from companion.core.types import VehicleState


# What other decisions on a flight's inputs would have put on the ground.
#
# Both ways, the recorded and the other, go through one model of the sprayer: the curves and lags
# of the recorded set-up, orders at their planned times. So an override changes what is decided,
# and not what the sprayer is. The ground cannot react: the aircraft flies as it flew, and the
# sensors say what they said.

_MICRO = 1e-6
ML_PER_L = 1000.0
L_DIGITS = 6


@dataclass(slots=True)
class Orders:
    """What decisions brought about, collected one by one."""

    valves: ValveRows = field(default_factory=ValveRows)
    rows: list[Row] = field(default_factory=list)
    flow: list[tuple[float, float]] = field(default_factory=list)

    def take(self, decision: Decision) -> None:
        """Take in the next decision."""
        self.rows += self.valves.take_plan(decision.plan)
        self.flow.append((decision.now_s, decision.flow_l_min))

    def carried_out(self, flight: AppliedFlight) -> AppliedFlight:
        """Return the flight as if these had been its orders, each given at its planned time."""
        table = np.array([*self.rows, *self.valves.end()], dtype=np.float64).reshape(-1, 4)
        table = table[np.argsort(table[:, 0], kind="stable")]
        changes = ValveChanges(
            planned_s=table[:, 0] * _MICRO,
            actual_s=np.full(len(table), np.nan),
            valve=table[:, 2].astype(np.int64),
            duty=table[:, 3] / 1000.0,
        )
        at_s, flow = np.array(self.flow, dtype=np.float64).reshape(-1, 2).T
        last = np.searchsorted(at_s, flight.time_s, "right") - 1
        flows = np.where(last >= 0, flow[np.maximum(last, 0)], 0.0) if len(flow) else 0.0
        return replace(flight, changes=changes, flow_l_min=flows + np.zeros(len(flight.time_s)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Sprayed:
    """What one way of deciding put on the ground, by the model; `zones` are litres by zone."""

    volume_l: float
    zones: dict[str, float]
    lag_distance_m: Distances
    border_margin_m: Distances
    misapplied_percent: float | None
    spraying_accuracy_percent: float | None
    off_target_ml: float
    missed: int
    apart: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Moved:
    """By how many metres the changes lie elsewhere, + is later; the border's among them."""

    mean: float | None
    mean_abs: float | None
    max_abs: float | None
    count: int


@dataclass(frozen=True, slots=True, kw_only=True)
class WhatIf:
    """Both ways beside each other."""

    recorded: Sprayed
    what_if: Sprayed
    moved_m: Moved


def compared(flight: AppliedFlight, recorded: Orders, other: Orders) -> WhatIf | None:
    """Return what both would have sprayed on this flight; None where it had no position."""
    try:
        was, was_found = _sprayed(recorded.carried_out(flight))
        now, now_found = _sprayed(other.carried_out(flight))
    except EvaluationError:
        return None
    places = {
        (step.change.valve, step.change.time_s): step.lag_distance_m for step in was_found.steps
    }
    moves = [
        step.lag_distance_m - before
        for step in now_found.steps
        if (before := places.get((step.change.valve, step.change.time_s))) is not None
        and step.lag_distance_m is not None
    ]
    distances = Distances.of(moves)
    return WhatIf(
        recorded=was,
        what_if=now,
        moved_m=Moved(
            mean=distances.mean,
            mean_abs=distances.mean_abs,
            max_abs=distances.max_abs,
            count=distances.count,
        ),
    )


def _sprayed(flight: AppliedFlight) -> tuple[Sprayed, Evaluation]:
    record = record_of(flight)
    strips = strips_of(record)
    found = evaluate_strips(record, strips)
    zones = zone_volumes(strips, record.prescription)
    sprayed = Sprayed(
        volume_l=found.applied_ml / ML_PER_L,
        zones={
            name or "-": round(zone.given_ml / ML_PER_L, L_DIGITS) for name, zone in zones.items()
        },
        lag_distance_m=found.lag_distance_m,
        border_margin_m=found.border_margin_m,
        misapplied_percent=found.misapplied_percent,
        spraying_accuracy_percent=found.spraying_accuracy_percent,
        off_target_ml=found.off_target_ml,
        missed=found.missed,
        apart=found.apart,
    )
    return sprayed, found


# Changes of a recorded set-up for a what-if: KEY=VALUE on the fields of `Setup`.
#
# Keys are those of the configuration file where the set-up has them ("lag.on_s", "safety.modes",
# "prescription.border"), or the dotted path of a field of `Setup` ("nozzle_sets.0.valves").

# Where the configuration file and the set-up name the same thing differently.
_ALIASES = {
    "lag.method": "method",
    "prescription.border": "border",
    "prescription.border_buffer_m": "border_buffer_m",
    "prescription.across": "across",
    "output.lease_s": "lease_s",
    "mission.lines_aside_m": "lines.aside_m",
    "mission.lines_course_deg": "lines.course_deg",
}
_PREFIXES = {"safety.": "limits."}
_FIXED = ("frame", "prescription")
_YES, _NO = ("true", "yes", "1"), ("false", "no", "0")


def override(setup: Setup, changes: Sequence[str]) -> Setup:
    """Return `setup` with every KEY=VALUE carried out; ConfigError for what cannot be."""
    for change in changes:
        key, equals, text = change.partition("=")
        key, text = key.strip(), text.strip()
        if not (key and equals):
            raise ConfigError(f"--set {change}: write KEY=VALUE, such as lag.on_s=0.12")
        path = _path(key)
        if path[0] in _FIXED:
            raise ConfigError(f"--set {key}: the ground of a recorded flight cannot be changed")
        try:
            setup = _replaced(setup, path, text, Setup)
        except (ValueError, TypeError) as error:
            raise ConfigError(f"--set {change}: {error}") from error
    return setup


def _path(key: str) -> list[str]:
    key = _ALIASES.get(key, key)
    for prefix, own in _PREFIXES.items():
        if key.startswith(prefix):
            key = own + key.removeprefix(prefix)
    return key.split(".")


def _replaced(value: Any, path: Sequence[str], text: str, hint: Any) -> Any:
    """Return `value` with the field at `path` replaced by what `text` says."""
    if not path:
        return _parsed(text, hint)
    name, rest = path[0], path[1:]
    if isinstance(value, tuple):
        if not (name.isdigit() and int(name) < len(value)):
            raise ValueError(f"{name} is not an index of {len(value)} values, counted from 0")
        i = int(name)
        return (*value[:i], _replaced(value[i], rest, text, get_args(hint)[0]), *value[i + 1 :])
    if not is_dataclass(value) or isinstance(value, type):
        raise ValueError(f"there is nothing below it called {name}")
    known = [field.name for field in fields(value) if field.init]
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        raise ValueError(
            f"{name} is unknown; " + (f"{near[0]}?" if near else f"known: {', '.join(known)}")
        )
    inner = get_type_hints(type(value))[name]
    return replace(value, **{name: _replaced(getattr(value, name), rest, text, inner)})


def _parsed(text: str, hint: Any) -> Any:
    """Return the value of type `hint` that `text` stands for; ValueError where it is none."""
    origin = get_origin(hint)
    if origin in (Union, UnionType):
        return _parsed_union(text, get_args(hint))
    if origin is Literal:
        return _one_of(text, {str(value): value for value in get_args(hint)})
    if origin in (tuple, frozenset):
        inner = get_args(hint)[0]
        words = text.strip("[]()").replace('"', "").replace("'", "").split(",")
        return origin(_parsed(word.strip(), inner) for word in words if word.strip())
    if hint is bool:
        return _one_of(text.lower(), dict.fromkeys(_YES, True) | dict.fromkeys(_NO, False))
    if isinstance(hint, type) and issubclass(hint, Enum):
        # As the configuration file writes them: rtk-float, 3d, look-ahead.
        names = {
            member.name.lower().replace("_", "-").removeprefix("fix-"): member for member in hint
        }
        return _one_of(text, names)
    if hint in (float, int, str):
        return hint(text)
    raise ValueError("name one of its fields")


def _parsed_union(text: str, hints: tuple[Any, ...]) -> Any:
    if NoneType in hints and text.lower() == "none":
        return None
    return _parsed(text, next(hint for hint in hints if hint is not NoneType))


def _one_of(text: str, known: dict[str, Any]) -> Any:
    if text not in known:
        raise ValueError(f"{text} is none of {', '.join(known)}")
    return known[text]


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
    simulated: Word = "unknown"
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
        simulated=content.simulated.word,
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


# Whether a replay treats the ground that its journal says was treated, cell by cell.
#
# A flight that ended in order wrote its ground at its very end: a few hundredths of a second
# behind the last decision, which matters only where a valve was still open. One that was cut
# wrote what was to be half way to its next commit, as of one of its last turns. Both are made
# again here by the runtime's own rules.

# The commit before a cut has the last told one, or the one before it.
TOLD_KEPT = 3
# From the last decision to the end: a turn that waited in vain, and its own time.
END_WITHIN_S = 4.0 * STEP_MAX_S


class ReplayedGround:
    """Takes what each step of a replay leaves, and compares at the end."""

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._told: deque[tuple[Memory, VehicleState | None, float]] = deque(maxlen=TOLD_KEPT)
        self._last: tuple[Memory, VehicleState | None, float] | None = None

    def take(self, memory: Memory, state: VehicleState | None, now_s: float) -> None:
        """Take what the step of `now_s` has left."""
        self._last = (memory, state, now_s)
        if not self._told or now_s >= self._told[-1][2] + COVERAGE_EVERY_S:
            self._told.append(self._last)

    def differing(self, kept: Coverage, *, is_closed: bool) -> int | None:
        """Return how many cells differ from the journal's; None where nothing can be compared."""
        if not self._setup.records_coverage or self._last is None:
            return None
        if is_closed:
            return self._at_the_end(kept, *self._last)
        counts = (
            cells_apart(kept, self._expected(*told, ahead_s=kept.ahead_s)) for told in self._told
        )
        return min(counts)

    def _at_the_end(
        self, kept: Coverage, memory: Memory, state: VehicleState | None, now_s: float
    ) -> int:
        least = Coverage() if memory.watched.area is None else memory.watched.area.coverage
        most = self._expected(memory, state, now_s, ahead_s=END_WITHIN_S)
        return cells_without(least, kept) + cells_without(kept, most.joined(least))

    def _expected(
        self, memory: Memory, state: VehicleState | None, now_s: float, *, ahead_s: float
    ) -> Coverage:
        return expected_coverage(self._setup, memory, state, now_s=now_s, cut_s=now_s + ahead_s)


def cells_without(one: Coverage, other: Coverage) -> int:
    """Return how many cells only the first has."""
    return sum(_only(tile, other.tiles.get(key, b"")) for key, tile in one.tiles.items())


def cells_apart(one: Coverage, other: Coverage) -> int:
    """Return how many cells only one of the two has."""
    return sum(
        _only(a.tiles.get(key, b""), b.tiles.get(key, b""))
        for key in set(chain(one.tiles, other.tiles))
        for a, b in ((one, other), (other, one))
    )


def _only(tile: bytes, other: bytes) -> int:
    return (int.from_bytes(tile, "little") & ~int.from_bytes(other, "little")).bit_count()
