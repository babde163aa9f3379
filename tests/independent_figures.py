"""The figures of a flight from its exported samples, without a line of the program.

`python tests/independent_figures.py samples.csv flight-0001.gpkg` reads what
`vrspray export flight-0001.gpkg --out samples.csv --format csv-samples` wrote, and the zones of
the map from the journal (a GeoPackage: SQLite with well-known binary). It was written from
docs/explanation/metrics.md with nothing but numpy and the standard library, so that an error in
the program's evaluation does not cancel out. Of a flight whose changes are all
measured: it knows no verdicts but `small` and `missed`.
"""

from __future__ import annotations

import csv
import json
import sqlite3
import struct
import sys
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ring = Floats
ML_PER_M = 0.1  # 1 L/ha on 1 m of width, per metre of track


def rings_of(blob: bytes) -> list[Ring]:
    """Return all rings of a GeoPackage's polygon or multipolygon."""
    envelope = {0: 0, 1: 32, 2: 48, 3: 48, 4: 64}[(blob[3] >> 1) & 7]
    rings: list[Ring] = []

    def read(at: int) -> int:
        order = "<" if blob[at] else ">"
        kind, count = struct.unpack_from(order + "II", blob, at + 1)
        at += 9
        for _ in range(count):
            if kind == 6:
                at = read(at)
                continue
            (points,) = struct.unpack_from(order + "I", blob, at)
            values = struct.unpack_from(f"{order}{2 * points}d", blob, at + 4)
            rings.append(np.array(values).reshape(-1, 2))
            at += 4 + 16 * points
        return at

    read(8 + envelope)
    return rings


class Map:
    """Zones with rates; a point is in a zone if a ray from it crosses its rings an odd time."""

    def __init__(self, journal: Path) -> None:
        uri = f"{journal.resolve().as_uri()}?mode=ro"
        with closing(sqlite3.connect(uri, uri=True)) as connection:
            rows = connection.execute("SELECT geom, rate_l_ha FROM zones").fetchall()
            (field,) = connection.execute("SELECT geom FROM field").fetchone()
        self.zones = [(rings_of(geom), float(rate)) for geom, rate in rows]
        self.field = rings_of(field)

    def rate(self, east_m: float, north_m: float) -> float:
        """Return the rate at a point; 0 outside the field."""
        if not within(self.field, east_m, north_m):
            return 0.0
        for rings, rate in self.zones:
            if within(rings, east_m, north_m):
                return rate
        return 0.0


def within(rings: list[Ring], east_m: float, north_m: float) -> bool:
    """Return whether a point lies inside rings."""
    odd = False
    for ring in rings:
        (x0, y0), (x1, y1) = ring[:-1].T, ring[1:].T
        spans = (y0 > north_m) != (y1 > north_m)
        x = x0[spans] + (north_m - y0[spans]) * (x1 - x0)[spans] / (y1 - y0)[spans]
        odd ^= bool(np.count_nonzero(x > east_m) % 2)
    return odd


def all_within(rings: list[Ring], east_m: Floats, north_m: Floats) -> NDArray[np.bool_]:
    """Return which of many points lie inside rings."""
    odd = np.zeros(len(east_m), dtype=np.bool_)
    for ring in rings:
        for (x0, y0), (x1, y1) in pairwise(ring):
            spans = (y0 > north_m) != (y1 > north_m)
            if y0 != y1:
                odd ^= spans & (x0 + (north_m - y0) * (x1 - x0) / (y1 - y0) > east_m)
    return odd


