"""What the valves sweep: from orders and states to treated ground, by what a valve really does.

When a valve lets liquid out, its flow edges say; they carry the volume of the rise and fall,
so ground that a later flight begins at such an edge gets its dose, neither more nor less on the
mean. What the schedule only meant to do is not looked at.

The way since the last stamp is kept as a few states and stamped every other second, in pieces as
long as they are straight, by a step that has little else to do: a step stays cheap.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from companion.core.boom import Boom, turning_of
from companion.core.frame import Offset, Place
from companion.core.options.coverage import Coverage, Quad
from companion.core.schedule import LagModel
from companion.core.types import FaultKind, Finding, SprayPlan, VehicleState

# What the boom sweeps over the ground while its valves are open: few and straight pieces.

# So far a tip of the boom may be off a straight piece: below the noise of an RTK position.
STRAIGHT_M = 0.03
NEAR_M = 1e-6
# Strips of neighbours that touch to this are one.
TOUCH_M = 0.01


class BoomPose(NamedTuple):
    """Where the boom was, the liquid's offset by the wind in it."""

    time_s: float
    east_m: float
    north_m: float
    heading_deg: float


def swept(
    boom: Boom, poses: tuple[BoomPose, ...], is_open: tuple[bool, ...], edges: tuple[FlowEdge, ...]
) -> list[Quad]:
    """Return the quadrilaterals swept on the way through `poses`; `is_open` holds at the first."""
    way = _BoomPath(boom, poses)
    stays = _stays(is_open, edges, poses[0].time_s, poses[-1].time_s)
    return [quad for strip in _strips(boom, stays) for quad in way.quads(*strip)]


# From when until when liquid comes out of one valve.
_Stays = tuple[tuple[float, float], ...]


def _stays(
    is_open: tuple[bool, ...], flow_edges: tuple[FlowEdge, ...], start_s: float, end_s: float
) -> list[_Stays]:
    """Return when each valve is open between two times."""
    now, since_s = list(is_open), [start_s] * len(is_open)
    found: list[list[tuple[float, float]]] = [[] for _ in is_open]
    for at_s, valve, opens in flow_edges:
        if at_s > end_s or opens is now[valve]:
            continue
        if now[valve]:
            found[valve].append((since_s[valve], at_s))
        now[valve], since_s[valve] = opens, max(at_s, start_s)
    for valve, opens in enumerate(now):
        if opens:
            found[valve].append((since_s[valve], end_s))
    return [tuple([stay for stay in stays if stay[1] > stay[0]]) for stays in found]


# Left and right end, place ahead, and when it is open: of valves side by side that are so together.
_Strip = tuple[float, float, float, _Stays]


def _strips(boom: Boom, stays: list[_Stays]) -> list[_Strip]:
    found: list[_Strip] = []
    for (right_m, forward_m, half_m), own in zip(boom.strips_m, stays, strict=True):
        left_m = right_m - half_m
        if found and found[-1][2:] == (forward_m, own) and abs(found[-1][1] - left_m) <= TOUCH_M:
            left_m = found.pop()[0]
        found.append((left_m, right_m + half_m, forward_m, own))
    return found


class _BoomPath:
    """The way of the boom through its poses, in as few straight pieces as it allows.

    Plain numbers: for some ten poses that is several times as fast as arrays are.
    """

    def __init__(self, boom: Boom, poses: tuple[BoomPose, ...]) -> None:
        self._fronts = poses
        reach_m, tips = boom.tip_m, []
        for _, east_m, north_m, heading_deg in poses:
            angle = math.radians(heading_deg)
            sin, cos = reach_m * math.sin(angle), reach_m * math.cos(angle)
            tips.append((east_m - cos, north_m + sin, east_m + cos, north_m - sin))
        self._knots_s = [poses[bend].time_s for bend in _bends(tips, 0, len(tips) - 1)]

    def quads(self, left_m: float, right_m: float, forward_m: float, stays: _Stays) -> list[Quad]:
        """Return the quadrilaterals that a strip sweeps while it is open."""
        found: list[Quad] = []
        for begin_s, end_s in stays:
            inner = [knot_s for knot_s in self._knots_s if begin_s < knot_s < end_s]
            ends = [
                self._ends(at_s, left_m, right_m, forward_m) for at_s in (begin_s, *inner, end_s)
            ]
            found.extend(
                (left, right, next_right, next_left)
                for (left, right), (next_left, next_right) in pairwise(ends)
            )
        return found

    def _ends(
        self, at_s: float, left_m: float, right_m: float, forward_m: float
    ) -> tuple[Place, Place]:
        """Return where the ends of a strip are at a time."""
        number = bisect_right(self._fronts, at_s, key=_time) - 1
        number = min(max(number, 0), len(self._fronts) - 2)
        first, last = self._fronts[number : number + 2]
        share = min(max((at_s - first.time_s) / (last.time_s - first.time_s), 0.0), 1.0)
        turned_deg = (last.heading_deg - first.heading_deg + 180.0) % 360.0 - 180.0
        angle = math.radians(first.heading_deg + share * turned_deg)
        sin, cos = math.sin(angle), math.cos(angle)
        east_m = first.east_m + share * (last.east_m - first.east_m) + forward_m * sin
        north_m = first.north_m + share * (last.north_m - first.north_m) + forward_m * cos
        return (
            (east_m + left_m * cos, north_m - left_m * sin),
            (east_m + right_m * cos, north_m - right_m * sin),
        )


