"""Synthetic flights of known truth, and what a flight record refuses.

The ground is a field of plots, 12 m along by 6 m across, flown in passes along the east, joined by
half circles well outside. Every change of the flow lies where the caller says.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from shapely import box

from analysis.evaluation import FlightMeta, FlightRecord, whole_boom
from companion.core.boom import Boom, Valve
from companion.core.prescription import Prescription, Zone
from companion.core.types import TimedChange

Floats = NDArray[np.float64]

PLOT_M = 12.0
SWATH_M = 6.0
RUN_UP_M = 15.0
PERIOD_S = 1.0 / 11.0
ML_M = 0.1  # mL per metre of track for 1 L/ha on 1 m


@dataclass(frozen=True, kw_only=True)
class Flight:
    """What is flown. `lag_m(change index)` places the flow's steps, borders apart."""

    rates: Sequence[Sequence[float]]
    plot_m: float = PLOT_M
    valves: int = 6
    speed_m_s: float = 5.0
    ripple_m_s: float = 0.0
    lag_m: Callable[[int], float] = lambda _: 0.0
    border_m: float = 0.0  # by how much on comes late and off early at the border
    pulsed: bool = False
    restart: bool = True
    stretch: float = 0.0  # periods that much too long
    step_s: float = 0.002
    scale: float = 1.0
    dose_noise: float = 0.0  # relative, 1 sd, a period
    rise_m: float = 0.0  # the averaged flow's ramp, centred on the step
    tail_m: float = 0.0  # or its exponential approach, with the step's volume
    ignore: frozenset[int] = frozenset()  # changes that the flow does not follow
    forward_m: float = 0.0
    seed: int = 0


def boom_of(valves: int, forward_m: float = 0.0) -> Boom:
    width_m = SWATH_M / valves
    return Boom(
        width_m=SWATH_M,
        valves=tuple(
            Valve(
                name=str(i + 1),
                right_m=(i + 0.5) * width_m - SWATH_M / 2,
                forward_m=forward_m,
                width_m=width_m,
            )
            for i in range(valves)
        ),
    )


def field_of(rates: Sequence[Sequence[float]], plot_m: float = PLOT_M) -> Prescription:
    return Prescription(
        [
            Zone(
                name=f"{p}-{i}",
                polygon=box(i * plot_m, p * SWATH_M, (i + 1) * plot_m, (p + 1) * SWATH_M),
                rate_l_ha=rate,
            )
            for p, row in enumerate(rates)
            for i, rate in enumerate(row)
        ]
    )


def path_at(flight: Flight, distance_m: Floats) -> tuple[Floats, Floats, Floats]:
    """Return east, north, heading along the serpentine."""
    length_m = len(flight.rates[0]) * flight.plot_m + 2 * RUN_UP_M
    turn_m = np.pi * SWATH_M / 2
    number = np.floor(distance_m / (length_m + turn_m)).astype(int)
    along = distance_m - number * (length_m + turn_m)
    forth = np.where(number % 2 == 0, 1.0, -1.0)
    middle_m = length_m / 2 - RUN_UP_M
    straight = np.minimum(along, length_m)
    angle = np.maximum(along - length_m, 0.0) / (SWATH_M / 2)
    radius = SWATH_M / 2
    east = middle_m + forth * (straight - length_m / 2 + radius * np.sin(angle))
    north = (number + 0.5) * SWATH_M + radius * (1.0 - np.cos(angle))
    heading = np.where(forth > 0, 90.0 - np.degrees(angle), 270.0 + np.degrees(angle))
    return east, north, heading


def steps_of(flight: Flight) -> tuple[list[tuple[float, float]], list[float]]:
    """Return (distance, rate from there on) of the flow's steps, and the lags inside the field."""
    length_m = len(flight.rates[0]) * flight.plot_m + 2 * RUN_UP_M
    steps: list[tuple[float, float]] = []
    lags: list[float] = []
    number = 0
    for p, row in enumerate(flight.rates):
        start_m = p * (length_m + np.pi * SWATH_M / 2) + RUN_UP_M - flight.forward_m
        order = list(row) if p % 2 == 0 else list(reversed(row))
        steps.append((start_m + flight.border_m, order[0]))
        for i in range(1, len(order)):
            if order[i] == order[i - 1]:
                continue
            lag_m = flight.lag_m(number)
            if number not in flight.ignore:
                steps.append((start_m + i * flight.plot_m + lag_m, order[i]))
                lags.append(lag_m)
            number += 1
        steps.append((start_m + len(order) * flight.plot_m - flight.border_m, 0.0))
    return steps, lags


