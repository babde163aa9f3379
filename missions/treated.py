"""What a plan treats, leaves bare and treats twice: the way as it is flown, by the flight's rules.

Where a pass begins or ends the aircraft is slow and cuts the corner, near the border a valve's
whole strip stays closed, and over treated ground it closes: the rules and their figures are those
of the companion (`companion.core.options.lines`, `coverage`, `nozzle`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from companion.core.nozzle import flow_for_rate
from companion.core.options.lines import (
    COURSE_AHEAD_S,
    ENTRY_SHARE,
    JERK_M_S3,
    JERK_SEEN_S,
    SWERVES_M_S,
)
from companion.core.safety import SPEED_MARGIN_M_S
from missions.boom import boom_of
from missions.corners import NOSE_DEG_S
from missions.coverage import CELL_M, CELLS_MAX
from missions.demand import Rates, valve_places
from missions.maps.compiling import JOINED_M
from missions.plan import Plan, Settings, Sortie, Treated, flown_lines
from missions.stops import Track, timed, track_of
from missions.strips import Bools, Extents, Floats, extents_of, sprayed_twice, whole
from missions.surroundings import OVERRUN_M, RunIn, with_run_ins

# The way is looked at so often, less often where it is long.
STEP_S, STEPS_MAX = 0.05, 200_000
# Places across a valve's strip that are looked at for treated ground.
ACROSS = 5
STRAIGHT_M = 0.01


def treated_by(plan: Plan, rates: Rates) -> Treated:
    """Return what the sorties treat; each knows of treated ground what itself has sprayed."""
    settings, field = plan.settings, plan.field
    # What lies beside a hole has a rate, and stays bare.
    beside = field.outline.intersection(dict(field.closed).get("hole", shapely.Point()))
    limit = shapely.union(field.limit, beside)
    rule = _Rule(
        settings=settings,
        rates=rates,
        valves=valve_places(settings.swath_width_m, settings.valves),
        extents=None
        if settings.border_buffer_m is None
        else extents_of(
            field.kept_in,
            width_m=settings.swath_width_m,
            buffer_m=settings.border_buffer_m,
        ),
    )
    total_s = max(plan.flight_s, 1.0)
    step_s = max(STEP_S, total_s / STEPS_MAX)
    swept = {sortie.number: rule.swept(sortie, step_s) for sortie in plan.sorties}
    strips = np.array([shape for shapes, _ in swept.values() for shape in shapes], dtype=object)
    treated = whole(strips)
    bare = _rated(shapely.difference(limit, treated), rates)
    ground_m2 = float(bare.area + treated.intersection(limit).area)
    return Treated(
        ground_m2=ground_m2,
        bare=bare,
        twice=sprayed_twice(strips),
        litres={number: volume_l for number, (_, volume_l) in swept.items()},
    )


def _rated(bare: BaseGeometry, rates: Rates) -> BaseGeometry:
    """Return the cells of some ground on which something is prescribed."""
    west, south, east, north = bare.bounds
    cell_m = max(CELL_M, math.sqrt((east - west) * (north - south) / CELLS_MAX))
    x, y = (
        axis.ravel()
        for axis in np.meshgrid(
            *(np.arange(a + cell_m / 2.0, b, cell_m) for a, b in ((west, east), (south, north)))
        )
    )
    shapely.prepare(bare)
    dry = ~(rates.rates_at(x, y) > 0.0) & shapely.contains_xy(bare, x, y)
    half_m = cell_m / 2.0
    cells = shapely.box(x[dry] - half_m, y[dry] - half_m, x[dry] + half_m, y[dry] + half_m)
    return shapely.difference(bare, shapely.union_all(cells))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rule:
    """When each valve (right_m, width_m) is open, along the way as it is flown."""

    settings: Settings
    rates: Rates
    valves: Floats
    extents: Extents | None

    def swept(self, sortie: Sortie, step_s: float) -> tuple[list[BaseGeometry], float]:
        """Return the ground of each time that valves side by side are open, and all litres."""
        track = track_of(sortie, self.settings, step_s)
        nose = _nose(track, self.settings)
        velocity = np.gradient(track.places, step_s, axis=0)
        found: list[BaseGeometry] = []
        volume_l = 0.0
        for way, from_m, to_m in _joined(track, self.settings.lines_course_deg):
            mine = np.flatnonzero(track.way == way)
            if len(mine) < 2:
                continue
            own = len(mine)
            if to_m == math.inf:
                # No gap to the next way.
                mine = np.append(mine, min(mine[-1] + 1, len(track.way) - 1))
            passed = _Pass(
                track=track, at=mine, velocity=velocity, nose=nose, from_m=from_m, to_m=to_m
            )
            is_open, flow_l_min = self.open(passed, found)
            found += passed.strips(is_open, self.valves)
            volume_l += float(flow_l_min[:own][is_open[:own]].sum()) * step_s / 60.0
        return found, volume_l

    def open(self, passed: _Pass, done: list[BaseGeometry]) -> tuple[Bools, Floats]:
        """Return at which places of a pass each valve is open, and the flow asked of it."""
        settings, (right_m, width_m) = self.settings, self.valves.T
        swept_m_s = passed.ahead_m_s[:, None] - passed.yaw[:, None] * right_m
        middle = passed.places[:, None] + passed.right[:, None] * right_m[:, None]
        flat = middle.reshape(-1, 2)
        rate = np.nan_to_num(self.rates.rates_at(flat[:, 0], flat[:, 1])).reshape(swept_m_s.shape)
        low, high = settings.flow_l_min or (0.0, math.inf)
        flow = flow_for_rate(1.0, 1.0, settings.swath_width_m) * rate * swept_m_s
        found: Bools = (flow > 0.0) & (flow >= low / 2.0)
        flow = np.clip(flow, low, high)
        found &= passed.may_spray(settings, settings.opens_s, SPEED_MARGIN_M_S)[:, None]
        found &= passed.may_spray(settings, settings.closes_s, 0.0)[:, None]
        half_m = width_m / 2.0 * np.abs(passed.right @ passed.unit)[:, None]
        along_m = (middle - passed.start) @ passed.unit
        found &= (along_m >= passed.from_m + half_m) & (along_m <= passed.to_m - half_m)
        for valve, strip in enumerate(self.valves.tolist()):
            if self.extents is not None:
                found[:, valve] &= self.extents.is_open(
                    passed.places, passed.right, (strip[0], strip[1])
                )
        if settings.switch_off_percent is not None:
            share = self._treated(passed, done)
            found &= ~(share >= settings.switch_off_percent / 100.0 - 1e-9)
        return found, flow * width_m / settings.swath_width_m

    def _treated(self, passed: _Pass, done: list[BaseGeometry]) -> Floats:
        """Return how much of each valve's strip is treated at each place."""
        aside_m = ((np.arange(ACROSS) + 0.5) / ACROSS - 0.5) * self.valves[:, 1:]
        across_m = (self.valves[:, :1] + aside_m).ravel()
        points = (passed.places[:, None] + passed.right[:, None] * across_m[:, None]).reshape(-1, 2)
        is_done = np.zeros(len(points), dtype=np.bool_)
        low, high = points.min(axis=0), points.max(axis=0)
        for shape in done:
            west, south, east, north = shape.bounds
            if west < high[0] and east > low[0] and south < high[1] and north > low[1]:
                shapely.prepare(shape)
                is_done |= shapely.contains_xy(shape, points)
        found: Floats = is_done.reshape(len(passed.at), len(self.valves), ACROSS).mean(axis=2)
        return found


