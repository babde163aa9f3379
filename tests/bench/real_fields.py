"""Plans for fields as they are drawn and recorded, each judged by `tests.mission_judge` alone.

    python -m tests.bench.real_fields [--only NAME] [--seed 1] [--json]

The eleven outlines of VRSPRAY_SAMPLES, rectangles with 1 to 100 trees, outlines recorded every 1
to 3 m. Seconds are those of the processor.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from time import process_time
from typing import Any

from shapely import box
from shapely.affinity import rotate

from companion.errors import VrsprayError
from missions.demand import Uniform
from missions.field import build_field
from missions.files.write import write_plan
from missions.plan import Settings
from missions.planner import plan_mission
from tests.mission_fields import blob, real_fields, recorded, trees
from tests.mission_judge import Drawn, judge, judge_fence

SPEED_M_S, ACCELERATION_M_S2, RATE_L_HA = 6.0, 2.5, 20.0
FENCE_CORNERS_MAX, FENCE_OUTSIDE_MAX_M = 70, 10.0


def cases(seed: int) -> Iterator[tuple[str, Drawn]]:
    """Yield every case with its name."""
    yield from real_fields()
    for count, area_ha in ((1, 2.0), (15, 10.0), (20, 20.0), (50, 50.0), (100, 150.0)):
        for corners in (8, 64):
            name = f"trees-{count}-{corners}"
            yield name, trees(count, corners=corners, area_ha=area_ha, seed=seed)
    for step_m in (1.0, 2.0, 3.0):
        turned = rotate(box(0.0, 0.0, 134.0, 84.0), 17.0)
        yield f"recorded-box-{step_m:g}", recorded(turned, step_m=step_m, seed=seed)
        shape = blob(1.12 * 5.0 ** (step_m - 1.0), seed=seed)
        yield f"recorded-blob-{step_m:g}", recorded(shape, step_m=step_m, seed=seed)


def planned(drawn: Drawn, **changes: Any) -> dict[str, Any]:
    """Return the figures of a plan, or why there is none."""
    settings = Settings(
        swath_width_m=drawn.width_m, speed_m_s=SPEED_M_S,
        acceleration_m_s2=ACCELERATION_M_S2, **changes,
    )  # fmt: skip
    begun = process_time()
    try:
        field = build_field(
            drawn.outline, obstacles=list(drawn.obstacles), no_spray=list(drawn.no_spray),
            obstacle_buffer_m=drawn.obstacle_buffer_m, swath_width_m=drawn.width_m,
        )  # fmt: skip
        plan = plan_mission(field, settings, Uniform(rate_l_ha=RATE_L_HA))
    except VrsprayError as error:
        return {"refused": str(error), "cpu_s": process_time() - begun}
    took_s = process_time() - begun
    with tempfile.TemporaryDirectory() as folder:
        whole = write_plan(plan, Path(folder) / "m.geojson")
        found = judge(
            drawn, json.loads(whole[0].read_text()),
            speed_m_s=SPEED_M_S, a_m_s2=ACCELERATION_M_S2,
        )  # fmt: skip
        fence: list[str] = []
        try:
            files = write_plan(plan, Path(folder) / "m.plan")
        except VrsprayError as error:
            fence = [str(error)]
        else:
            for file in files:
                if file.suffix != ".plan":
                    continue
                fence += judge_fence(
                    drawn, json.loads(file.read_text()),
                    corners_max=FENCE_CORNERS_MAX, outside_max_m=FENCE_OUTSIDE_MAX_M,
                )  # fmt: skip
    return found | {
        "cpu_s": took_s,
        "minutes": plan.flight_s / 60.0,
        "sorties": len(plan.sorties),
        "fence": sorted(set(fence)),
        "said_percent": plan.coverage.reachable_percent,
    }


def main() -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.real_fields", description=__doc__)
    parser.add_argument("--only", default="", help="cases whose name has this")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    results = {}
    for name, drawn in cases(given.seed):
        if given.only not in name:
            continue
        results[name] = row = planned(drawn)
        say(f"{name:17}" + "".join(f" {key} {_shown(value)}" for key, value in row.items()))
    if given.json:
        sys.stdout.write(json.dumps(results, indent=1) + "\n")
    return 0


def _shown(value: object) -> str:
    return f"{value:.2f}" if isinstance(value, float) else str(value)


def say(text: str) -> None:
    """Tell a figure."""
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main())
