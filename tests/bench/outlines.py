"""Plans for real, recorded and made-up outlines, each judged apart, beside what peers fly.

    python -m tests.bench.outlines [--count 210] [--seed 1] [--fields DIR] [--only NAME]
        [--jobs 2] [--keep DIR] [--json FILE] [--bound]

Every outline is written as GeoJSON and planned by `vrspray plan` itself, in a process of its own
with a limit of processor time. What it writes is judged by `tests.mission_judge` (shapely and the
shape of the Earth alone), and its missions are flown by `tests.mission_flight`. The real outlines
are those of VRSPRAY_SAMPLES and of --fields. Exit 1 where a criterion fails. With --bound nothing
is planned: it tells what the grid's lines would take if they left no more than a plan may, on
fields below 1 ha.
"""

from __future__ import annotations

import argparse
import importlib
import io
import json
import multiprocessing
import os
import resource
import statistics
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from itertools import groupby, pairwise
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkProcess
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.cli.app import execute
from tests.bench.parcels import KINDS, Parcel, parcel, read_parcel
from tests.bench.peers import PEERS, lines_of, tanks, way_of_lines
from tests.mission_fields import trees
from tests.mission_flight import (
    UPRIGHT_S,
    Power,
    Way,
    flown_s,
    items_of_plan,
    items_of_waypoints,
    legs_s,
    length_m,
    near,
    way_of,
)
from tests.mission_judge import Drawn, Legs, judge, judge_fence, judge_legs, legs_of

Floats = NDArray[np.float64]

WIDTH_M, SPEED_M_S, ACCELERATION_M_S2, RATE_L_HA = 6.0, 6.0, 2.5, 20.0
TANK_L, RESERVE_L, OBSTACLE_BUFFER_M = 40.0, 1.0, 2.0
BATTERY_WH, BATTERY_RESERVE = 1000.0, 0.2
POWER = Power(
    hover_w=3000.0, cruise_w=2600.0, per_kg_w=40.0, limit_wh=BATTERY_WH * (1.0 - BATTERY_RESERVE)
)
# What a corner costs the peers' estimate of their battery; their time is that of the flight.
PEER_STOP_S = 3.0
CONFIG = Path(__file__).parents[2] / "examples" / "anyang" / "config.toml"

# What must hold.
REACHED_PERCENT, NEAR_M = 99.8, 2.0
# Planned beside flown time: hardly ever too short.
TIME_PERCENT = (-2.0, 5.0)
FENCE_CORNERS, FENCE_OUTSIDE_M, ITEMS = 70, 10.0, 649
CPU_SMALL_S, CPU_LARGE_S, LARGE_HA, PEAK_MB = 5.0, 20.0, 150.0, 300.0
# Beyond this there is no answer.
CPU_LIMIT_S = 120
TREES = ((1, 2.0), (15, 10.0), (20, 20.0), (50, 50.0), (100, 150.0))
SIZES = ((1.0, "< 1 ha"), (10.0, "1 to 10 ha"), (100.0, "10 to 100 ha"), (np.inf, "> 100 ha"))


def config_text() -> str:
    """Return the configuration of all plans: the Anyang sprayer with a battery, and no map."""
    head, rest = CONFIG.read_text(encoding="utf-8").split("[prescription]")
    boom = rest[rest.index("[boom]") : rest.index("[mission]")]
    return f"""{head}{boom}[mission]
swath_width_m = {WIDTH_M}
speed_m_s = {SPEED_M_S}
acceleration_m_s2 = {ACCELERATION_M_S2}
height_m = 3.5
rate_l_ha = {RATE_L_HA}
tank_l = {TANK_L}
reserve_l = {RESERVE_L}
obstacle_buffer_m = {OBSTACLE_BUFFER_M}
battery_wh = {BATTERY_WH}
battery_reserve_percent = {100.0 * BATTERY_RESERVE}
power_hover_w = {POWER.hover_w}
power_cruise_w = {POWER.cruise_w}
power_per_kg_w = {POWER.per_kg_w}
"""


