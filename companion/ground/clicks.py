"""Which valve is dead, stuck or clogged, from the flow of single valves opened one after another.

In flight one nozzle of twelve is hidden in the sum; alone it is all there is. Each valve's flow is
compared with that of the others: what they have in common (the pump, which gives more pressure to
one valve than to all, the meter's gain, the day's viscosity) is no fault of a valve.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median

from companion.core.types import FaultKind

# How far valves of one sprayer differ from each other in health: 2 % (1 sd) on the twin, and what
# the table of a whole set cannot say.
VALVE_SPREAD = 0.02
# One healthy valve in 16 000 is as far off as this many standard deviations.
ALARM_SPREADS = 4.0
# With fewer than three valves that flow there is no usual one: the table, and what a pump without
# a pressure regulator gives more to one valve than to all.
ALONE_SPREAD = 0.06
# Less than this of the usual flow is none; the drops that a lag moves are more than nothing.
NOTHING_SHARE = 0.2
# All valves below this share of the table: it is not the valves.
SUPPLY_SHARE = 0.75
# A flow with all closed that is one valve's, within this, is that of one that stays open.
STUCK_SHARE = (0.5, 1.5)
# Two counts of a meter: each is off by up to one step, evenly.
_COUNT_SD = math.sqrt(1.0 / 6.0)
_LEAST_EXPECTED_ML = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class ClickFlow:
    """What was metered of one valve: ordered open for `open_s` in all, counted over `window_s`."""

    valve: int
    open_s: float
    window_s: float
    metered_ml: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ClickLaw:
    """The table's flow of each valve, fully open; the meter's step; what flowed with all closed.

    `closed_share` of the full flow may be metered with all closed, as in flight.
    """

    valve_ml_s: tuple[float, ...]
    step_ml: float
    idle_ml: float = 0.0
    idle_s: float = 1.0
    meter_spread: float = 0.0125
    closed_share: float = 0.02

    def __post_init__(self) -> None:
        if not self.valve_ml_s or not all(0.0 < flow < math.inf for flow in self.valve_ml_s):
            raise ValueError(f"valve_ml_s must be positive, got {self.valve_ml_s}")
        if not (0.0 < self.step_ml < math.inf and 0.0 < self.idle_s < math.inf):
            raise ValueError("step_ml and idle_s must be positive")
        if not (0.0 < self.meter_spread < 1.0 and 0.0 < self.closed_share < 1.0):
            raise ValueError("meter_spread and closed_share must lie in (0, 1)")


@dataclass(frozen=True, slots=True, kw_only=True)
class ClickFinding:
    """One valve: `kind` is None where it is in order. `share` is of what the others deliver.

    `limit` is how far from 1 the share may be; it says what this test can see.
    """

    valve: int
    kind: FaultKind | None
    share: float | None
    limit: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ClickJudgement:
    """All valves, and what they have in common: `common` is their flow over the table's."""

    valves: tuple[ClickFinding, ...]
    common: float | None
    fault: FaultKind | None = None
    idle_ml_s: float = 0.0


def judge_clicks(law: ClickLaw, flows: Sequence[ClickFlow]) -> ClickJudgement:
    """Return what is wrong with each valve that was clicked.

    >>> law = ClickLaw(valve_ml_s=(20.0,) * 4, step_ml=0.2)
    >>> metered = (41.0, 30.0, 40.5, 0.0)
    >>> flows = [ClickFlow(valve=v, open_s=2.0, window_s=4.0, metered_ml=m)
    ...          for v, m in enumerate(metered)]
    >>> [str(each.kind) for each in judge_clicks(law, flows).valves]
    ['None', 'clog', 'None', 'stuck-closed']
    """
    idle_ml_s = law.idle_ml / law.idle_s
    if not 0.0 <= idle_ml_s < math.inf:
        return _unknown(flows)
    ratios = [_ratio(law, flow, idle_ml_s) for flow in flows]
    known = [ratio for ratio in ratios if ratio is not None]
    flowing = [ratio for ratio in known if ratio > NOTHING_SHARE]
    if not known:
        return _unknown(flows)
    has_usual = len(flowing) >= 3
    usual = median(flowing) if has_usual else 1.0
    valves = tuple(
        _finding(law, flow, ratio, usual, has_usual=has_usual)
        for flow, ratio in zip(flows, ratios, strict=True)
    )
    fault = _common_fault(law, usual, idle_ml_s, flowing)
    silent = [each for each in valves if each.kind is FaultKind.STUCK_CLOSED]
    if fault is FaultKind.STUCK_OPEN and len(silent) == 1:
        # Its order changes nothing, and something flows without an order.
        fault = None
        valves = tuple(
            replace(each, kind=FaultKind.STUCK_OPEN) if each is silent[0] else each
            for each in valves
        )
    common = median(flowing) if flowing else 0.0
    return ClickJudgement(valves=valves, common=common, fault=fault, idle_ml_s=idle_ml_s)


