"""From evidence to findings: which fault, of which valve, and whether it closes the valves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from companion.core.liquid_bins import Bin
from companion.core.liquid_naming import Evidence, name_of, name_of_nothing, valve_of
from companion.core.types import FaultKind, Finding, Inhibit, VehicleState

if TYPE_CHECKING:
    from companion.core.detection import WatchMemory
    from companion.core.liquid_law import Watching

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
        name = name_of_nothing(
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


def told_apart(watching: Watching, memory: WatchMemory) -> WatchMemory:
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
    tolerated_ml_s = watching.law.closed_share * watching.full_ml_s
    wet = (i for i, each in enumerate(memory.closed) if _flow([each], memory.gain) > tolerated_ml_s)
    bins = memory.closed[next(wet, len(memory.closed)) + 1 :]
    if len(bins) < CLOSED_BINS or not watching.law.closed_check:
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
        text = f"tank at its reserve of {watching.law.reserve_l or 0.0:g} L"
        memory = _with(memory, Finding(kind=FaultKind.TANK_LOW, at_s=now_s, text=text))
    return memory


def _sensor(
    watching: Watching, memory: WatchMemory, kind: FaultKind, text: str, now_s: float
) -> WatchMemory:
    is_closing = kind is FaultKind.METER_FAULT and watching.law.meter_required
    memory = _with(memory, Finding(kind=kind, at_s=now_s, text=text))
    return _latched(memory, Inhibit.FLOW_FAULT) if is_closing else memory


def _is_tank_low(watching: Watching, state: VehicleState) -> bool:
    reserve_l, tank = watching.law.reserve_l, state.tank
    if reserve_l is None or tank is None or tank.level_l is None:
        return False
    return not tank.level_l > reserve_l


def _evidence(watching: Watching, memory: WatchMemory, count: int) -> Evidence:
    return Evidence.of(
        memory.bins[-count:],
        gain=memory.gain,
        pressure_gain=memory.pressure_gain,
        open_ml_s=watching.open_ml_s,
        restless_share=watching.law.restless_share,
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
