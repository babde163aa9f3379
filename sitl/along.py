"""How exact would it have been on a flight that was really flown: `vrspray sitl fly --along`.

The vehicle follows a log, and the twin sprays along its smoothed path (`smoother.py`); what the
companion hears is what the log's autopilot told. Beside it fly, over the same ground and with the
same sprayer: no compensation, one look-ahead, and perfect knowledge of the whole flight.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import shapely

from analysis.border import off_target_ml
from analysis.changes import changes_of
from analysis.dose import misapplied_parts
from analysis.strips import strips_of
from analysis.track import rise_over
from analysis.transitions import SmoothTrack
from companion.assembly import refuse_mismatch
from companion.config import load
from companion.core.frame import LocalFrame
from companion.core.nozzle import RANGE_SLACK, allowed_duty, flow_for_rate
from companion.core.prescription import Prescription, Zone
from companion.core.schedule import TRIM_AGAIN_S, TRIM_STEP_MAX
from companion.core.types import (
    EstimatorReport,
    Fix,
    GnssReport,
    HeartbeatReport,
    Inhibit,
    LandedReport,
    Method,
    OperatorCommand,
    SpeedReport,
    SprayPlan,
    Telemetry,
    TimedChange,
)
from companion.errors import ConfigError
from companion.wording import counted
from missions.maps.compiling import compiled_setup
from sitl.anyang import EXAMPLE
from sitl.earth import Earth
from sitl.flight import MESSAGE_DELAY_S, FlightOptions, FlightResult, fly
from sitl.fly_files import draw, write_result
from sitl.knowledge import perfect_setup
from sitl.outputs import SERVO_FRAME_S, WIRE_S
from sitl.profile import MeasuredSet, PlantProfile, Pulsing, load_profile
from sitl.recorded import (
    COLUMNS,
    MOVING_M_S,
    Recorded,
    held,
    paths_of,
    read_flight,
    receiver_of,
    rows_of,
)

if TYPE_CHECKING:
    from analysis.flight_record import FlightRecord
    from analysis.strips import Strip
    from companion.core.safety import Limits
    from companion.core.setup import Setup
    from companion.core.types import Input
    from sitl.trajectory import Floats, Trajectory

# Zones across the track, as long as fields have them; by turns a low and a high rate, as parts of
# what the sprayer gives in full at the flight's speed.
ZONE_MIN_M, ZONE_MAX_M, LOW, HIGH = 6.0, 15.0, 0.6, 0.95
BESIDE_M, KNOT_M = 3.0, 0.5
# The nose turns: the flight is in a turn, and stays in it for as long as what it leaves behind.
TURNING_DEG_S, TURN_STAYS_S = 10.0, 0.3
JITTER_S, STATUS_S = 0.003, 0.5
# What the way of a message adds to the age of a place, as measured on the twin.
POSITION_S = 0.004
FINE_S, PLAN_S, LEASE_S = 0.002, 0.05, 0.3
# So long before and after a boundary a change is judged, and from so near on its levels.
AROUND_S, LEVEL_FROM_S, MISSED_BELOW, MOVED_M = 0.5, 0.2, 0.5, 0.1
RATE_MIN_HZ, RATE_MAX_HZ, FLIGHTS_MAX = 4.0, 50.0, 100

METHODS = ("vrspray", "perfect", "none", "look-ahead")


@dataclass(frozen=True, slots=True, kw_only=True)
class AlongOptions:
    """What the command line says."""

    log: Path
    config: Path | None = None
    plant: str | None = None
    position_rate_hz: float | None = None
    seed: int = 1
    flights: int = 3
    out: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Bed:
    """A recorded flight with its true path, the ground under it, and the sprayer over it."""

    flight: Recorded
    told: Any
    path: Trajectory
    setup: Setup
    profile: PlantProfile
    output: Literal["gpio", "servo"]
    rate_hz: float
    notes: tuple[str, ...]


def prepare(options: AlongOptions) -> Bed:
    """Read log and configuration, and lay the ground under the flight."""
    config = load(options.config or EXAMPLE / "config.toml")
    refuse_mismatch(config)
    setup = compiled_setup(config)
    flight = read_flight(options.log, setup.limits.allows)
    states = flight.states
    if setup.pumping is not None or setup.atomisers or setup.lag.up_time_s:
        raise ConfigError(
            f"{config.path}: --along needs PWM valves; it cannot judge pumps or atomisers"
        )
    rate_hz = options.position_rate_hz
    if rate_hz is None:
        rate_hz = float(config.link.position_rate_hz)
    if not RATE_MIN_HZ <= rate_hz <= RATE_MAX_HZ:
        raise ConfigError(
            f"--position-rate-hz {rate_hz:g}: give {RATE_MIN_HZ:g} to {RATE_MAX_HZ:g}"
        )
    earth, notes = _earth(setup), list(flight.notes)
    path, told = paths_of(flight, earth)
    line = shapely.LineString(np.column_stack((path.east_m, path.north_m)))
    if options.config is None or line.intersection(setup.prescription.field).length < ZONE_MIN_M:
        here = LocalFrame(*(float(states[name][0]) for name in COLUMNS[1:3]))
        setup = replace(setup, frame=here, lines=None, overlap=None, treated=None)
        earth = _earth(setup)
        path, told = paths_of(flight, earth)
        setup = replace(setup, prescription=zones_along(path, setup, seed=options.seed))
        notes.append(
            f"no map under this flight: laid {setup.prescription.zone_count} zones of "
            f"{ZONE_MIN_M:g} to {ZONE_MAX_M:g} m across the track"
        )
    off_m2 = (told.east_m - path.east_m) ** 2 + (told.north_m - path.north_m) ** 2
    notes.append(
        f"reported and smoothed positions differ by {math.sqrt(float(off_m2.mean())):.2f} m (rms); "
        "smaller differences in the table mean nothing"
    )
    receiver = receiver_of(flight)
    limits, eased = _eased(setup.limits, flight)
    lag = replace(setup.lag, position_s=POSITION_S)
    return Bed(
        flight=flight,
        told=_told(flight, told, earth, rate_hz, notes),
        path=path,
        setup=replace(setup, limits=limits, lag=lag),
        profile=_plant(options.plant, setup),
        output="gpio" if config.output.kind == "gpio" else "servo",
        rate_hz=rate_hz,
        notes=(*notes, *([] if receiver is None else [receiver.words]), *eased),
    )


def _earth(setup: Setup) -> Earth:
    return Earth(setup.frame.latitude_deg, setup.frame.longitude_deg)


def _told(
    flight: Recorded, told: Trajectory, earth: Earth, rate_hz: float, notes: list[str]
) -> Any:
    """Return the states at a rate: rows left out, or some put between two."""
    states = flight.states
    if rate_hz <= 1.05 * flight.rate_hz:
        ticks = np.floor((states.time_s - states.time_s[0]) * rate_hz + 0.25)
        return states[np.diff(ticks, prepend=-1.0) > 0.0]
    notes.append(
        f"the log holds {flight.rate_hz:.0f} positions a second; those between were interpolated "
        "from both sides, which no companion can do in flight"
    )
    at_s = _between(states.time_s, rate_hz)
    at = told.at(at_s)
    height_m, down_m_s = (np.interp(at_s, states.time_s, states[COLUMNS[i]]) for i in (3, 6))
    place = earth.to_geographic_all(at.east_m, at.north_m)
    moves = at.velocity_north_m_s, at.velocity_east_m_s, down_m_s
    return rows_of([at_s, *place, height_m, *moves, at.heading_deg % 360.0])


def _between(time_s: Floats, rate_hz: float) -> Floats:
    """Return times with some more between them, and none in a gap."""
    gaps_s = np.diff(time_s)
    parts = np.where(gaps_s < 1.5 * np.median(gaps_s), np.round(gaps_s * rate_hz), 1)
    number = np.arange(len(time_s))
    places = [i + np.arange(part) / part for i, part in enumerate(parts.tolist())]
    found: Floats = np.interp(np.concatenate(places), number, time_s)
    return found


def zones_along(path: Trajectory, setup: Setup, *, seed: int) -> Prescription:
    """Return zones across a track: every place has the zone of the way that first came near it."""
    rng = np.random.default_rng((seed, 40))
    way = np.column_stack((path.east_m, path.north_m))
    gone_m = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(way, axis=0).T))))
    at_m = np.arange(0.0, gone_m[-1], KNOT_M)
    knots = np.column_stack([np.interp(at_m, gone_m, each) for each in way.T])
    kept: list[int] = []
    for i, knot in enumerate(knots):
        old = [j for j in kept if j < i - 3.0 * BESIDE_M / KNOT_M]
        if not old or np.hypot(*(knots[old] - knot).T).min() > BESIDE_M:
            kept.append(i)
    ends_m = np.cumsum(rng.uniform(ZONE_MIN_M, ZONE_MAX_M, int(gone_m[-1] / ZONE_MIN_M) + 2))
    number = np.searchsorted(ends_m, at_m[kept], side="right")
    field = shapely.buffer(shapely.LineString(knots), setup.boom.reach_m + BESIDE_M)
    points = shapely.MultiPoint(knots[kept])
    cells = shapely.get_parts(shapely.voronoi_polygons(points, extend_to=field, ordered=True))
    usual_m_s = float(np.percentile(path.speed_m_s, 98.0))
    full = setup.nozzle_sets[-1].flow_max_l_min / flow_for_rate(1.0, usual_m_s, setup.boom.width_m)
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


def _plant(name: str | None, setup: Setup) -> PlantProfile:
    """Return a hidden sprayer with the curve, the period and the lags that the companion has."""
    if name is not None:
        profile = load_profile(name)
        if profile.valve_count != len(setup.boom.valves) or profile.has_sections:
            raise ConfigError(f"--plant {name}: give one with as many PWM valves")
        return replace(profile, pwm=replace(profile.pwm, frequency_hz=setup.pwm.frequency_hz))
    like, lag, pwm = load_profile("wang-2024"), setup.lag, setup.pwm
    opens_s = max(lag.on_s - 0.5 * like.ramp_s, 0.0)
    return replace(
        like,
        name="as configured",
        boom_width_m=setup.boom.width_m,
        valve_count=len(setup.boom.valves),
        pwm=Pulsing(**{each: getattr(pwm, each) for each in Pulsing.__dataclass_fields__}),
        nozzle_sets=tuple(
            MeasuredSet(valves=each.valves, duty=each.curve.duty, flow_l_min=each.curve.flow_l_min)
            for each in setup.nozzle_sets
        ),
        dead_open_s=opens_s,
        dead_close_s=max(lag.off_s - 0.5 * like.closing_s, opens_s),
        flow_law="straight",
    )


def _eased(limits: Limits, flight: Recorded) -> tuple[Limits, list[str]]:
    """Return limits that let the flight be sprayed, and what of it they would have barred."""
    states, speed_m_s = flight.states, float(flight.speed_m_s.max())
    others = {mode for mode in _modes(flight) if not limits.allows(mode)}
    low_m, high_m = float(states.height_m.min()), float(states.height_m.max())
    fix = Fix(min(held(flight.fixes, at_s, limits.fix) for at_s in states.time_s.tolist()))
    barred = {
        ", ".join(sorted(others)): bool(others),
        f"{speed_m_s:.1f} m/s": speed_m_s > limits.speed_max_m_s,
        f"{low_m:.0f} to {high_m:.0f} m high": (
            low_m < limits.height_min_m or high_m > limits.height_max_m
        ),
        f"fix {fix.name}": fix < limits.fix,
    }
    eased = replace(
        limits,
        modes=limits.modes | others,
        speed_max_m_s=max(limits.speed_max_m_s, speed_m_s + 1.0),
        height_min_m=min(limits.height_min_m, low_m - 1.0),
        height_max_m=max(limits.height_max_m, high_m + 1.0),
        fix=min(fix, limits.fix),
        accuracy_max_m=None, wind_required=False, speed_check_required=False, label=None,
        enable_by=frozenset({"command"}), rc_channel=None, estop_required=False,
    )  # fmt: skip
    said = "; ".join(what for what, is_barred in barred.items() if is_barred)
    return eased, [f"[safety] would have kept the valves closed ({said}); ignored here"] * bool(
        said
    )


def _modes(flight: Recorded) -> set[str]:
    return {held(flight.modes, at_s, "UNKNOWN") for at_s in flight.states.time_s.tolist()}


def heard(bed: Bed, seed: int) -> Iterator[Input]:
    """Return what the companion hears: the log's states with their stamps, a little later."""
    rng = np.random.default_rng((seed, 41))
    return heapq.merge(
        _positions(bed.told, rng), _speeds(bed.flight, rng), _statuses(bed.flight),
        key=lambda item: item.received_s,
    )  # fmt: skip


