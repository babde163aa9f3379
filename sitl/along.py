"""How exact would it have been on a flight that was really flown: `vrspray sitl fly --along`.

The vehicle follows a log, and the twin sprays along its smoothed path (`smoother.py`); what the
companion hears is what the log's autopilot told. Beside it fly, over the same ground and with the
same sprayer: no compensation, one look-ahead, and perfect knowledge of the whole flight.
"""

from __future__ import annotations

import heapq
import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from analysis.changes import changes_of
from analysis.dose import misapplied_parts
from analysis.strips import strips_of
from analysis.track import rise_over
from analysis.transitions import SmoothTrack
from companion.assembly import refuse_mismatch
from companion.config import load
from companion.core.nozzle import RANGE_SLACK, allowed_duty, flow_for_rate
from companion.core.prescription import Prescription, Zone
from companion.core.schedule import TRIM_AGAIN_S, TRIM_STEP_MAX
from companion.core.types import (
    EstimatorReport,
    Fix,
    GnssReport,
    HeartbeatReport,
    LandedReport,
    Method,
    OperatorCommand,
    SpeedReport,
    SprayPlan,
    Telemetry,
    TimedChange,
)
from missions.maps.compiling import compiled_setup
from sitl.anyang import EXAMPLE
from sitl.earth import Earth
from sitl.flight import MESSAGE_DELAY_S, FlightOptions, FlightResult, fly, true_profile
from sitl.knowledge import perfect_setup
from sitl.navigation import SPEED_REPORT_RATE_HZ
from sitl.outputs import SERVO_FRAME_S, WIRE_S
from sitl.profile import PlantProfile, load_profile
from sitl.recorded import MOVING_M_S, Recorded, read_flight
from sitl.smoother import true_path

if TYPE_CHECKING:
    from analysis.changes import Change
    from analysis.flight_record import FlightRecord
    from analysis.strips import Strip
    from analysis.track import Bools
    from companion.core.setup import Setup
    from companion.core.types import Input
    from sitl.trajectory import Floats, Trajectory

# Zones across the track, as long as fields have them; rates as shares of what the sprayer can do
# at the flight's usual speed, by turns low and high.
ZONE_MIN_M, ZONE_MAX_M = 6.0, 15.0
LOW, HIGH = 0.6, 0.95
BESIDE_M, KNOT_M = 3.0, 0.5
# The nose turns: the flight is in a turn, and stays in it for as long as what it leaves behind.
TURNING_DEG_S, TURN_STAYS_S = 10.0, 0.3
JITTER_S = 0.003
# What the way of a message adds to the age of a place, as measured on the twin.
POSITION_S = 0.004
FINE_S, PLAN_S, LEASE_S = 0.002, 0.05, 0.3
SEEDS = 3

METHODS = ("vrspray", "perfect", "none", "look-ahead")


@dataclass(frozen=True, slots=True, kw_only=True)
class AlongOptions:
    """What the command line says."""

    log: Path
    config: Path | None = None
    plant: str | None = None
    position_rate_hz: float | None = None
    seed: int = 1
    flights: int = SEEDS
    out: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Bed:
    """A recorded flight with its true path, the ground under it, and the sprayer over it."""

    flight: Recorded
    told: Recorded
    path: Trajectory
    setup: Setup
    profile: PlantProfile
    speed_m_s: float
    position_rate_hz: float
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    """What one method did on one flight; a row of `events` is (late by volume, late by itself).

    Both are in metres along the strip. NaN is a step that is too small to have a place of its own.
    """

    method: str
    events: Floats
    missed: int
    misapplied_percent: float
    turn_percent: float | None
    straight_percent: float | None
    every_percent: float
    volume_error_percent: float
    cannot_percent: float
    inhibits: frozenset[str]


