"""A hand-written `gpiod` 2: what is used of its interface, its refusals; faults are fields.

What it does was read from gpiod 2.5 and the kernel's documents, and measured on gpio-sim: a line
is held by one request at a time, a released line returns to its pull (or keeps its level, on
Raspberry Pi's kernels), an output reads back the level of its pin.
"""

from __future__ import annotations

import errno
import os
from dataclasses import dataclass, field
from enum import Enum
from types import SimpleNamespace, TracebackType
from typing import Any


class Value(Enum):
    INACTIVE = 0
    ACTIVE = 1


class Direction(Enum):
    AS_IS = 1
    INPUT = 2
    OUTPUT = 3


@dataclass
class LineSettings:
    direction: Direction = Direction.AS_IS
    output_value: Value = Value.INACTIVE
    active_low: bool = False


@dataclass
class FakeLine:
    """A pin: its level, and who holds it."""

    level: int = 0
    pull: int = 0
    holder: Request | None = None


@dataclass
class Request:
    chip: FakeChip
    offsets: list[int]
    released: bool = False

    def _check(self) -> None:
        if self.released:
            raise RuntimeError("line request has been released")
        if self.chip.is_gone:
            raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))

    def set_values(self, values: dict[int, Value]) -> None:
        self._check()
        if self.chip.refuses_writes:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        if not set(values) <= set(self.offsets):
            raise ValueError("a line that was not requested")
        for offset, value in values.items():
            if offset not in self.chip.stuck:
                self.chip.lines[offset].level = value.value
        self.chip.calls.append({offset: value.value for offset, value in values.items()})

    def get_values(self, lines: list[int]) -> list[Value]:
        self._check()
        return [Value(self.chip.lines[offset].level) for offset in lines]

    def release(self) -> None:
        if self.released:
            return
        self.released = True
        for offset in self.offsets:
            line = self.chip.lines[offset]
            line.holder = None
            if not self.chip.keeps_levels:
                line.level = line.pull


@dataclass
class FakeChip:
    """One chip; what is done to it is in `calls`."""

    label: str = "pinctrl-bcm2711"
    count: int = 58
    lines: dict[int, FakeLine] = field(default_factory=dict)
    calls: list[dict[int, int]] = field(default_factory=list)
    requests: list[dict[str, Any]] = field(default_factory=list)
    keeps_levels: bool = False
    is_gone: bool = False
    refuses_writes: bool = False
    busy_times: int = 0
    stuck: set[int] = field(default_factory=set)

    def __post_init__(self) -> None:
        for offset in range(self.count):
            self.lines.setdefault(offset, FakeLine())

    def levels(self, *offsets: int) -> list[int]:
        return [self.lines[offset].level for offset in offsets]


class _Open:
    """A chip as `gpiod.Chip(path)` gives it."""

    def __init__(self, chip: FakeChip) -> None:
        self._chip = chip

    def __enter__(self) -> _Open:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: object, trace: TracebackType | None
    ) -> None:
        """Nothing to let go of."""

    def get_info(self) -> SimpleNamespace:
        return SimpleNamespace(label=self._chip.label, num_lines=self._chip.count)

    def request_lines(
        self,
        config: dict[tuple[int, ...], LineSettings],
        *,
        consumer: str,
        output_values: dict[int, Value],
    ) -> Request:
        chip = self._chip
        offsets = [offset for group in config for offset in group]
        if not all(0 <= offset < chip.count for offset in offsets):
            raise ValueError("line offset of out range")
        busy = any(chip.lines[offset].holder is not None for offset in offsets)
        if busy or chip.busy_times > 0:
            chip.busy_times -= 1
            raise OSError(errno.EBUSY, os.strerror(errno.EBUSY))
        request = Request(chip, offsets)
        for settings in config.values():
            if settings.direction is not Direction.OUTPUT:
                raise ValueError("not an output")
        for offset in offsets:
            line = chip.lines[offset]
            line.holder = request
            if offset not in chip.stuck:
                line.level = output_values[offset].value
        chip.requests.append({"consumer": consumer, "offsets": offsets})
        return request


class FakeGpiod:
    """The module: `Chip`, `LineSettings`, `line`; chips by their path."""

    def __init__(self, chips: dict[str, FakeChip], *, version: str = "2.5.0") -> None:
        self.chips = chips
        self.__version__ = version
        self.LineSettings = LineSettings
        self.line = SimpleNamespace(Value=Value, Direction=Direction)

    def Chip(self, path: str) -> _Open:  # noqa: N802, as in gpiod
        chip = self.chips.get(path)
        if chip is None or chip.is_gone:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), path)
        return _Open(chip)
