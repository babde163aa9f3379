"""What plans predict of treated, bare and twice treated ground, beside what the twin leaves.

    python -m tests.bench.plan_treated [--fields 20] [--first 1] [--autopilot px4] [--overrun]

Each field has another shape, size (0.1 to 2 ha), rate, speed and tank. All its sorties are flown on
the plan's lines, and the judge (`tests/ground_judge.py`) counts from the truth of all of them.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import random
import sys
import tempfile
from pathlib import Path
from typing import Any

import shapely
from shapely.affinity import rotate

from companion.cli.app import execute
from tests.bench.missions import to_degrees
from tests.ground_judge import Field, Truth, judge
from tests.mission_fields import blob

EXAMPLE = Path(__file__).parents[2] / "examples" / "anyang" / "config.toml"


def written(folder: Path, seed: int, *, autopilot: str, overrun: bool) -> list[str]:
    """Write one field and its configuration; return the options of its plan."""
    draw = random.Random(seed)
    area_ha = 0.1 * 20.0 ** draw.random()
    if seed % 2:
        long_m = (area_ha * 1e4 * draw.uniform(1.2, 4.0)) ** 0.5
        shape = rotate(shapely.box(0, 0, long_m, area_ha * 1e4 / long_m), draw.uniform(0, 180))
    else:
        shape = blob(area_ha, seed=seed)
    west, south, east, north = shape.bounds
    middle = draw.uniform(0.3, 0.7) * (east - west) + west
    parts = [(draw.uniform(14.0, 18.0), west - 1, middle), (draw.uniform(18.0, 26.0), middle, east)]
    features = [
        {"type": "Feature", "properties": {"rate": round(rate, 1)},
         "geometry": json.loads(shapely.to_geojson(to_degrees(
             shapely.intersection(shape, shapely.box(a, south - 1, b + 1e-9, north + 1)))))}
        for rate, a, b in parts
    ]  # fmt: skip
    write(folder, features, autopilot=autopilot, overrun=overrun)
    return [
        "--speed-m-s",
        f"{draw.uniform(3.5, 5.0):.1f}",
        "--tank-l",
        f"{draw.uniform(6, 20):.0f}",
    ]


def write(
    folder: Path, features: list[Any], *, autopilot: str = "ardupilot", overrun: bool = False
) -> None:
    """Write a field and its configuration: the example's sprayer."""
    (folder / "field.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "features": features})
    )
    head, _, tail = EXAMPLE.read_text().partition("[prescription]")
    _, _, tail = tail.partition("\n[")
    text = f'{head}[prescription]\nfile = "field.geojson"\nunit = "L/ha"\n\n[{tail}'
    text = "\n".join(line for line in text.splitlines() if not line.startswith("angle_deg"))
    more = f'[mission]\nautopilot = "{autopilot}"'
    if overrun:
        more += '\noverrun = "allowed"\nrun_in_m = "auto"'
    (folder / "config.toml").write_text(text.replace("[mission]", more))


def run(*words: object) -> dict[str, Any]:
    """Return the answer of a command."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()):
        status = execute([*map(str, words), "--json"])
    assert status == 0, words
    found: dict[str, Any] = json.loads(out.getvalue())
    return found


def compared(folder: Path, seed: int, *, autopilot: str, overrun: bool) -> dict[str, float]:
    """Return what is predicted and flown of one field, in percent of it."""
    options = written(folder, seed, autopilot=autopilot, overrun=overrun)
    return {"seed": seed} | of_field(folder, *options)


def of_field(folder: Path, *options: str) -> dict[str, float]:
    """Plan and fly all sorties of the field in a folder."""
    config, map_file, plan = folder / "config.toml", folder / "field.geojson", folder / "m.plan"
    said = run("plan", map_file, "--prescription", map_file, "--config", config, "--out", plan,
               "--force", *options)  # fmt: skip
    config.write_text(
        config.read_text().replace("[mission]", '[mission]\nlines = "m.lines.geojson"')
    )
    truths = []
    for number, mission in enumerate(said["files"]):
        out = folder / f"flown-{number}"
        run("sitl", "fly", "--config", config, "--mission", mission, "--out", out)
        truths.append(Truth.read(out / "truth.npz"))
    ground = Field.read(map_file, truths[0].origin_deg, lines_file=folder / "m.lines.geojson")
    true = judge(truths, ground)
    percent = 100.0 / true.field_m2
    return {
        "ha": true.field_m2 / 1e4,
        "sorties": len(truths),
        "bare_percent": said["bare_m2"] * percent,
        "flown_bare_percent": true.bare_m2 * percent,
        "twice_percent": said["twice_m2"] * percent,
        "flown_twice_percent": true.twice_m2 * percent,
        "litres": said["treated_l"],
        "flown_litres": true.applied_l,
        "planned_litres": said["volume_l"],
        "outside_ml": true.outside_ml,
    }


def main() -> int:
    """Print the figures; 0 even where a target is missed: the figures are the result."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.plan_treated", description=__doc__)
    parser.add_argument("--fields", type=int, default=20)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--autopilot", default="ardupilot")
    parser.add_argument("--overrun", action="store_true")
    given = parser.parse_args()
    rows = []
    for seed in range(given.first, given.first + given.fields):
        with tempfile.TemporaryDirectory() as scratch:
            rows.append(
                compared(Path(scratch), seed, autopilot=given.autopilot, overrun=given.overrun)
            )
        sys.stderr.write(" ".join(f"{name} {value:.4g}" for name, value in rows[-1].items()) + "\n")
    off = {
        what: [row[f"{what}_percent"] - row[f"flown_{what}_percent"] for row in rows]
        for what in ("bare", "twice")
    }
    sys.stdout.write(json.dumps({
        "fields": rows,
        **{f"{what}_worst": max(map(abs, each)) for what, each in off.items()},
        **{f"{what}_within_1": sum(abs(one) <= 1.0 for one in each) for what, each in off.items()},
    }, indent=1) + "\n")  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main())
