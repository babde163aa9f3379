"""Judges a flight beside a real firmware: where each change fell, from truth and servo outputs.

Imports nothing of the program. The sprayer is the simplest that has a sprayer's delays: a board
that obeys the pulses of a servo frame, valves with a dead time and a straight rise, flow by the
published table with straight lines between its points, one tank, no PWM ripple, no scatter.

The definitions are those of docs/explanation/metrics.md, written anew: a change lies where a
sharp step of the same volume would lie; + is too late, in metres along the track.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapefile
import shapely
from numpy.typing import NDArray

from tests.firmware.station import Place, Pulses

Floats = NDArray[np.float64]

STEP_S, COARSE_S = 0.002, 0.01
SMOOTHED_S = 0.1  # to each side: the vehicle's acceleration is steady for so long
METRES_A_DEGREE = 111_319.49
CLOSED_US, FULL_US, DEAD_BAND = 1000.0, 2000.0, 0.01
SMALL_STEP, CLOSE_M, REACH_M = 0.08, 2.5, 4.0
GRAZED_M = 1.5  # before and after a change: whether it is the same one beside
OFF_TARGET_ELEMENT_M = 0.1
CELL_M = 0.5
# On a line: within a metre of it, and within 20 degrees of its course.
ASIDE_MAX_M, ALONG = 1.0, 0.94


@dataclass(frozen=True, slots=True)
class Sprayer:
    """The valves and what they do with a pulse: as examples/anyang, whose lags are the same."""

    right_m: tuple[float, ...] = (-2.5, -1.5, -0.5, 0.5, 1.5, 2.5)
    outputs: tuple[int, ...] = (9, 10, 11, 12, 13, 14)
    width_m: float = 1.0
    # An order waits for the next frame of 20 ms: drawn for each output, 10 ms on average.
    frame_s: float = 0.020
    dead_s: float = 0.069
    rise_s: float = 0.070
    duty: tuple[float, ...] = (0.0, 0.2, 0.4, 0.5, 0.7, 0.8, 0.9, 1.0)
    # Of all six, Wang et al. 2024, Table 2; below the first point a straight line to closed.
    flow_l_min: tuple[float, ...] = (0.0, 1.476, 3.024, 3.276, 4.62, 5.052, 5.952, 6.096)

    def flow_ml_s(self, pulse_us: Floats) -> Floats:
        """Return one valve's flow at steady pulses."""
        duty = (pulse_us - CLOSED_US) / (FULL_US - CLOSED_US)
        duty = np.where(duty < DEAD_BAND, 0.0, np.clip(duty, 0.0, 1.0))
        found: Floats = np.interp(duty, self.duty, self.flow_l_min)
        return found * 1000.0 / 60.0 / len(self.right_m)


@dataclass(frozen=True, slots=True)
class Zone:
    """A part of the field with one rate, in degrees."""

    outline: shapely.Geometry
    rate_l_ha: float


@dataclass(frozen=True, slots=True)
class Change:
    """One valve at one boundary; `lag_m` is None for a change that never came."""

    valve: int
    at_s: float
    along_m: float
    from_l_ha: float
    to_l_ha: float
    speed_m_s: float
    lag_m: float | None


@dataclass(slots=True)
class Verdict:
    """What a flight did."""

    changes: list[Change] = field(default_factory=list)
    apart: list[Change] = field(default_factory=list)
    off_target_ml: float = 0.0
    off_lines_ml: float = 0.0
    sprayed_l: float = 0.0
    prescribed_l: float = 0.0
    position_late_s: float = float("nan")

    @property
    def lags_m(self) -> Floats:
        """Of the changes that came."""
        return np.array([one.lag_m for one in self.changes if one.lag_m is not None])

    @property
    def missed(self) -> list[Change]:
        """Those that never came."""
        return [one for one in self.changes if one.lag_m is None]

    @property
    def mean_abs_m(self) -> float:
        """Mean of absolute lag distances."""
        return float(np.mean(np.abs(self.lags_m)))

    @property
    def worst_m(self) -> float:
        """The largest absolute lag distance."""
        return float(np.max(np.abs(self.lags_m)))

    def __str__(self) -> str:
        lags_m = self.lags_m
        if not len(lags_m):
            return f"no change came; {len(self.missed)} missed, {self.sprayed_l:.3f} L sprayed"
        return (
            f"{len(lags_m)} changes: mean {self.mean_abs_m:.3f} m (signed {lags_m.mean():+.3f}), "
            f"worst {self.worst_m:.3f} m; {len(self.missed)} missed, {len(self.apart)} apart; "
            f"off target {self.off_target_ml:.2f} mL, off lines {self.off_lines_ml:.2f} mL; "
            f"sprayed {self.sprayed_l:.3f} L of {self.prescribed_l:.3f} L"
        )