def prepare(options: AlongOptions) -> Bed:
    """Read log and configuration, and lay the ground under the flight."""
    flight = read_flight(options.log)
    config = load(options.config or EXAMPLE / "config.toml")
    refuse_mismatch(config)
    setup = compiled_setup(config)
    frame = setup.frame
    notes = list(flight.notes)
    path = true_path(flight, Earth(frame.latitude_deg, frame.longitude_deg))
    moving = flight.speed_m_s[flight.speed_m_s > MOVING_M_S]
    speed_m_s = float(np.median(moving))
    if options.config is None or not _comes_over(path, setup.prescription):
        frame = replace(
            frame,
            latitude_deg=float(flight.latitude_deg[0]),
            longitude_deg=float(flight.longitude_deg[0]),
        )
        path = true_path(flight, Earth(frame.latitude_deg, frame.longitude_deg))
        ground = zones_along(path, setup, seed=options.seed)
        setup = replace(setup, frame=frame, prescription=ground)
        notes.append(f"{ground.zone_count} zones of 6 to 15 m laid across the track")
    rate_hz = options.position_rate_hz or float(config.link.position_rate_hz)
    if rate_hz > 1.05 * flight.rate_hz:
        notes.append(
            f"the log holds {flight.rate_hz:.0f} states a second: those between are made of the "
            "one before and the one after, which nobody knows in flight"
        )
    profile = load_profile(options.plant or "wang-2024")
    profile = replace(profile, pwm=replace(profile.pwm, frequency_hz=setup.pwm.frequency_hz))
    setup, eased = _eased(setup, flight)
    return Bed(
        flight=flight,
        told=flight.at_rate(rate_hz),
        path=path,
        setup=setup,
        profile=profile,
        speed_m_s=speed_m_s,
        position_rate_hz=rate_hz,
        notes=(*notes, *eased),
    )


def _comes_over(path: Trajectory, ground: Prescription) -> bool:
    line = shapely.LineString(np.column_stack((path.east_m, path.north_m)))
    return bool(line.intersection(ground.field).length > ZONE_MIN_M)


def zones_along(path: Trajectory, setup: Setup, *, seed: int) -> Prescription:
    """Return zones across a track: every place has the zone of the way that first came near it."""
    rng = np.random.default_rng((seed, 40))
    way = np.column_stack((path.east_m, path.north_m))
    gone_m = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(way, axis=0).T))))
    at_m = np.arange(0.0, gone_m[-1], KNOT_M)
    knots = np.column_stack([np.interp(at_m, gone_m, each) for each in way.T])
    kept = _first_ways(knots)
    ends_m = np.cumsum(rng.uniform(ZONE_MIN_M, ZONE_MAX_M, int(gone_m[-1] / ZONE_MIN_M) + 2))
    number = np.searchsorted(ends_m, at_m[kept], side="right")
    field = shapely.buffer(shapely.LineString(knots), setup.boom.reach_m + BESIDE_M)
    cells = shapely.get_parts(
        shapely.voronoi_polygons(shapely.MultiPoint(knots[kept]), extend_to=field, ordered=True)
    )
    full = setup.nozzle_sets[-1].flow_max_l_min
    full /= flow_for_rate(1.0, float(np.percentile(path.speed_m_s, 98.0)), setup.boom.width_m)
    return Prescription(
        [
            Zone(
                name=f"{zone}.{part}", polygon=ground, rate_l_ha=full * (HIGH if zone % 2 else LOW)
            )
            for zone in np.unique(number).tolist()
            for part, ground in enumerate(
                shapely.get_parts(shapely.union_all(cells[number == zone]).intersection(field))
            )
        ]
    )


def _first_ways(knots: Floats) -> Any:
    """Return the knots that lie on ground not flown over before."""
    apart = int(3.0 * BESIDE_M / KNOT_M)
    kept: list[int] = []
    for i, knot in enumerate(knots):
        old = [j for j in kept if j < i - apart]
        if not old or np.hypot(*(knots[old] - knot).T).min() > BESIDE_M:
            kept.append(i)
    return np.array(kept)


