"""What the tables of the sensors must say together with the others."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from companion.config.model import Config

Found = Iterator[tuple[str, str]]


def sensor_contradictions(config: Config) -> Found:
    """Yield (key, what is wrong and what to write instead)."""
    yield from _meter(config)
    yield from _pressure(config)
    yield from _tank(config)
    if config.detection.enabled and config.flow_meter.source == "none":
        yield (
            "detection.enabled",
            'without a flow meter nothing is detected; set flow_meter.source = "gpio", or false',
        )


def _meter(config: Config) -> Found:
    table = config.flow_meter
    if table.source != "gpio":
        return
    if table.line is None:
        yield "flow_meter.line", "missing; write the GPIO line of the pulses"
    if table.pulses_per_l is None:
        yield (
            "flow_meter.pulses_per_l",
            "missing; write the pulses of a litre, measured with a bucket",
        )


def _pressure(config: Config) -> Found:
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


def _tank(config: Config) -> Found:
    table = config.tank
    if table.source == "none":
        return
    capacity_l = tank_capacity_l(config)
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


def tank_capacity_l(config: Config) -> float | None:
    """Return what a full tank holds."""
    if config.tank.capacity_l is not None:
        return config.tank.capacity_l
    return None if config.mission is None else config.mission.tank_l
