"""Each valve's flow against the others', tracked slowly from the total flow meter.

Where valves spray differently (skew borders, sections, zones beside each other) the total tells
them apart: what the meter counts beyond the table is split into what single valves give more or
less than the mean, and what is common to all (gain, pressure, bend of the table, lags). A Kalman
filter does it window by window, whose prior pulls every factor back to 1. Where the valves do the
same, only the common part learns: the meter's gain never moves a factor, and so never the dose.

Plain Python on purpose: sums of linear algebra libraries differ from computer to computer, and a
replay must be equal to the bit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from companion.core.arithmetic import exp
from companion.core.nozzle import NozzleSet
from companion.core.options.flow_meter import ML_S_PER_L_MIN, is_usable
from companion.core.schedule import LagModel
from companion.core.types import FaultKind, Finding, FlowReport, PwmLimits, SprayPlan

if TYPE_CHECKING:
    from companion.core.boom import Boom

# Whole PWM periods of about this time, so that the pulses cancel.
WINDOW_S = 0.18
# Of what the valves give in a window: one that differs less from its share tells nothing of them.
APART_SHARE = 0.2
# One standard deviation before any flight: of a valve's factor, and of what is common to all.
FACTOR_SPREAD = 0.05
GAIN_SPREAD, PRESSURE_SPREAD, BEND_SPREAD, LAG_SPREAD_S = 0.10, 0.30, 0.10, 0.03
# Of a window: meter and its pulses, and each valve's own lag where it opens or closes.
NOISE_SHARE, NOISE_ML, EDGE_S = 0.008, 0.1, 0.006
# A window further off than this is a fault or a burst of pulses; it counts no more than one here.
OUTLIER_SPREADS = 3.0
# A valve is named where it is surely this far from the others: half of what the trade's rule
# replaces a nozzle at (ISO 16122-2), and in so many standard deviations, as it is asked all the
# time.
NAMED_SHARE, NAMED_SPREADS = 0.05, 3.0
# Of a deviation, so many standard deviations are taken for noise: the dose follows the rest.
SURE_SPREADS = 2.0
# What is off for so many windows on end, about the time in a small zone, is our model and no noise:
# their variance is scaled by it. Never by less than this, by which factors of scattered valves on
# the twin err as their spreads say; it follows over so many such blocks.
BLOCK_WINDOWS = 8
SCALE_LEAST, SCALE_BLOCKS = 3.0, 25.0
_COMMON = (GAIN_SPREAD, PRESSURE_SPREAD, PRESSURE_SPREAD, BEND_SPREAD, *(LAG_SPREAD_S,) * 4)


@dataclass(frozen=True, slots=True, kw_only=True)
class ValveTracking:
    """How far a factor may go from 1, how slowly, and when the meter can be believed."""

    limit: float = 0.10
    tau_s: float = 3600.0
    meter_delay_s: float = 0.001
    meter_minimum_l_min: float = 0.5

    def __post_init__(self) -> None:
        if not 0.01 <= self.limit <= 0.2:
            raise ValueError(f"limit must lie in [0.01, 0.2], got {self.limit}")
        if not 60.0 <= self.tau_s <= 36_000.0:
            raise ValueError(f"tau_s must lie in [60, 36000] s, got {self.tau_s}")
        if not 0.0 <= self.meter_delay_s <= 1.0:
            raise ValueError(f"meter_delay_s must lie in [0, 1] s, got {self.meter_delay_s}")
        if not 0.0 <= self.meter_minimum_l_min <= 1e4:
            raise ValueError(
                f"meter_minimum_l_min must lie in [0, 1e4], got {self.meter_minimum_l_min}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracking:
    """The settings on one sprayer: its set, the lags of each valve, and the length of a window."""

    settings: ValveTracking
    nozzles: NozzleSet
    lags: tuple[LagModel, ...]
    window_s: float
    still: Valves
    prior: tuple[float, ...]

    @classmethod
    def of(
        cls,
        settings: ValveTracking,
        boom: Boom,
        nozzle_sets: tuple[NozzleSet, ...],
        lag: LagModel,
        pwm: PwmLimits,
    ) -> Tracking:
        """Return the settings for a sprayer with one nozzle set of at least two valves."""
        if len(nozzle_sets) != 1 or len(nozzle_sets[0].valves) < 2:
            raise ValueError("valves are tracked with one nozzle set of two valves or more")
        count = len(nozzle_sets[0].valves)
        spreads = (FACTOR_SPREAD,) * count + _COMMON
        all_shut = (0.0,) * len(boom.valves)
        return cls(
            settings=settings,
            nozzles=nozzle_sets[0],
            lags=tuple(lag.of_valve(valve) for valve in boom.valves),
            window_s=max(round(WINDOW_S / pwm.period_s), 1) * pwm.period_s,
            still=Valves(all_shut, all_shut, 0.0, ()),
            prior=tuple(spread * spread for spread in spreads),
        )


class Edge(NamedTuple):
    """A change of a valve's flow, that comes as a ramp; `opens` is 1, -1 or 0."""

    from_s: float
    ramp_s: float
    valve: int
    change_ml_s: float
    kind: int
    opens: float


