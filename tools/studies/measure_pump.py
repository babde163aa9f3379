"""Measures the lags of a sprayer whose pump makes the flow, on the twin, as a rig would.

    python -m tools.studies.measure_pump [PLANT]

prints the `[lag]` table to paste, and `[pump]` where the pump has an order of its own. Steps of
30 % up and down, each left alone until the flow stands; with valves, the boom opened and shut at a
flow that stands. What was ordered is compared with the volume that came. The position's age is no
matter of the sprayer: it is that of `python -m tools.studies.measure_lags`, for any plant behind
the same autopilot.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from statistics import fmean

import numpy as np
from numpy.typing import NDArray

from companion.core.schedule import LagModel
from sitl.plants import PumpPlant
from sitl.profile import PlantProfile, load_profile
from sitl.section_plant import SectionPlant

Floats = NDArray[np.float64]

SEEDS = (9001, 9002, 9003, 9004)
# Nine time constants of the slowest pump: what is missing then is a ten thousandth of the step.
DWELL_S = 15.0
LINE_S = 1.0
STEP_S = 0.001
DRY = 0.02
CYCLE = (("on", 0.5), ("up", 0.65), ("down", 0.45), ("down", 0.35), ("up", 0.5), ("off", 0.0))
CYCLES = 3
# Of the example's flights (examples/anyang/lags/gpio.toml).
POSITION_S = 0.035


def measure(profile: PlantProfile, *, output_s: float = 0.0) -> LagModel:
    """Return the lags of this make of sprayer."""
    seen: dict[str, list[float]] = {}
    for seed in SEEDS:
        for kind, lag_s in _rig(profile, seed):
            seen.setdefault(kind, []).append(lag_s)
    return _lags(seen, output_s)


def _lags(seen: dict[str, list[float]], output_s: float) -> LagModel:
    """Return the lags of what was seen of a flow that is driven."""
    mean = {kind: fmean(values) for kind, values in seen.items()}
    return LagModel(
        on_s=mean["on"],
        off_s=mean["off"],
        up_s=mean["up"],
        down_s=mean["down"],
        on_start_s=min(seen["first"]),
        off_end_s=max(seen["last"]),
        output_s=output_s,
        position_s=POSITION_S,
        up_time_s=mean["up time"],
        down_time_s=mean["down time"],
    )


def _rig(profile: PlantProfile, seed: int) -> list[tuple[str, float]]:
    """Return the kind and the lag of every change of a few cycles, the first one left out."""
    plant = PumpPlant(profile, seed=seed)
    orders = _cycles()
    for _, at_s, duty in orders:
        plant.record_change(at_s, 0, duty)
    seen = []
    for kind, at_s, _ in orders[len(CYCLE) :]:
        seen += _look(plant.volume_ml, kind, at_s)
    return seen


def measure_sections(profile: PlantProfile, *, output_s: float = 0.0) -> tuple[LagModel, LagModel]:
    """Return the lags of a pump with an order of its own, and those of its sections' valves."""
    pump: dict[str, list[float]] = {}
    valves: dict[str, list[float]] = {}
    for seed in SEEDS:
        for seen, found in ((pump, _pump_rig(profile, seed)), (valves, _valve_rig(profile, seed))):
            for kind, lag_s in found:
                seen.setdefault(kind, []).append(lag_s)
    on_s, off_s = fmean(valves["on"]), fmean(valves["off"])
    return _lags(pump, output_s), LagModel(
        on_s=on_s,
        off_s=off_s,
        # On-off valves change no flow; what stands here is not used.
        up_s=on_s,
        down_s=off_s,
        on_start_s=min(valves["first"]),
        off_end_s=max(valves["last"]),
        output_s=output_s,
        position_s=POSITION_S,
    )