def _joined(track: Track, bend_deg: float) -> list[tuple[int, float, float]]:
    """Return the (way, from_m, to_m) of lines; where one goes on in another, and between, no end.

    The companion reads such lines as one (`missions.maps.compiling`).
    """
    found: list[tuple[int, float, float]] = []
    for way, _, from_m, to_m in track.parts:
        last, first_m, end_m = found[-1] if found else (-1, 0.0, 0.0)
        if found and _goes_on(track, (last, way), (end_m, from_m), bend_deg):
            found.pop()
            if last == way:
                from_m = first_m
            else:
                found.append((last, first_m, math.inf))
                found += [(between, -math.inf, math.inf) for between in range(last + 1, way)]
                from_m = -math.inf
        found.append((way, from_m, to_m))
    return found


def _goes_on(
    track: Track, ways: tuple[int, int], along_m: tuple[float, float], bend_deg: float
) -> bool:
    starts, ends = np.hsplit(track.ends[list(ways)], 2)
    unit = (ends - starts) / np.hypot(*(ends - starts).T)[:, None]
    one, other = starts + unit * np.array(along_m)[:, None]
    is_gentle = float(unit[0] @ unit[1]) >= math.cos(math.radians(bend_deg))
    return is_gentle and math.dist(one, other) < JOINED_M