class Valves(NamedTuple):
    """What was ordered: duties, flow and open valves of changes that are over, and the others."""

    duty: tuple[float, ...]
    flow_ml_s: tuple[float, ...]
    open_count: float
    edges: tuple[Edge, ...]


class Estimate(NamedTuple):
    """Deviations of the valves, then what is common; their covariance; scale of the variance.

    `block` is what the windows since the last whole block were off by, in standard deviations.
    """

    values: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    scale: float = SCALE_LEAST
    block: tuple[float, ...] = ()


class TrackMemory(NamedTuple):
    """What is known from one step to the next; `nozzles` is the set with the factors in force."""

    valves: Valves
    estimate: Estimate
    nozzles: NozzleSet
    report: FlowReport | None = None
    begun_s: float | None = None
    begun_ml: float = 0.0
    findings: tuple[Finding, ...] = ()


class Window(NamedTuple):
    """One window's row of the regression, beside what the meter counted beyond the table."""

    row: tuple[float, ...]
    beyond_ml: float
    variance: float


def begin(tracking: Tracking) -> TrackMemory:
    """Return what a flight begins with: every factor is 1."""
    size = len(tracking.prior)
    covariance = tuple(
        tuple(tracking.prior[row] if row == column else 0.0 for column in range(size))
        for row in range(size)
    )
    estimate = Estimate((0.0,) * size, covariance)
    return TrackMemory(tracking.still, estimate, tracking.nozzles)


def follow(
    tracking: Tracking,
    memory: TrackMemory | None,
    plan: SprayPlan | None,
    report: FlowReport | None,
    *,
    now_s: float,
) -> TrackMemory:
    """Return the memory after what `plan` has brought about and the meter's newest count."""
    memory = memory or begin(tracking)
    if plan is not None:
        memory = memory._replace(valves=_ordered(tracking, memory.valves, plan, now_s))
    last = memory.report
    if not is_usable(report, last, now_s):
        sound = report if report is not None and math.isfinite(report.volume_ml) else None
        return memory._replace(report=sound, begun_s=None, valves=_folded(memory.valves, now_s))
    assert report is not None  # is_usable
    if last is None or memory.begun_s is None:
        begun_s, begun_ml = _seen_s(tracking, report), report.volume_ml
        return memory._replace(report=report, begun_s=begun_s, begun_ml=begun_ml)
    return _counted(tracking, memory, last, report)


def _seen_s(tracking: Tracking, report: FlowReport) -> float:
    return report.received_s - tracking.settings.meter_delay_s


def _counted(
    tracking: Tracking, memory: TrackMemory, last: FlowReport, report: FlowReport
) -> TrackMemory:
    """Return the memory with every window that has ended by the newest count."""
    until_s, from_s = _seen_s(tracking, report), _seen_s(tracking, last)
    begun_s, begun_ml, valves, estimate = (
        memory.begun_s, memory.begun_ml, memory.valves, memory.estimate,
    )  # fmt: skip
    assert begun_s is not None
    while begun_s + tracking.window_s <= until_s:
        end_s = begun_s + tracking.window_s
        share = (end_s - from_s) / (until_s - from_s)
        end_ml = last.volume_ml + share * (report.volume_ml - last.volume_ml)
        window = window_of(tracking, valves, begun_s, end_s, end_ml - begun_ml)
        if window is not None:
            estimate = updated(tracking, estimate, window)
        begun_s, begun_ml, valves = end_s, end_ml, _folded(valves, end_s)
    nozzles, findings = memory.nozzles, memory.findings
    if estimate is not memory.estimate:
        found = deviations(tracking, estimate)
        nozzles = _tracked(tracking, found)
        findings = _named(tracking, found, findings, at_s=report.received_s)
    return TrackMemory(valves, estimate, nozzles, report, begun_s, begun_ml, findings)


# ------------------------------------------------------------------------------ what was ordered


def _ordered(tracking: Tracking, valves: Valves, plan: SprayPlan, now_s: float) -> Valves:
    """Return the valves with what a plan, until now the newest, has brought about by `now_s`."""
    duty, edges, lease_s = list(valves.duty), list(valves.edges), plan.lease_until_s

    def put(at_s: float, valve: int, after: float) -> None:
        if after != duty[valve]:
            edge = _edge(tracking, valve, at_s, duty[valve], after)
            duty[valve] = after
            if edge is not None:
                edges.append(edge)

    for valve, after in enumerate(plan.duty):
        put(plan.issued_s, valve, after)
    for change in plan.changes:
        if change.at_s > now_s or change.at_s >= lease_s:
            break
        put(change.at_s, change.valve, change.duty)
    if lease_s <= now_s:
        for valve in range(len(duty)):
            put(lease_s, valve, 0.0)
    if len(edges) == len(valves.edges):
        return valves
    return Valves(tuple(duty), valves.flow_ml_s, valves.open_count, tuple(edges))


