"""When liquid comes out of a valve, or stops: from the plan in force and what was found.

A valve is open by the changes that a plan has brought about in its time; an inhibit has made a plan
without any. What flow, pressure and tank say of the liquid goes before it. An order takes effect on
the liquid after its lag, the volume-equivalent one: a sharp edge there carries the same volume as
the rise or fall.
"""

from __future__ import annotations

from typing import NamedTuple

from companion.core.schedule import LagModel
from companion.core.types import FaultKind, Finding, SprayPlan

# Found in the liquid: nothing, or not what was ordered, comes out.
NO_LIQUID = frozenset({FaultKind.NO_FLOW, FaultKind.PUMP_OFF, FaultKind.TANK_EMPTY, FaultKind.AIR})


class Lags(NamedTuple):
    """The lag of the valves, and that of what makes the flow: the same, or a pump's."""

    valve: LagModel
    flow: LagModel


class Toggle(NamedTuple):
    """From `at_s` on liquid comes out of a valve, or none does."""

    at_s: float
    valve: int
    opens: bool


def ordered_until(
    plan: SprayPlan | None,
    pumped: SprayPlan | None,
    findings: tuple[Finding, ...],
    *,
    now_s: float,
    lags: Lags,
    ordered: tuple[bool, ...],
    toggles: tuple[Toggle, ...],
    lapses: bool,
) -> tuple[tuple[bool, ...], tuple[Toggle, ...]]:
    """Return what is ordered by `now_s` and what becomes of it, after what was until then.

    `pumped` is the flow of a pump that makes it, where there is one. With `lapses` a plan ends with
    its lease, as an executor has it.
    """
    for at_s, opened, lag in _openings(plan, pumped, lags, now_s, lapses=lapses):
        wanted = _real(opened, findings) if findings else opened
        if wanted == ordered:
            continue
        for valve, (was, opens) in enumerate(zip(ordered, wanted, strict=True)):
            if was != opens:
                lag_s = (lag.on_s if opens else lag.off_s) + lags.valve.output_s
                toggles = toggled(toggles, Toggle(at_s + lag_s, valve, opens))
        ordered = wanted
    return ordered, toggles


def _openings(
    plan: SprayPlan | None, pumped: SprayPlan | None, lags: Lags, now_s: float, *, lapses: bool
) -> list[tuple[float, tuple[bool, ...], LagModel]]:
    """Return which valves let liquid out, from when on, and by the lag of what."""
    if plan is None:
        return []
    duty = [each > 0.0 for each in plan.duty]
    until_s = min(now_s, plan.lease_until_s) if lapses else now_s
    runs = pumped is None or pumped.duty[0] > 0.0
    lag = lags.valve
    found = [(plan.issued_s, tuple(each and runs for each in duty), lag)]
    changes = [(change.at_s, change.valve, change.duty > 0.0) for change in plan.changes]
    if pumped is not None:
        changes += [(change.at_s, -1, change.duty > 0.0) for change in pumped.changes]
        changes.sort()
    for at_s, valve, opens in changes:
        if not at_s <= until_s:
            break
        if valve < 0:
            runs = opens
        else:
            duty[valve] = opens
        lag = lags.flow if valve < 0 else lags.valve
        found.append((at_s, tuple(each and runs for each in duty), lag))
    if lapses and not now_s < plan.lease_until_s:
        found.append((plan.lease_until_s, (False,) * len(duty), lags.valve))
    return found


def _real(opened: tuple[bool, ...], findings: tuple[Finding, ...]) -> tuple[bool, ...]:
    """Return which valves let liquid out, after all that was found."""
    kinds = {finding.kind for finding in findings}
    shut = {each.valve for each in findings if each.kind is FaultKind.STUCK_CLOSED}
    stuck = {each.valve for each in findings if each.kind is FaultKind.STUCK_OPEN}
    flows = not kinds & NO_LIQUID
    return tuple(
        flows and ((is_open and valve not in shut) or valve in stuck)
        for valve, is_open in enumerate(opened)
    )


def toggled(toggles: tuple[Toggle, ...], new: Toggle) -> tuple[Toggle, ...]:
    """Return the toggles with one more; one that comes before the last of its valve undoes it."""
    for number in range(len(toggles) - 1, -1, -1):
        if toggles[number].valve == new.valve:
            if toggles[number].at_s >= new.at_s:
                return toggles[:number] + toggles[number + 1 :]
            break
    return (*toggles, new)


def open_at(
    is_open: tuple[bool, ...], toggles: tuple[Toggle, ...], at_s: float
) -> tuple[tuple[bool, ...], tuple[Toggle, ...]]:
    """Return which valves are open at a time, and what follows later."""
    now = list(is_open)
    for toggle in toggles:
        if toggle.at_s <= at_s:
            now[toggle.valve] = toggle.opens
    return tuple(now), tuple(toggle for toggle in toggles if toggle.at_s > at_s)
