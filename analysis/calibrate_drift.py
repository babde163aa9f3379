"""`vrspray calibrate drift`: which valve has left the others, from the journals of flights.

Where valves change apart (skew borders, plots beside each other, sections) the total meter tells
them apart: its volume is regressed on what the table says of each valve. The meter's gain, the
pressure that rises for fewer open valves and errors of the lags are common to all valves and are
fitted beside them, so factors are ratios with the mean 1. What the flights do not tell stays near
1 with a wide interval: a prior holds it there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from analysis.calibration.identify import Estimate
from analysis.calibration.steps import FlowRecord, record_of
from analysis.calibration.valves import WORN_SHARE
from companion.cli.answer import AsJson, answer, note
from companion.errors import JournalError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.calibration.steps import Floats, Order
    from companion.core.schedule import LagModel
    from companion.core.setup import Setup

# A nozzle that begins to block: half of what the trade's rule replaces it at.
EARLY_SHARE = 0.05
# One standard deviation: of a valve's factor before any flight, and of what is common to all.
FACTOR_SPREAD = 0.10
GAIN_SPREAD, PRESSURE_SPREAD, CURVE_SPREAD, LAG_SPREAD_S = 0.10, 0.30, 0.10, 0.03
# Whole PWM periods of about this time, so that the pulses cancel.
WINDOW_S = 0.18
# A count older than this leaves a gap.
GAP_S = 0.5
# Of a window: meter and its pulses, and each valve's own lag where it opens or closes.
NOISE_SHARE, NOISE_ML, EDGE_S = 0.01, 0.3, 0.02
# The flights are cut into so many parts; each is left out once, to see how far the answer moves.
PARTS = 20
PART_WINDOWS_MIN = 4
NORMAL_95 = 1.96


@dataclass(frozen=True, slots=True, kw_only=True)
class Windows:
    """One flight, window by window: each valve's table volume, common columns, meter, spread."""

    valves_ml: Floats
    common_ml: Floats
    metered_ml: Floats
    spread_ml: Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftedValves:
    """Each valve's factor on what its configuration says, and in how many windows they differed."""

    factors: tuple[Estimate, ...]
    windows: int
    apart: int


def drift(
    journals: Annotated[
        list[Path], typer.Argument(help="Journals of flights with one sprayer, with a flow meter.")
    ],
    meter_lag_s: Annotated[
        float, typer.Option(help="Delay of the meter, including its message, in seconds.")
    ] = 0.001,
    as_json: AsJson = False,
) -> None:
    """Find valves whose flow has drifted: blocked or worn nozzles.

    From the total flow meter, wherever the valves sprayed differently. Exit 0: none is further
    than 5 % off; 1: one is, or the flights do not tell; 2: a journal cannot be used.

    Example: vrspray calibrate drift flights/*.gpkg
    """
    from analysis.journals.content import read_journal
    from companion.errors import ConfigError

    if not 0.0 <= meter_lag_s <= 1.0:
        raise ConfigError(f"--meter-lag-s {meter_lag_s:g}: give 0 to 1 s")
    names: list[str] = []
    flights = []
    for journal in journals:
        content = read_journal(journal)
        setup = content.setup
        own = [valve.name for valve in setup.boom.valves]
        _check(journal, setup, own, names or own)
        names = own
        record = record_of(content.items(), setup)
        if len(record.time_s) < 2:
            raise JournalError(f"{journal}: has no flow meter readings, so nothing tells valves")
        flights.append(windows_of(record, setup, meter_lag_s=meter_lag_s))
    found = drifted(flights)
    if found is None:
        why = "the valves never sprayed differently for long enough: nothing tells them apart"
        answer({"error": why} if as_json else {}, (), as_json=as_json)
        note(f"error: {why}")
        raise typer.Exit(1)
    result = as_shape(found, names)
    answer(result, lines(result), as_json=as_json)
    if any(valve["verdict"] != "none" for valve in result["valves"]):
        raise typer.Exit(1)


def _check(journal: Path, setup: Setup, own: list[str], names: list[str]) -> None:
    """Refuse a flight from which single valves cannot be told."""
    if setup.pumping is not None:
        raise JournalError(f"{journal}: the pump makes the flow; no valve is dosed by itself")
    if len(own) < 2:
        raise JournalError(f"{journal}: has one valve; there is none to compare it with")
    if len(setup.nozzle_sets) > 1:
        raise JournalError(
            f"{journal}: changes between nozzle sets, which drift cannot judge; measure each "
            "valve with `vrspray calibrate valves`"
        )
    if own != names:
        raise JournalError(f"{journal}: is of other valves ({', '.join(own)}) than the first")


