"""The stub's truth judged as any flight: from `truth.npz` to the metrics of the demo."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.evaluation import Evaluation, FlightMeta, FlightRecord, evaluate
from companion.core.types import TimedChange
from sitl.earth import Earth
from sitl.profile import load_profile

if TYPE_CHECKING:
    from companion.core.setup import Setup


def evaluate_truth(folder: Path, setup: Setup, *, closed_us: float, full_us: float) -> Evaluation:
    """Return every metric of a flight of the stub, from what it wrote into `folder`."""
    summary: dict[str, Any] = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    profile = load_profile(summary["profile"])
    with np.load(folder / "truth.npz") as arrays:
        flat = Earth(setup.frame.latitude_deg, setup.frame.longitude_deg)
        east_m, north_m = _in_frame(arrays, summary["origin"], flat)
        record = FlightRecord(
            time_s=arrays["time_s"],
            east_m=east_m,
            north_m=north_m,
            heading_deg=arrays["heading_deg"],
            volume_ml=arrays["volume_ml"],
            boom=setup.boom,
            prescription=setup.prescription,
            lines=setup.lines,
            pwm_period_s=profile.pwm.period_s,
            duty_limits=(profile.pwm.duty_min, profile.pwm.duty_max),
            nozzle_sets=setup.nozzle_sets,
            orders=_orders(arrays, closed_us, full_us),
            meta=FlightMeta(
                speed_m_s=summary["speed_m_s"],
                method=setup.method.value,
                fidelity="pulsed",
                output="servo",
                seed=summary["seed"],
            ),
        )
    return evaluate(record)


def _in_frame(
    arrays: Any, origin: dict[str, float], frame: Earth
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return the path in the frame of the map; the stub's own begins at its home."""
    home = Earth(origin["latitude_deg"], origin["longitude_deg"])
    latitudes, longitudes = home.to_geographic_all(arrays["east_m"], arrays["north_m"])
    return frame.to_local_all(latitudes, longitudes)


def _orders(arrays: Any, closed_us: float, full_us: float) -> tuple[TimedChange, ...]:
    """Return the orders that changed a valve, as duties."""
    times, valves = arrays["order_time_s"].tolist(), arrays["order_valve"].tolist()
    duties = np.clip((arrays["order_pulse_us"] - closed_us) / (full_us - closed_us), 0.0, 1.0)
    changed: list[TimedChange] = []
    last: dict[int, float] = {}
    for at_s, valve, duty in zip(times, valves, duties.tolist(), strict=True):
        if last.get(valve, 0.0) != duty:
            changed.append(TimedChange(at_s=at_s, valve=valve, duty=duty))
            last[valve] = duty
    return tuple(sorted(changed, key=lambda change: change.at_s))


def judge(folder: Path, setup: Setup, *, closed_us: float, full_us: float) -> dict[str, object]:
    """Add the flight's metrics to its `truth.json`, and return them."""
    found = evaluate_truth(folder, setup, closed_us=closed_us, full_us=full_us)
    found = replace(found, zone_volume_error_percent={})
    metrics = found.as_json()
    path = folder / "truth.json"
    summary = json.loads(path.read_text(encoding="utf-8")) | {"metrics": metrics}
    path.write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    return metrics