def _time(pose: BoomPose) -> float:
    return pose.time_s


def _bends(tips: list[tuple[float, float, float, float]], first: int, last: int) -> list[int]:
    """Return the indices between which both tips go straight (as Douglas and Peucker have it)."""
    x0, y0, x1, y1 = tips[first]
    x2, y2, x3, y3 = tips[last]
    dx, dy, ex, ey = x2 - x0, y2 - y0, x3 - x1, y3 - y1
    left, right = math.hypot(dx, dy), math.hypot(ex, ey)
    worst, worst_m = 0, STRAIGHT_M
    for number in range(first + 1, last):
        xa, ya, xb, yb = tips[number]
        xa, ya, xb, yb = xa - x0, ya - y0, xb - x1, yb - y1
        off_m = max(
            abs(xa * dy - ya * dx) / left if left > NEAR_M else math.hypot(xa, ya),
            abs(xb * ey - yb * ex) / right if right > NEAR_M else math.hypot(xb, yb),
        )
        if off_m > worst_m:
            worst, worst_m = number, off_m
    if not worst:
        return []
    return [*_bends(tips, first, worst), worst, *_bends(tips, worst, last)]


# When liquid comes out of a valve, or stops: from the plan in force and what was found.
#
# A valve is open by the changes that a plan has brought about in its time; an inhibit has made a
# plan without any. What flow, pressure and tank say of the liquid goes before it. An order takes
# effect on the liquid after its lag, the volume-equivalent one: a sharp edge there carries the
# same volume as the rise or fall.

# Found in the liquid: nothing, or not what was ordered, comes out.
NO_LIQUID = frozenset({FaultKind.NO_FLOW, FaultKind.PUMP_OFF, FaultKind.TANK_EMPTY, FaultKind.AIR})


class Lags(NamedTuple):
    """The lag of the valves, and that of what makes the flow: the same, or a pump's."""

    valve: LagModel
    flow: LagModel


class FlowEdge(NamedTuple):
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
    flow_edges: tuple[FlowEdge, ...],
    lapses: bool,
) -> tuple[tuple[bool, ...], tuple[FlowEdge, ...]]:
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
                flow_edges = with_flow_edge(flow_edges, FlowEdge(at_s + lag_s, valve, opens))
        ordered = wanted
    return ordered, flow_edges


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
        if opens is (runs if valve < 0 else duty[valve]):
            continue
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


def with_flow_edge(flow_edges: tuple[FlowEdge, ...], new: FlowEdge) -> tuple[FlowEdge, ...]:
    """Return the edges with one more; one that comes before the last of its valve undoes it."""
    for number in range(len(flow_edges) - 1, -1, -1):
        if flow_edges[number].valve == new.valve:
            if flow_edges[number].at_s >= new.at_s:
                return flow_edges[:number] + flow_edges[number + 1 :]
            break
    return (*flow_edges, new)


def open_at(
    is_open: tuple[bool, ...], flow_edges: tuple[FlowEdge, ...], at_s: float
) -> tuple[tuple[bool, ...], tuple[FlowEdge, ...]]:
    """Return which valves are open at a time, and what follows later."""
    now = list(is_open)
    for flow_edge in flow_edges:
        if flow_edge.at_s <= at_s:
            now[flow_edge.valve] = flow_edge.opens
    return tuple(now), tuple(flow_edge for flow_edge in flow_edges if flow_edge.at_s > at_s)