def geojson_zones(path: Path, rate_field: str = "rate") -> list[Zone]:
    """Read zones without any reader of the program."""
    found = json.loads(path.read_text())
    return [
        Zone(shapely.geometry.shape(one["geometry"]), float(one["properties"][rate_field]))
        for one in found["features"]
    ]


def shapefile_zones(path: Path, rate_field: str = "rate") -> list[Zone]:
    """Read the zones of a shapefile in degrees."""
    with shapefile.Reader(str(path)) as reader:
        return [
            Zone(shapely.geometry.shape(row.shape.__geo_interface__), float(row.record[rate_field]))
            for row in reader.iterShapeRecords()
        ]


def geojson_lines(path: Path, kind: str = "spray") -> list[shapely.LineString]:
    """Return the lines of one kind of a plan."""
    found = json.loads(path.read_text())
    return [
        shapely.geometry.shape(one["geometry"])
        for one in found["features"]
        if one["properties"]["kind"] == kind
    ]


def geojson_area(path: Path) -> shapely.Geometry:
    """Return the union of a file's outlines."""
    found = json.loads(path.read_text())
    return shapely.union_all([shapely.geometry.shape(one["geometry"]) for one in found["features"]])


# ---------------------------------------------------------------------------------------- clocks


def vehicle_times(places: Sequence[Place], pulses: Sequence[Pulses]) -> Floats:
    """Return when each place was true on the vehicle's clock.

    SIMSTATE has no time. The servo outputs, asked for at the same rate, are sent in the same
    moment and have one. Which of the two is sent first is seen by which come together; the order
    in the stream holds even where this computer was late to read it.
    """
    if places[0].at_s is not None:
        return np.array([one.at_s for one in places])
    came_s = np.array([one.came_s for one in places])
    marks_s = np.array([one.came_s for one in pulses])
    at_s = np.array([one.at_s for one in pulses])
    after = np.array([one.pulses_before for one in places])
    after = np.clip(after, 1, len(marks_s) - 1)
    is_after = np.median(marks_s[after] - came_s) <= np.median(came_s - marks_s[after - 1])
    found: Floats = at_s[after if is_after else after - 1]
    return found


@dataclass(frozen=True, slots=True)
class Path2d:
    """The true way on an even grid of time."""

    at_s: Floats
    east_m: Floats
    north_m: Floats
    yaw_rad: Floats
    along_m: Floats
    speed_m_s: Floats


class Plane:
    """Degrees to metres about a place; over a field its error is below a millimetre."""

    def __init__(self, latitude_deg: float, longitude_deg: float) -> None:
        self._latitude_deg, self._longitude_deg = latitude_deg, longitude_deg
        latitude = np.radians(latitude_deg)
        # WGS 84: radii of the meridian and of the prime vertical.
        squared, flat = 0.00669437999014, np.sin(latitude) ** 2
        prime_m = 6_378_137.0 / np.sqrt(1.0 - squared * flat)
        self._north_m = np.radians(1.0) * prime_m * (1.0 - squared) / (1.0 - squared * flat)
        self._east_m = np.radians(1.0) * prime_m * np.cos(latitude)

    def metres(self, longitude_deg: Any, latitude_deg: Any) -> tuple[Floats, Floats]:
        """Return east and north."""
        return (
            (np.asarray(longitude_deg) - self._longitude_deg) * self._east_m,
            (np.asarray(latitude_deg) - self._latitude_deg) * self._north_m,
        )

    def of(self, geometry: shapely.Geometry) -> shapely.Geometry:
        """Return a geometry in metres."""
        return shapely.transform(
            geometry, lambda rows: np.column_stack(self.metres(rows[:, 0], rows[:, 1]))
        )


