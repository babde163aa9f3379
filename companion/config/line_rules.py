"""Lines of this computer: each belongs to one thing, whichever table names it.

The second who asks the kernel for a line is refused, so that a line claimed twice is a start that
fails in the field. Hardware PWM and the outputs of shift registers count from 0 on their own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from companion.config.model import Config

Found = Iterator[tuple[str, str]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """A key, and the line that it names."""

    key: str
    line: int
    chip_key: str
    chip: str


def line_contradictions(config: Config) -> Found:
    """Yield (key, what is wrong) of a line that is claimed a second time on one chip."""
    for first, second in _shared(config):
        if first.chip == second.chip:
            yield second.key, f"{first.key} has this line; give each its own"


def line_warnings(config: Config) -> Found:
    """Yield lines of one number on chips of two names: these may be one chip.

    A chip is found by its name or by its label, and which labels there are only the computer knows.
    """
    for first, second in _shared(config):
        if first.chip != second.chip:
            yield (
                second.key,
                f"{first.key} has line {first.line} too; if {first.chip} ({first.chip_key}) and "
                f"{second.chip} ({second.chip_key}) are one chip, give each its own line",
            )


def claims(config: Config) -> tuple[Claim, ...]:
    """Return what claims lines, the valves first."""
    output = config.output
    found: dict[str, int | None] = {}
    if output.kind == "gpio" and config.gpio.driver == "lines":
        found |= {f"valve[{n}].channel": valve.channel for n, valve in enumerate(config.valve)}
        found["output.return_channel"] = output.return_channel
        found["gpio.alive_line"] = config.gpio.alive_line
    found["safety.estop_line"] = config.safety.estop_line
    every = [(key, line, "output.chip", output.chip) for key, line in found.items()]
    meter = config.flow_meter
    if meter.source == "gpio":
        every.append(("flow_meter.line", meter.line, "flow_meter.chip", meter.chip))
    return tuple(
        Claim(key=key, line=line, chip_key=chip_key, chip=chip.removeprefix("/dev/"))
        for key, line, chip_key, chip in every
        if line is not None
    )


def _shared(config: Config) -> Iterator[tuple[Claim, Claim]]:
    """Yield each two that name the same number."""
    return (pair for pair in combinations(claims(config), 2) if pair[0].line == pair[1].line)