# The way is stamped after this time: a area of 10 m at 5 m/s is one look at some 2000 cells.
STAMP_EVERY_S = 2.0
# No longer than this the stamp waits for a step that has the time; in a turn none has.
UNSTAMPED_MAX_S = 1.0
# States nearer than this add nothing to the way between them: within 0.2 s of braking by 2.5 m/s2
# a place between two is off by a centimetre.
POSE_STEP_M = 0.8
# However slowly it flies: well below what counts as a gap.
POSE_EVERY_S = 0.5
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
class TreatedAreaSettings:
    """What the record of treated ground has to know of the sprayer, and of earlier flights."""

    boom: Boom
    lags: Lags
    is_pumped: bool
    treated: Coverage | None = None


def wake_m(boom: Boom) -> float:
    """Return on how much of the last way what is treated is this pass's own."""
    ahead_m = [forward_m for _, forward_m, _ in boom.strips_m]
    spread_m = max(ahead_m) - min(ahead_m)
    return min(spread_m + WAKE_MARGIN_M, WAKE_MAX_M)


class Snapshot(NamedTuple):
    """All that had been treated until a time, when the boom had come `way_m` far."""

    until_s: float
    way_m: float
    coverage: Coverage


class Unstamped(NamedTuple):
    """A way that has ended and is to be stamped, as long as a step takes, when there is time."""

    boom: Boom
    poses: tuple[BoomPose, ...]
    is_open: tuple[bool, ...]
    flow_edges: tuple[FlowEdge, ...]

    def on(self, raster: Coverage) -> Coverage:
        """Return what had been treated before it with its own ground added."""
        return raster.stamped(swept(*self))


class TreatedArea(NamedTuple):
    """What has been treated, and the way that is not yet stamped.

    `raster` lacks the ground of `unstamped`, and so does the last of the `older`. `poses` begin
    with the last way's end, `is_open` holds there; `flow_edges` come later, in the order of their
    orders. `ordered` is what was ordered last. `way_m` is how far the boom had come at `place`
    (east, north); what it flew closed counts as straight.
    """

    raster: Coverage
    older: tuple[Snapshot, ...] = ()
    poses: tuple[BoomPose, ...] = ()
    is_open: tuple[bool, ...] = ()
    ordered: tuple[bool, ...] = ()
    flow_edges: tuple[FlowEdge, ...] = ()
    way_m: float = 0.0
    place: Place | None = None
    unstamped: Unstamped | None = None

    @property
    def coverage(self) -> Coverage:
        """Return all that had been treated when the last way ended."""
        return self.raster if self.unstamped is None else self.unstamped.on(self.raster)

    def may_wait(self, now_s: float) -> bool:
        """Return whether what is left to be stamped may be left to a later step."""
        return now_s - self.older[-1].until_s < UNSTAMPED_MAX_S

    def settled(self) -> TreatedArea:
        """Return the same with nothing left to be stamped."""
        if self.unstamped is None:
            return self
        raster = self.coverage
        last = self.older[-1]._replace(coverage=raster)
        return self._replace(raster=raster, older=(*self.older[:-1], last), unstamped=None)

    def before(self, at_s: float, *, here: Place, behind_m: float) -> Coverage | None:
        """Return what had been treated by some time before `at_s`, the newest that is known.

        And before the boom came nearer than `behind_m`, along its way, to where it is now.
        """
        way_m = self.came_m([*((x, y) for _, x, y, _ in self.poses), here]) - behind_m
        found = None
        for snapshot in self.older:
            if snapshot.until_s <= at_s and snapshot.way_m <= way_m:
                found = snapshot
        if found is None:
            return None
        return self.coverage if found is self.older[-1] else found.coverage

    def came_m(self, places: Iterable[Place]) -> float:
        """Return how far the boom has come when it has gone on through these places."""
        way_m, last = self.way_m, self.place
        for place in places:
            if last is not None:
                way_m += math.dist(last, place)
            last = place
        return way_m

    def come(self, *more: BoomPose) -> TreatedArea:
        """Return the area with the way through its poses and those ahead counted."""
        places = [(x, y) for _, x, y, _ in (*self.poses, *more)]
        if not places:
            return self
        return self._replace(way_m=self.came_m(places), place=places[-1])