def _eased(setup: Setup, flight: Recorded) -> tuple[Setup, list[str]]:
    """Return limits that let the flight be sprayed, and what was eased for it."""
    limits, said = setup.limits, []
    flown = {mode for at_s, mode in flight.modes if at_s <= flight.time_s[-1]}
    begun = [mode for at_s, mode in flight.modes if at_s <= flight.time_s[0]]
    flown -= {mode for at_s, mode in flight.modes if at_s <= flight.time_s[0]} - set(begun[-1:])
    others = sorted(mode for mode in flown if not limits.allows(mode))
    fast = float(flight.speed_m_s.max())
    low, high = float(flight.height_m.min()), float(flight.height_m.max())
    fix = min((fix for _, fix in flight.fixes), default=int(limits.fix))
    if others and not (flown - set(others)):
        said.append("modes " + ", ".join(others))
        limits = replace(limits, modes=limits.modes | frozenset(others))
    if fast > limits.speed_max_m_s:
        said.append(f"speeds up to {fast:.1f} m/s")
        limits = replace(limits, speed_max_m_s=fast + 1.0)
    if low < limits.height_min_m or high > limits.height_max_m:
        said.append(f"heights of {low:.1f} to {high:.1f} m")
        limits = replace(limits, height_min_m=low - 1.0, height_max_m=high + 1.0)
    if fix < limits.fix:
        said.append(f"a fix of {Fix(fix).name}")
        limits = replace(limits, fix=Fix(fix), accuracy_max_m=None)
    limits = replace(limits, label=None, wind_required=False, enable_by=frozenset({"command"}))
    setup = replace(
        setup,
        limits=replace(limits, rc_channel=None, estop_required=False),
        lag=replace(setup.lag, position_s=POSITION_S),
        centres_pulses=False,
    )
    return setup, [f"allowed here, though the configuration bars them: {', '.join(said)}"] * bool(
        said
    )


def heard(bed: Bed, seed: int) -> Iterator[Input]:
    """Return what the companion hears: the log's states with their stamps, a little later."""
    rng = np.random.default_rng((seed, 41))
    return heapq.merge(
        _positions(bed.told, rng), _speeds(bed.flight, rng), _statuses(bed.flight),
        key=lambda item: item.received_s,
    )  # fmt: skip


def _late(time_s: Floats, rng: np.random.Generator) -> list[float]:
    late_s = np.maximum(MESSAGE_DELAY_S + JITTER_S * rng.standard_normal(len(time_s)), 0.0)
    return [float(each) for each in np.maximum.accumulate(time_s + late_s)]


def _positions(told: Recorded, rng: np.random.Generator) -> Iterator[Input]:
    received = _late(told.time_s, rng)
    for i, received_s in enumerate(received):
        yield Telemetry(
            received_s=received_s,
            boot_s=math.floor(float(told.time_s[i]) * 1e3 + 1e-6) / 1e3,
            latitude_deg=float(told.latitude_deg[i]),
            longitude_deg=float(told.longitude_deg[i]),
            relative_altitude_m=round(float(told.height_m[i]), 3),
            velocity_north_m_s=round(float(told.velocity_north_m_s[i]), 2),
            velocity_east_m_s=round(float(told.velocity_east_m_s[i]), 2),
            velocity_down_m_s=round(float(told.velocity_down_m_s[i]), 2),
            heading_deg=round(float(told.heading_deg[i]), 2) % 360.0,
        )


def _speeds(flight: Recorded, rng: np.random.Generator) -> Iterator[Input]:
    told = flight.at_rate(min(SPEED_REPORT_RATE_HZ, flight.rate_hz))
    for received_s, speed in zip(_late(told.time_s, rng), told.speed_m_s.tolist(), strict=True):
        yield SpeedReport(received_s=received_s, ground_speed_m_s=speed)