class Valve:
    """One strip: its path, distance, volume, prescribed volume, boundaries."""

    def __init__(self, table: dict[str, Floats], about: dict[str, Any], ground: Map) -> None:
        name = about["column"]
        self.time_s = table["time_s"]
        heading = np.radians(table["heading_deg"])
        sin, cos = np.sin(heading), np.cos(heading)
        self.x = table["east_m"] + sin * about["forward_m"] + cos * about["right_m"]
        self.y = table["north_m"] + cos * about["forward_m"] - sin * about["right_m"]
        moved = np.hypot(np.diff(self.x), np.diff(self.y))
        self.s = np.concatenate(([0.0], np.cumsum(moved)))
        self.step_s = float(self.time_s[-1] - self.time_s[0]) / (len(self.time_s) - 1)
        self.rates = table[f"rate_l_ha_{name}"]
        # In the field, but for a tenth of a metre at either end.
        half_m = max(0.5 * about["width_m"] - 0.1, 0.25 * about["width_m"])
        self.inside = np.ones(len(self.time_s), dtype=np.bool_)
        for right_m in (-half_m, half_m):
            self.inside &= all_within(ground.field, self.x + cos * right_m, self.y - sin * right_m)
        drops = table[f"flow_l_min_{name}"] / 0.06 * self.step_s
        self.volume = np.cumsum(drops)
        self.across = about["width_m"] * self._square(sin, cos)
        self.edges = [self._edge(i, ground) for i in np.flatnonzero(np.diff(self.rates))]
        self.asked = self._asked()

    def _square(self, sin: Floats, cos: Floats) -> Floats:
        """Return how square the strip lies to the motion: |cos(heading - course)|."""
        run_e, run_n = self.over(self.x, PERIOD["s"]), self.over(self.y, PERIOD["s"])
        run = np.hypot(run_e, run_n)
        return np.where(run > 1e-6, np.abs(run_e * sin + run_n * cos) / np.maximum(run, 1e-9), 1.0)

    def _edge(self, row: int, ground: Map) -> tuple[float, float, float, float]:
        """Return time, distance, rate before and after of the boundary behind a row."""
        before, after = float(self.rates[row]), float(self.rates[row + 1])
        low, high = 0.0, 1.0
        for _ in range(18):
            part = 0.5 * (low + high)
            x = self.x[row] + part * (self.x[row + 1] - self.x[row])
            y = self.y[row] + part * (self.y[row + 1] - self.y[row])
            if abs(ground.rate(x, y) - before) < 1e-9:
                low = part
            else:
                high = part
        part = 0.5 * (low + high)
        time_s = float(self.time_s[row] + part * self.step_s)
        return time_s, float(self.s[row] + part * (self.s[row + 1] - self.s[row])), before, after

    def _asked(self) -> Floats:
        knots = np.sort(np.concatenate((self.time_s, [edge[0] for edge in self.edges])))
        starts = np.array([self.time_s[0], *[edge[0] for edge in self.edges]])
        rates = np.array([self.rates[0], *[edge[3] for edge in self.edges]])
        middle = 0.5 * (knots[1:] + knots[:-1])
        rate = rates[np.searchsorted(starts, middle, "right") - 1]
        across = np.interp(middle, self.time_s, self.across)
        drops = rate * ML_PER_M * across * np.diff(np.interp(knots, self.time_s, self.s))
        return np.interp(self.time_s, knots, np.concatenate(([0.0], np.cumsum(drops))))

    def at(self, values: Floats, time_s: Floats | float) -> Floats:
        """Return values at any times; beyond the ends the last one."""
        return np.asarray(np.interp(time_s, self.time_s, values))

    def over(self, values: Floats, length_s: float) -> Floats:
        """Return the rise of values over a time, centred."""
        half = 0.5 * length_s
        return self.at(values, self.time_s + half) - self.at(values, self.time_s - half)

    def mean(self, values: Floats, length_s: float) -> Floats:
        """Return the centred mean over a time; beyond the ends stands the last value."""
        steps = int(np.ceil(length_s / self.step_s)) + 2
        padded = np.pad(values - values[0], steps, mode="edge")
        areas = np.concatenate(([0.0], np.cumsum(0.5 * (padded[1:] + padded[:-1]))))
        index = np.arange(len(padded), dtype=np.float64)
        half = 0.5 * length_s / self.step_s
        rise = np.interp(index + half, index, areas) - np.interp(index - half, index, areas)
        return rise[steps:-steps] / (2.0 * half) + values[0]


PERIOD = {"s": 0.0}
Span = tuple[float, float]