def begin(settings: TreatedAreaSettings) -> TreatedArea:
    """Return the area of a flight that has not sprayed yet."""
    treated = settings.treated or Coverage()
    shut = (False,) * len(settings.boom.valves)
    return TreatedArea(treated, (Snapshot(-math.inf, -math.inf, treated),), (), shut, shut)


def follow(
    settings: TreatedAreaSettings,
    area: TreatedArea | None,
    plan: SprayPlan | None,
    state: VehicleState | None,
    *,
    pumped: SprayPlan | None = None,
    findings: tuple[Finding, ...],
    drift_m: Offset | None,
    now_s: float,
) -> TreatedArea:
    """Return the area until `now_s`, where `plan` was the one in force, `pumped` its pump's."""
    if area is None:
        area = begin(settings)
    is_as_ordered = not (findings or settings.is_pumped) and _orders_stay(area, plan, now_s)
    if is_as_ordered and _stays_so(area, plan, state, now_s):
        return area
    if not is_as_ordered:
        area = _ordered(settings, area, plan, pumped, findings, now_s=now_s)
    is_at_work = any(area.is_open) or any(area.ordered) or bool(area.flow_edges)
    if not (is_at_work or (plan is not None and plan.opens)):
        return area.come()._replace(poses=()) if area.poses else area
    pose = _pose(state, drift_m)
    if pose is None or not area.poses:
        return _broken_off(settings, area, pose, now_s)
    if not is_at_work:
        return area.come(pose)._replace(poses=(pose,))
    return _moved(settings, area, pose, now_s)


def _orders_stay(area: TreatedArea, plan: SprayPlan | None, now_s: float) -> bool:
    """Return whether a plan has kept every valve as it was ordered before."""
    if plan is None or not now_s < plan.lease_until_s:
        return False
    ordered = area.ordered
    for duty, is_open in zip(plan.duty, ordered, strict=True):
        if (duty > 0.0) is not is_open:
            return False
    for change in plan.changes:
        if change.at_s <= now_s and (change.duty > 0.0) is not ordered[change.valve]:
            return False
    return True


def _stays_so(
    area: TreatedArea, plan: SprayPlan | None, state: VehicleState | None, now_s: float
) -> bool:
    """Return whether nothing has to be noted yet: the usual step, told apart at little cost."""
    if plan is None or state is None:
        return False
    if not area.poses:
        return not (plan.opens or area.flow_edges or any(area.ordered) or any(area.is_open))
    if not 0.0 <= now_s - area.poses[0].time_s < STAMP_EVERY_S:
        return False
    # With a wind's offset that moved meanwhile this is a little off, and no more than that.
    last_s, east_m, north_m, _ = area.poses[-1]
    away_m = abs(state.east_m - east_m) + abs(state.north_m - north_m)
    return away_m < POSE_STEP_M and state.time_s - last_s < POSE_EVERY_S


def _moved(
    settings: TreatedAreaSettings, area: TreatedArea, pose: BoomPose, now_s: float
) -> TreatedArea:
    last = area.poses[-1]
    moved_m = math.hypot(pose.east_m - last.east_m, pose.north_m - last.north_m)
    if not (0.0 <= pose.time_s - last.time_s <= GAP_MAX_S and moved_m <= JUMP_MAX_M):
        return _broken_off(settings, area, pose, now_s)
    if now_s - area.poses[0].time_s >= STAMP_EVERY_S:
        return _stamped(settings.boom, area, pose)
    if moved_m < POSE_STEP_M and pose.time_s - last.time_s < POSE_EVERY_S:
        return area
    return area._replace(poses=(*area.poses, pose))


