"""What the valves sweep: from orders and states to treated ground, by what a valve really does.

When a valve lets liquid out, `swath_liquid` says; its edges carry the volume of the rise and fall,
so ground that a later flight begins at such an edge gets its dose, neither more nor less on the
mean. What the schedule only meant to do is not looked at.

The way since the last stamp is kept as a few states and stamped every other second, in pieces as
long as they are straight: a step stays cheap.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from companion.core.boom import Boom
from companion.core.coverage import Coverage
from companion.core.drift import Offset
from companion.core.frame import Place
from companion.core.swath_liquid import Lags, Toggle, open_at, ordered_until
from companion.core.swath_way import Front, swept
from companion.core.types import Finding, SprayPlan, VehicleState

# The way is stamped after this time: a swath of 10 m at 5 m/s is one look at some 2000 cells.
STAMP_EVERY_S = 2.0
# States nearer than this add nothing to the way between them: within 0.2 s of braking by 2.5 m/s2
# a place between two is off by a centimetre.
FRONT_STEP_M = 0.8
# However slowly it flies: well below what counts as a gap.
FRONT_EVERY_S = 0.5
# States farther apart than these are a gap or a jump: nothing is known of the way between.
GAP_MAX_S = 1.0
JUMP_MAX_M = 25.0
# Snapshots that are kept for whoever wants to know what was treated some time ago. Two of them
# are a stamp's time and a fifth of the wake apart, so seven go back beyond both.
SNAPSHOTS_MAX = 8
SNAPSHOT_WAKES = 0.2
# Ground of the last metres of the way is the wake of this very pass: as far as the boom's strips
# lie one behind the other, a raster's cell, and a gust or two. The gap is capped at the length of
# the longest aircraft, so that a wrong figure cannot leave half the field unchecked.
WAKE_MARGIN_M = 1.0
WAKE_MAX_M = 25.0


@dataclass(frozen=True, slots=True, kw_only=True)
class SwathSettings:
    """What the record of treated ground has to know of the sprayer, and of earlier flights."""

    boom: Boom
    lags: Lags
    is_pumped: bool
    treated: Coverage | None = None


def wake_m(boom: Boom) -> float:
    """Return on how much of the last way what is treated is this pass's own."""
    spread_m = float(boom.forward_m.max() - boom.forward_m.min())
    return min(spread_m + WAKE_MARGIN_M, WAKE_MAX_M)


class Snapshot(NamedTuple):
    """All that had been treated until a time, when the boom had come `way_m` far."""

    until_s: float
    way_m: float
    coverage: Coverage


class Swath(NamedTuple):
    """What has been treated, and the way that is not yet stamped.

    `fronts` begin with the last stamp, `is_open` holds there; `toggles` come later, in the order of
    their orders. `ordered` is what was ordered last. `way_m` is how far the boom had come at
    `place` (east, north); what it flew closed counts as straight.
    """

    coverage: Coverage
    older: tuple[Snapshot, ...] = ()
    fronts: tuple[Front, ...] = ()
    is_open: tuple[bool, ...] = ()
    ordered: tuple[bool, ...] = ()
    toggles: tuple[Toggle, ...] = ()
    way_m: float = 0.0
    place: Place | None = None

    def before(self, at_s: float, *, here: Place, behind_m: float) -> Coverage | None:
        """Return what had been treated by some time before `at_s`, the newest that is known.

        And before the boom came nearer than `behind_m`, along its way, to where it is now.
        """
        way_m = self.came_m([*((x, y) for _, x, y, _ in self.fronts), here]) - behind_m
        found = None
        for until_s, at_m, coverage in self.older:
            if until_s <= at_s and at_m <= way_m:
                found = coverage
        return found

    def came_m(self, places: Iterable[Place]) -> float:
        """Return how far the boom has come when it has gone on through these places."""
        way_m, last = self.way_m, self.place
        for place in places:
            if last is not None:
                way_m += math.dist(last, place)
            last = place
        return way_m

    def come(self, *more: Front) -> Swath:
        """Return the swath with the way through its fronts and those ahead counted."""
        places = [(x, y) for _, x, y, _ in (*self.fronts, *more)]
        if not places:
            return self
        return self._replace(way_m=self.came_m(places), place=places[-1])