def _edge(tracking: Tracking, valve: int, at_s: float, before: float, after: float) -> Edge | None:
    """Return when a change of duty reaches the meter; None of a valve that the set lacks."""
    nozzles, lag = tracking.nozzles, tracking.lags[valve]
    if valve not in nozzles.valves:
        return None
    opens = 0.0
    if before <= 0.0:
        kind, opens, mid_s, half_s = 0, 1.0, lag.on_s, lag.on_s - lag.on_start_s
    elif after <= 0.0:
        kind, opens, mid_s, half_s = 1, -1.0, lag.off_s, lag.off_end_s - lag.off_s
    else:
        kind, mid_s = (2, lag.up_s) if after > before else (3, lag.down_s)
        half_s = mid_s
    half_s = max(min(half_s, mid_s), 1e-3)
    share_ml_s = nozzles.share(valve) * ML_S_PER_L_MIN / len(nozzles.valves)
    change_ml_s = (nozzles.curve.flow_for(after) - nozzles.curve.flow_for(before)) * share_ml_s
    from_s = at_s + mid_s + lag.output_s - half_s
    return Edge(from_s, 2.0 * half_s, valve, change_ml_s, kind, opens)


def _risen(since_s: float, ramp_s: float) -> float:
    """Return the time for which a change that comes as a ramp has been there, as if whole."""
    if since_s <= 0.0:
        return 0.0
    return since_s * since_s / (2.0 * ramp_s) if since_s < ramp_s else since_s - 0.5 * ramp_s


def _folded(valves: Valves, at_s: float) -> Valves:
    """Return the valves with the changes that are over at `at_s` in their flow."""
    over = [edge for edge in valves.edges if edge.from_s + edge.ramp_s <= at_s]
    if not over:
        return valves
    flow_ml_s, open_count = list(valves.flow_ml_s), valves.open_count
    for edge in over:
        flow_ml_s[edge.valve] += edge.change_ml_s
        open_count += edge.opens
    left = tuple(edge for edge in valves.edges if edge.from_s + edge.ramp_s > at_s)
    return Valves(valves.duty, tuple(flow_ml_s), open_count, left)


# ---------------------------------------------------------------------------- what a window tells


def window_of(
    tracking: Tracking, valves: Valves, from_s: float, until_s: float, metered_ml: float
) -> Window | None:
    """Return what a window tells; None where too little flows for the meter."""
    nozzles, length_s = tracking.nozzles, until_s - from_s
    count = len(nozzles.valves)
    each_ml = [flow_ml_s * length_s for flow_ml_s in valves.flow_ml_s]
    open_s, variance, lags_ml = valves.open_count * length_s, 0.0, [0.0] * 4
    for edge in valves.edges:
        there_s = _risen(until_s - edge.from_s, edge.ramp_s)
        there_s -= _risen(from_s - edge.from_s, edge.ramp_s)
        each_ml[edge.valve] += edge.change_ml_s * there_s
        open_s += edge.opens * there_s
        if from_s <= edge.from_s + 0.5 * edge.ramp_s < until_s:
            lags_ml[edge.kind] -= edge.change_ml_s
            if edge.opens:
                variance += (edge.change_ml_s * EDGE_S) ** 2
    own_ml = [each_ml[valve] for valve in nozzles.valves]
    total_ml = math.fsum(own_ml)
    minimum_ml = tracking.settings.meter_minimum_l_min * ML_S_PER_L_MIN * length_s
    if not total_ml > max(minimum_ml, 1e-6) or not metered_ml >= 0.0:
        return None
    shares = nozzles.shares or (1.0,) * count
    apart_ml = tuple(
        own - share * total_ml / count for own, share in zip(own_ml, shares, strict=True)
    )
    if not max(map(abs, apart_ml)) > APART_SHARE * total_ml / count:
        apart_ml = (0.0,) * count
    opened = min(max(open_s / (length_s * count), 0.05), 1.0)
    # The flow of the valves that are open, on the middle of the table: bends of it are common.
    curve = nozzles.curve
    middle_ml = 0.5 * (curve.flow_l_min[0] + curve.flow_l_min[-1]) * ML_S_PER_L_MIN * length_s
    bend = min(max(total_ml / opened / middle_ml - 1.0, -1.0), 1.0)
    shut = 1.0 - opened
    common_ml = (total_ml, total_ml * shut, total_ml * shut * shut, total_ml * bend, *lags_ml)
    variance += NOISE_ML**2 + (NOISE_SHARE * total_ml) ** 2
    return Window(apart_ml + common_ml, metered_ml - total_ml, variance)