def parcels(count: int, seed: int, folder: Path | None) -> Iterator[Parcel]:
    """Yield the real outlines, rectangles with trees, then so many made-up ones of all kinds."""
    samples = os.environ.get("VRSPRAY_SAMPLES")
    for kind, each in (("real", samples and Path(samples) / "fields"), ("given", folder)):
        for path in sorted(Path(each).glob("*.geojson")) if each else ():
            if not path.stem.endswith(".obstacles"):
                yield read_parcel(path, kind=kind)
    for trees_count, area_ha in TREES:
        made = trees(trees_count, corners=64, area_ha=area_ha, seed=seed)
        yield Parcel(
            name=f"trees-{trees_count}", kind="trees", outline=made.outline,
            obstacles=tuple(made.obstacles),
        )  # fmt: skip
    for number in range(count):
        yield parcel(KINDS[number % len(KINDS)], seed + number // len(KINDS))


# --- one outline --------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Planned:
    """What the command answers: its JSON, the plan and the missions' items with their fences."""

    told: dict[str, Any]
    plan: dict[str, Any]
    items: list[list[tuple[int, float, float, float]]]
    fenced: list[dict[str, Any]]
    fence_refused: str | None


class RefusedError(Exception):
    """No plan, and the command says why."""


def run(each: Parcel) -> dict[str, Any]:
    """Return all figures of an outline, or why there is no plan."""
    with tempfile.TemporaryDirectory(prefix="vrspray-bench-") as scratch:
        folder = Path(scratch)
        outline, obstacles = each.write(folder)
        config = folder / "config.toml"
        config.write_text(config_text(), encoding="utf-8")
        begun = process_time()
        _limit_cpu(begun + CPU_LIMIT_S)
        try:
            planned, took_s = _planned(outline, obstacles, config)
        except RefusedError as error:
            return {"refused": str(error), "cpu_s": process_time() - begun}
        except Exception:  # noqa: BLE001 - a traceback is what this looks for
            return {"broken": traceback.format_exc(limit=-4), "cpu_s": process_time() - begun}
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        _limit_cpu(None)
        drawn = Drawn(
            outline=each.outline, obstacles=each.obstacles, width_m=WIDTH_M,
            obstacle_buffer_m=OBSTACLE_BUFFER_M,
        )  # fmt: skip
        found = {"cpu_s": took_s, "peak_mb": peak_mb} | _judged(drawn, planned)
        return found | {"peers": _peers(drawn, planned)}


def _limit_cpu(until_s: float | None) -> None:
    _, hard = resource.getrlimit(resource.RLIMIT_CPU)
    soft = resource.RLIM_INFINITY if until_s is None else int(until_s) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (soft, hard))


def _planned(outline: Path, obstacles: Path | None, config: Path) -> tuple[Planned, float]:
    """Plan as the command does; where no fence fits, the mission is written without one."""
    refused, took_s = None, 0.0
    for suffix in (".plan", ".waypoints"):
        said = io.StringIO()
        begun = process_time()
        command = [
            "plan",
            "--force",
            outline,
            "--out",
            outline.with_suffix(suffix),
            "--config",
            config,
        ]
        command += ["--json"] if obstacles is None else ["--json", "--obstacle", obstacles]
        with redirect_stdout(said), redirect_stderr(io.StringIO()):
            code = execute([str(each) for each in command])
        told = json.loads(said.getvalue())
        if code:
            if suffix == ".waypoints" or "fence" not in told["error"]:
                raise RefusedError(told["error"])
            refused, took_s = told["error"], process_time() - begun
            continue
        took_s = took_s or process_time() - begun
        missions = [Path(path) for path in told["files"]]
        texts = [path.read_text(encoding="utf-8") for path in missions]
        fenced = [json.loads(text) for text in texts] if suffix == ".plan" else []
        items = [items_of_plan(each) for each in fenced] or [items_of_waypoints(t) for t in texts]
        plan = json.loads(Path(told["lines_file"]).read_text(encoding="utf-8"))
        break
    return Planned(
        told=told, plan=plan, items=items, fenced=fenced, fence_refused=refused
    ), took_s  # fmt: skip