def _smooth(at_s: Floats, values: Floats, grid_s: Floats) -> Floats:
    """Fit a parabola about each hundredth of a second; samples are rounded to 1 cm."""
    coarse_s = np.arange(grid_s[0] - SMOOTHED_S, grid_s[-1] + 2.0 * SMOOTHED_S, COARSE_S)
    half = round(SMOOTHED_S / COARSE_S)
    away = np.arange(-half, half + 1.0)
    squares, fourths = (away**2).sum(), (away**4).sum()
    kernel = fourths - squares * away**2
    even = np.interp(coarse_s, at_s, values)
    smooth = np.convolve(even - even[0], kernel / kernel.sum(), mode="same") + even[0]
    found: Floats = np.interp(grid_s, coarse_s, smooth)
    return found


def true_path(places: Sequence[Place], at_s: Floats, plane: Plane) -> Path2d:
    """Return the way on a grid of STEP_S."""
    order = np.unique(at_s, return_index=True)[1]
    at_s = at_s[order]
    rows = [places[number] for number in order]
    east_m, north_m = plane.metres(
        [one.longitude_deg for one in rows], [one.latitude_deg for one in rows]
    )
    yaw_rad = np.unwrap([one.yaw_rad for one in rows])
    grid_s = np.arange(at_s[0] + 3 * SMOOTHED_S, at_s[-1] - 3 * SMOOTHED_S, STEP_S)
    east_m, north_m = _smooth(at_s, east_m, grid_s), _smooth(at_s, north_m, grid_s)
    steps_m = np.hypot(np.diff(east_m), np.diff(north_m))
    along_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    speed = np.gradient(along_m, STEP_S)
    return Path2d(grid_s, east_m, north_m, np.interp(grid_s, at_s, yaw_rad), along_m, speed)


# -------------------------------------------------------------------------------------- sprayer


def flows_ml_s(pulses: Sequence[Pulses], grid_s: Floats, sprayer: Sprayer, seed: int) -> Floats:
    """Return the flow of each valve on the grid: rows are valves."""
    draw = np.random.default_rng(seed)
    at_s = np.array([one.at_s for one in pulses])
    # A pulse that first shows in a message began since the one before.
    since_s = np.concatenate([[at_s[0]], 0.5 * (at_s[1:] + at_s[:-1])])
    flows = []
    for output in sprayer.outputs:
        us = np.array([one.us[output - 1] for one in pulses], dtype=float)
        phase_s = draw.uniform(0.0, sprayer.frame_s)
        first_s = sprayer.frame_s * np.floor((grid_s[0] - 1.0) / sprayer.frame_s)
        frames_s = np.arange(first_s + phase_s, grid_s[-1] + 1.0, sprayer.frame_s)
        seen = np.searchsorted(since_s, frames_s, side="right") - 1
        wanted = sprayer.flow_ml_s(us[np.clip(seen, 0, None)])
        # Each frame's flow begins after the dead time and rises over the rise.
        held = np.searchsorted(frames_s, grid_s - sprayer.dead_s, side="right") - 1
        sharp = wanted[np.clip(held, 0, None)]
        width = max(1, round(sprayer.rise_s / STEP_S))
        summed = np.cumsum(np.concatenate([np.full(width, sharp[0]), sharp]))
        flows.append((summed[width:] - summed[:-width]) / width)
    return np.array(flows)


# docs/reference/driver-board.md, rule 11: a width that has moved by less than half the dither for
# so long closes its valve.
ALIVE_S, MOVE_US = 0.3, 4