def record_of(flight: Flight) -> tuple[FlightRecord, list[float]]:
    """Return the record of a flight and the lags that its flow has."""
    rng = np.random.default_rng(flight.seed)
    passes = len(flight.rates)
    length_m = len(flight.rates[0]) * flight.plot_m + 2 * RUN_UP_M
    total_m = passes * length_m + (passes - 1) * np.pi * SWATH_M / 2
    time_s = np.arange(0.0, total_m / flight.speed_m_s, flight.step_s)
    distance_m = flight.speed_m_s * time_s
    for period_s in (1.7, 3.1, 7.3):
        phase = rng.uniform(0.0, 2 * np.pi)
        swing_m = flight.ripple_m_s * period_s / (2 * np.pi) * np.sqrt(2 / 3)
        distance_m = distance_m + swing_m * np.sin(2 * np.pi * time_s / period_s + phase)
    east_m, north_m, heading_deg = path_at(flight, distance_m)
    steps, lags = steps_of(flight)
    boom = boom_of(flight.valves, flight.forward_m)
    column = _pulsed if flight.pulsed else _averaged
    volumes = [
        flight.scale * column(flight, valve, steps, time_s, distance_m, rng)
        for valve in boom.valves
    ]
    orders = _orders(flight, steps, time_s, distance_m)
    record = FlightRecord(
        time_s=time_s,
        east_m=east_m,
        north_m=north_m,
        heading_deg=heading_deg,
        volume_ml=np.stack(volumes, axis=1),
        boom=boom,
        prescription=field_of(flight.rates, flight.plot_m),
        pwm_period_s=PERIOD_S,
        orders=orders,
        meta=FlightMeta(
            speed_m_s=flight.speed_m_s,
            method="scheduled",
            fidelity="pulsed" if flight.pulsed else "averaged",
            output="gpio",
            seed=flight.seed,
        ),
    )
    return record, lags * flight.valves


def _orders(
    flight: Flight, steps: list[tuple[float, float]], time_s: Floats, distance_m: Floats
) -> tuple[TimedChange, ...]:
    times_s = np.interp([s for s, _ in steps], distance_m, time_s) - 0.1
    return tuple(
        TimedChange(at_s=float(at_s), valve=valve, duty=rate / 60.0)
        for at_s, (_, rate) in zip(times_s, steps, strict=True)
        for valve in range(flight.valves)
    )


def _averaged(
    flight: Flight,
    valve: Valve,
    steps: list[tuple[float, float]],
    time_s: Floats,
    distance_m: Floats,
    rng: np.random.Generator,
) -> Floats:
    """Return the volume of a flow that is in proportion to the speed, ramped in distance."""
    volume_ml = np.zeros_like(distance_m)
    last = 0.0
    half_m = max(flight.rise_m / 2, 1e-9)
    for step_m, rate in steps:
        x = np.clip(distance_m - (step_m - half_m), 0.0, 2 * half_m)
        past = np.maximum(distance_m - (step_m + half_m), 0.0)
        run_m = x * x / (4 * half_m) + past
        if flight.tail_m:
            x = np.maximum(distance_m - (step_m - flight.tail_m), 0.0)
            run_m = x - flight.tail_m * (1.0 - np.exp(-x / flight.tail_m))
        volume_ml += (rate - last) * ML_M * valve.width_m * run_m
        last = rate
    if flight.dose_noise:
        drops = np.diff(volume_ml, prepend=0.0)
        cells = (time_s / PERIOD_S).astype(int)
        noise = rng.normal(0.0, flight.dose_noise, cells[-1] + 1)
        volume_ml = np.cumsum(drops * (1.0 + noise[cells]))
    return volume_ml