@dataclass(frozen=True, slots=True, kw_only=True)
class _Pass:
    """One line of a track; `at` are the places of its way, `nose` where the nose points [rad]."""

    track: Track
    at: np.ndarray[tuple[int, ...], np.dtype[np.int64]]
    velocity: Floats
    nose: Floats
    from_m: float
    to_m: float

    @property
    def start(self) -> Floats:
        return self.track.ends[self.track.way[self.at[0]], :2]

    @property
    def unit(self) -> Floats:
        step = self.track.ends[self.track.way[self.at[0]], 2:] - self.start
        return np.asarray(step / np.hypot(*step))

    @property
    def places(self) -> Floats:
        return np.asarray(self.track.places[self.at])

    @property
    def right(self) -> Floats:
        nose = self.nose[self.at]
        return np.column_stack([np.cos(nose), -np.sin(nose)])

    @property
    def ahead_m_s(self) -> Floats:
        nose = self.nose[self.at]
        along = np.column_stack([np.sin(nose), np.cos(nose)])
        return np.asarray((self.velocity[self.at] * along).sum(axis=1))

    @property
    def yaw(self) -> Floats:
        return np.asarray(np.gradient(self.nose, self.track.step_s)[self.at])

    @property
    def gain(self) -> Floats:
        return np.asarray(np.gradient(self.velocity, self.track.step_s, axis=0))

    def _before(self, values: Floats, ago_s: float) -> Floats:
        """Return values of the track so long before."""
        return values[np.maximum(self.at - round(ago_s / self.track.step_s), 0)]

    def may_spray(self, settings: Settings, acts_s: float, more_m_s: float) -> Bools:
        """Return where the aircraft was fast enough and on its line (`Lines.flown`) so long ago."""
        unit, bend = self.unit, math.tan(math.radians(settings.lines_course_deg))
        aside = np.array([unit[1], -unit[0]])
        soon_s = min(settings.ends_s, COURSE_AHEAD_S)
        now, gain = self._before(self.velocity, acts_s), self._before(self.gain, acts_s)
        speed = np.hypot(*now.T)
        swerves = JERK_M_S3 * soon_s * (0.5 * soon_s + JERK_SEEN_S)
        swerves = swerves * np.minimum(speed / SWERVES_M_S, 1.0)
        found: Bools = np.abs((self.places - self.start) @ aside) <= (
            ENTRY_SHARE * settings.lines_aside_m
        )
        found &= speed >= settings.speeds_m_s[0] + more_m_s
        for then, more in ((now, 0.0), (now + gain * soon_s, swerves)):
            found &= np.abs(then @ aside) + more <= bend * (then @ unit)
        return found

    def strips(self, is_open: Bools, valves: Floats) -> list[BaseGeometry]:
        """Return what valves sweep while they are open, those side by side together."""
        found: list[BaseGeometry] = []
        columns: dict[tuple[int, int, int], float] = {}
        for valve, (right_m, width_m) in enumerate(valves.tolist()):
            edges = np.flatnonzero(np.diff(is_open[:, valve], prepend=False, append=False))
            for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
                left_m = columns.pop((valve, first, end), right_m - width_m / 2.0)
                columns[valve + 1, first, end] = left_m
            # Those that go no farther to the right are whole.
            for key in [key for key in columns if key[0] == valve]:
                found += self._strip(key, columns.pop(key), valves)
        for key in list(columns):
            found += self._strip(key, columns.pop(key), valves)
        return found

    def _strip(
        self, key: tuple[int, int, int], left_m: float, valves: Floats
    ) -> Iterable[BaseGeometry]:
        """Yield the ground between two ways."""
        last, first, end = key
        right_m = valves[last - 1, 0] + valves[last - 1, 1] / 2.0
        some = slice(first, min(end + 1, len(self.at)))
        places, right = self.places[some], self.right[some]
        sides = [places + right * each for each in (left_m, right_m)]
        if len(places) < 2:
            return
        shape = shapely.make_valid(shapely.Polygon(np.concatenate([sides[0], sides[1][::-1]])))
        yield shape.simplify(STRAIGHT_M)