def _pump_rig(profile: PlantProfile, seed: int) -> list[tuple[str, float]]:
    """Return kind and lag of the pump's changes, all sections open."""
    assert profile.supply is not None
    plant, supply = SectionPlant(profile, seed=seed), profile.supply
    for valve in range(profile.valve_count):
        plant.record_change(0.0, valve, 1.0)
    seen = []
    orders = _cycles()
    for _, at_s, part in orders:
        plant.record_pump(at_s, supply.stop_us + part * (supply.max_us - supply.stop_us))
    for kind, at_s, _ in orders[len(CYCLE) :]:
        seen += _look(lambda times: plant.volume_ml(times).sum(axis=1)[:, None], kind, at_s)
    return seen


def _valve_rig(profile: PlantProfile, seed: int) -> list[tuple[str, float]]:
    """Return kind and lag of the sections' openings and closings, the pump at half."""
    assert profile.supply is not None
    plant, supply = SectionPlant(profile, seed=seed), profile.supply
    plant.record_pump(0.0, 0.5 * (supply.stop_us + supply.max_us))
    orders = [(kind, DWELL_S * (number + 1)) for number, kind in enumerate(("on", "off") * CYCLES)]
    for kind, at_s in orders:
        for valve in range(profile.valve_count):
            plant.record_change(at_s, valve, 1.0 if kind == "on" else 0.0)
    seen = []
    for kind, at_s in orders:
        seen += _look(lambda times: plant.volume_ml(times).sum(axis=1)[:, None], kind, at_s)
    return seen


def _cycles() -> list[tuple[str, float, float]]:
    """Return kind, time and part of the range of every change ordered."""
    return [
        (kind, DWELL_S * (number + 1), part) for number, (kind, part) in enumerate(CYCLE * CYCLES)
    ]


def _look(volume_ml: Callable[[Floats], Floats], kind: str, at_s: float) -> list[tuple[str, float]]:
    """Return what one change showed."""
    times: Floats = at_s + np.arange(-LINE_S, DWELL_S - STEP_S, STEP_S)
    volume: Floats = volume_ml(times)[:, 0]
    count = round(LINE_S / STEP_S)
    before = (volume[count] - volume[0]) / LINE_S
    after = (volume[-1] - volume[-1 - count]) / LINE_S
    # The two lines meet where a sharp step would have given the same volume.
    missing_ml = volume[count] + after * (times[-1] - at_s) - volume[-1]
    seen = [(kind, float(missing_ml / (after - before)))]
    flow = np.diff(volume) / STEP_S
    wet = np.flatnonzero((flow > DRY * max(before, after)) & (times[:-1] >= at_s))
    if kind in ("up", "down"):
        # An exponential is half way after ln 2 and nine tenths after ln 10 of its time constants.
        part = (flow - before) / (after - before)
        half, most = (int(np.flatnonzero(part < share)[-1]) for share in (0.5, 0.9))
        seen.append((f"{kind} time", float(times[most] - times[half]) / math.log(5.0)))
    if kind == "on":
        seen.append(("first", float(times[wet[0]] - at_s)))
    if kind == "off":
        seen.append(("last", float(times[wet[-1]] - at_s) + STEP_S))
    return seen


def main(arguments: Sequence[str]) -> int:
    """Print the `[lag]` table of a plant."""
    name = arguments[0] if arguments else "pump"
    profile = load_profile(name)
    sys.stdout.write(f"# {name}: `python -m tools.studies.measure_pump {name}`\n")
    names: tuple[str, ...] = ("on_s", "off_s", "up_s", "down_s", "on_start_s", "off_end_s")
    names = (*names, "output_s", "position_s")
    lag = pump = None
    if profile.has_sections:
        pump, lag = measure_sections(profile)
    else:
        lag = measure(profile)
        names = (*names, "up_time_s", "down_time_s")
    sys.stdout.write("[lag]\n")
    sys.stdout.writelines(f"{key} = {getattr(lag, key):.4f}\n" for key in names)
    if pump is not None:
        rows = {"spin_up_s": "on_start_s", "stop_end_s": "off_end_s"}
        rows |= {key: key for key in ("up_s", "down_s", "up_time_s", "down_time_s")}
        sys.stdout.write("\n[pump]\n")
        sys.stdout.writelines(f"{key} = {getattr(pump, rows[key]):.4f}\n" for key in rows)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