@dataclass(frozen=True, slots=True)
class Closing:
    """A valve that was open and that the board closed, its width having stood still."""

    output: int
    came_s: float


def obeyed(
    pulses: Sequence[Pulses], outputs: Sequence[int] = Sprayer().outputs
) -> tuple[list[Pulses], list[Closing]]:
    """Return the pulses as a board obeys them that wants its widths to move, and what it closed.

    PX4 repeats the last order of a dead companion for ever: such a board is what closes there.
    """
    found: list[Pulses] = []
    closings: list[Closing] = []
    moved = dict.fromkeys(outputs, (-np.inf, -np.inf))  # to which width, when
    is_open = dict.fromkeys(outputs, False)
    for one in pulses:
        us = list(one.us)
        for output in outputs:
            width_us = us[output - 1]
            if abs(width_us - moved[output][0]) >= MOVE_US:
                moved[output] = (width_us, one.at_s)
            is_wanted = width_us > CLOSED_US + DEAD_BAND * (FULL_US - CLOSED_US)
            is_alive = one.at_s - moved[output][1] < ALIVE_S
            if is_wanted and not is_alive:
                us[output - 1] = round(CLOSED_US)
                if is_open[output]:
                    closings.append(Closing(output, one.came_s))
            is_open[output] = is_wanted and is_alive
        found.append(Pulses(one.came_s, one.at_s, tuple(us)))
    return found, closings


# -------------------------------------------------------------------------------------- verdict


def judge(
    places: Sequence[Place],
    pulses: Sequence[Pulses],
    zones: Sequence[Zone],
    *,
    inside: shapely.Geometry | None = None,
    lines: Sequence[shapely.LineString] | None = None,
    sprayer: Sprayer | None = None,
    seed: int = 1,
    grazing_m: float = 0.0,
) -> Verdict:
    """Return what a flight did.

    A change counts apart where it would be another one that far aside: a valve that runs along a
    boundary crosses it here by one place and there by the next.

    `inside` is where liquid may fall, else all zones. With `lines` only what is flown along one of
    them counts; what is sprayed off them is `off_lines_ml`.
    """
    sprayer = sprayer or Sprayer()
    plane = _plane(zones)
    path = true_path(places, vehicle_times(places, pulses), plane)
    flows = flows_ml_s(pulses, path.at_s, sprayer, seed)
    return _verdict(path, flows, plane, zones, inside, lines, sprayer, grazing_m)


def judge_perfect(
    places: Sequence[Place],
    zones: Sequence[Zone],
    *,
    inside: shapely.Geometry | None = None,
    lines: Sequence[shapely.LineString] | None = None,
    sprayer: Sprayer | None = None,
    grazing_m: float = 0.0,
) -> Verdict:
    """Return what a sprayer without delay would have done that believes the speeds that are told.

    Its changes are on time to the millimetre. What is left is what places and speeds disagree by.
    """
    sprayer = sprayer or Sprayer()
    plane = _plane(zones)
    at_s = np.array([place.at_s for place in places], dtype=float)
    path = true_path(places, at_s, plane)
    flat = [Zone(plane.of(zone.outline), zone.rate_l_ha) for zone in zones]
    speed_m_s = np.interp(path.at_s, at_s, [place.speed_m_s for place in places])
    flows = [
        np.nan_to_num(rates_at(flat, *_valve_place(path, right_m))) * sprayer.width_m * speed_m_s
        for right_m in sprayer.right_m
    ]
    return _verdict(path, 0.1 * np.array(flows), plane, zones, inside, lines, sprayer, grazing_m)


def apart_m(verdict: Verdict, other: Verdict) -> tuple[Floats, Floats]:
    """Return how far the changes of two verdicts of one flight are apart, those that both have.

    And as metres of the greater dose: a change by a seventh that lies 0.28 m off puts as much in
    the wrong place as one from nothing that lies 0.04 m off.
    """
    lags_m = {(one.valve, one.at_s): one.lag_m for one in other.changes}
    rows = [
        (one.lag_m - lag_m, abs(one.to_l_ha - one.from_l_ha) / max(one.to_l_ha, one.from_l_ha))
        for one in verdict.changes
        if one.lag_m is not None and (lag_m := lags_m.get((one.valve, one.at_s))) is not None
    ]
    found_m, steps = np.array(rows).reshape(-1, 2).T
    return found_m, np.abs(found_m) * steps