def windows_of(record: FlowRecord, setup: Setup, *, meter_lag_s: float) -> Windows:
    """Return a flight's windows with something to flow and the meter counting throughout."""
    period_s = record.period_s
    length_s = max(round(WINDOW_S / period_s), 1) * period_s
    edges_s = np.arange(record.time_s[0], record.time_s[-1], length_s)
    metered_ml = np.diff(np.interp(edges_s, record.time_s, record.volume_ml))
    largest, valves = setup.nozzle_sets[-1], setup.boom.valves
    volumes_ml = np.zeros((len(edges_s), len(valves)))
    lag_ml = np.zeros((len(edges_s) - 1, 4))
    edge_ml = np.zeros(len(edges_s) - 1)
    open_s = np.zeros((len(edges_s), len(valves)))
    lags = [record.lag.of_valve(valve) for valve in valves]
    for order in record.orders:
        if order.valve not in largest.valves:
            continue
        change_ml_s = order.change_ml_s * largest.share(order.valve)
        kind, mid_s, half_s = _effect(order, lags[order.valve])
        from_s = order.at_s + mid_s + meter_lag_s - half_s
        volumes_ml[:, order.valve] += change_ml_s * _risen(edges_s - from_s, 2.0 * half_s)
        if kind < 2:
            sign = 1.0 if kind == 0 else -1.0
            open_s[:, order.valve] += sign * _risen(edges_s - from_s, 2.0 * half_s)
        window = int((from_s + half_s - edges_s[0]) // length_s)
        if 0 <= window < len(edge_ml):
            lag_ml[window, kind] -= change_ml_s
            if kind < 2:
                edge_ml[window] += (change_ml_s * EDGE_S) ** 2
    expected_ml = np.diff(volumes_ml, axis=0)
    total_ml = expected_ml.sum(axis=1)
    shut = 1.0 - np.diff(open_s, axis=0).sum(axis=1) / (length_s * len(largest.valves))
    newest = np.searchsorted(record.time_s, edges_s, "right") - 1
    gaps_s = np.diff(record.time_s)
    far = np.concatenate(([0.0], np.cumsum(gaps_s > GAP_S)))
    until = np.minimum(newest + 1, len(far) - 1)
    kept = (total_ml > 1e-6) & (far[until[1:]] == far[newest[:-1]]) & (metered_ml >= 0.0)
    # The flow of a valve that is open, on the flight's middle one: bends of the table are common.
    each_ml = total_ml / np.maximum(1.0 - shut, 0.05)
    middle_ml = float(np.median(each_ml[kept])) if kept.any() else 1.0
    bend = np.clip(each_ml / middle_ml - 1.0, -1.0, 1.0)
    common_ml = np.column_stack(
        [total_ml, total_ml * shut, total_ml * bend, total_ml * bend**2, lag_ml]
    )
    spread_ml = np.sqrt((NOISE_ML + NOISE_SHARE * total_ml) ** 2 + edge_ml)
    return Windows(
        valves_ml=expected_ml[kept],
        common_ml=common_ml[kept],
        metered_ml=metered_ml[kept],
        spread_ml=spread_ml[kept],
    )


def _effect(order: Order, lag: LagModel) -> tuple[int, float, float]:
    """Return the kind of a change, and when half of it and how much of a ramp has come [s]."""
    if order.before_ml_s <= 0.0:
        kind, mid_s, half_s = 0, lag.on_s, lag.on_s - lag.on_start_s
    elif order.after_ml_s <= 0.0:
        kind, mid_s, half_s = 1, lag.off_s, lag.off_end_s - lag.off_s
    else:
        is_up = order.after_ml_s > order.before_ml_s
        kind, mid_s = (2, lag.up_s) if is_up else (3, lag.down_s)
        half_s = mid_s
    return kind, mid_s + lag.output_s, max(min(half_s, mid_s), 1e-3)


def _risen(since_s: Floats, ramp_s: float) -> Floats:
    """Return the time for which a change that comes as a ramp has been there, as if whole."""
    within: Floats = np.clip(since_s, 0.0, ramp_s)
    return within**2 / (2.0 * ramp_s) + np.maximum(since_s - ramp_s, 0.0)


def drifted(flights: Sequence[Windows]) -> DriftedValves | None:
    """Return each valve's factor with 95 % intervals; None where nothing tells valves apart.

    The intervals are the wider of what the windows' spread says and what leaving out a part of
    the flights moves the answer by: a bend that we do not model is no noise.
    """
    count = flights[0].valves_ml.shape[1]
    rows, wrong, prior = _rows(flights, count)
    shares = np.concatenate(
        [each.valves_ml / each.common_ml[:, :1] - 1.0 / count for each in flights]
    )
    apart = int((np.abs(shares).max(axis=1) > 0.2 / count).sum()) if len(shares) else 0
    if len(rows) < PARTS * PART_WINDOWS_MIN or not apart:
        return None
    best, covariance = _fitted(rows, wrong, prior)
    left = wrong - rows @ best
    scale = max(float(left @ left) / len(left), 1.0)
    centred = np.eye(count) - 1.0 / count
    middle = centred @ best[:count]
    variance = scale * np.diag(centred @ covariance[:count, :count] @ centred)
    moved = np.zeros(count)
    part = np.arange(len(rows)) * PARTS // len(rows)
    for number in range(PARTS):
        other, _ = _fitted(rows[part != number], wrong[part != number], prior)
        moved += (centred @ other[:count] - middle) ** 2
    spread = np.sqrt(np.maximum(variance, moved * (PARTS - 1) / PARTS))
    factors = tuple(
        Estimate(
            value=1.0 + float(own),
            low=1.0 + float(own - NORMAL_95 * sd),
            high=1.0 + float(own + NORMAL_95 * sd),
            count=apart,
        )
        for own, sd in zip(middle, spread, strict=True)
    )
    return DriftedValves(factors=factors, windows=len(rows), apart=apart)


def _rows(flights: Sequence[Windows], count: int) -> tuple[Floats, Floats, Floats]:
    """Return the weighted rows of all flights, each with common columns of its own."""
    common = flights[0].common_ml.shape[1]
    width = count + common * len(flights)
    blocks, wrong = [], []
    for number, each in enumerate(flights):
        block = np.zeros((len(each.metered_ml), width))
        block[:, :count] = each.valves_ml
        block[:, count + number * common : count + (number + 1) * common] = each.common_ml
        blocks.append(block / each.spread_ml[:, None])
        wrong.append((each.metered_ml - each.valves_ml.sum(axis=1)) / each.spread_ml)
    spreads = [FACTOR_SPREAD] * count
    own = [GAIN_SPREAD, PRESSURE_SPREAD, CURVE_SPREAD, CURVE_SPREAD]
    spreads += [*own, *[LAG_SPREAD_S] * (common - len(own))] * len(flights)
    return np.concatenate(blocks), np.concatenate(wrong), np.array(spreads) ** -2.0


def _fitted(
    rows: Floats, wrong: Floats, prior: Floats
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    covariance = np.asarray(np.linalg.inv(rows.T @ rows + np.diag(prior)), dtype=np.float64)
    return covariance @ (rows.T @ wrong), covariance


def verdict_of(factor: Estimate) -> str:
    """Return `replace` beyond the trade's 10 %, `early` beyond 5 %, where the interval is sure."""
    off = max(factor.low - 1.0, 1.0 - factor.high)
    if off > WORN_SHARE:
        return "replace"
    return "early" if off > EARLY_SHARE else "none"


def as_shape(found: DriftedValves, names: Sequence[str]) -> dict[str, Any]:
    """Return the answer: each valve's factor and what it means."""
    return {
        "valves": [
            {
                "name": name,
                "flow_factor": {"value": own.value, "low": own.low, "high": own.high},
                "verdict": verdict_of(own),
            }
            for name, own in zip(names, found.factors, strict=True)
        ],
        "windows": found.windows,
        "windows_apart": found.apart,
    }


def lines(result: dict[str, Any]) -> Iterator[str]:
    """Yield the answer for a person."""
    yield "each valve against its configured flow, the mean of all 1; 95 % interval:"
    for valve in result["valves"]:
        own = valve["flow_factor"]
        yield f"  {valve['name']:>4s}  {own['value']:.3f} ({own['low']:.3f} to {own['high']:.3f})"
    for valve in result["valves"]:
        if valve["verdict"] == "none":
            continue
        off = 100.0 * (valve["flow_factor"]["value"] - 1.0)
        what = "is blocked" if off < 0.0 else "is worn"
        if valve["verdict"] == "early":
            what = "begins to block" if off < 0.0 else "begins to wear"
        yield (
            f"valve {valve['name']}: {off:+.0f} % from the others: its nozzle {what}, or its lag "
            "has changed; clean it, then measure with `vrspray calibrate valves`"
        )
    if all(valve["verdict"] == "none" for valve in result["valves"]):
        widest = max(
            0.5 * (each["flow_factor"]["high"] - each["flow_factor"]["low"])
            for each in result["valves"]
        )
        yield f"no valve is surely further than 5 % from the others (known to {widest:.1%})"
