"""Errors that a controller knows nothing of, one at a time: of lag, position, its rate, and wind.

Those of lags act on the configuration, those of position on the messages, and wind on where the
liquid lands. What they cost is measured in `sitl/studies/sensitivity.py`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from companion.core.frame import LocalFrame
from companion.core.schedule import LagModel
from companion.core.types import Input, Telemetry
from companion.errors import ConfigError
from sitl.anyang import anyang_passes

if TYPE_CHECKING:
    from analysis.flight_record import FlightRecord

RATE_HZ = 20.0
# Ballistic droplets of 250 um from 3.5 m, through a downwash of 8 m/s that fades to the ground.
FALL_S = 0.80
# 3.5 m at the downwash's full speed: about the least that is to expect.
COARSE_FALL_S = 0.45
# Slower than this there is no course to be told.
MOVING_M_S = 0.5

INSIDE = ("up_s", "down_s")
BORDER = ("on_s", "off_s", "on_start_s", "off_end_s")


@dataclass(frozen=True, slots=True, kw_only=True)
class Disturbance:
    """One error of one flight; without any of its values there is none.

    `lag_short_s` is how much too short the lags in `kinds` are in the configuration. `behind_m`
    is how far behind the vehicle its position is told, along its course; `along_m` and `across_m`
    are how far off it is told on the ground: towards the end of the first pass, and to its right.
    `drift_along_m` and `drift_across_m` are how far wind carries the droplets, the same two ways.
    """

    key: str
    label: str
    lag_short_s: float = 0.0
    kinds: tuple[str, ...] = (*INSIDE, *BORDER)
    behind_m: float = 0.0
    along_m: float = 0.0
    across_m: float = 0.0
    rate_hz: float = RATE_HZ
    drift_along_m: float = 0.0
    drift_across_m: float = 0.0

    @property
    def is_drift(self) -> bool:
        """Return whether it acts on the falling droplets only."""
        return self.drift_along_m != 0.0 or self.drift_across_m != 0.0


DISTURBANCES = (
    Disturbance(key="lag-short-20", label="lags 20 ms too short", lag_short_s=0.020),
    Disturbance(key="lag-long-20", label="lags 20 ms too long", lag_short_s=-0.020),
    Disturbance(key="lag-short-50", label="lags 50 ms too short", lag_short_s=0.050),
    Disturbance(
        key="up-short-20", label="up lag alone 20 ms too short", lag_short_s=0.020, kinds=("up_s",)
    ),
    Disturbance(
        key="down-short-20",
        label="down lag alone 20 ms too short",
        lag_short_s=0.020,
        kinds=("down_s",),
    ),
    Disturbance(
        key="on-off-short-20",
        label="on and off lags alone 20 ms too short",
        lag_short_s=0.020,
        kinds=BORDER,
    ),
    Disturbance(key="behind-10", label="position 10 cm behind, along the track", behind_m=0.10),
    Disturbance(key="ground-along-10", label="ground offset 10 cm along the passes", along_m=0.10),
    Disturbance(
        key="ground-across-10", label="ground offset 10 cm across the passes", across_m=0.10
    ),
    Disturbance(key="rate-50", label="positions at 50 Hz", rate_hz=50.0),
    Disturbance(key="rate-10", label="positions at 10 Hz", rate_hz=10.0),
    Disturbance(key="rate-5", label="positions at 5 Hz", rate_hz=5.0),
    Disturbance(
        key="wind-along",
        label=f"wind 1 m/s along, {FALL_S:.2f} s of fall",
        drift_along_m=1.0 * FALL_S,
    ),
    Disturbance(
        key="wind-across",
        label=f"wind 1 m/s across, {FALL_S:.2f} s of fall",
        drift_across_m=1.0 * FALL_S,
    ),
    Disturbance(
        key="wind-along-coarse",
        label=f"wind 1 m/s along, {COARSE_FALL_S:.2f} s of fall",
        drift_along_m=1.0 * COARSE_FALL_S,
    ),
)
UNDISTURBED = Disturbance(key="undisturbed", label="undisturbed, positions at 20 Hz")


def shortened(lag: LagModel, what: Disturbance) -> LagModel:
    """Return the lags with the error in them."""
    wrong = {name: getattr(lag, name) - what.lag_short_s for name in what.kinds}
    return replace(lag, **wrong)


def displaced(items: Iterator[Input], *, what: Disturbance, frame: LocalFrame) -> Iterator[Input]:
    """Yield the inputs with every position in the wrong place."""
    east_m, north_m = on_ground(frame, what.along_m, what.across_m)
    if (what.behind_m, east_m, north_m) == (0.0, 0.0, 0.0):
        yield from items
        return
    for item in items:
        yield (
            _moved(item, frame, what.behind_m, east_m, north_m)
            if isinstance(item, Telemetry)
            else item
        )


def _moved(
    told: Telemetry, frame: LocalFrame, behind_m: float, east_m: float, north_m: float
) -> Telemetry:
    velocity_east, velocity_north = told.velocity_east_m_s or 0.0, told.velocity_north_m_s or 0.0
    speed_m_s = math.hypot(velocity_east, velocity_north)
    if speed_m_s > MOVING_M_S:
        east_m -= behind_m * velocity_east / speed_m_s
        north_m -= behind_m * velocity_north / speed_m_s
    at_east_m, at_north_m = frame.to_local(told.latitude_deg, told.longitude_deg)
    latitude_deg, longitude_deg = frame.to_geographic(at_east_m + east_m, at_north_m + north_m)
    return replace(told, latitude_deg=latitude_deg, longitude_deg=longitude_deg)


def drifted(record: FlightRecord, what: Disturbance, frame: LocalFrame) -> FlightRecord:
    """Return the flight with the path that would have put its liquid where the wind puts it."""
    east_m, north_m = on_ground(frame, what.drift_along_m, what.drift_across_m)
    return replace(record, east_m=record.east_m + east_m, north_m=record.north_m + north_m)


def on_ground(frame: LocalFrame, along_m: float, across_m: float) -> tuple[float, float]:
    """Return (east, north) of a way along the first pass and to the right of it."""
    line = anyang_passes(frame)[0]
    east_m, north_m = line.end_east_m - line.start_east_m, line.end_north_m - line.start_north_m
    length_m = math.hypot(east_m, north_m)
    east, north = east_m / length_m, north_m / length_m
    return along_m * east + across_m * north, along_m * north - across_m * east


def chosen(keys: Iterable[str]) -> tuple[Disturbance, ...]:
    """Return the disturbances of some keys, all without any."""
    wanted = tuple(keys)
    known = {each.key: each for each in DISTURBANCES}
    for key in wanted:
        if key not in known:
            raise ConfigError(f"--only {key}: choose of {', '.join(known)}")
    return tuple(known[key] for key in dict.fromkeys(wanted)) or DISTURBANCES