def _late(time_s: Floats, rng: np.random.Generator) -> list[float]:
    late_s = np.maximum(MESSAGE_DELAY_S + JITTER_S * rng.standard_normal(len(time_s)), 0.0)
    found: list[float] = np.maximum.accumulate(time_s + late_s).tolist()
    return found


def _positions(told: Any, rng: np.random.Generator) -> Iterator[Input]:
    for received_s, row in zip(_late(told.time_s, rng), told.tolist(), strict=True):
        boot_s, latitude, longitude, height_m, north, east, down, nose = row
        yield Telemetry(
            received_s=received_s,
            boot_s=math.floor(boot_s * 1e3 + 1e-6) / 1e3,
            latitude_deg=round(latitude, 7),
            longitude_deg=round(longitude, 7),
            relative_altitude_m=round(height_m, 3),
            velocity_north_m_s=round(north, 2),
            velocity_east_m_s=round(east, 2),
            velocity_down_m_s=round(down, 2),
            heading_deg=round(nose % 360.0, 2) % 360.0,
        )


def _speeds(flight: Recorded, rng: np.random.Generator) -> Iterator[Input]:
    late = _late(flight.states.time_s, rng)
    for received_s, speed in zip(late, flight.speed_m_s.tolist(), strict=True):
        yield SpeedReport(received_s=received_s, ground_speed_m_s=speed)