def _judged(drawn: Drawn, planned: Planned) -> dict[str, Any]:
    """Return the figures of a plan."""
    found = judge(drawn, planned.plan, speed_m_s=SPEED_M_S, a_m_s2=ACCELERATION_M_S2)
    fence: set[str] = set() if planned.fence_refused is None else {"refused"}
    for content in planned.fenced:
        fence |= set(
            judge_fence(
                drawn, content, corners_max=FENCE_CORNERS, outside_max_m=FENCE_OUTSIDE_M
            )
        )  # fmt: skip
    rows = planned.told["sorties"]
    ways = [way_of(items, drawn.plane, SPEED_M_S) for items in planned.items]
    flown = [flown_s(way) for way in ways]
    errors = [100.0 * (row["flight_s"] / s - 1.0) for row, s in zip(rows, flown, strict=True)]
    drawn_wh = [
        POWER.wh(
            ground_s=ground_s, way_m=length_m(way), speed_m_s=SPEED_M_S,
            litres=on_board_l(planned.plan, row["number"], row["volume_l"], way),
        )
        for way, row, ground_s in zip(ways, rows, flown, strict=True)
    ]  # fmt: skip
    return found | {
        "sorties": len(rows),
        "litres_percent": 100.0
        * (sum(row["volume_l"] for row in rows) / (found["area_ha"] * RATE_L_HA) - 1.0),
        "overlap_litres_percent": planned.told["overlap_litres_percent"],
        "flight_min": sum(flown) / 60.0,
        "time_percent": 100.0 * (sum(row["flight_s"] for row in rows) / sum(flown) - 1.0),
        "worst_time_percent": max(errors, key=abs),
        "battery_percent": 100.0 * max(drawn_wh) / POWER.limit_wh,
        "planned_battery_percent": 100.0
        * max(row["energy_wh"] for row in rows) / POWER.limit_wh,
        "tank_percent": 100.0 * max(row["volume_l"] for row in rows) / (TANK_L - RESERVE_L),
        "items": max(row["items"] for row in rows),
        "near": sum(near(way, NEAR_M) for way in ways),
        "fence": sorted(fence),
        "fence_refused": planned.fence_refused,
        "warnings": len(planned.told["warnings"]),
        "said_percent": planned.told["reachable_percent"],
    }  # fmt: skip


def on_board_l(plan: dict[str, Any], number: int, volume_l: float, way: Way) -> float:
    """Return the mean of the litres on board over the time of a sortie's way.

    What a load takes of a battery is its power times the time for which it is carried: the tank
    empties in the short lines of a flight, which take far more time a metre than its ferries. By
    metres a load counts for longer than it is on board where the first ferry is long.
    """
    flown_m = np.concatenate([[0.0], np.cumsum(way.lengths_m)])
    flown = np.concatenate([[0.0], np.cumsum(legs_s(way))])
    legs_m, sprayed_l = [], []
    for each in plan["features"]:
        properties = each["properties"]
        if each["geometry"]["type"] != "LineString" or properties["sortie"] != number:
            continue
        points = np.array(each["geometry"]["coordinates"])
        scale = np.array([np.cos(np.radians(points[0, 1])), 1.0])
        legs_m.append(float(np.hypot(*(np.diff(points, axis=0) * scale).T).sum()))
        sprayed_l.append(properties["volume_l"])
    # Degrees become metres by the way itself, which is as long.
    ends_m = np.concatenate([[0.0], np.cumsum(legs_m)])
    ends_m *= flown_m[-1] / max(ends_m[-1], 1e-12)
    taken_s = np.diff(np.interp(ends_m, flown_m, flown))
    before_l = volume_l + RESERVE_L - np.cumsum([0.0, *sprayed_l])
    carried = taken_s * (before_l[:-1] + before_l[1:]) / 2.0
    return float(carried.sum() / flown[-1]) if flown[-1] > 0.0 else float(before_l[-1])


# --- beside it ----------------------------------------------------------------------------------


def _peers(drawn: Drawn, planned: Planned) -> dict[str, dict[str, float]]:
    """Return the figures of this plan and the peers', from the first line to the last."""
    ways = [way_of(items, drawn.plane, SPEED_M_S) for items in planned.items]
    spray_m = sum(
        float(np.hypot(*np.diff(points, axis=0).T).sum())
        for kind, points in legs_of(drawn, planned.plan)
        if kind == "spray"
    )
    found = {"ours": _summed(ways, spray_m)}
    home = ways[0].places[0]
    area = drawn.plane.area(drawn.outline)
    per_m = RATE_L_HA * WIDTH_M / 1e4
    mean_w = POWER.cruise_w + POWER.per_kg_w * (RESERVE_L + (TANK_L - RESERVE_L) / 2.0)
    for peer in PEERS:
        ground = drawn.flown() if peer == "headland" else area
        lines = lines_of(peer, ground, drawn.width_m)
        rows = tanks(
            lines, home, tank_m=(TANK_L - RESERVE_L) / per_m,
            range_s=POWER.limit_wh * 3600.0 / mean_w - UPRIGHT_S * POWER.hover_w / mean_w,
            speed_m_s=SPEED_M_S, stop_s=PEER_STOP_S,
        )  # fmt: skip
        legs: Legs = [("spray", row.reshape(2, 2)) for sortie in rows for row in sortie] + [
            ("transit", np.array([a[2:], b[:2]]))
            for sortie in rows
            for a, b in pairwise(sortie)
            if not np.allclose(a[2:], b[:2])
        ]
        sprayed_m = float(np.hypot(*(lines[:, 2:] - lines[:, :2]).T).sum())
        flights = [_way(way_of_lines(sortie, home)) for sortie in rows]
        judged = judge_legs(drawn, legs, speed_m_s=SPEED_M_S, a_m_s2=ACCELERATION_M_S2)
        kept = (
            "missed_m2",
            "missed_places",
            "off_m2",
            "transit_outside_m",
            "twice_percent",
            "reachable_percent",
        )
        found[peer] = _summed(flights, sprayed_m) | {key: judged[key] for key in kept}
    return found