class Flow:
    """The smoothed volume of a valve over its smoothed way, and what it was between boundaries."""

    def __init__(self, valve: Valve, period_s: float) -> None:
        self.valve, self.period_s = valve, period_s
        self.volume = valve.mean(valve.mean(valve.volume, period_s), period_s)
        self.way = valve.mean(valve.mean(valve.s, period_s), period_s)
        run, rise = valve.over(self.way, period_s), valve.over(self.volume, period_s)
        self.dose = np.divide(rise, run, out=np.zeros(len(run)), where=run > 0.1 * period_s)
        inner = [edge[0] for edge in valve.edges]
        self.times = [float(valve.time_s[0]), *inner, float(valve.time_s[-1])]

    def between(self, start_s: float, end_s: float) -> float:
        """Return the mean dose between two times."""
        rises = [
            self.valve.at(each, np.array([start_s, end_s])) for each in (self.volume, self.way)
        ]
        ml, metres = (float(np.diff(each)[0]) for each in rises)
        return ml / metres

    def row(self, time_s: float) -> int:
        return int((time_s - self.valve.time_s[0]) / self.valve.step_s)

    def level(self, number: int, *, usual: bool = False) -> float:
        """Return the dose of a stretch, its mean or what it mostly was."""
        rate = self.valve.edges[number - 1][3] if number else float(self.valve.rates[0])
        if rate <= 0.0:
            return 0.0
        start_s, dwell_s = self.times[number], self.times[number + 1] - self.times[number]
        ends_s = start_s + 0.5 * dwell_s, start_s + 0.88 * dwell_s
        if usual:
            return float(np.median(self.dose[self.row(ends_s[0]) : self.row(ends_s[1]) + 1]))
        return self.between(*ends_s)

    def asked(self, number: int) -> float:
        """Return the step of the dose that a boundary asks for."""
        time_s, _, before, after = self.valve.edges[number]
        return (after - before) * ML_PER_M * float(self.valve.at(self.valve.across, time_s))

    def change(self, number: int, after_s: float) -> tuple[float, Span]:
        """Return the middle of a change, not before `after_s`, and from when to when it lasts."""
        time_s, _, _, after = self.valve.edges[number]
        low, high = self.level(number), self.level(number + 1)
        mostly = self.level(number, usual=True), self.level(number + 1, usual=True)
        if (mostly[1] - mostly[0]) / self.asked(number) >= 0.25:
            low, high = mostly
        end_s = self.times[number + 2]
        early_s = max(self.times[number], time_s - 2.0, after_s)
        late_s = end_s if after > 0.0 else time_s + 0.5 * (end_s - time_s)
        first, last = self.row(early_s), self.row(late_s) + 1
        part = (self.dose[first:last] - low) / (high - low)
        metres = np.diff(self.way[first : last + 1], append=self.way[-1])[: len(part)]
        middle = first + int(np.argmin(np.cumsum((np.clip(part, 0.0, 1.0) - 0.5) * metres)))
        middle_s = float(self.valve.time_s[middle])

        def quarters(low: float, high: float) -> Span:
            part = (self.dose[first:last] - low) / (high - low)
            below = np.flatnonzero(part[: middle - first + 1] <= 0.25)
            above = np.flatnonzero(part[middle - first :] >= 0.75)
            low_s = float(self.valve.time_s[first + below[-1]]) if len(below) else early_s
            return low_s, float(self.valve.time_s[middle + above[0]]) if len(above) else late_s

        period_s = self.period_s
        low_s, high_s = quarters(low, high)
        slow_s = max(high_s - low_s - 1.68 * period_s, 0.0)
        # Slow by the doses of the whole stretches, it may be sharp by those right beside it.
        left = max(middle_s - 20.0 * period_s, early_s), middle_s - 1.5 * period_s
        right = middle_s + 1.5 * period_s, min(middle_s + 20.0 * period_s, late_s)
        if slow_s > 0.0 and min(left[1] - left[0], right[1] - right[0]) >= 3.0 * period_s:
            near = self.between(*left), self.between(*right)
            span = quarters(*near) if (near[1] - near[0]) * (high - low) > 0.0 else (low_s, high_s)
            if span[1] - span[0] <= 1.68 * period_s:
                (low_s, high_s), slow_s = span, 0.0
        return middle_s, (low_s - 0.35 * period_s - slow_s, high_s + 1.35 * period_s + 3.0 * slow_s)

    def line(self, near_s: float, far_s: float, sign: float) -> tuple[float, float, float]:
        """Return a point of the volume over the way near a change, and the slope away from it."""
        periods = min(int(abs(far_s - near_s) / self.period_s) - 2, 20)
        anchor_s = near_s + sign * self.period_s
        ends = sorted((anchor_s, anchor_s + sign * periods * self.period_s))
        way, volume = (float(self.valve.at(each, anchor_s)) for each in (self.way, self.volume))
        return way, volume, self.between(*ends)


