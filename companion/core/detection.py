"""Clogs, leaks, stuck valves, air, an empty tank, a dead meter: noticed from flow and pressure.

Metered over expected flow is summed up (CUSUM: Page, Biometrika 41, 1954) beyond a slack that the
calibration's spread gives. The expected flow is the table's for the duties in force, so that the
trim, which changes duties, hides nothing. What closes the valves stays until the operator has
disabled spraying: a fault that went away by itself is no repair.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from companion.core.flow_window import ML_S_PER_L_MIN, STALE_S
from companion.core.liquid_bins import (
    LONGEST_BINS,
    Bin,
    Collecting,
    collected,
    duties_of,
    heard,
    pressed,
    with_orders,
)
from companion.core.liquid_findings import (
    Findings,
    of_closed,
    of_sensors,
    of_spraying,
    told_apart,
)
from companion.core.liquid_law import Detection, Watching
from companion.core.types import FlowReport, Inhibit, SprayPlan, VehicleState

# In standard deviations of the calibration: what is no evidence, and how much of it, times a
# second, is an alarm. With the default spread 4 % and 8.75 % x s: a tenth of the flow in 1.5 s,
# and healthy bins would have to be 8 % off for two seconds.
SLACK_SPREADS = 3.2
ALARM_SPREADS_S = 7.0
# Of one bin: a single wrong one, such as at an edge that came late, is no alarm.
EVIDENCE_MAX = 0.25
# The meter's own gain is learnt in the mean of this time, and within this: it is no fault.
LEARN_S = 20.0
GAIN_SPREADS = 4.0
BINS_KEPT = 64
NOTHING_SHARE = 0.1


class WatchMemory(NamedTuple):
    """What is known of the liquid from one step to the next.

    `low` and `high` are the sums of evidence and how many bins they began ago; `gain` is the
    meter's own, learnt within bounds.
    """

    collecting: Collecting = Collecting()
    bins: tuple[Bin, ...] = ()
    closed: tuple[Bin, ...] = ()
    low: tuple[float, int] = (0.0, 0)
    high: tuple[float, int] = (0.0, 0)
    nothing_s: float = 0.0
    air: bool = False
    gain: float = 1.0
    pressure_gain: float = 1.0
    learnt_s: float = 0.0
    changed_s: float = -math.inf
    open_s: float = -math.inf  # when a valve was last ordered open
    heard_s: float = -math.inf  # when the meter last said something sound
    enabled: bool = False
    findings: Findings = ()
    latched: frozenset[Inhibit] = frozenset()


def follow(
    watching: Watching,
    memory: WatchMemory,
    plan: SprayPlan | None,
    state: VehicleState | None,
    *,
    index: int,
    now_s: float,
) -> WatchMemory:
    """Return the memory after what came by `now_s`; `plan` was in force until now."""
    if state is None:
        return memory
    memory = _enabled(memory, state)
    if plan is not None:
        memory = _ordered(watching, memory, plan, index, now_s)
    collecting = heard(
        memory.collecting,
        state.position_received_s,
        keep_from_s=now_s - _kept_s(watching),
        now_s=now_s,
    )
    collecting = pressed(collecting, state.pressure, delay_s=watching.delay_s, now_s=now_s)
    collecting, filled = collected(
        collecting, state.flow, bin_s=watching.bin_s, delay_s=watching.delay_s, now_s=now_s
    )
    memory = memory._replace(collecting=collecting, heard_s=_heard(memory, state.flow, now_s))
    if filled is not None:
        memory = _judged(watching, memory, filled, state)
    return of_sensors(watching, memory, state, now_s)


def _kept_s(watching: Watching) -> float:
    """Return how long orders are needed: until the bin that they are in is filled."""
    return watching.delay_s + LONGEST_BINS * watching.bin_s + 3.0 * STALE_S


def _heard(memory: WatchMemory, report: FlowReport | None, now_s: float) -> float:
    """Return when the meter was last sound; before its first word from the first step on."""
    if memory.heard_s == -math.inf:
        return now_s
    if report is None or not math.isfinite(report.volume_ml):
        return memory.heard_s
    return max(memory.heard_s, min(report.received_s, now_s))


def _enabled(memory: WatchMemory, state: VehicleState) -> WatchMemory:
    """Disabling takes the latches back, the next enable begins with an empty list."""
    if state.enabled == memory.enabled:
        return memory
    if not state.enabled:
        return memory._replace(enabled=False, latched=frozenset())
    return memory._replace(
        enabled=True,
        findings=(),
        bins=(),
        closed=(),
        low=(0.0, 0),
        high=(0.0, 0),
        nothing_s=0.0,
        air=False,
    )


def _ordered(
    watching: Watching, memory: WatchMemory, plan: SprayPlan, index: int, now_s: float
) -> WatchMemory:
    before = memory.collecting.orders
    orders = with_orders(
        before,
        (watching.order(at_s, duties, index) for at_s, duties in duties_of(plan, now_s)),
        keep_from_s=now_s - _kept_s(watching),
    )
    changed_s, open_s = memory.changed_s, memory.open_s
    if orders and any(orders[-1].flows_ml_s):
        open_s = now_s
    elif before and any(before[-1].flows_ml_s):
        open_s = orders[-1].at_s
    if watching.settle_s > 0.0 and orders and before:
        then, now = math.fsum(before[-1].flows_ml_s), math.fsum(orders[-1].flows_ml_s)
        if not abs(now - then) <= 0.03 * max(now, then):
            changed_s = now_s
    return memory._replace(
        collecting=memory.collecting._replace(orders=orders), changed_s=changed_s, open_s=open_s
    )


def _judged(
    watching: Watching, memory: WatchMemory, filled: Bin, state: VehicleState
) -> WatchMemory:
    """Return the memory after one bin: sums of evidence, what was learnt, and what was found."""
    expected_ml = memory.gain * filled.all_ml
    length_s = filled.end_s - filled.begin_s
    if expected_ml <= 0.0:
        if not filled.begin_s - memory.open_s >= watching.closed_after_s:
            return memory._replace(closed=())
        memory = memory._replace(closed=(*memory.closed[-7:], filled))
        return of_closed(watching, memory)
    minimum_ml_s = watching.law.meter_minimum_l_min * ML_S_PER_L_MIN
    if not (
        filled.is_whole
        and expected_ml >= minimum_ml_s * length_s
        and filled.begin_s - memory.changed_s >= watching.settle_s
    ):
        return memory
    error = filled.metered_ml / expected_ml - 1.0
    memory = _summed(watching, memory, filled, error)
    if abs(error) <= watching.law.spread * SLACK_SPREADS and max(memory.low[0], memory.high[0]) < (
        0.5 * ALARM_SPREADS_S * watching.law.spread
    ):
        memory = _learnt(watching, memory, filled)
    alarm = ALARM_SPREADS_S * watching.law.spread
    if memory.low[0] >= alarm or memory.high[0] >= alarm or memory.nothing_s > 0.0:
        memory = of_spraying(watching, memory, state, alarm=alarm)
    return told_apart(watching, memory) if memory.findings else memory


def _summed(watching: Watching, memory: WatchMemory, filled: Bin, error: float) -> WatchMemory:
    slack = watching.law.spread * SLACK_SPREADS
    most = 2.0 * ALARM_SPREADS_S * watching.law.spread
    length_s = filled.end_s - filled.begin_s

    def more(before: tuple[float, int], beyond: float) -> tuple[float, int]:
        evidence = min(beyond, EVIDENCE_MAX) - slack
        total = min(max(before[0] + evidence * length_s, 0.0), most)
        return (total, min(before[1] + 1, BINS_KEPT)) if total > 0.0 else (0.0, 0)

    is_nothing = not error > NOTHING_SHARE - 1.0
    return memory._replace(
        bins=(*memory.bins[-(BINS_KEPT - 1) :], filled),
        closed=(),
        low=more(memory.low, -error),
        high=more(memory.high, error),
        nothing_s=memory.nothing_s + length_s if is_nothing else 0.0,
    )


def _learnt(watching: Watching, memory: WatchMemory, filled: Bin) -> WatchMemory:
    """Return the meter's gain, and the pressure sensor's, a step nearer to what is seen."""
    length_s = filled.end_s - filled.begin_s
    learnt_s = min(memory.learnt_s + length_s, LEARN_S)
    share, room = length_s / learnt_s, GAIN_SPREADS * watching.law.spread
    gain = memory.gain + share * (filled.metered_ml / filled.all_ml - memory.gain)
    pressure_gain = memory.pressure_gain
    if filled.pressure is not None:
        pressure_gain += share * (filled.pressure - pressure_gain)
    return memory._replace(
        gain=min(max(gain, 1.0 - room), 1.0 + room),
        pressure_gain=min(max(pressure_gain, 1.0 - room), 1.0 + room),
        learnt_s=learnt_s,
    )


def inhibits_of(memory: WatchMemory | None) -> frozenset[Inhibit]:
    """Return the reasons not to spray that flow, pressure and tank give."""
    return frozenset() if memory is None else memory.latched


__all__ = ["Detection", "WatchMemory", "Watching", "follow", "inhibits_of"]