def begin(settings: SwathSettings) -> Swath:
    """Return the swath of a flight that has not sprayed yet."""
    treated = settings.treated or Coverage()
    shut = (False,) * len(settings.boom.valves)
    return Swath(treated, (Snapshot(-math.inf, -math.inf, treated),), (), shut, shut)


def follow(
    settings: SwathSettings,
    swath: Swath | None,
    plan: SprayPlan | None,
    state: VehicleState | None,
    *,
    pumped: SprayPlan | None = None,
    findings: tuple[Finding, ...],
    drift_m: Offset | None,
    now_s: float,
) -> Swath:
    """Return the swath until `now_s`, where `plan` was the one in force, `pumped` its pump's."""
    if swath is None:
        swath = begin(settings)
    if not (findings or settings.is_pumped) and _stays_so(swath, plan, state, now_s):
        return swath
    swath = _ordered(settings, swath, plan, pumped, findings, now_s=now_s)
    is_at_work = any(swath.is_open) or any(swath.ordered) or bool(swath.toggles)
    if not (is_at_work or (plan is not None and plan.opens)):
        return swath.come()._replace(fronts=()) if swath.fronts else swath
    front = _front(state, drift_m)
    if front is None or not swath.fronts:
        return _broken_off(settings, swath, front, now_s)
    if not is_at_work:
        return swath.come(front)._replace(fronts=(front,))
    return _moved(settings, swath, front, now_s)


def _stays_so(
    swath: Swath, plan: SprayPlan | None, state: VehicleState | None, now_s: float
) -> bool:
    """Return whether nothing has to be noted yet: the usual step, told apart at little cost."""
    if plan is None or state is None or not now_s < plan.lease_until_s:
        return False
    if not swath.fronts:
        return not (plan.opens or swath.toggles or any(swath.ordered) or any(swath.is_open))
    if not 0.0 <= now_s - swath.fronts[0].time_s < STAMP_EVERY_S:
        return False
    ordered = swath.ordered
    for duty, is_open in zip(plan.duty, ordered, strict=True):
        if (duty > 0.0) is not is_open:
            return False
    for change in plan.changes:
        if change.at_s <= now_s and (change.duty > 0.0) is not ordered[change.valve]:
            return False
    # With a wind's offset that moved meanwhile this is a little off, and no more than that.
    last_s, east_m, north_m, _ = swath.fronts[-1]
    away_m = abs(state.east_m - east_m) + abs(state.north_m - north_m)
    return away_m < FRONT_STEP_M and state.time_s - last_s < FRONT_EVERY_S


def _moved(settings: SwathSettings, swath: Swath, front: Front, now_s: float) -> Swath:
    last = swath.fronts[-1]
    moved_m = math.hypot(front.east_m - last.east_m, front.north_m - last.north_m)
    if not (0.0 <= front.time_s - last.time_s <= GAP_MAX_S and moved_m <= JUMP_MAX_M):
        return _broken_off(settings, swath, front, now_s)
    if now_s - swath.fronts[0].time_s >= STAMP_EVERY_S:
        return _stamped(settings.boom, swath, front)
    if moved_m < FRONT_STEP_M and front.time_s - last.time_s < FRONT_EVERY_S:
        return swath
    return swath._replace(fronts=(*swath.fronts, front))