def lags(valve: Valve, period_s: float) -> tuple[list[float], int]:
    """Return the lag distance of every change inside the field, and how many never came."""
    flow = Flow(valve, period_s)
    spans: list[Span] = []
    middle_s, missed = -np.inf, 0
    for i in range(len(valve.edges)):
        middle_s, span = flow.change(i, middle_s)
        spans.append(span)
    found = []
    for i, (_, distance_m, before, after) in enumerate(valve.edges):
        if min(before, after) <= 0.0 or abs(after - before) / before < 0.08:
            continue
        if (flow.level(i + 1) - flow.level(i)) / flow.asked(i) < 0.5:
            missed += 1
            continue
        floor_s = spans[i - 1][1] if i else float(valve.time_s[0])
        ceiling_s = spans[i + 1][0] if i + 1 < len(spans) else float(valve.time_s[-1])
        s0, v0, q0 = flow.line(spans[i][0], floor_s, -1.0)
        s1, v1, q1 = flow.line(spans[i][1], ceiling_s, 1.0)
        found.append((v1 - v0 + q0 * s0 - q1 * s1) / (q0 - q1) - distance_m)
    return found, missed


def figures(samples: Path, journal: Path) -> dict[str, float]:
    """Return the figures of a flight."""
    about = json.loads(Path(f"{samples}-metadata.json").read_text(encoding="utf-8"))["notes"][0]
    with samples.open(newline="", encoding="utf-8") as file:
        reader = csv.reader(file)
        names = next(reader)
        rows = np.array([[float(value) for value in row] for row in reader])
    table = dict(zip(names, rows.T, strict=True))
    period_s = PERIOD["s"] = float(about["pwm_period_s"])
    ground = Map(journal)
    valves = [Valve(table, each, ground) for each in about["valves"]]
    distances: list[float] = []
    missed = 0
    for valve in valves:
        its, never = lags(valve, period_s)
        distances += its
        missed += never
    wrong = asked = 0.0
    for valve in valves:
        run = valve.over(valve.s, period_s)
        counts = valve.inside & (run > 0.5 * period_s)
        metres = np.gradient(valve.s)[counts] / run[counts]
        given_ml, asked_ml = valve.over(valve.volume, period_s), valve.over(valve.asked, period_s)
        wrong += float((np.abs(given_ml - asked_ml)[counts] * metres).sum())
        asked += float((asked_ml[counts] * metres).sum())
    speed = valves[0].over(valves[0].s, period_s) / period_s
    given = sum((v.over(v.volume, period_s) for v in valves), np.zeros(len(speed))) / period_s
    target = np.zeros(len(speed))
    inside = speed > 0.5
    for valve in valves:
        pace = valve.over(valve.s, period_s) / period_s
        target += valve.rates * ML_PER_M * pace * valve.across
        inside &= valve.inside
    inside &= target > 0.0
    accuracy = 100.0 * (1.0 - np.abs(given - target)[inside] / target[inside])
    lag = np.array(distances)
    return {
        "volume_l": float(sum(valve.volume[-1] for valve in valves)) / 1000.0,
        "spraying_accuracy_percent": float(accuracy.mean()),
        "misapplied_percent": 100.0 * wrong / asked,
        "lag_distance_mean_abs_m": float(np.abs(lag).mean()),
        "lag_distance_mean_m": float(lag.mean()),
        "changes": float(len(lag)),
        "missed": float(missed),
    }


if __name__ == "__main__":
    sys.stdout.write(json.dumps(figures(Path(sys.argv[1]), Path(sys.argv[2])), indent=1) + "\n")