def _nose(track: Track, settings: Settings) -> Floats:
    """Return where the nose points [rad]: to where the aircraft flies, as fast as it turns."""
    step = np.diff(track.places, axis=0, append=track.places[-1:])
    course = np.arctan2(step[:, 0], step[:, 1])
    most = math.radians(settings.nose_rate_deg_s or NOSE_DEG_S) * track.step_s
    moves = np.hypot(*step.T) > 0.05 * settings.speed_m_s * track.step_s
    heading, found = float(course[0]), []
    for wanted, is_moving in zip(course.tolist(), moves.tolist(), strict=True):
        left = math.remainder(wanted - heading, 2.0 * math.pi)
        heading += min(max(left, -most), most) if is_moving else 0.0
        found.append(heading)
    return np.array(found)


# In words, with the reason for what stays bare, and what ways outside the field would change.

# Less of the field is not worth a way out of it.
WORTH_PERCENT = 1.0


def treated_lines(plan: Plan, rates: Rates, *, has_runs: bool) -> list[str]:
    """Return what the flight treats and leaves in words, and what run-ins outside would spare."""
    found = plan.treated
    if found is None:
        return []
    said = found.summary()
    passes = boom_of(plan.settings, plan.field).united(flown_lines(plan.sorties))
    under_m2 = float(found.bare.intersection(passes).area)
    lines = [
        f"treated   {said['treated_percent']:.1f} %: {said['bare_m2']:.0f} m2 stay bare "
        f"({under_m2:.0f} where a pass begins, ends or touches the border, "
        f"{said['bare_m2'] - under_m2:.0f} beside the passes), {said['twice_m2']:.0f} m2 twice, "
        f"with {said['treated_l']:.2f} L"
    ]
    if not has_runs and 100.0 * under_m2 > WORTH_PERCENT * found.ground_m2:
        other = _with_overrun(plan)
        there = treated_by(other, rates).summary()
        lines.append(
            f'overrun   mission.overrun = "allowed" with run_in_m = "auto", where the aircraft may '
            f"leave the field: {there['treated_percent']:.1f} % treated, "
            f"{(other.flight_s - plan.flight_s) / 60.0:.1f} min more"
        )
    return lines


def thirsty_warnings(plan: Plan) -> tuple[str, ...]:
    """Return which sorties put out more than their tank holds for them, and why."""
    usable_l = plan.settings.usable_l
    return tuple(
        f"sortie {sortie.number} puts out {plan.needs_l(sortie):.2f} L, and {usable_l:.2f} L of "
        "the tank are no reserve: nozzles give their least flow where it is slow; plan it again "
        "with a higher mission.reserve_l"
        for sortie in plan.sorties
        if plan.needs_l(sortie) > usable_l + 0.005
    )


def _with_overrun(plan: Plan) -> Plan:
    """Return the plan with run-ins outside the field, nothing else changed."""
    ground = plan.field.outline.convex_hull.buffer(OVERRUN_M).difference(plan.field.blocked)
    longer = with_run_ins(plan.sorties, plan.field, plan.settings, RunIn(ground=ground))
    return replace(plan, sorties=timed(longer, plan.settings))
