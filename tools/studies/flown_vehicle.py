"""The simulated vehicle `flown` beside the logs that it is fitted to, by the same figures.

    python -m tools.studies.flown_vehicle LOG.BIN [LOG.BIN ...] [--seeds 12]

Of each log its missions are read, and of the simulated vehicle what it tells at 10 Hz on a mission
like theirs; a smoother says where each truly was. Whatever the smoother hides, it hides in both.
What drifts for longer than some seconds shows in neither.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from companion.core.types import Telemetry
from sitl.airframes import AIRFRAMES, Airframe
from sitl.earth import Earth
from sitl.navigation import Navigation
from sitl.recorded import Recorded, paths_of, read_flight, rows_of
from sitl.smoother import STEP_S
from sitl.trajectory import Floats, Leg, Route
from sitl.vehicle import Vehicle

# Of q130.BIN (68 s, five legs) and q116.BIN (34 s, two legs), both AUTO; written 2026-11-28.
FITTED: dict[str, tuple[float, float]] = {
    "push_m_s2": (2.12, 2.03),
    "ramp_m_s3": (0.930, 0.917),
    "turn_deg_s": (59.6, 26.3),
    "twist_deg_s2": (222.0, 90.5),
    "across_m_s": (0.0420, 0.0287),
    "across_time_s": (0.70, 0.75),
    "sway_m_s": (0.0157, 0.0125),
    "place_off_m": (0.0126, 0.0138),
    "place_time_s": (1.64, 1.42),
    "place_step_m": (0.00298, 0.00297),
    "place_white": (-0.037, -0.041),
    "pace_off_m_s": (0.0240, 0.0197),
    "pace_time_s": (6.92, 3.32),
    "pace_step_m_s": (0.00772, 0.00509),
    "pace_white": (0.033, -0.023),
}
MOVING_M_S, LEG_MIN_S, TURNING_DEG_S = 1.0, 3.0, 20.0
# A mission of q130's kind: its legs' length, how far each turns, and its speed.
LEG_M, TURN_DEG, SPEED_M_S, LEGS = 28.0, 140.0, 6.0, 6
HOME = Earth(30.932, -104.0403)
# Of what is off: so many messages back its correlation is looked at.
LAGS = 12
SWAY_S = 2.0


def figures_of(flight: Recorded) -> dict[str, float]:
    """Return how a flight moved, and how far off it was told."""
    states = flight.states
    earth = Earth(float(states.latitude_deg[0]), float(states.longitude_deg[0]))
    path, _ = paths_of(flight, earth)
    speed = np.maximum(path.speed_m_s, 1e-3)
    east, north = path.velocity_east_m_s / speed, path.velocity_north_m_s / speed
    gains = [np.gradient(v, STEP_S) for v in (path.velocity_east_m_s, path.velocity_north_m_s)]
    push = gains[0] * east + gains[1] * north
    moves = path.speed_m_s > MOVING_M_S
    turns = np.gradient(path.heading_deg, STEP_S)
    twists = np.abs(np.gradient(turns, STEP_S))
    pivots = np.abs(turns) > TURNING_DEG_S
    across = list(_across(path, moves))
    then = path.at(states.time_s)
    place_m = np.column_stack(earth.to_local_all(states.latitude_deg, states.longitude_deg))
    off_m = place_m - np.column_stack((then.east_m, then.north_m))
    off_m_s = np.column_stack((states.east_m_s, states.north_m_s)) - np.column_stack(
        (then.velocity_east_m_s, then.velocity_north_m_s)
    )
    return {
        "push_m_s2": float(np.percentile(np.abs(push[moves]), 90)),
        "ramp_m_s3": float(np.median(np.abs(np.gradient(push, STEP_S)[moves]))),
        "turn_deg_s": float(np.median(np.abs(turns[pivots]))) if pivots.any() else np.nan,
        "twist_deg_s2": float(np.percentile(twists, 99)) if pivots.any() else np.nan,
        "across_m_s": float(np.sqrt(np.mean(np.concatenate(across) ** 2))),
        "across_time_s": _falls_s(across, STEP_S, 60),
        "sway_m_s": float(np.std(np.concatenate(list(_swayed(path.speed_m_s, moves))))),
        **_off("place", "m", off_m, 1.0 / flight.rate_hz),
        **_off("pace", "m_s", off_m_s, 1.0 / flight.rate_hz),
    }


def _across(path: Any, moves: Any) -> Iterator[Floats]:
    """Yield the velocity across each leg: nobody leads a vehicle that way but gusts."""
    for rows in _legs(moves):
        east = path.east_m[rows[-1]] - path.east_m[rows[0]]
        north = path.north_m[rows[-1]] - path.north_m[rows[0]]
        speeds = path.velocity_east_m_s[rows] * north - path.velocity_north_m_s[rows] * east
        yield speeds / np.hypot(east, north)


def _swayed(speed_m_s: Floats, moves: Any) -> Iterator[Floats]:
    """Yield what is quick in the speed of each leg: off a parabola through SWAY_S."""
    half = round(0.5 * SWAY_S / STEP_S)
    x = np.arange(-half, half + 1) * STEP_S
    middle = np.linalg.pinv(np.vander(x, 3))[-1]
    smooth = np.convolve(speed_m_s, middle[::-1], mode="same")
    for rows in _legs(moves):
        yield (speed_m_s - smooth)[rows]


def _legs(moves: Any) -> Iterator[Any]:
    for rows in np.split(np.arange(len(moves)), np.flatnonzero(np.diff(moves)) + 1):
        if moves[rows[0]] and len(rows) * STEP_S > LEG_MIN_S:
            yield rows


def _correlations(parts: Sequence[Floats], count: int) -> Floats:
    found = [sum(float((x[k:] * x[: len(x) - k]).sum()) for x in parts) for k in range(count)]
    return np.array(found) / found[0]


def _falls_s(parts: Sequence[Floats], step_s: float, count: int) -> float:
    """Return when a correlation has fallen to 1/e."""
    return float(np.argmax(_correlations(parts, count) < np.exp(-1.0))) * step_s


def _off(name: str, unit: str, off: Floats, step_s: float) -> dict[str, float]:
    """Return size, time constant and white share of an error: an exponential after its start."""
    parts = list((off - off.mean(axis=0)).T)
    fell = _correlations(parts, LAGS)[1:]
    slope, start = np.polyfit(step_s * np.arange(1, LAGS), np.log(np.maximum(fell, 0.05)), 1)
    return {
        f"{name}_off_{unit}": float(np.sqrt(np.mean(np.square(parts)))),
        f"{name}_time_s": float(-1.0 / slope),
        f"{name}_step_{unit}": float(np.diff(off, 2, axis=0).std() / np.sqrt(6.0)),
        f"{name}_white": float(1.0 - np.exp(start)),
    }


def simulated(airframe: Airframe, seed: int) -> Recorded:
    """Return what the simulated vehicle tells on such a mission."""
    courses = np.radians(np.arange(LEGS) * TURN_DEG)
    ends = accumulate(LEG_M * np.exp(1j * courses))
    # A leg of no length makes it stand at the end of each, as the logs' missions do.
    legs = tuple(
        Leg(east_m=e.imag, north_m=e.real, speed_m_s=SPEED_M_S) for e in ends for _ in "ab"
    )
    route = Route(start_east_m=0.0, start_north_m=0.0, legs=legs)
    path = Vehicle(
        route, start_s=0.0, seed=seed, corners="ardupilot", airframe=airframe
    ).fly_to_end()
    told = Navigation(path, HOME, seed=seed, position_rate_hz=10.0, off=airframe.noise)
    rows = [
        (
            m.boot_s, m.latitude_deg, m.longitude_deg, m.relative_altitude_m,
            m.velocity_north_m_s, m.velocity_east_m_s, m.velocity_down_m_s, m.heading_deg,
        )
        for m in told.advance(float(path.time_s[-1]))
        if isinstance(m, Telemetry)
    ]  # fmt: skip
    states = rows_of(np.array(rows, dtype=np.float64).T)
    return Recorded(name="simulated", states=states, receiver=np.empty((3, 0)))


def main() -> None:
    """Print the figures of logs and vehicles."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("logs", nargs="*", type=Path)
    parser.add_argument("--seeds", type=int, default=12)
    given = parser.parse_args()
    flown = [figures_of(read_flight(log, lambda mode: mode == "AUTO")) for log in given.logs]
    twins = {
        name: [figures_of(simulated(airframe, seed)) for seed in range(1, given.seeds + 1)]
        for name, airframe in AIRFRAMES.items()
    }
    heads = [*(log.stem for log in given.logs), *twins]
    sys.stdout.write(f"| Figure | {' | '.join(heads)} |\n|---{'|---' * len(heads)}|\n")
    for name in twins["flown"][0]:
        cells = [f"{one[name]:.3g}" for one in flown]
        for each in twins.values():
            values = [one[name] for one in each]
            cells.append(f"{np.mean(values):.3g} ({min(values):.3g} to {max(values):.3g})")
        sys.stdout.write(f"| {name} | {' | '.join(cells)} |\n")


if __name__ == "__main__":
    main()
