"""How small a fault single valves show, opened one after another, and how often a healthy one does.

    python -m tests.bench.clicks --sprayers 200 [--open-s 1.0] [--step-ml 0.217] [--first-seed 1]

Each sprayer of `wang-2024` is another one (5 % of lag and 2 % of flow between valves, the meter's
gain within 3 %, 1 % of noise a period). Each valve is opened twice for `--open-s`, pulse by pulse
as the plant has it, and counted as `vrspray doctor --click --wet` does: from before to after, less
what was counted with all closed. Valve 4 has the fault. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections import Counter
from collections.abc import Sequence
from functools import cache

import numpy as np

from companion.ground.clicks import ClickFlow, ClickJudgement, ClickLaw, judge_clicks
from companion.output.pwm import Edge
from sitl.plant import PulsedPlant
from sitl.profile import ML_S_PER_L_MIN, PlantProfile, load_profile

PLANT = "wang-2024"
FAULTY = 3
CLOGS = (0.05, 0.08, 0.10, 0.12, 0.15, 0.20, 0.30, 0.50)
TIMES, CLOSED_S, IDLE_S = 2, 0.8, 1.5
METER_STEP_ML = 1000.0 / 4600.0


@cache
def profile() -> PlantProfile:
    """Return the sprayer."""
    return load_profile(PLANT)


def clicked(
    seed: int,
    *,
    open_s: float,
    step_ml: float,
    clog: float = 0.0,
    stuck: bool | None = None,
    leak: float = 0.0,
) -> ClickJudgement:
    """Return what is said of one sprayer; `stuck` is how valve 4 stays, `leak` of the full flow."""
    plant = PulsedPlant(profile(), seed=seed)
    count = profile().valve_count
    openings = [1.0] * count
    openings[FAULTY] = 1.0 - clog
    plant.restrict(0.0, openings=openings, supply=1.0)
    if leak:
        plant.leak(0.0, leak * profile().nozzle_sets[-1].flow_max_l_min * ML_S_PER_L_MIN)
    if stuck is not None:
        plant.stick(0.0, FAULTY, is_open=stuck)
    now_s, windows = 1.0, []
    for valve in range(count):
        idle_s, now_s = now_s, now_s + IDLE_S
        begin_s = now_s
        for _ in range(TIMES):
            plant.record([Edge(now_s, valve, True, 1.0)])
            plant.record([Edge(now_s + open_s, valve, False, 0.0)])
            now_s += open_s + CLOSED_S
        windows.append((idle_s, begin_s, now_s))
    times_s = np.array([at_s for window in windows for at_s in window])
    counted_ml = np.floor(plant.meter_volume_ml(times_s) / step_ml) * step_ml
    counts = counted_ml.reshape(count, 3)
    idle_ml = float((counts[:, 1] - counts[:, 0]).sum())
    largest = profile().nozzle_sets[-1]
    valve_ml_s = largest.flow_max_l_min * ML_S_PER_L_MIN / len(largest.valves)
    law = ClickLaw(
        valve_ml_s=(valve_ml_s,) * count, step_ml=step_ml, idle_ml=idle_ml, idle_s=IDLE_S * count
    )
    flows = [
        ClickFlow(
            valve=valve,
            open_s=TIMES * open_s,
            window_s=end_s - begin_s,
            metered_ml=float(counts[valve, 2] - counts[valve, 1]),
        )
        for valve, (_, begin_s, end_s) in enumerate(windows)
    ]
    return judge_clicks(law, flows)


def figures(seeds: Sequence[int], *, open_s: float, step_ml: float) -> dict[str, object]:
    """Return how often each fault is named as that valve's, and how often a healthy valve is."""
    found: dict[str, object] = {}
    wrong = valves = 0
    for clog in (0.0, *CLOGS):
        named = 0
        for seed in seeds:
            said = clicked(seed, open_s=open_s, step_ml=step_ml, clog=clog)
            kinds = [each.kind for each in said.valves]
            named += kinds[FAULTY] is not None
            healthy = [kind for valve, kind in enumerate(kinds) if clog == 0.0 or valve != FAULTY]
            wrong += sum(kind is not None for kind in healthy) + (said.fault is not None)
            valves += len(healthy)
        if clog:
            found[f"clog {clog:.2f}"] = named / len(seeds)
    found["false"] = {"valves": valves, "wrong": wrong}
    for name, stuck, leak in (("shut", False, 0.0), ("open", True, 0.0), ("leak", None, 0.05)):
        names: Counter[str] = Counter()
        for seed in seeds:
            said = clicked(seed, open_s=open_s, step_ml=step_ml, stuck=stuck, leak=leak)
            names[f"{said.valves[FAULTY].kind}, all: {said.fault}"] += 1
        found[name] = dict(names)
    return found


def main(arguments: Sequence[str]) -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("--sprayers", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--open-s", type=float, default=1.0)
    parser.add_argument("--step-ml", type=float, default=METER_STEP_ML)
    given = parser.parse_args(arguments)
    if given.sprayers < 1 or not 0.0 < given.open_s <= 10.0 or not 0.0 < given.step_ml < math.inf:
        parser.error("give at least one sprayer, --open-s up to 10 and a --step-ml above 0")
    seeds = range(given.first_seed, given.first_seed + given.sprayers)
    found = figures(seeds, open_s=given.open_s, step_ml=given.step_ml)
    sys.stdout.write(
        json.dumps({"sprayers": given.sprayers, "open_s": given.open_s, **found}, indent=1) + "\n"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