def _statuses(flight: Recorded) -> Iterator[Input]:
    start_s, end_s = flight.states.time_s[[0, -1]].tolist()
    yield OperatorCommand(received_s=start_s, enable=True, source="command")
    for now_s in np.arange(start_s, end_s + STATUS_S, STATUS_S).tolist():
        # A log begins with the arming: of that itself it may say nothing.
        armed = bool(held(flight.armed, now_s, True))
        mode, fix = held(flight.modes, now_s, "UNKNOWN"), held(flight.fixes, now_s, 0)
        yield HeartbeatReport(received_s=now_s, autopilot="ardupilot", armed=armed, mode=mode)
        yield GnssReport(received_s=now_s, fix=Fix(fix))
        yield EstimatorReport(received_s=now_s, healthy=True)
        yield LandedReport(received_s=now_s, in_air=armed)


# Perfect knowledge: of the whole flight, of every valve; held to what the sprayer can do.


def perfect_plans(setup: Setup, path: Trajectory) -> Iterator[SprayPlan]:
    """Yield the plans of who knows the whole flight; `setup` is that of `perfect_setup`.

    Each valve is dosed by its own speed across the boom when the order acts: a change of zone by
    its lag, in between as often and by as much as our own trims, and never below the least flow.
    """
    times_s = np.arange(path.time_s[0], path.time_s[-1], PLAN_S).tolist()
    fine = path.at(np.arange(path.time_s[0], path.time_s[-1], FINE_S))
    count = len(setup.boom.valves)
    changes = [each for valve in range(count) for each in _perfect_changes(setup, fine, valve)]
    changes.sort(key=lambda change: change.at_s)
    at_s = [change.at_s for change in changes]
    duty, done = [0.0] * count, 0
    for sequence, now_s in enumerate(times_s, start=1):
        first, last = np.searchsorted(at_s, (now_s, now_s + LEASE_S), side="right").tolist()
        for change in changes[done:first]:
            duty[change.valve] = change.duty
        done = first
        yield SprayPlan(
            sequence=sequence,
            issued_s=now_s,
            duty=tuple(duty),
            changes=tuple(changes[first:last]),
            lease_until_s=now_s + 1.01 * LEASE_S,
        )


