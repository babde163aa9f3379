"""Clogs, leaks, stuck valves, air, an empty tank, a dead meter: noticed from flow and pressure.

Metered over expected flow is summed up (CUSUM: Page, Biometrika 41, 1954) beyond a slack that the
calibration's spread gives. The expected flow is the table's for the duties in force, so that the
trim, which changes duties, hides nothing. What closes the valves stays until the operator has
disabled spraying: a fault that went away by itself is no repair.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from companion.core.options.flow_meter import ML_S_PER_L_MIN, STALE_S, Watching
from companion.core.options.liquid_evidence import (
    LONGEST_BINS,
    Bin,
    Collecting,
    Evidence,
    collected,
    heard,
    name_of,
    name_of_no_flow,
    pressed,
    valve_of,
    with_orders,
)
from companion.core.types import FaultKind, Finding, FlowReport, Inhibit, SprayPlan, VehicleState

# From evidence to findings: which fault, of which valve, and whether it closes the valves.

Findings = tuple[Finding, ...]

# What is shorter than so many bins of the usual length has no name yet; nothing for so long is no
# flow (5 of 0.27 s: 1.4 s).
BINS_NAMED = 4
NOTHING_S = 1.3
# While closed: so many bins after the first with liquid in it, the last two with liquid as well.
# What closed late leaves its end in the first ones; a fault that begins fills the first in part.
CLOSED_BINS = 3
CLOSED_LAST_BINS = 2
# Further from the table than this nothing is sprayed, whatever it is.
FAR_SHARE = 0.25
# Without a sound word of the meter for this long, while valves are open, it is silent.
SILENT_S = 1.5
CLOSING = {
    FaultKind.LEAK: Inhibit.LEAK,
    FaultKind.STUCK_OPEN: Inhibit.VALVE_STUCK_OPEN,
    FaultKind.NO_FLOW: Inhibit.NO_FLOW,
    FaultKind.PUMP_OFF: Inhibit.NO_FLOW,
    FaultKind.TANK_EMPTY: Inhibit.TANK_EMPTY,
    FaultKind.TANK_LOW: Inhibit.TANK_EMPTY,
}
# One of these at a time: what is wrong with the flow. It may be named better within this time.
_OF_THE_FLOW = frozenset(
    {
        FaultKind.CLOG,
        FaultKind.STUCK_CLOSED,
        FaultKind.LEAK,
        FaultKind.STUCK_OPEN,
        FaultKind.SUPPLY,
        FaultKind.AIR,
        FaultKind.PUMP_OFF,
        FaultKind.TANK_EMPTY,
        FaultKind.NO_FLOW,
        FaultKind.DEAD_METER,
    }
)
_SURE = frozenset(
    {FaultKind.PUMP_OFF, FaultKind.TANK_EMPTY, FaultKind.NO_FLOW, FaultKind.DEAD_METER}
)
RENAMED_S = 3.0
_OF_ONE_VALVE = {
    FaultKind.CLOG: False,
    FaultKind.STUCK_CLOSED: False,
    FaultKind.STUCK_OPEN: True,
}
_TEXTS = {
    FaultKind.CLOG: "clog",
    FaultKind.STUCK_CLOSED: "valve does not open, or clogged",
    FaultKind.LEAK: "leak, or worn nozzles",
    FaultKind.STUCK_OPEN: "valve does not close, or leak",
    FaultKind.SUPPLY: "supply: pump, regulator, filter",
    FaultKind.AIR: "air in the line",
    FaultKind.PUMP_OFF: "no pressure: pump off",
    FaultKind.TANK_EMPTY: "tank empty",
    FaultKind.NO_FLOW: "no flow: valves do not open, or no pump",
    FaultKind.DEAD_METER: "pressure as ever: flow meter dead",
}


def of_spraying(
    watching: Watching, memory: WatchMemory, state: VehicleState, *, alarm: float
) -> WatchMemory:
    """Return the memory with the name of what the sums of evidence say, once it has one."""
    if memory.nothing_s > 0.0:
        if memory.nothing_s < NOTHING_S:
            return memory
        count = max(round(memory.nothing_s / watching.bin_s), 2)
        evidence = _evidence(watching, memory, count)
        name = name_of_no_flow(
            evidence,
            is_air_before=memory.air,
            is_tank_low=_is_tank_low(watching, state),
        )
        return _found(watching, memory, name, evidence)
    count = memory.low[1] if memory.low[0] >= alarm else memory.high[1]
    length_s = math.fsum(each.end_s - each.begin_s for each in memory.bins[-count:])
    if count < 2 or length_s < (BINS_NAMED - 0.5) * watching.bin_s:
        return memory
    evidence = _evidence(watching, memory, count)
    return _found(watching, memory, name_of(evidence), evidence)


def with_valve_told(watching: Watching, memory: WatchMemory) -> WatchMemory:
    """Return the memory with the valve of a fault that has none yet, once the orders tell it."""
    for finding in memory.findings:
        is_open = _OF_ONE_VALVE.get(finding.kind)
        if is_open is None or finding.valve is not None:
            continue
        since_s = finding.at_s - BINS_NAMED * watching.bin_s
        bins = [each for each in memory.bins if each.begin_s >= since_s]
        valve = _valve(watching, memory, bins, is_open=is_open)
        if valve is not None:
            return _with(memory, replace(finding, valve=valve))
    return memory


def of_closed(watching: Watching, memory: WatchMemory) -> WatchMemory:
    """Return the memory with what is metered while every valve is closed."""
    tolerated_ml_s = watching.settings.closed_share * watching.full_ml_s
    wet = (i for i, each in enumerate(memory.closed) if _flow([each], memory.gain) > tolerated_ml_s)
    bins = memory.closed[next(wet, len(memory.closed)) + 1 :]
    if len(bins) < CLOSED_BINS or not watching.settings.closed_check:
        return memory
    flow_ml_s, last_ml_s = _flow(bins, memory.gain), _flow(bins[-CLOSED_LAST_BINS:], memory.gain)
    if not (flow_ml_s > tolerated_ml_s and last_ml_s > tolerated_ml_s):
        return memory
    is_valve = 0.8 <= flow_ml_s / watching.open_ml_s <= 1.2
    kind = FaultKind.STUCK_OPEN if is_valve else FaultKind.LEAK
    text = f"{_TEXTS[kind]}: {flow_ml_s * 0.06:.2f} L/min with all closed"
    valve = None
    if is_valve:
        together = [*memory.bins[-memory.high[1] :], *bins] if memory.high[1] else list(bins)
        valve = _valve(watching, memory, together, is_open=True)
    found = Finding(kind=kind, at_s=bins[-1].end_s, text=text, valve=valve)
    return _named(memory, found, is_sure=True)


def _flow(bins: Sequence[Bin], gain: float) -> float:
    """Return the mean flow in bins that follow each other, mL/s."""
    length_s = bins[-1].end_s - bins[0].begin_s
    return math.fsum(each.metered_ml for each in bins) / length_s / gain


def of_sensors(
    watching: Watching, memory: WatchMemory, state: VehicleState, now_s: float
) -> WatchMemory:
    """Return the memory with what the sensors say of themselves, and of the tank."""
    flow, is_open = state.flow, memory.open_s >= now_s - watching.delay_s
    if flow is not None and flow.fault:
        memory = _sensor(watching, memory, FaultKind.METER_FAULT, flow.fault, now_s)
    elif is_open and not now_s - memory.heard_s <= SILENT_S:
        memory = _sensor(watching, memory, FaultKind.METER_FAULT, "flow meter silent", now_s)
    pressure, tank = state.pressure, state.tank
    if pressure is not None and pressure.fault:
        memory = _sensor(watching, memory, FaultKind.PRESSURE_FAULT, pressure.fault, now_s)
    if tank is not None and tank.fault:
        memory = _sensor(watching, memory, FaultKind.TANK_FAULT, tank.fault, now_s)
    if _is_tank_low(watching, state) and state.enabled:
        text = f"tank at its reserve of {watching.settings.reserve_l or 0.0:g} L"
        memory = _with(memory, Finding(kind=FaultKind.TANK_LOW, at_s=now_s, text=text))
    return memory


def _sensor(
    watching: Watching, memory: WatchMemory, kind: FaultKind, text: str, now_s: float
) -> WatchMemory:
    is_closing = kind is FaultKind.METER_FAULT and watching.settings.meter_required
    memory = _with(memory, Finding(kind=kind, at_s=now_s, text=text))
    return _latched(memory, Inhibit.FLOW_FAULT) if is_closing else memory


def _is_tank_low(watching: Watching, state: VehicleState) -> bool:
    reserve_l, tank = watching.settings.reserve_l, state.tank
    if reserve_l is None or tank is None or tank.level_l is None:
        return False
    return not tank.level_l > reserve_l


def _evidence(watching: Watching, memory: WatchMemory, count: int) -> Evidence:
    return Evidence.of(
        memory.bins,
        count,
        gain=memory.gain,
        # What was learnt in a few seconds may be the fault's.
        likely_gain=1.0 + (memory.gain - 1.0) * memory.learnt_s / LEARN_S,
        pressure_gain=memory.pressure_gain,
        open_ml_s=watching.open_ml_s,
        unsteady_share=watching.settings.unsteady_share,
    )


def _found(
    watching: Watching, memory: WatchMemory, kind: FaultKind, evidence: Evidence
) -> WatchMemory:
    """Return the memory with a fault of the flow; far from the table it closes."""
    valve = None
    if kind in _OF_ONE_VALVE:
        valve = _valve(watching, memory, evidence.bins, is_open=_OF_ONE_VALVE[kind])
    percent = 100.0 * (evidence.flow - 1.0)
    pressed = ""
    if evidence.pressure is not None:
        pressed = f", pressure {100.0 * (evidence.pressure - 1.0):+.0f} %"
    text = f"{_TEXTS[kind]}: flow {percent:+.0f} %{pressed}"
    at_s = evidence.bins[-1].end_s
    found = Finding(kind=kind, at_s=at_s, text=text, valve=valve)
    memory = _named(memory, found, is_sure=kind in _SURE)
    if kind is FaultKind.AIR:
        memory = memory._replace(air=True)
    is_far = kind is not FaultKind.DEAD_METER and not abs(evidence.flow - 1.0) <= FAR_SHARE
    return _latched(memory, Inhibit.FLOW_FAULT) if is_far and kind not in CLOSING else memory


def _valve(
    watching: Watching, memory: WatchMemory, bins: Sequence[Bin], *, is_open: bool
) -> int | None:
    return valve_of(bins, gain=memory.gain, open_ml_s=watching.open_ml_s, is_open=is_open)


def _named(memory: WatchMemory, finding: Finding, *, is_sure: bool) -> WatchMemory:
    """Return the memory with a fault of the flow, or with a better name for the one it has."""
    before = next((known for known in memory.findings if known.kind in _OF_THE_FLOW), None)
    if before is None or before.kind is finding.kind:
        return _with(memory, finding)
    if not (is_sure or finding.at_s - before.at_s <= RENAMED_S):
        return memory
    others = tuple(known for known in memory.findings if known is not before)
    memory = memory._replace(findings=(*others, replace(finding, at_s=before.at_s)))
    reason = CLOSING.get(finding.kind)
    if reason is not None:
        memory = memory._replace(latched=memory.latched - {CLOSING.get(before.kind)})
    return _latched(memory, reason)


def _with(memory: WatchMemory, finding: Finding) -> WatchMemory:
    """Return the memory with a finding that is new, or whose valve has become known."""
    others = []
    for known in memory.findings:
        if known.kind is not finding.kind:
            others.append(known)
        elif finding.valve is None or known.valve is not None:
            return _latched(memory, CLOSING.get(finding.kind))
    memory = memory._replace(findings=(*others, finding))
    return _latched(memory, CLOSING.get(finding.kind))


def _latched(memory: WatchMemory, reason: Inhibit | None) -> WatchMemory:
    """Return the memory with a reason that stays until the operator disables."""
    if reason is None or not memory.enabled or reason in memory.latched:
        return memory
    return memory._replace(latched=memory.latched | {reason})


# In standard deviations of the calibration: what is no evidence, and how much of it, times a
# second, is an alarm. With the default spread 4 % and 8.75 % x s: a tenth of the flow in 1.5 s,
# and healthy bins would have to be 8 % off for two seconds.
SLACK_SPREADS = 3.2
ALARM_SPREADS_S = 7.0
# Of one bin: a single wrong one, such as at an edge that came late, is no alarm.
EVIDENCE_MAX = 0.25
# The meter's own gain is learnt on average of this time, and within this: it is no fault.
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
    memory: WatchMemory | None,
    plan: SprayPlan | None,
    state: VehicleState | None,
    *,
    index: int,
    now_s: float,
) -> WatchMemory:
    """Return the memory after what came by `now_s`; `plan` was in force until now.

    Its `latched` are the reasons not to spray that flow, pressure and tank give.
    """
    memory = memory or WatchMemory()
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
        (watching.order(at_s, duties, index) for at_s, duties in plan.duties_until(now_s)),
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
    minimum_ml_s = watching.settings.meter_minimum_l_min * ML_S_PER_L_MIN
    if not (
        filled.is_whole
        and expected_ml >= minimum_ml_s * length_s
        and filled.begin_s - memory.changed_s >= watching.settle_s
    ):
        return memory
    error = filled.metered_ml / expected_ml - 1.0
    memory = _summed(watching, memory, filled, error)
    if abs(error) <= watching.settings.spread * SLACK_SPREADS and max(
        memory.low[0], memory.high[0]
    ) < (0.5 * ALARM_SPREADS_S * watching.settings.spread):
        memory = _learnt(watching, memory, filled)
    alarm = ALARM_SPREADS_S * watching.settings.spread
    if memory.low[0] >= alarm or memory.high[0] >= alarm or memory.nothing_s > 0.0:
        memory = of_spraying(watching, memory, state, alarm=alarm)
    return with_valve_told(watching, memory) if memory.findings else memory


def _summed(watching: Watching, memory: WatchMemory, filled: Bin, error: float) -> WatchMemory:
    slack = watching.settings.spread * SLACK_SPREADS
    most = 2.0 * ALARM_SPREADS_S * watching.settings.spread
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
    share, room = length_s / learnt_s, GAIN_SPREADS * watching.settings.spread
    gain = memory.gain + share * (filled.metered_ml / filled.all_ml - memory.gain)
    pressure_gain = memory.pressure_gain
    if filled.pressure is not None:
        pressure_gain += share * (filled.pressure - pressure_gain)
    return memory._replace(
        gain=min(max(gain, 1.0 - room), 1.0 + room),
        pressure_gain=min(max(pressure_gain, 1.0 - room), 1.0 + room),
        learnt_s=learnt_s,
    )
