"""What the tables of this computer's lines and of the sensors must say together with the others.

Loaded by a configuration that has any of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from companion.config.document import Document

Found = Iterator[tuple[str, str]]

# Lines of this computer: each belongs to one thing, whichever table names it.
#
# The second who asks the kernel for a line is refused, so that a line claimed twice is a start that
# fails in the field. Hardware PWM and the outputs of shift registers count from 0 on their own.


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """A key, and the line that it names."""

    key: str
    line: int
    chip_key: str
    chip: str


def line_contradictions(config: Document) -> Found:
    """Yield (key, what is wrong) of a line that is claimed a second time on one chip."""
    for first, second in _shared(config):
        if first.chip == second.chip:
            yield second.key, f"{first.key} uses the same line; give each its own"


def line_warnings(config: Document) -> Found:
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


def claims(config: Document) -> tuple[Claim, ...]:
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


def _shared(config: Document) -> Iterator[tuple[Claim, Claim]]:
    """Yield each two that name the same number."""
    return (pair for pair in combinations(claims(config), 2) if pair[0].line == pair[1].line)


# What the tables of the sensors must say together with the others.


def sensor_contradictions(config: Document, capacity_l: float | None) -> Found:
    """Yield (key, what is wrong and what to write instead)."""
    yield from _meter(config)
    yield from _pressure(config)
    yield from _tank(config, capacity_l)
    if config.detection.enabled and config.flow_meter.source == "none":
        yield (
            "detection.enabled",
            'needs a flow meter to detect faults; set flow_meter.source = "gpio", or write false',
        )


def _meter(config: Document) -> Found:
    table = config.flow_meter
    if table.source != "gpio":
        return
    if table.line is None:
        yield "flow_meter.line", "missing; write the GPIO line of the pulses"
    if table.pulses_per_l is None:
        yield (
            "flow_meter.pulses_per_l",
            "missing; write the pulses per litre, measured with a bucket",
        )


def _pressure(config: Document) -> Found:
    table = config.pressure
    if not table.at_4_ma_kpa < table.at_20_ma_kpa:
        yield (
            "pressure.at_20_ma_kpa",
            f"not above pressure.at_4_ma_kpa = {table.at_4_ma_kpa:g}; write the range's end",
        )
    if len(table.duty) != len(table.kpa) or len(table.duty) == 1:
        yield (
            "pressure.kpa",
            f"{len(table.kpa)} pressures for {len(table.duty)} duties; write as many of both, "
            "two or more, or none",
        )
    if not all(a < b for a, b in pairwise(table.duty)):
        yield "pressure.duty", "must increase; write the measured points in order of duty"


def _tank(config: Document, capacity_l: float | None) -> Found:
    table = config.tank
    if table.source == "none":
        return
    if capacity_l is None:
        yield "tank.capacity_l", "missing; write it here, or as mission.tank_l"
    elif table.filled_l is not None and not table.filled_l <= capacity_l:
        yield "tank.filled_l", f"more than the tank holds ({capacity_l:g} L); write at most that"
    if table.source == "flow" and config.flow_meter.source == "none":
        yield "tank.source", '"flow" needs a flow meter; set flow_meter.source, or "none"'
    if not table.at_4_ma_l < table.at_20_ma_l:
        yield (
            "tank.at_20_ma_l",
            f"not above tank.at_4_ma_l = {table.at_4_ma_l:g}; write the range's end",
        )