def _perfect_changes(setup: Setup, fine: Trajectory, number: int) -> Iterator[TimedChange]:
    valve, timing = setup.boom.valves[number], setup.timings[number]
    turn = np.radians(fine.heading_deg)
    sin, cos = np.sin(turn), np.cos(turn)
    east_m = fine.east_m + sin * valve.forward_m + cos * valve.right_m
    north_m = fine.north_m + cos * valve.forward_m - sin * valve.right_m
    across_m_s = np.abs(np.gradient(east_m, FINE_S) * sin + np.gradient(north_m, FINE_S) * cos)
    rate = np.nan_to_num(setup.prescription.rates_at(east_m, north_m))
    flow = rate * across_m_s * flow_for_rate(1.0, 1.0, setup.boom.width_m)
    cuts = [0, *(np.flatnonzero(np.diff(rate)) + 1).tolist(), len(rate)]
    period, step = (max(round(each / FINE_S), 1) for each in (setup.pwm.period_s, TRIM_AGAIN_S))
    in_force = 0.0
    for begin, end in pairwise(cuts):
        for at in range(begin, end, step):
            # A change begins a period; a trim waits for the next one, half a period on average.
            starts = min(at + (period // 2 if at > begin else 0), end - 1)
            wanted_l_min = float(flow[starts : min(starts + period, end)].mean())
            wanted = allowed_duty(setup.nozzle_sets[-1].curve.duty_for(wanted_l_min), setup.pwm)
            is_trim = at > begin and wanted > 0.0 and in_force > 0.0
            if is_trim:
                wanted = min(max(wanted, in_force - TRIM_STEP_MAX), in_force + TRIM_STEP_MAX)
            if wanted == in_force:
                continue
            at_s = float(fine.time_s[at]) - timing.lead_s(in_force, wanted)
            yield TimedChange(at_s=at_s, valve=number, duty=wanted, restart=not is_trim)
            in_force = wanted


# The flights, and what they are judged by.


def fly_method(bed: Bed, method: str, seed: int) -> FlightResult:
    """Fly the recorded way with one method."""
    setup, plans = replace(bed.setup, centres_pulses=bed.output == "gpio"), None
    options = FlightOptions(
        fidelity="pulsed", output=bed.output, seed=seed, knows=method == "perfect"
    )
    if method == "perfect":
        output_s = WIRE_S + 0.5 * SERVO_FRAME_S if bed.output == "servo" else 0.0
        setup = perfect_setup(setup, bed.profile, seed=seed, output_s=output_s)
        setup = replace(setup, method=Method.SCHEDULED)
        plans = perfect_plans(setup, bed.path)
    elif method != "vrspray":
        lag = setup.lag
        ahead_s = 0.25 * (lag.on_s + lag.off_s + lag.up_s + lag.down_s) + lag.output_s
        setup = replace(setup, method=Method(method), look_ahead_s=ahead_s)
    return fly(
        setup, bed.path, bed.profile, options,
        speed_m_s=_usual_m_s(bed.path), method=method, heard=heard(bed, seed), plans=plans,
    )  # fmt: skip


def _usual_m_s(path: Trajectory) -> float:
    return float(np.median(path.speed_m_s[path.speed_m_s > MOVING_M_S]))


def figures_of(bed: Bed, result: FlightResult) -> dict[str, Any]:
    """Return what a flight is judged by; a row of `steps` is as `_steps` has it."""
    record, count = result.record, len(bed.setup.boom.valves)
    strips = strips_of(record)
    sets = bed.setup.nozzle_sets
    # Below its least flow and above its full one a sprayer cannot do what is asked.
    least = (1.0 - RANGE_SLACK) * sets[0].flow_min_l_min / count
    full = (1.0 + RANGE_SLACK) * sets[-1].flow_max_l_min / count
    yaw = np.abs(np.gradient(np.unwrap(record.heading_deg, period=360.0), record.step_s))
    wide = np.ones(2 * round(TURN_STAYS_S / record.step_s) + 1)
    turning = np.convolve(yaw > TURNING_DEG_S, wide, mode="same")
    swept, fast = _swept_m_s(record), bed.setup.limits.speed_min_m_s
    table: list[Any] = []
    steps: list[Any] = []
    for strip, own in zip(strips, swept[:-1], strict=True):
        track, parts = strip.track, misapplied_parts([strip])
        flow = rise_over(strip.asked_ml, track.period_steps) / track.period_s * 0.06
        # Nor below the speed that its configuration asks for; and what a pivoting boom carries back
        # goes over ground that it has just left.
        goes_back = (own < 0.0) & (swept[:-1].max(axis=0) > 0.0)
        can = (flow >= least) & (flow <= full) & (swept[-1] >= fast) & ~goes_back
        here = np.stack([np.interp(parts.time_s, track.time_s, each) for each in (can, turning)])
        table.append(np.stack((parts.wrong_ml, parts.asked_ml, *(here > 0.5))))
        steps += _steps(strip, can)
    wrong, asked, can, turn = np.concatenate(table, axis=1)

    def percent(which: Floats) -> float | None:
        whole = float(asked @ which)
        return 100.0 * float(wrong @ which) / whole if whole > 0.0 else None

    given_ml = float((record.volume_ml[-1] - record.volume_ml[0]).sum())
    asked_ml = sum(float(strip.asked_ml[-1]) for strip in strips)
    return {
        "misapplied_percent": percent(can),
        "turn_misapplied_percent": percent(can * turn),
        "straight_misapplied_percent": percent(can * (1.0 - turn)),
        "every_misapplied_percent": percent(np.ones_like(can)),
        "cannot_percent": 100.0 * float(asked @ (1.0 - can)) / max(float(asked.sum()), 1e-9),
        "volume_error_percent": 100.0 * (given_ml / max(asked_ml, 1e-9) - 1.0),
        "outside_ml": off_target_ml(strips, record.prescription),
        "steps": np.array(steps).reshape(-1, 3),
        "inhibits": result.inhibits,
    }


def _swept_m_s(record: FlightRecord) -> Floats:
    """Return how fast each strip goes along the nose, and last how fast the reference goes."""
    step_s, nose = record.step_s, np.radians(np.unwrap(record.heading_deg, period=360.0))
    east, north = np.gradient(record.east_m, step_s), np.gradient(record.north_m, step_s)
    along = east * np.sin(nose) + north * np.cos(nose)
    each = along - np.outer(record.boom.right_m, np.gradient(nose, step_s))
    return np.vstack((each, np.hypot(east, north)))


def _steps(strip: Strip, can: Any) -> Iterator[tuple[float, float, float]]:
    """Yield (late by volume [m], late by its own levels [m], how much of it came) of each change.

    Of those that anybody could make: the flow can be had all around, and no other is near.
    """
    track, stretches, smooth = strip.track, strip.stretches, SmoothTrack(strip.track)
    around_s = np.array([-AROUND_S, -LEVEL_FROM_S, 0.0, LEVEL_FROM_S, AROUND_S])
    for i, change in enumerate(changes_of(track, stretches)):
        if change is None or change.border:
            continue
        at_s = change.time_s + around_s
        stays_s = min(stretches[i].dwell_s, stretches[i + 1].dwell_s)
        if stays_s < AROUND_S + track.period_s or not can[slice(*track.samples(at_s[::4]))].all():
            continue
        way, given = track.at(smooth.distance_m, at_s), track.at(smooth.volume_ml, at_s)
        asked = track.at(strip.asked_ml, at_s)
        way[2] = change.distance_m
        rise, wanted, whole = np.diff(given), np.diff(asked), np.diff(way)
        if not whole.min() > MOVED_M:
            continue
        step = wanted[2:].sum() / whole[2:].sum() - wanted[:2].sum() / whole[:2].sum()
        before, after = rise[0] / whole[0], rise[3] / whole[3]
        came, late = (after - before) / step, (math.nan, math.nan)
        if came >= MISSED_BELOW:
            meets = given[3] - given[1] + before * way[1] - after * way[3]
            by_volume = (wanted.sum() - rise.sum()) / step
            late = float(by_volume), float(meets / (before - after) - change.distance_m)
        yield *late, float(came)


def fly_along(options: AlongOptions, say: Callable[[str], None]) -> dict[str, Any]:
    """Fly every method along the log, each flight over a map of its own; return the results."""
    if not (options.seed >= 0 and 1 <= options.flights <= FLIGHTS_MAX):
        raise ConfigError(f"give a --seed of 0 or more, and 1 to {FLIGHTS_MAX} --flights")
    seeds = range(options.seed, options.seed + options.flights)
    beds = [prepare(replace(options, seed=seed)) for seed in seeds]
    rows, records = [], {}
    for method in METHODS:
        flights = [
            fly_method(*each) for each in zip(beds, [method] * len(beds), seeds, strict=True)
        ]
        rows.append(row_of(method, [figures_of(*each) for each in zip(beds, flights, strict=True)]))
        records[method] = flights[0].record
        say(f"{method}: {counted(len(flights), 'flight')}")
    bed = beds[0]
    result = {
        "log": bed.flight.name,
        "position_rate_hz": bed.rate_hz,
        "recorded_rate_hz": round(bed.flight.rate_hz, 2),
        "flown_s": float(np.ptp(bed.path.time_s)),
        "speed_m_s": _usual_m_s(bed.path),
        "modes": sorted(_modes(bed.flight)),
        "plant": bed.profile.name,
        "flights": len(beds),
        "methods": rows,
        "limits": _limits(rows),
        "notes": list(bed.notes),
    }
    if options.out is not None:
        write_result(options.out, result)
        both = {method: records[method] for method in METHODS[:2]}
        title = f"{result['log']}, vrspray, positions at {result['position_rate_hz']:g} Hz"
        draw(both, options.out / "along.png", say, title=title)
    return result


def row_of(method: str, flights: list[dict[str, Any]]) -> dict[str, Any]:
    """Return one method's figures of all flights together."""

    def spread(name: str) -> dict[str, float] | None:
        known = [each[name] for each in flights if each[name] is not None]
        return (
            {"mean": float(np.mean(known)), "min": min(known), "max": max(known)} if known else None
        )

    def distances(values: Floats) -> dict[str, float | None]:
        size = np.abs(values[np.isfinite(values)])
        if not len(size):
            return {"mean_abs": None, "median_abs": None, "mean": None}
        mean = float(np.nanmean(values))
        return {"mean_abs": float(size.mean()), "median_abs": float(np.median(size)), "mean": mean}

    steps = np.concatenate([each["steps"] for each in flights])
    return {
        "method": method,
        **{name: spread(name) for name in flights[0] if name.endswith(("percent", "_ml"))},
        "lag_distance_m": distances(steps[:, 0]),
        "switch_m": distances(steps[:, 1]),
        "changes": len(steps),
        "missed": int((steps[:, 2] < MISSED_BELOW).sum()),
        "inhibits": sorted({reason for each in flights for reason in each["inhibits"]}),
    }


def _limits(rows: list[dict[str, Any]]) -> str:
    """Return in one line what keeps this flight from being sprayed exactly."""
    found = [[_number(row[name]) for row in rows[:2]] for name in (
        "misapplied_percent", "turn_misapplied_percent", "straight_misapplied_percent",
        "cannot_percent",
    )]  # fmt: skip
    (_, best), (turn, _), (straight, _), (cannot, _) = found
    return (
        f"{best} % is the sprayer's own error, which perfect knowledge of the flight leaves too; "
        f"vrspray misapplied {straight} %"
        f"{'' if turn == '-' else f' outside turns, {turn} % in turns'}; "
        f"{cannot} % of the volume is not counted: there the vehicle was too slow or too fast, or "
        "pivoted back over it"
    )


def along_lines(result: dict[str, Any]) -> Iterator[str]:
    """Yield the results for a person."""
    yield (
        f"{result['log']}: {result['flown_s']:.0f} s at {result['speed_m_s']:.1f} m/s (median), "
        f"positions at {result['position_rate_hz']:g} Hz, {counted(result['flights'], 'flight')} "
        "per method"
    )
    yield (
        f"{'':<10}{'misapplied %':>14}{'in turns':>10}{'lag m':>8}{'median':>8}{'step m':>8}"
        f"{'volume %':>10}{'outside mL':>12}{'missed':>12}"
    )
    for row in result["methods"]:
        lag, missed = row["lag_distance_m"], f"{row['missed']} of {row['changes']}"
        yield (
            f"{row['method']:<10}{_number(row['misapplied_percent'], 2):>14}"
            f"{_number(row['turn_misapplied_percent']):>10}{_number(lag, 3, 'mean_abs'):>8}"
            f"{_number(lag, 3, 'median_abs'):>8}{_number(row['switch_m'], 3, 'median_abs'):>8}"
            f"{_number(row['volume_error_percent']):>10}{_number(row['outside_ml']):>12}"
            f"{missed:>12}"
        )
    yield f"limits: {result['limits']}"
    reasons = result["methods"][0]["inhibits"]
    yield f"valves closed at times: {', '.join(Inhibit(each).words for each in reasons)}"
    for text in result["notes"]:
        yield f"note: {text}"


def _number(values: dict[str, Any] | None, digits: int = 1, key: str = "mean") -> str:
    value = None if values is None else values[key]
    return "-" if value is None else f"{value:.{digits}f}"