def bounds(each: Parcel) -> tuple[float, float]:
    """Return what the grid's lines and passes over what they miss take, of the lines' own time.

    Without a turn for those passes, and with one for each place: at equal coverage less than the
    first is not to be had with these lines, and hardly less than the second.
    """
    drawn = Drawn(outline=each.outline, width_m=WIDTH_M, obstacle_buffer_m=OBSTACLE_BUFFER_M)
    lines = lines_of("grid", drawn.plane.area(drawn.outline), WIDTH_M)
    legs: Legs = [("spray", row.reshape(2, 2)) for row in lines]
    judged = judge_legs(drawn, legs, speed_m_s=SPEED_M_S, a_m_s2=ACCELERATION_M_S2)
    lines_s = flown_s(_way(lines.reshape(-1, 2)))
    long_m = 100.0
    two = np.array([[0.0, 0.0], [0.0, long_m], [WIDTH_M, long_m], [WIDTH_M, 0.0]])
    turn_s = flown_s(_way(two)) - flown_s(_way(two[:2])) - long_m / SPEED_M_S
    spare_m2 = (1.0 - REACHED_PERCENT / 100.0) * drawn.reachable.area
    missed_m2 = max(judged["missed_m2"] - spare_m2, 0.0)
    passes_s = missed_m2 / WIDTH_M / SPEED_M_S
    turns_s = judged["missed_places"] * turn_s if missed_m2 > 0.0 else 0.0
    return 1.0 + passes_s / lines_s, 1.0 + (passes_s + turns_s) / lines_s


def say_bounds(cases: Sequence[Parcel]) -> None:
    """Tell the medians of `bounds` of small fields without obstacles."""
    found = [
        bounds(each)
        for each in cases
        if not each.obstacles and Drawn(outline=each.outline).ground.area < SIZES[0][0] * 1e4
    ]
    bare, turning = (statistics.median(some) for some in zip(*found, strict=True))
    say(
        f"{len(found)} fields below {SIZES[0][0]:g} ha without obstacles: the grid's lines and "
        f"passes over what they miss take {bare:.2f} of the lines' time, {turning:.2f} with a "
        "turn for each place (medians)"
    )


def _way(places: Floats) -> Way:
    return Way(places=places, speeds_m_s=np.full(len(places) - 1, SPEED_M_S))


def _summed(ways: Sequence[Way], spray_m: float) -> dict[str, float]:
    """Return minutes and metres, without the way from home to the first line and the last one's."""
    last = len(ways) - 1
    inner = [
        way.without_ends(first=number == 0, last=number == last) for number, way in enumerate(ways)
    ]
    whole_m = sum(length_m(way) for way in inner)
    return {
        "minutes": sum(flown_s(way) for way in inner) / 60.0,
        "not_working_m": max(whole_m - spray_m, 0.0),
        "whole_m": whole_m,
        "sorties": len(ways),
    }


# --- verdicts -----------------------------------------------------------------------------------

CRITERIA: dict[str, Callable[[dict[str, Any]], bool]] = {
    "reach": lambda row: row["reachable_percent"] >= REACHED_PERCENT,
    "off": lambda row: row["off_m2"] <= 0.02,
    "transit": lambda row: row["transit_outside_m"] <= 0.02,
    "time": lambda row: TIME_PERCENT[0] <= row["worst_time_percent"] <= TIME_PERCENT[1],
    "battery": lambda row: row["battery_percent"] <= 100.0,
    "tank": lambda row: row["tank_percent"] <= 100.0 + 1e-6,
    "fence": lambda row: not row["fence"] or row["fence"] == ["refused"],
    "items": lambda row: row["items"] <= ITEMS,
    "2 m": lambda row: row["near"] == 0,
    "cpu": lambda row: row["cpu_s"]
    <= (CPU_SMALL_S if row["area_ha"] <= LARGE_HA else CPU_LARGE_S),
    "memory": lambda row: row["peak_mb"] <= PEAK_MB,
}  # fmt: skip