def _plane(zones: Sequence[Zone]) -> Plane:
    middle = shapely.union_all([zone.outline for zone in zones]).centroid
    return Plane(middle.y, middle.x)


def _verdict(
    path: Path2d,
    flows: Floats,
    plane: Plane,
    zones: Sequence[Zone],
    inside: shapely.Geometry | None,
    lines: Sequence[shapely.LineString] | None,
    sprayer: Sprayer,
    grazing_m: float,
) -> Verdict:
    flat = [Zone(plane.of(zone.outline), zone.rate_l_ha) for zone in zones]
    allowed = plane.of(inside) if inside is not None else None
    if allowed is None:
        allowed = shapely.union_all([zone.outline for zone in flat])
    verdict = Verdict(sprayed_l=float(flows.sum()) * STEP_S / 1000.0)
    on_line = np.ones(len(path.at_s), dtype=bool)
    if lines is not None:
        on_line = along_lines(path, [plane.of(line) for line in lines])
        verdict.off_lines_ml = float(flows[:, ~on_line].sum()) * STEP_S
    for valve in range(len(sprayer.right_m)):
        _judge_valve(verdict, valve, path, on_line, flat, flows[valve], sprayer, grazing_m)
    verdict.off_target_ml = _off_target_ml(path, flows, allowed, sprayer)
    return verdict


def rates_at(zones: Sequence[Zone], east_m: Floats, north_m: Floats) -> Floats:
    """Return the rate at each place, NaN outside."""
    rates = np.full(len(east_m), np.nan)
    for zone in zones:
        rates[shapely.contains_xy(zone.outline, east_m, north_m)] = zone.rate_l_ha
    return rates


def _valve_place(path: Path2d, right_m: float) -> tuple[Floats, Floats]:
    east_m = path.east_m + right_m * np.cos(path.yaw_rad)
    return east_m, path.north_m - right_m * np.sin(path.yaw_rad)


def along_lines(path: Path2d, lines: Sequence[shapely.LineString]) -> NDArray[np.bool_]:
    """Return where the vehicle flies along one of the lines: near it, and as it goes."""
    points = shapely.points(path.east_m, path.north_m)
    moves = np.gradient(path.east_m, STEP_S), np.gradient(path.north_m, STEP_S)
    found = np.zeros(len(points), dtype=bool)
    for line in lines:
        (x0, y0), (x1, y1) = line.coords[0], line.coords[-1]
        forward = (moves[0] * (x1 - x0) + moves[1] * (y1 - y0)) / line.length
        is_along = forward >= ALONG * np.maximum(path.speed_m_s, 0.1)
        found |= is_along & (shapely.distance(points, line) <= ASIDE_MAX_M)
    return found