def expected(
    settings: TreatedAreaSettings,
    area: TreatedArea | None,
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

    With `cut_s` at `now_s` it is that of a flight that ends now. `area` and `plan` are what the
    step of `now_s` has left.
    """
    area = area or begin(settings)
    pose = _pose(state, drift_m)
    if pose is None or state is None or not area.poses:
        return area.coverage
    ahead = _ordered(settings, area, plan, pumped, findings, now_s=max(cut_s, now_s), lapses=False)
    lags = settings.lags
    closes_s = cut_s + max(lags.valve.off_s, lags.flow.off_s) + lags.valve.output_s
    flow_edges = [
        flow_edge
        for flow_edge in ahead.flow_edges
        if flow_edge.opens is False or flow_edge.at_s <= cut_s
    ]
    for valve, is_open in enumerate(ahead.ordered):
        if is_open:
            flow_edges.append(FlowEdge(closes_s, valve, opens=False))
    last_s = max((flow_edge.at_s for flow_edge in flow_edges), default=now_s)
    carried_s = max(min(last_s - now_s, GAP_MAX_S + 1.0), 0.0)
    poses = [*area.poses]
    if pose.time_s > poses[-1].time_s:
        poses.append(pose)
    end = BoomPose(
        pose.time_s + carried_s,
        pose.east_m + state.velocity_east_m_s * carried_s,
        pose.north_m + state.velocity_north_m_s * carried_s,
        pose.heading_deg + turning_of(state).after(carried_s)[0],
    )
    ahead = ahead._replace(poses=tuple(poses), flow_edges=tuple(flow_edges))
    made = _stamped(settings.boom, ahead, end).coverage
    return Coverage(tiles=made.tiles, ahead_s=max(cut_s - now_s, 0.0))


def _pose(state: VehicleState | None, drift_m: Offset | None) -> BoomPose | None:
    if state is None or state.heading_deg is None:
        return None
    east_m, north_m = state.east_m, state.north_m
    if drift_m is not None:
        east_m, north_m = east_m + drift_m[0], north_m + drift_m[1]
    pose = BoomPose(state.time_s, east_m, north_m, state.heading_deg)
    return pose if all(map(math.isfinite, pose)) else None


def _ordered(
    settings: TreatedAreaSettings,
    area: TreatedArea,
    plan: SprayPlan | None,
    pumped: SprayPlan | None,
    findings: tuple[Finding, ...],
    *,
    now_s: float,
    lapses: bool = True,
) -> TreatedArea:
    ordered, flow_edges = ordered_until(
        plan, pumped, findings, now_s=now_s, lags=settings.lags,
        ordered=area.ordered, flow_edges=area.flow_edges, lapses=lapses,
    )  # fmt: skip
    if ordered is area.ordered:
        return area
    return area._replace(ordered=ordered, flow_edges=flow_edges)


def _broken_off(
    settings: TreatedAreaSettings, area: TreatedArea, pose: BoomPose | None, now_s: float
) -> TreatedArea:
    """Return the area stamped as far as its way is known, and begun anew at `pose`."""
    if len(area.poses) > 1:
        area = _stamped(settings.boom, area._replace(poses=area.poses[:-1]), area.poses[-1])
    is_open, flow_edges = open_at(area.is_open, area.flow_edges, now_s)
    poses = () if pose is None else (pose,)
    return area.come(*poses)._replace(poses=poses, is_open=is_open, flow_edges=flow_edges)


def _stamped(boom: Boom, area: TreatedArea, pose: BoomPose) -> TreatedArea:
    """Return the area with its way to `pose` stamped."""
    area = area.settled()
    poses = (*area.poses, pose) if pose.time_s > area.poses[-1].time_s else area.poses
    end_s = poses[-1].time_s
    is_open, later = open_at(area.is_open, area.flow_edges, end_s)
    unstamped = None
    if len(poses) > 1 and (any(area.is_open) or len(later) < len(area.flow_edges)):
        unstamped = Unstamped(boom, poses, area.is_open, area.flow_edges)
    come = area.come(pose)
    return TreatedArea(
        raster=area.raster,
        older=_kept(area.older, Snapshot(end_s, come.way_m, area.raster), wake_m(boom)),
        poses=poses[-1:], is_open=is_open, ordered=area.ordered, flow_edges=later,
        way_m=come.way_m, place=come.place, unstamped=unstamped,
    )  # fmt: skip


def _kept(older: tuple[Snapshot, ...], new: Snapshot, behind_m: float) -> tuple[Snapshot, ...]:
    """Return the snapshots with a new one, instead of the last where that is still near."""
    if len(older) > 1 and older[-1].way_m - older[-2].way_m < SNAPSHOT_WAKES * behind_m:
        older = older[:-1]
    return (*older, new)[-SNAPSHOTS_MAX:]