def _statuses(flight: Recorded) -> Iterator[Input]:
    start_s, end_s = float(flight.time_s[0]), float(flight.time_s[-1])

    def held(told: Iterable[tuple[float, Any]], now_s: float, default: Any) -> Any:
        return next((value for at_s, value in reversed(tuple(told)) if at_s <= now_s), default)

    for i in range(math.ceil((end_s - start_s) / 0.5) + 1):
        now_s = start_s + 0.5 * i
        armed = bool(held(flight.armed, now_s, True))
        yield HeartbeatReport(
            received_s=now_s,
            autopilot="ardupilot",
            armed=armed,
            mode=held(flight.modes, now_s, "UNKNOWN"),
        )
        if not i:
            yield OperatorCommand(received_s=now_s, enable=True, source="command")
        yield GnssReport(received_s=now_s, fix=Fix(held(flight.fixes, now_s, 0)))
        yield EstimatorReport(received_s=now_s, healthy=True)
        yield LandedReport(received_s=now_s, in_air=armed)


# Perfect knowledge: of the whole flight, of every valve; held to what the sprayer can do.


def perfect_plans(setup: Setup, path: Trajectory) -> Iterator[SprayPlan]:
    """Return the plans of who knows the whole flight; `setup` is that of `perfect_setup`.

    Each valve is dosed by its own speed across the boom when the order acts: a change of zone by
    its lag, in between as often and by as much as our own trims, and never below the least flow.
    """
    start_s, end_s = float(path.time_s[0]), float(path.time_s[-1])
    fine = path.at(np.arange(start_s, end_s, FINE_S))
    changes = [
        change
        for valve in range(len(setup.boom.valves))
        for change in _perfect_changes(setup, fine, valve)
    ]
    changes.sort(key=lambda change: change.at_s)
    duty, number = [0.0] * len(setup.boom.valves), 0
    for sequence, now_s in enumerate(np.arange(start_s, end_s, PLAN_S).tolist(), start=1):
        while number < len(changes) and changes[number].at_s <= now_s:
            duty[changes[number].valve] = changes[number].duty
            number += 1
        last = number
        while last < len(changes) and changes[last].at_s < now_s + LEASE_S:
            last += 1
        yield SprayPlan(
            sequence=sequence,
            issued_s=now_s,
            duty=tuple(duty),
            changes=tuple(changes[number:last]),
            lease_until_s=now_s + LEASE_S,
        )