def updated(tracking: Tracking, before: Estimate, window: Window) -> Estimate:
    """Return the estimate after a window: faded towards the prior, then corrected."""
    kept = exp(-tracking.window_s / tracking.settings.tau_s)
    values = [kept * value for value in before.values]
    faded, size = kept * kept, len(values)
    covariance = [[faded * each for each in row] for row in before.covariance]
    for index, prior in enumerate(tracking.prior):
        covariance[index][index] += (1.0 - faded) * prior
    row = window.row
    used = [index for index in range(size) if row[index]]
    seen = [math.fsum([line[index] * row[index] for index in used]) for line in covariance]
    told = math.fsum([row[index] * seen[index] for index in used])
    variance = window.variance * max(before.scale, SCALE_LEAST) + told
    wrong = window.beyond_ml - math.fsum([row[index] * values[index] for index in used])
    off = wrong / math.sqrt(variance)
    if abs(off) > OUTLIER_SPREADS:
        wrong, off = wrong * OUTLIER_SPREADS / abs(off), math.copysign(OUTLIER_SPREADS, off)
    gain = [each / variance for each in seen]
    scale, block = before.scale, (*before.block, wrong / math.sqrt(window.variance + told))
    if len(block) == BLOCK_WINDOWS:
        scale += (math.fsum(block) ** 2 / BLOCK_WINDOWS - scale) / SCALE_BLOCKS
        block = ()
    return Estimate(
        tuple(value + each * wrong for value, each in zip(values, gain, strict=True)),
        tuple(
            tuple(each - factor * other for each, other in zip(line, seen, strict=True))
            for line, factor in zip(covariance, gain, strict=True)
        ),
        scale,
        block,
    )


# ------------------------------------------------------------------------------ what follows of it


def deviations(tracking: Tracking, estimate: Estimate) -> list[tuple[float, float]]:
    """Return how far each valve is from the mean of all, and one standard deviation of that.

    What all have in common no meter can tell from its own gain, so it counts for neither.
    """
    nozzles = tracking.nozzles
    count = len(nozzles.valves)
    weights = [share / count for share in nozzles.shares or (1.0,) * count]
    values = estimate.values[:count]
    mean = math.fsum([weight * value for weight, value in zip(weights, values, strict=True)])
    rows = [line[:count] for line in estimate.covariance[:count]]
    with_mean = [
        math.fsum([weight * each for weight, each in zip(weights, row, strict=True)])
        for row in rows
    ]
    of_mean = math.fsum([weight * each for weight, each in zip(weights, with_mean, strict=True)])
    return [
        (value - mean, math.sqrt(max(rows[own][own] - 2.0 * with_mean[own] + of_mean, 0.0)))
        for own, value in enumerate(values)
    ]


def _tracked(tracking: Tracking, found: list[tuple[float, float]]) -> NozzleSet:
    """Return the nozzle set with the shares in force: of a deviation only what is sure counts.

    All are drawn in where one is beyond the limit, so that their mean stays 1.
    """
    nozzles = tracking.nozzles
    count = len(found)
    shares = nozzles.shares or (1.0,) * count
    sure = [math.copysign(max(abs(off) - SURE_SPREADS * sd, 0.0), off) for off, sd in found]
    if not any(sure):
        return nozzles
    mean = math.fsum([share * off for share, off in zip(shares, sure, strict=True)]) / count
    sure = [off - mean for off in sure]
    largest, limit = max(map(abs, sure)), tracking.settings.limit
    drawn = limit / largest if largest > limit else 1.0
    own = tuple(share * (1.0 + drawn * off) for share, off in zip(shares, sure, strict=True))
    return NozzleSet(valves=nozzles.valves, curve=nozzles.curve, shares=own)


def _named(
    tracking: Tracking,
    found: list[tuple[float, float]],
    told: tuple[Finding, ...],
    *,
    at_s: float,
) -> tuple[Finding, ...]:
    """Return the findings with the valves that are surely off; each is named once a flight."""
    known = {finding.valve for finding in told}
    of_others = len(found) / (len(found) - 1.0)
    for valve, (off, sd) in zip(tracking.nozzles.valves, found, strict=True):
        if valve in known or not of_others * (abs(off) - NAMED_SPREADS * sd) > NAMED_SHARE:
            continue
        more = "more" if off > 0.0 else "less"
        text = f"gives {of_others * abs(off):.0%} {more} than the others, see its nozzle"
        finding = Finding(kind=FaultKind.VALVE_DRIFT, at_s=at_s, text=text, valve=valve)
        told = (*told, finding)
    return told
