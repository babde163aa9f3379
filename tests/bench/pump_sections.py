"""What a pump with sections, and one with atomisers, put on the ground of their example's field.

    python -m tests.bench.pump_sections [SEED...]

Four passes over zones of 60 m, steps of 30 %, 5 m/s, ends of the field slanted by 45 degrees. With
steps driven past their target and without, in gusts of 1 m/s and in still air, and with the boom
as one section, shut by one valve, for what sections save at the border.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

from analysis.evaluation import Evaluation, evaluate
from analysis.flight_record import FlightRecord
from companion.config import load
from companion.core.nozzle import flow_for_rate
from companion.core.setup import Setup
from missions.maps.compiling import compiled_setup
from sitl.flight import FlightOptions, fly
from sitl.motor_parts import droplet_figures, ranges_us
from sitl.profile import PlantProfile, load_profile
from sitl.routes import read_route
from sitl.vehicle import Vehicle

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
MISSION = EXAMPLES / "pump-sections" / "mission.waypoints"
SPEED_M_S = 5.0
SEEDS = (11, 12, 13)


def one_section(text: str) -> str:
    """Return the example with its boom as one section, where the border's volume is kept."""
    head, rest = text.split("[[valve]]", 1)
    tail = rest[rest.index("# Curve by") :]
    valve = (
        '[[valve]]\nname = "1"\nright_m = 0.0\nchannel = 9\n\n[[nozzle_set]]\nvalves = ["1"]\n\n'
    )
    return (head + valve + tail).replace('border = "inside"', 'border = "volume"')


def not_driven(text: str) -> str:
    """Return the example without the pump's time constants."""
    lines = [line for line in text.splitlines() if "_time_s" not in line]
    return "\n".join(lines) + "\n"


def example_setup(example: str, change: Any = None) -> tuple[Setup, FlightOptions]:
    """Return what an example's controller knows, its text changed."""
    path = EXAMPLES / example / "config.toml"
    text = path.read_text(encoding="utf-8")
    if change is not None:
        text = change(text)
    folder = (EXAMPLES / "pump-sections").as_posix()
    for name in ("prescription.geojson", "boundary.geojson"):
        text = text.replace(f'"{name}"', f'"{folder}/{name}"')
        text = text.replace(f'"../pump-sections/{name}"', f'"{folder}/{name}"')
    with tempfile.TemporaryDirectory() as scratch:
        changed = Path(scratch) / "config.toml"
        changed.write_text(text, encoding="utf-8")
        config = load(changed)
        options = FlightOptions(
            fidelity="averaged", output="servo", drive_ranges_us=ranges_us(config)
        )
        return compiled_setup(config), options


def joined(profile: PlantProfile) -> PlantProfile:
    """Return the sprayer with its boom as one section."""
    one = replace(profile.nozzle_sets[0], valves=(0,))
    return replace(profile, valve_count=1, nozzle_sets=(one,))


def flown(
    setup: Setup, options: FlightOptions, profile: PlantProfile, seed: int, gust_m_s: float
) -> dict[str, Any]:
    """Return the figures of one flight."""
    route = read_route(MISSION, setup.frame, speed_m_s=SPEED_M_S, default_speed_m_s=SPEED_M_S)
    path = Vehicle(route, start_s=0.0, seed=seed, gust_m_s=gust_m_s).fly_to_end()
    result = fly(setup, path, profile, replace(options, seed=seed), speed_m_s=SPEED_M_S)
    found = evaluate(result.record)
    return figures(found, result.record) | {
        "droplets": droplet_figures(setup, result.drives),
        "late": result.late,
    }


def figures(found: Evaluation, record: FlightRecord) -> dict[str, Any]:
    """Return what the page tells of a flight."""
    lag, border = found.lag_distance_m, found.border_margin_m
    return {
        "lag_mean_abs_m": lag.mean_abs,
        "lag_max_abs_m": lag.max_abs,
        "changes": lag.count,
        "missed": found.missed,
        "spraying_accuracy_percent": found.spraying_accuracy_percent,
        "misapplied_percent": found.misapplied_percent,
        "volume_error_percent": found.volume_error_percent,
        "worst_section_percent": max(map(abs, found.section_volume_error_percent.values())),
        "border_margin_m": [border.min, border.mean, border.max],
        "off_target_ml": found.off_target_ml,
        "flow_l_min": flow_for_rate(20.0, SPEED_M_S, record.boom.width_m),
    }


CASES: tuple[tuple[str, str, Any, float], ...] = (
    ("sections, driven", "pump-sections", None, 1.0),
    ("sections, driven, still air", "pump-sections", None, 0.0),
    ("sections, not driven", "pump-sections", not_driven, 1.0),
    ("sections, not driven, still air", "pump-sections", not_driven, 0.0),
    ("one section, driven", "pump-sections", one_section, 1.0),
    ("atomisers, driven", "atomiser", None, 1.0),
    ("atomisers, driven, still air", "atomiser", None, 0.0),
)


def main(arguments: Sequence[str]) -> int:
    """Fly all cases and print the figures as JSON, each as soon as it is known."""
    seeds = [int(text) for text in arguments] or list(SEEDS)
    for name, example, change, gust_m_s in CASES:
        setup, options = example_setup(example, change)
        profile = load_profile(example)
        if change is one_section:
            profile = joined(profile)
        flights = [flown(setup, options, profile, seed, gust_m_s) for seed in seeds]
        means = [each["lag_mean_abs_m"] for each in flights if each["lag_mean_abs_m"] is not None]
        whole = {"case": name, "seeds": seeds, "lag_mean_abs_m": fmean(means) if means else None}
        sys.stdout.write(json.dumps(whole | {"flights": flights}) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
