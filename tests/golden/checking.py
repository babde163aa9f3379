"""Replaying golden flights: the decisions have to be the recorded ones, field by field.

To the bit, as a refactoring leaves them; or, for a step that makes the core faster, the same
valves, inhibits and nozzle sets, with times within 1 us and all other numbers within 1e-9.
"""

from __future__ import annotations

import json
import lzma
import math
import platform
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from analysis.journals.content import read_journal
from analysis.replay import FlownCore
from companion.core.setup import Setup
from companion.core.types import Decision, Input
from companion.journal import codec
from companion.journal.codec import FieldNames, to_plain
from companion.journal.coverage import read_coverage
from companion.journal.reader import opened

FOLDER = Path(__file__).parent / "journals"
TIME_WITHIN_S = 1e-6
WITHIN = 1e-9
SUMS_CHANGED = (3, 12)
_BEGIN = '{"Decision":['


class Beside:
    """Sees what the core is given in a replay, and what it decides; this one does nothing."""

    def begin(self, given: Setup) -> None:
        """Take in what is constant in the flight."""

    def observe(self, item: Input) -> None:
        """Take in one input."""

    def compare(self, decided: Decision) -> None:
        """Take in what was decided."""


ALONE = Beside()


@dataclass(frozen=True, kw_only=True)
class Replayed:
    """What came of one flight; `cells` is how many cells of treated ground differ."""

    decisions: int
    differences: int
    first: str | None
    cells: int | None
    is_left_out: bool = False

    @property
    def is_equal(self) -> bool:
        """Whether every decision and the treated ground are as they were recorded."""
        return not self.differences and not self.cells


def names() -> list[str]:
    """Return the names of all recorded flights."""
    return sorted(path.name.removesuffix(".gpkg.xz") for path in FOLDER.glob("*.gpkg.xz"))


def is_of_this_arithmetic(meta: Mapping[str, str]) -> bool:
    """Return whether a journal's last bits are to be had here: from 3.12 on Python sums otherwise.

    `sum` of floats then keeps what rounding loses.
    """
    major, minor, *_ = map(int, meta["python"].split("."))
    recorded_new, runs_new = (major, minor) >= SUMS_CHANGED, sys.version_info >= SUMS_CHANGED
    return meta["machine"] == platform.machine() and recorded_new == runs_new


@contextmanager
def unpacked(name: str, folder: Path = FOLDER) -> Iterator[Path]:
    """Give a recorded flight's journal as a file."""
    with TemporaryDirectory(prefix="golden-") as scratch:
        path = Path(scratch) / f"{name}.gpkg"
        path.write_bytes(lzma.decompress((folder / f"{name}.gpkg.xz").read_bytes()))
        yield path


def replayed(
    path: Path,
    *,
    is_tolerant: bool | None = False,
    until_s: float = math.inf,
    core: Callable[[Setup], FlownCore] = FlownCore,
    beside: Beside = ALONE,
) -> Replayed:
    """Return how the decisions of today differ from those in a journal.

    With `is_tolerant` None they are compared to the bit where this computer and this Python can.
    What comes more than `until_s` after the first decision is left out, as is the treated ground.
    """
    content = read_journal(path)
    if is_tolerant is None:
        is_tolerant = not is_of_this_arithmetic(content.meta)
    flown = core(content.setup)
    beside.begin(content.setup)
    written = _written_then(content.field_names)
    decisions = differences = 0
    first, begin_s, is_left_out = None, None, False
    for entry in content.entries:
        if not entry.is_decision:
            recorded = content.value(entry)
            assert not isinstance(recorded, Decision)
            flown.observe(recorded)
            beside.observe(recorded)
            continue
        time_s = float(entry.body[len(_BEGIN) : entry.body.index(",")])
        begin_s = time_s if begin_s is None else begin_s
        if time_s > begin_s + until_s:
            is_left_out = True
            break
        decisions += 1
        decided = flown.decide(time_s)
        beside.compare(decided)
        # The same text is the same value to the bit, and is sooner compared.
        if written is not None and written(decided) == _in_names_of_today(entry.body):
            continue
        found = difference(content.value(entry), decided, is_tolerant=is_tolerant)
        if found is not None:
            differences += 1
            first = first or f"decision {decisions} at {time_s:.3f} s: {found}"
    cells = None
    if not is_left_out:
        with opened(path) as journal:
            kept = read_coverage(journal.connection)
        if kept is not None:
            cells = flown.ground.differing(kept, is_closed=content.is_closed)
    return Replayed(
        decisions=decisions,
        differences=differences,
        first=first,
        cells=cells,
        is_left_out=is_left_out,
    )