def expected(
    settings: SwathSettings,
    swath: Swath | None,
    plan: SprayPlan | None,
    state: VehicleState | None,
    *,
    pumped: SprayPlan | None = None,
    findings: tuple[Finding, ...],
    drift_m: Offset | None,
    now_s: float,
    cut_s: float,
) -> Coverage:
    """Return the coverage as it will be if all goes on until `cut_s` and every valve closes then.

    With `cut_s` at `now_s` it is that of a flight that ends now. `swath` and `plan` are what the
    step of `now_s` has left.
    """
    swath = swath or begin(settings)
    front = _front(state, drift_m)
    if front is None or state is None or not swath.fronts:
        return swath.coverage
    ahead = _ordered(settings, swath, plan, pumped, findings, now_s=max(cut_s, now_s), lapses=False)
    lags = settings.lags
    closes_s = cut_s + max(lags.valve.off_s, lags.flow.off_s) + lags.valve.output_s
    toggles = [toggle for toggle in ahead.toggles if toggle.opens is False or toggle.at_s <= cut_s]
    for valve, is_open in enumerate(ahead.ordered):
        if is_open:
            toggles.append(Toggle(closes_s, valve, opens=False))
    last_s = max((toggle.at_s for toggle in toggles), default=now_s)
    carried_s = max(min(last_s - now_s, GAP_MAX_S + 1.0), 0.0)
    fronts = [*swath.fronts]
    if front.time_s > fronts[-1].time_s:
        fronts.append(front)
    end = Front(
        front.time_s + carried_s,
        front.east_m + state.velocity_east_m_s * carried_s,
        front.north_m + state.velocity_north_m_s * carried_s,
        front.heading_deg + state.yaw_rate_deg_s * carried_s,
    )
    ahead = ahead._replace(fronts=tuple(fronts), toggles=tuple(toggles))
    made = _stamped(settings.boom, ahead, end).coverage
    return Coverage(tiles=made.tiles, ahead_s=max(cut_s - now_s, 0.0))


def _front(state: VehicleState | None, drift_m: Offset | None) -> Front | None:
    if state is None or state.heading_deg is None:
        return None
    east_m, north_m = state.east_m, state.north_m
    if drift_m is not None:
        east_m, north_m = east_m + drift_m[0], north_m + drift_m[1]
    front = Front(state.time_s, east_m, north_m, state.heading_deg)
    return front if all(map(math.isfinite, front)) else None


def _ordered(
    settings: SwathSettings,
    swath: Swath,
    plan: SprayPlan | None,
    pumped: SprayPlan | None,
    findings: tuple[Finding, ...],
    *,
    now_s: float,
    lapses: bool = True,
) -> Swath:
    ordered, toggles = ordered_until(
        plan, pumped, findings, now_s=now_s, lags=settings.lags,
        ordered=swath.ordered, toggles=swath.toggles, lapses=lapses,
    )  # fmt: skip
    if ordered is swath.ordered:
        return swath
    return swath._replace(ordered=ordered, toggles=toggles)


def _broken_off(settings: SwathSettings, swath: Swath, front: Front | None, now_s: float) -> Swath:
    """Return the swath stamped as far as its way is known, and begun anew at `front`."""
    if len(swath.fronts) > 1:
        swath = _stamped(settings.boom, swath._replace(fronts=swath.fronts[:-1]), swath.fronts[-1])
    is_open, toggles = open_at(swath.is_open, swath.toggles, now_s)
    fronts = () if front is None else (front,)
    return swath.come(*fronts)._replace(fronts=fronts, is_open=is_open, toggles=toggles)


def _stamped(boom: Boom, swath: Swath, front: Front) -> Swath:
    """Return the swath with its way to `front` stamped."""
    fronts = (*swath.fronts, front) if front.time_s > swath.fronts[-1].time_s else swath.fronts
    end_s = fronts[-1].time_s
    is_open, later = open_at(swath.is_open, swath.toggles, end_s)
    coverage = swath.coverage
    if len(fronts) > 1 and (any(swath.is_open) or len(later) < len(swath.toggles)):
        coverage = coverage.stamped(swept(boom, fronts, swath.is_open, swath.toggles))
    come = swath.come(front)
    return Swath(
        coverage=coverage,
        older=_kept(swath.older, Snapshot(end_s, come.way_m, coverage), wake_m(boom)),
        fronts=fronts[-1:],
        is_open=is_open,
        ordered=swath.ordered,
        toggles=later,
        way_m=come.way_m,
        place=come.place,
    )


def _kept(older: tuple[Snapshot, ...], new: Snapshot, behind_m: float) -> tuple[Snapshot, ...]:
    """Return the snapshots with a new one, instead of the last where that is still near."""
    if len(older) > 1 and older[-1].way_m - older[-2].way_m < SNAPSHOT_WAKES * behind_m:
        older = older[:-1]
    return (*older, new)[-SNAPSHOTS_MAX:]