def failed(row: dict[str, Any]) -> list[str]:
    """Return the criteria that a plan fails."""
    for kind in ("no answer", "broken", "refused"):
        if kind in row:
            return [kind]
    return [name for name, holds in CRITERIA.items() if not holds(row)]


# --- many outlines, each in a process of its own ------------------------------------------------


def run_all(cases: Sequence[Parcel], jobs: int) -> Iterator[tuple[Parcel, dict[str, Any]]]:
    """Yield each outline's figures, as they come."""
    context = multiprocessing.get_context("fork")
    left, running = list(reversed(cases)), dict[Connection, tuple[Parcel, ForkProcess]]()
    try:
        while left or running:
            while left and len(running) < jobs:
                each = left.pop()
                ours, theirs = context.Pipe(duplex=False)
                process = context.Process(target=_child, args=(each, theirs))
                process.start()
                theirs.close()
                running[ours] = (each, process)
            for ready in wait(list(running)):
                assert isinstance(ready, Connection)
                each, process = running.pop(ready)
                try:
                    row = ready.recv()
                except EOFError:
                    row = {"no answer": f"more than {CPU_LIMIT_S} s of processor time"}
                ready.close()
                process.join()
                yield each, row
    finally:
        for connection, (_, process) in running.items():
            connection.close()
            process.kill()
            process.join()


def _child(each: Parcel, answers: Connection) -> None:
    answers.send(run(each))
    answers.close()


def compiled() -> None:
    """Have the command's bytecode written once, as where it is installed.

    Where the environment forbids that, each plan would take half a second to compile it.
    """
    sys.dont_write_bytecode = False
    context = multiprocessing.get_context("fork")
    first = context.Process(target=importlib.import_module, args=("missions.cli",))
    first.start()
    first.join()


def main() -> int:
    """Print a line for each outline and the tables; 1 where a criterion fails."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.outlines", description=__doc__)
    parser.add_argument("--count", type=int, default=210, help="made-up outlines")
    parser.add_argument("--seed", type=int, default=1, help="the first of their seeds")
    parser.add_argument("--fields", type=Path, help="folder of more outlines (*.geojson)")
    parser.add_argument("--only", default="", help="outlines whose name has this")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--keep", type=Path, help="folder for the outlines that fail")
    parser.add_argument("--json", type=Path, help="file for all figures")
    parser.add_argument("--bound", action="store_true", help="what covering as much must take")
    given = parser.parse_args()
    cases = [
        each for each in parcels(given.count, given.seed, given.fields) if given.only in each.name
    ]
    if given.bound:
        say_bounds(cases)
        return 0
    if given.keep is not None:
        given.keep.mkdir(parents=True, exist_ok=True)
    compiled()
    results: dict[str, dict[str, Any]] = {}
    for each, row in run_all(cases, given.jobs):
        results[each.name] = row | {"kind": each.kind, "failed": failed(row)}
        say(_line(each, results[each.name]))
        if given.json:
            # Each time: a run that is ended has told what it found.
            given.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
        if results[each.name]["failed"] and given.keep is not None:
            each.write(given.keep)
    for line in tables(list(results.values())):
        say(line)
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    say(f"{(spent.ru_utime + spent.ru_stime) / 60.0:.1f} minutes of processor time")
    return 1 if any(row["failed"] for row in results.values()) else 0


def _line(each: Parcel, row: dict[str, Any]) -> str:
    wrong = f"  FAILS {', '.join(row['failed'])}" if row["failed"] else ""
    for kind in ("no answer", "broken", "refused"):
        if kind in row:
            return f"{each.name:18} {kind}: {row[kind].strip().splitlines()[-1]}"
    peer = row["peers"]["grid"]["minutes"]
    return (
        f"{each.name:18} {row['area_ha']:7.2f} ha, {len(each.obstacles):3} obst, "
        f"reach {row['reachable_percent']:6.2f} twice {row['twice_percent']:5.2f} "
        f"off {row['off_m2']:.2f} out {row['transit_outside_m']:.2f} "
        f"time {row['worst_time_percent']:+5.1f} batt {row['battery_percent']:5.1f} "
        f"items {row['items']:3} near {row['near']} cpu {row['cpu_s']:5.1f} "
        f"MB {row['peak_mb']:4.0f} x grid {row['peers']['ours']['minutes'] / peer:4.2f} "
        f"{' '.join(row['fence'])}{wrong}"
    )


def tables(rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield the tables: what holds by kind, and the peers by kind and by size."""
    yield ""
    yield f"{'kind':10} outlines, answered; failures of each criterion"
    for kind, some in _by(rows, lambda row: row["kind"]):
        counts: dict[str, int] = {}
        for row in some:
            for name in row["failed"]:
                counts[name] = counts.get(name, 0) + 1
        answered = [row for row in some if "area_ha" in row]
        told = ", ".join(f"{name} {count}" for name, count in sorted(counts.items()))
        yield f"{kind:10} {len(some)}, {len(answered)}; {told or 'none'}"
    whole = [row for row in rows if "area_ha" in row]
    if not whole:
        return
    for key, worst in (
        ("reachable_percent", min), ("off_m2", max), ("transit_outside_m", max),
        ("battery_percent", max), ("items", max), ("near", max), ("cpu_s", max), ("peak_mb", max),
    ):  # fmt: skip
        values = [row[key] for row in whole]
        yield f"{key:20} median {statistics.median(values):8.2f}, worst {worst(values):8.2f}"
    low, high = (pick(row["worst_time_percent"] for row in whole) for pick in (min, max))
    yield f"{'time_percent':20} of sorties {low:+.1f} to {high:+.1f}"
    yield ""
    yield "twice: ground under two strips; litres: those that fall twice, and those above the map"
    yield f"{'size':12} {'n':>3} | twice %, litres twice %, litres above % | median, most of each"
    sizes = _by(whole, lambda row: size_of(row["area_ha"]), ordered=False)
    for name, some in sizes:
        columns = [
            [row[key] for row in some]
            for key in ("twice_percent", "overlap_litres_percent", "litres_percent")
        ]
        yield f"{name:12} {len(some):3} | " + ", ".join(
            f"{statistics.median(each):.1f} {max(each):.1f}" for each in columns
        )
    yield ""
    yield from _peer_rows("kind", _by(whole, lambda row: row["kind"]))
    yield from _peer_rows("size", sizes)