def _unknown(flows: Sequence[ClickFlow]) -> ClickJudgement:
    """Return that nothing is known: no number is no proof of health."""
    valves = tuple(
        ClickFinding(valve=flow.valve, kind=FaultKind.METER_FAULT, share=None, limit=1.0)
        for flow in flows
    )
    return ClickJudgement(valves=valves, common=None, fault=FaultKind.METER_FAULT)


def _ratio(law: ClickLaw, flow: ClickFlow, idle_ml_s: float) -> float | None:
    """Return a valve's flow over the table's; None where the count is not a number."""
    expected_ml = law.valve_ml_s[flow.valve] * flow.open_s
    if not expected_ml > _LEAST_EXPECTED_ML or not flow.window_s >= flow.open_s:
        return None
    if not 0.0 <= flow.metered_ml < math.inf:
        return None
    return max(flow.metered_ml - idle_ml_s * flow.window_s, 0.0) / expected_ml


def limit_of(law: ClickLaw, flow: ClickFlow, *, has_usual: bool = True) -> float:
    """Return by which share a valve may differ from the usual one.

    >>> law = ClickLaw(valve_ml_s=(20.0,) * 6, step_ml=0.2)
    >>> round(limit_of(law, ClickFlow(valve=0, open_s=2.0, window_s=4.0, metered_ml=0.0)), 3)
    0.095
    """
    expected_ml = law.valve_ml_s[flow.valve] * flow.open_s
    counts_ml = law.step_ml * _COUNT_SD
    # The flow with all closed is taken away: its own count is as coarse.
    idle_ml = counts_ml * flow.window_s / law.idle_s if law.idle_ml > 0.0 else 0.0
    spread = math.hypot(
        VALVE_SPREAD if has_usual else ALONE_SPREAD,
        law.meter_spread,
        counts_ml / expected_ml,
        idle_ml / expected_ml,
    )
    return ALARM_SPREADS * spread


def _finding(
    law: ClickLaw, flow: ClickFlow, ratio: float | None, usual: float, *, has_usual: bool
) -> ClickFinding:
    if ratio is None:
        return ClickFinding(valve=flow.valve, kind=FaultKind.METER_FAULT, share=None, limit=1.0)
    share, limit = ratio / usual, limit_of(law, flow, has_usual=has_usual)
    kind: FaultKind | None = None
    if share <= NOTHING_SHARE:
        kind = FaultKind.STUCK_CLOSED
    elif not share >= 1.0 - limit:
        kind = FaultKind.CLOG
    elif not share <= 1.0 + limit:
        kind = FaultKind.LEAK
    return ClickFinding(valve=flow.valve, kind=kind, share=share, limit=limit)


def _common_fault(
    law: ClickLaw, usual: float, idle_ml_s: float, flowing: Sequence[float]
) -> FaultKind | None:
    """Return what is wrong with all: a flow with all closed, none at all, or too little of it."""
    valve_ml_s = usual * math.fsum(law.valve_ml_s) / len(law.valve_ml_s)
    closed_ml_s = law.closed_share * math.fsum(law.valve_ml_s) + law.step_ml / law.idle_s
    if idle_ml_s > closed_ml_s:
        is_valve = STUCK_SHARE[0] <= idle_ml_s / valve_ml_s <= STUCK_SHARE[1]
        return FaultKind.STUCK_OPEN if is_valve else FaultKind.LEAK
    if not flowing:
        return FaultKind.NO_FLOW
    return FaultKind.SUPPLY if median(flowing) < SUPPLY_SHARE else None