def _judge_valve(
    verdict: Verdict,
    valve: int,
    path: Path2d,
    on_line: NDArray[np.bool_],
    zones: Sequence[Zone],
    flow: Floats,
    sprayer: Sprayer,
    grazing_m: float,
) -> None:
    def place(aside_m: float) -> tuple[Floats, Floats]:
        return _valve_place(path, sprayer.right_m[valve] + aside_m)

    def rates_of(aside_m: float) -> Floats:
        return np.where(on_line, rates_at(zones, *place(aside_m)), np.nan)

    # The valve's own way: in a turn the ends of the boom go faster and slower than the middle.
    east_m, north_m = place(0.0)
    steps_m = np.hypot(np.diff(east_m), np.diff(north_m))
    along_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    rates = rates_of(0.0)
    known = np.where(np.isnan(rates), -1.0, rates)
    beside = [rates_of(aside_m) for aside_m in (-grazing_m, grazing_m) if grazing_m]
    edges = np.flatnonzero(np.diff(known) != 0.0) + 1
    edges = edges[path.speed_m_s[edges] >= 1.0]
    volume = np.concatenate([[0.0], np.cumsum(flow[1:] * np.diff(path.at_s))])
    ml = np.where(np.isnan(rates), 0.0, rates)[1:] * sprayer.width_m * steps_m * 0.1
    verdict.prescribed_l += float(ml.sum()) / 1000.0
    bounds = np.concatenate([[0], edges, [len(known) - 1]])
    for number, edge in enumerate(edges, start=1):
        before, after = known[edge - 1], known[edge]
        if before < 0.0 or after < 0.0:
            continue  # the border's
        here_m = along_m[edge]
        back_m = here_m - along_m[bounds[number - 1]]
        on_m = along_m[bounds[number + 1]] - here_m
        lag_m = _lag_m(along_m, volume, here_m, back_m, on_m, (before, after))
        off_s = GRAZED_M / path.speed_m_s[edge]
        sides = edge + np.array([-1, 1]) * round(off_s / STEP_S)
        sides = np.clip(sides, 0, len(known) - 1)
        is_grazed = any(
            (side[sides[0]], side[sides[1]]) != (known[sides[0]], known[sides[1]])
            for side in beside
        )
        change = Change(
            valve + 1,
            float(path.at_s[edge]),
            float(here_m),
            float(before),
            float(after),
            float(path.speed_m_s[edge]),
            lag_m,
        )
        is_small = abs(after - before) < SMALL_STEP * max(before, after)
        if is_small or is_grazed or min(back_m, on_m) < CLOSE_M:
            verdict.apart.append(change)
        else:
            verdict.changes.append(change)


def _lag_m(
    along_m: Floats,
    volume_ml: Floats,
    here_m: float,
    back_m: float,
    on_m: float,
    rates: tuple[float, float],
) -> float | None:
    """Return how late a sharp step of the same volume would lie; None where none came."""
    near_m = min(1.0, 0.35 * min(back_m, on_m))
    far_back_m = min(max(0.75 * back_m, near_m + 0.8), back_m - 0.3, REACH_M)
    far_on_m = min(max(0.75 * on_m, near_m + 0.8), on_m - 0.3, REACH_M)
    marks_m = here_m + np.array([-far_back_m, -near_m, near_m, far_on_m])
    v0, v1, v2, v3 = np.interp(marks_m, along_m, volume_ml)
    dose_before = (v1 - v0) / (far_back_m - near_m)
    dose_after = (v3 - v2) / (far_on_m - near_m)
    wanted = 0.1 * (rates[1] - rates[0])
    if not (dose_after - dose_before) / wanted >= 0.5:
        return None
    # Two lines: v1 + dose_before (s - s1) and v2 + dose_after (s - s2).
    crossing_m = (v2 - v1 + dose_before * marks_m[1] - dose_after * marks_m[2]) / (
        dose_before - dose_after
    )
    return float(crossing_m - here_m)


def _off_target_ml(
    path: Path2d, flows: Floats, allowed: shapely.Geometry, sprayer: Sprayer
) -> float:
    """Return the volume that fell outside, the strips in elements of a decimetre."""
    count = round(sprayer.width_m / OFF_TARGET_ELEMENT_M)
    found_ml = 0.0
    for valve, right_m in enumerate(sprayer.right_m):
        open_now = np.flatnonzero(flows[valve] > 0.0)
        for number in range(count):
            aside_m = right_m + sprayer.width_m * ((number + 0.5) / count - 0.5)
            east_m = path.east_m[open_now] + aside_m * np.cos(path.yaw_rad[open_now])
            north_m = path.north_m[open_now] - aside_m * np.sin(path.yaw_rad[open_now])
            is_out = ~shapely.contains_xy(allowed, east_m, north_m)
            found_ml += float(flows[valve][open_now[is_out]].sum()) * STEP_S / count
    return found_ml