def _pulsed(
    flight: Flight,
    valve: Valve,
    steps: list[tuple[float, float]],
    time_s: Floats,
    distance_m: Floats,
    rng: np.random.Generator,
) -> Floats:
    """Return the volume of centred pulses whose periods restart at each step, with their debt."""
    peak_ml_s = 60.0 * ML_M * valve.width_m * 5.0  # the dose of 60 L/ha at 5 m/s when open
    starts_s = [*np.interp([s for s, _ in steps], distance_m, time_s).tolist(), float(time_s[-1])]
    edges: list[tuple[float, float]] = []
    debt_s = 0.0
    at_s = starts_s[0]
    if not flight.restart:
        at_s -= rng.uniform(0.0, PERIOD_S)
    for (_, rate), end_s, start_s in zip(steps, starts_s[1:], starts_s, strict=False):
        at_s = start_s if flight.restart else at_s
        while at_s < end_s and rate > 0.0:
            until_s = at_s + PERIOD_S * (1.0 + flight.stretch)
            noise = 1.0 + rng.normal(0.0, flight.dose_noise) if flight.dose_noise else 1.0
            on_s = _on_s(rate, valve, peak_ml_s, _run(time_s, distance_m, at_s, until_s)) * noise
            on_s = min(max(on_s + debt_s, 0.0), until_s - at_s)
            middle_s = 0.5 * (at_s + until_s)
            pulse = (middle_s - on_s / 2, middle_s + on_s / 2)
            debt_s = 0.0
            if until_s > end_s and flight.restart:
                pulse = (min(pulse[0], end_s), min(pulse[1], end_s))
                asked_s = _on_s(rate, valve, peak_ml_s, _run(time_s, distance_m, at_s, end_s))
                debt_s = asked_s - (pulse[1] - pulse[0])
                until_s = end_s
            edges.append(pulse)
            at_s = until_s
        if rate == 0.0:
            debt_s, at_s = 0.0, end_s
    open_s, close_s = np.array(edges).T
    index = np.searchsorted(open_s, time_s, "right")
    total = np.concatenate(([0.0], np.cumsum(close_s - open_s)))
    running = np.minimum(time_s, close_s[np.maximum(index - 1, 0)])
    passed = total[np.maximum(index - 1, 0)] + np.maximum(
        running - open_s[np.maximum(index - 1, 0)], 0.0
    )
    return peak_ml_s * np.where(index > 0, passed, 0.0)


def _run(time_s: Floats, distance_m: Floats, start_s: float, end_s: float) -> float:
    start_m, end_m = np.interp([start_s, end_s], time_s, distance_m)
    return float(end_m - start_m)


def _on_s(rate: float, valve: Valve, peak_ml_s: float, run_m: float) -> float:
    return rate * ML_M * valve.width_m * run_m / peak_ml_s


PLAIN = Flight(rates=[[20.0, 26.0, 20.0], [20.0, 15.0, 20.0]], valves=2)


def test_a_record_with_uneven_time_is_refused() -> None:
    record, _ = record_of(PLAIN)
    time_s = record.time_s.copy()
    time_s[5] += 0.001
    with pytest.raises(ValueError, match="even steps"):
        replace(record, time_s=time_s)


def test_a_record_whose_volume_falls_is_refused() -> None:
    record, _ = record_of(PLAIN)
    volume_ml = record.volume_ml.copy()
    volume_ml[-1] = 0.0
    with pytest.raises(ValueError, match="must not fall"):
        replace(record, volume_ml=volume_ml)


def test_a_record_with_a_column_too_few_is_refused() -> None:
    record, _ = record_of(PLAIN)
    with pytest.raises(ValueError, match="samples x valves"):
        replace(record, volume_ml=record.volume_ml[:, :1])


def test_a_record_with_a_position_that_is_no_number_is_refused() -> None:
    record, _ = record_of(PLAIN)
    east_m = record.east_m.copy()
    east_m[7] = np.nan
    with pytest.raises(ValueError, match="finite"):
        replace(record, east_m=east_m)


def test_the_whole_boom_is_one_strip_with_all_volume() -> None:
    record, _ = record_of(PLAIN)
    whole = whole_boom(record)
    assert [(v.width_m, v.right_m) for v in whole.boom.valves] == [(SWATH_M, 0.0)]
    assert np.allclose(whole.volume_ml[:, 0], record.volume_ml.sum(axis=1))