def _perfect_changes(setup: Setup, fine: Trajectory, number: int) -> Iterator[TimedChange]:
    valve = setup.boom.valves[number]
    turn = np.radians(fine.heading_deg)
    sin, cos = np.sin(turn), np.cos(turn)
    east_m = fine.east_m + sin * valve.forward_m + cos * valve.right_m
    north_m = fine.north_m + cos * valve.forward_m - sin * valve.right_m
    across_m_s = np.abs(np.gradient(east_m, FINE_S) * sin + np.gradient(north_m, FINE_S) * cos)
    rate = np.nan_to_num(setup.prescription.rates_at(east_m, north_m))
    curve, timing = setup.nozzle_sets[-1].curve, setup.timings[number]
    per_rate = flow_for_rate(1.0, 1.0, setup.boom.width_m)
    flow = rate * across_m_s * per_rate
    cuts = np.flatnonzero(np.diff(rate)) + 1
    period, step = (max(round(each / FINE_S), 1) for each in (setup.pwm.period_s, TRIM_AGAIN_S))
    in_force = 0.0
    for begin, end in zip([0, *cuts.tolist()], [*cuts.tolist(), len(rate)], strict=True):
        for at in range(begin, end, step):
            # A change begins a period; a trim waits for the next one, half a period on average.
            starts = min(at + (period // 2 if at > begin else 0), end - 1)
            wanted_l_min = float(flow[starts : min(starts + period, end)].mean())
            wanted = allowed_duty(curve.duty_for(wanted_l_min), setup.pwm)
            if wanted == in_force:
                continue
            is_trim = at > begin and wanted > 0.0 and in_force > 0.0
            if is_trim:
                wanted = min(max(wanted, in_force - TRIM_STEP_MAX), in_force + TRIM_STEP_MAX)
            yield TimedChange(
                at_s=float(fine.time_s[at]) - timing.lead_s(in_force, wanted),
                valve=number,
                duty=wanted,
                restart=not is_trim,
            )
            in_force = wanted


# The flights, and what they are judged by.


def options_of(bed: Bed, seed: int) -> FlightOptions:
    """Return how every method is flown."""
    return FlightOptions(
        fidelity="pulsed", output="servo", seed=seed, position_rate_hz=bed.position_rate_hz
    )


def fly_method(bed: Bed, method: str, seed: int) -> FlightResult:
    """Fly the recorded way with one method."""
    options = options_of(bed, seed)
    if method == "perfect":
        options = replace(options, knows=True)
        profile = true_profile(bed.profile, options)
        setup = perfect_setup(bed.setup, profile, seed=seed, output_s=WIRE_S + 0.5 * SERVO_FRAME_S)
        setup = replace(setup, method=Method.SCHEDULED)
        plans = perfect_plans(setup, bed.path)
        return fly(
            setup, bed.path, profile, options,
            speed_m_s=bed.speed_m_s, method=method, heard=(), plans=plans,
        )  # fmt: skip
    setup = bed.setup
    if method != "vrspray":
        lag = setup.lag
        ahead_s = 0.25 * (lag.on_s + lag.off_s + lag.up_s + lag.down_s) + lag.output_s
        setup = replace(setup, method=Method(method), look_ahead_s=ahead_s)
    return fly(
        setup, bed.path, bed.profile, options,
        speed_m_s=bed.speed_m_s, method=method, heard=heard(bed, seed),
    )  # fmt: skip


def figures_of(bed: Bed, result: FlightResult) -> Figures:
    """Return what a flight is judged by."""
    record = result.record
    strips = strips_of(record)
    dosed = [_Dosed.of(strip, bed.setup) for strip in strips]
    steps = np.concatenate([each.steps() for each in dosed])
    time_s, wrong, asked, can = (
        np.concatenate(each) for each in zip(*(strip.misapplied() for strip in dosed), strict=True)
    )
    turning = _turning(record, time_s)

    def percent(which: Any) -> float | None:
        whole = float(asked[which].sum())
        return 100.0 * float(wrong[which].sum()) / whole if whole > 0.0 else None

    given_ml, asked_ml = (
        sum(float(each[-1] - each[0]) for each in volumes)
        for volumes in zip(*((s.track.volume_ml, s.asked_ml) for s in strips), strict=True)
    )
    return Figures(
        method=record.meta.method,
        events=steps[:, :2],
        missed=int((steps[:, 2] < MISSED_BELOW).sum()),
        misapplied_percent=percent(can) or 0.0,
        turn_percent=percent(turning & can),
        straight_percent=percent(~turning & can),
        every_percent=percent(asked >= 0.0) or 0.0,
        volume_error_percent=100.0 * (given_ml / asked_ml - 1.0),
        cannot_percent=100.0 * float(asked[~can].sum() / asked.sum()),
        inhibits=frozenset(result.inhibits),
    )


# So long before and after a boundary a change is judged, and from so near on its levels.
AROUND_S, LEVEL_FROM_S = 0.5, 0.2
MISSED_BELOW = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class _Dosed:
    """A strip with the flow that is asked of it [L/min], and where that can be had.

    Below its least flow and above its full one a sprayer cannot do what is asked, whoever asks it.
    """

    strip: Strip
    smooth: SmoothTrack
    can: Bools

    @classmethod
    def of(cls, strip: Strip, setup: Setup) -> _Dosed:
        count, sets, track = len(setup.boom.valves), setup.nozzle_sets, strip.track
        least, full = sets[0].flow_min_l_min / count, sets[-1].flow_max_l_min / count
        flow = rise_over(strip.asked_ml, track.period_steps) / track.period_s * 0.06
        can = (flow >= (1.0 - RANGE_SLACK) * least) & (flow <= (1.0 + RANGE_SLACK) * full)
        return cls(strip=strip, smooth=SmoothTrack(track), can=can)

    def misapplied(self) -> tuple[Floats, Floats, Floats, Bools]:
        """Return time, wrong and asked volume at the strip's marks, and where it can be had."""
        parts = misapplied_parts([self.strip])
        can = np.interp(parts.time_s, self.strip.track.time_s, self.can.astype(np.float64))
        return parts.time_s, parts.wrong_ml, parts.asked_ml, can > 0.5

    def steps(self) -> Floats:
        """Return (late by volume, late by itself, how much of it came) of every change, in rows.

        Of those that anybody could make: the flow can be had all around, and no other is near.
        """
        track, stretches = self.strip.track, self.strip.stretches
        found = []
        for i, change in enumerate(changes_of(track, stretches)):
            if change is None or change.border:
                continue
            around = slice(
                track.sample(change.time_s - AROUND_S), track.sample(change.time_s + AROUND_S)
            )
            stays_s = min(stretches[i].dwell_s, stretches[i + 1].dwell_s)
            if stays_s >= AROUND_S + track.period_s and self.can[around].all():
                found.append(self._step(change))
        return np.array(found).reshape(-1, 3)

    def _step(self, change: Change) -> tuple[float, float, float]:
        track = self.strip.track
        near = np.array([-AROUND_S, -LEVEL_FROM_S, 0.0, LEVEL_FROM_S, AROUND_S])
        at_s = change.time_s + near
        way, given = track.at(self.smooth.distance_m, at_s), track.at(self.smooth.volume_ml, at_s)
        here, asked = track.at(track.distance_m, at_s)[2], track.at(self.strip.asked_ml, at_s)
        gone, rise = np.diff(way), np.diff(given)
        step = (asked[4] - asked[2]) / (way[4] - here) - (asked[2] - asked[0]) / (here - way[0])
        by_volume = (asked[4] - asked[0] - (given[4] - given[0])) / step
        before, after = rise[0] / gone[0], rise[3] / gone[3]
        came = (after - before) / step
        by_itself = math.nan
        if came >= MISSED_BELOW:
            meets = given[3] - given[1] + before * way[1] - after * way[3]
            by_itself = meets / (before - after) - here
        return float(by_volume), float(by_itself), float(came)


def _turning(record: FlightRecord, time_s: Floats) -> Any:
    """Return at which times the nose turns, or has just turned."""
    yaw = np.abs(np.gradient(np.unwrap(record.heading_deg, period=360.0), record.step_s))
    width = max(round(TURN_STAYS_S / record.step_s), 1)
    turning = np.convolve(yaw > TURNING_DEG_S, np.ones(2 * width + 1), mode="same") > 0.0
    return np.interp(time_s, record.time_s, turning.astype(np.float64)) > 0.5


def fly_along(options: AlongOptions, say: Callable[[str], None]) -> dict[str, Any]:
    """Fly every method along the log, and return the results."""
    beds = [prepare(replace(options, seed=options.seed + n)) for n in range(options.flights)]
    bed = beds[0]
    began_s = time.perf_counter()
    flights: dict[str, list[Figures]] = {}
    for method in METHODS:
        flights[method] = [
            figures_of(each, fly_method(each, method, options.seed + number))
            for number, each in enumerate(beds)
        ]
        say(f"{method}: {options.flights} flights")
    rows = [_row(method, flights[method]) for method in METHODS]
    return {
        "log": bed.flight.name,
        "position_rate_hz": bed.position_rate_hz,
        "recorded_rate_hz": round(bed.flight.rate_hz, 2),
        "flown_s": float(bed.path.time_s[-1] - bed.path.time_s[0]),
        "speed_m_s": bed.speed_m_s,
        "flights": options.flights,
        "methods": rows,
        "limits": _limits(rows),
        "notes": list(bed.notes),
        "wall_s": time.perf_counter() - began_s,
    }


def _row(method: str, flights: list[Figures]) -> dict[str, Any]:
    def spread(name: str) -> dict[str, float] | None:
        known = [value for each in flights if (value := getattr(each, name)) is not None]
        if not known:
            return None
        return {"mean": float(np.mean(known)), "min": min(known), "max": max(known)}

    def distances(values: Floats) -> dict[str, Any]:
        known = values[np.isfinite(values)]
        if not len(known):
            return {"mean_abs": None, "median_abs": None, "mean": None, "count": 0}
        return {
            "mean_abs": float(np.abs(known).mean()),
            "median_abs": float(np.median(np.abs(known))),
            "mean": float(known.mean()),
            "count": len(known),
        }

    events = np.concatenate([each.events for each in flights])
    return {
        "method": method,
        "lag_distance_m": distances(events[:, 0]),
        "switch_m": distances(events[:, 1]),
        "changes": len(events),
        "missed": sum(each.missed for each in flights),
        "misapplied_percent": spread("misapplied_percent"),
        "turn_misapplied_percent": spread("turn_percent"),
        "straight_misapplied_percent": spread("straight_percent"),
        "every_misapplied_percent": spread("every_percent"),
        "cannot_percent": spread("cannot_percent"),
        "volume_error_percent": spread("volume_error_percent"),
        "inhibits": sorted({reason for each in flights for reason in each.inhibits}),
    }


def along_lines(result: dict[str, Any]) -> Iterator[str]:
    """Yield the results for a person."""
    yield (
        f"{result['log']}: {result['flown_s']:.0f} s at {result['speed_m_s']:.1f} m/s (median), "
        f"positions at {result['position_rate_hz']:g} Hz, {result['flights']} flights a method"
    )
    yield (
        f"{'':<10} {'misapplied %':>12} {'in turns':>9} {'lag m':>7} {'median':>7} {'step m':>7} "
        f"{'volume %':>9} {'missed':>10}"
    )
    for row in result["methods"]:
        lag, missed = row["lag_distance_m"], f"{row['missed']} of {row['changes']}"
        yield (
            f"{row['method']:<10} {_number(row['misapplied_percent'], 2):>12} "
            f"{_number(row['turn_misapplied_percent'], 1):>9} {_number(lag, 3, 'mean_abs'):>7} "
            f"{_number(lag, 3, 'median_abs'):>7} {_number(row['switch_m'], 3, 'median_abs'):>7} "
            f"{_number(row['volume_error_percent'], 1):>9} {missed:>10}"
        )
    yield f"limits: {result['limits']}"
    for text in result["notes"]:
        yield f"note: {text}"


def _number(values: dict[str, Any] | None, digits: int, key: str = "mean") -> str:
    value = None if values is None else values[key]
    return "-" if value is None else f"{value:.{digits}f}"


def _limits(rows: list[dict[str, Any]]) -> str:
    """Return in one line what keeps this flight from being sprayed exactly."""
    ours, perfect = (next(r for r in rows if r["method"] == m) for m in ("vrspray", "perfect"))
    cannot = ours["cannot_percent"]["mean"]
    turn, straight = ours["turn_misapplied_percent"], ours["straight_misapplied_percent"]
    worst = "turns"
    if turn is None or straight is None or turn["mean"] < 2.0 * straight["mean"]:
        worst = "changes of speed between them"
    best = perfect["misapplied_percent"]["mean"]
    return (
        f"{best:.1f} % is the sprayer's own, {ours['misapplied_percent']['mean'] - best:.1f} % "
        f"comes of not knowing the flight, most of it in {worst}; for {cannot:.0f} % of the volume "
        "it flies too slowly or too fast for the sprayer (not judged above)"
    )