def _written_then(then: FieldNames) -> Callable[[object], str] | None:
    """Return what writes a value with the fields it had then; None where they were others.

    Fields that came later stand behind those and are left out at their defaults, which is what they
    are in a journal without them. With any other value they are written, and the text is another.
    """
    was = {
        codec._RENAMED_TYPES.get(kind, kind): tuple(
            codec._RENAMED_FIELDS.get((kind, name), name) for name in names
        )
        for kind, names in then.items()
    }
    kept: dict[type[Any], tuple[tuple[str, ...], dict[str, Any]]] = {}
    for kind in codec._kept((Decision,)):
        today = codec.FIELD_NAMES[kind.__name__]
        had = was.get(kind.__name__, today)
        if today[: len(had)] != had:
            return None
        later = {one.name: one.default for one in fields(kind) if one.name in today[len(had) :]}
        kept[kind] = had, later

    def plain(value: Any) -> object:
        kind = type(value)
        if kind is float or kind is str or kind is int or value is None:
            return value
        if kind is tuple:
            return [plain(each) for each in value]
        if kind not in kept:
            return to_plain(value)
        had, later = kept[kind]
        names = had
        if later and any(getattr(value, name) != is_not for name, is_not in later.items()):
            names = (*had, *later)
        return {kind.__name__: [plain(getattr(value, name)) for name in names]}

    return lambda value: json.dumps(plain(value), separators=(",", ":"))


def _in_names_of_today(text: str) -> str:
    for old, new in codec._RENAMED_TYPES.items():
        text = text.replace(f'{{"{old}":', f'{{"{new}":')
    return text


def difference(
    was: Any, now: Any, name: str = "", *, is_tolerant: bool = False, within: float = WITHIN
) -> str | None:
    """Return the first field in which two values of the core differ; None where none does.

    NaN equals NaN and 0.0 is not -0.0, but for a tolerant comparison: numbers that are no times
    may differ by `within` there.

    >>> difference((1.0, 2.0), (1.0, 2.5), "duty")
    'duty[1] was 2.0, is 2.5'
    """
    if isinstance(was, float) and isinstance(now, float):
        is_same = _near(was, now, name, within) if is_tolerant else _to_the_bit(was, now)
        return None if is_same else f"{name} was {was!r}, is {now!r}"
    if type(was) is not type(now):
        return f"{name} was {was!r}, is {now!r}"
    if is_dataclass(was):
        pairs: Sequence[tuple[Any, Any, str]] = [
            (a, b, f"{name}.{one}".strip("."))
            for one in _names(type(was))
            if not _is_one(a := getattr(was, one), b := getattr(now, one))
        ]
    elif isinstance(was, tuple) and len(was) == len(now):
        pairs = [
            (a, b, f"{name}[{i}]")
            for i, (a, b) in enumerate(zip(was, now, strict=True))
            if not _is_one(a, b)
        ]
    else:
        is_known = isinstance(was, Enum | str | int | frozenset | tuple) or was is None
        assert is_known, f"{name}: {type(was).__name__} is not a value of the core"
        return None if was == now else f"{name} was {was!r}, is {now!r}"
    each = (difference(*one, is_tolerant=is_tolerant, within=within) for one in pairs)
    return next((found for found in each if found), None)


@cache
def _names(kind: type[Any]) -> tuple[str, ...]:
    return tuple(one.name for one in fields(kind))


def _is_one(was: Any, now: Any) -> bool:
    """Whether two values are the same at the first glance; most are, and need no name."""
    return was is now or (type(was) is type(now) is float and was == now != 0.0)


def _to_the_bit(was: float, now: float) -> bool:
    if math.isnan(was) or math.isnan(now):
        return math.isnan(was) and math.isnan(now)
    return was == now and math.copysign(1.0, was) == math.copysign(1.0, now)


def _near(was: float, now: float, name: str, within: float) -> bool:
    if math.isnan(was) or math.isnan(now) or math.isinf(was):
        return was == now or (math.isnan(was) and math.isnan(now))
    is_time = name.endswith("_s") and not name.endswith(("m_s", "deg_s"))
    if is_time:
        return abs(was - now) <= TIME_WITHIN_S
    return abs(was - now) <= within * max(1.0, abs(was))
