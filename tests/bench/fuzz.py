"""Random and corrupted frames through the whole companion: `python -m tests.bench.fuzz`.

`python -m tests.bench.fuzz [frames] [seed]`. Spells of a healthy vehicle and spells in which its
frames are mixed with few or with many random ones alternate, so that there is something to close
and a way back.
No exception; no valve open under an inhibit, judged by a follower of the plans and by an oracle
of its own; the memory after it is the memory in the middle of it.
"""

from __future__ import annotations

import gc
import json
import sys
import time
import tracemalloc
from typing import Any

import numpy as np

from tests.bench.bad_frames import random_frame
from tests.bench.gate_frames import STEP_S, Loop, Vehicle, long_setup

BEGIN_S = 100.0
# One round: a healthy vehicle, then now and then a bad frame (so that each reason is met alone),
# then a flood of them. Bad frames for each healthy one, on average, and for how many steps.
ROUND = ((30, 0.0), (100, 0.1), (60, 8.0))
ENABLE_STEPS = 10


def rate_at(number: int) -> float:
    """Return how many bad frames there are for each healthy one at a step."""
    place = number % sum(steps for steps, _ in ROUND)
    for steps, rate in ROUND:
        if place < steps:
            return rate
        place -= steps
    raise AssertionError(place)


def fuzz(frames: int, seed: int, *, watch_memory: bool = True) -> dict[str, Any]:
    """Return what came of at least `frames` random frames among healthy ones."""
    rng = np.random.default_rng(seed)
    setup = long_setup(length_m=20_000.0)
    loop, vehicle = Loop(setup), Vehicle(setup, begin_s=BEGIN_S)
    number = wild = healthy = 0
    middle = None
    began_s = time.perf_counter()
    if watch_memory:
        tracemalloc.start()
    while wild < frames:
        now_s = BEGIN_S + number * STEP_S
        rate = rate_at(number)
        data = vehicle.enable() if number % ENABLE_STEPS == 5 else b""
        for frame in vehicle.said(number, now_s):
            count = int(rng.poisson(rate))
            keeps = rate < 1.0 or rng.random() < 0.7
            data += b"".join(
                [random_frame(rng, frame, system_id=1) for _ in range(count)]
                + ([frame] if keeps else [])
            )
            wild += count
            healthy += keeps
        loop.turn(data, now_s)
        number += 1
        if watch_memory and middle is None and wild >= frames // 2:
            gc.collect()
            middle = tracemalloc.get_traced_memory()[0]
    found: dict[str, Any] = {
        "random_frames": wild,
        "healthy_frames": healthy,
        "seed": seed,
        "steps": loop.step_count,
        "open_steps": loop.open_count,
        "wrong": loop.wrong,
        "wall_s": round(time.perf_counter() - began_s, 1),
    }
    if watch_memory and middle is not None:
        gc.collect()
        found["memory_kib"] = round(tracemalloc.get_traced_memory()[0] / 1024, 1)
        found["memory_growth_kib"] = round((tracemalloc.get_traced_memory()[0] - middle) / 1024, 1)
        tracemalloc.stop()
    return found


def main() -> int:
    """Print what was found; fail for a valve that was open, or for memory that grew."""
    frames = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
    seed = int(sys.argv[2]) if len(sys.argv) > 2 else 1
    found = fuzz(frames, seed)
    sys.stdout.write(json.dumps(found, indent=2) + "\n")
    return int(bool(found["wrong"]) or found["open_steps"] == 0 or found["memory_growth_kib"] > 256)


if __name__ == "__main__":
    sys.exit(main())