def _by(
    rows: Sequence[dict[str, Any]], key: Callable[[dict[str, Any]], str], *, ordered: bool = True
) -> list[tuple[str, list[dict[str, Any]]]]:
    order = [name for _, name in SIZES]
    rank = (lambda row: key(row)) if ordered else (lambda row: str(order.index(key(row))))
    return [
        (name, list(some)) for name, some in groupby(sorted(rows, key=rank), key=key)
    ]  # fmt: skip


def size_of(area_ha: float) -> str:
    """Return the class of size."""
    return next(name for limit, name in SIZES if area_ha < limit)


def _peer_rows(by: str, groups: list[tuple[str, list[dict[str, Any]]]]) -> Iterator[str]:
    yield (
        f"{by:12} {'n':>3} | missed m2: ours, {', '.join(PEERS)} | off field m2 | "
        "ours / theirs: time | not working | median of each"
    )
    for name, some in [*groups, ("all", [row for _, rows in groups for row in rows])]:
        yield (
            f"{name:12} {len(some):3} | "
            f"{_median(some, lambda row: row['missed_m2']):.1f}, "
            + ", ".join(f"{_median(some, _of(peer, 'missed_m2')):.0f}" for peer in PEERS)
            + f" | {_median(some, lambda row: row['off_m2']):.1f}, "
            + ", ".join(f"{_median(some, _of(peer, 'off_m2')):.0f}" for peer in PEERS)
            + " | "
            + ", ".join(f"{_median(some, _ratio(peer, 'minutes')):.3f}" for peer in PEERS)
            + " | "
            + ", ".join(f"{_median(some, _ratio(peer, 'not_working_m')):.2f}" for peer in PEERS)
        )


def _median(rows: Sequence[dict[str, Any]], key: Callable[[dict[str, Any]], float]) -> float:
    return statistics.median(key(row) for row in rows)


def _of(peer: str, key: str) -> Callable[[dict[str, Any]], float]:
    return lambda row: float(row["peers"][peer][key])


def _ratio(peer: str, key: str) -> Callable[[dict[str, Any]], float]:
    def ratio(row: dict[str, Any]) -> float:
        return float(row["peers"]["ours"][key]) / max(float(row["peers"][peer][key]), 1e-9)

    return ratio


def say(text: str) -> None:
    """Tell a figure."""
    sys.stderr.write(text.rstrip() + "\n")
    sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main())
