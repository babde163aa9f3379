"""The companion sprays the plan's lines over the wire, and a ferry over the map not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

import pytest

from sitl.serve import ServeOptions
from tests.bench.wire import RTK, example
from tests.bench.wire_clock import fly
from tests.sitl.test_wire_flight import HOME, write_field, write_mission

pytestmark = pytest.mark.sitl


def write_line(path: Path, *norths_m: float) -> None:
    """Write one spray line along the pass, between two places north of home."""
    points = [list(HOME.to_geographic(0.0, north_m))[::-1] for north_m in norths_m]
    line = {
        "type": "Feature",
        "properties": {"kind": "spray", "sortie": 1},
        "geometry": {"type": "LineString", "coordinates": points},
    }
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [line]}))


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_only_the_line_is_sprayed_over_the_wire(
    tmp_path: Path, autopilot: Literal["ardupilot", "px4"]
) -> None:
    config = example(tmp_path / "field", autopilot=autopilot, port=14550)
    folder = config.parent
    write_field(folder)
    write_mission(folder / "short.waypoints")
    write_line(folder / "lines.geojson", 28.0, 80.0)
    text = config.read_text().replace('rate_field = "rate"', 'rate_field = "rate"\nunit = "L/ha"')
    config.write_text(text.replace("[mission]", '[mission]\nlines = "lines.geojson"'))
    scenario = tmp_path / "rtk.toml"
    scenario.write_text(RTK)
    result, fault = fly(
        config,
        ServeOptions(
            autopilot=autopilot,
            field_config=config,
            mission=folder / "short.waypoints",
            scenario=scenario,
            seed=5,
            out=folder / "truth",
        ),
    )
    metrics = result["metrics"]
    assert fault is None
    assert metrics["missed"] == 0
    assert metrics["lag_distance_m"]["count"] == 4 * 6  # the boundaries at 32, 44, 56 and 68 m
    # 52 m of plots of 15, 25, 16, 27 and 15 L/ha, less what the flow takes at both ends.
    asked_ml = 0.6 * (4.0 * 15.0 + 12.0 * 25.0 + 12.0 * 16.0 + 12.0 * 27.0 + 12.0 * 15.0)
    assert metrics["applied_ml"] == pytest.approx(asked_ml, rel=0.06)
    assert metrics["off_target_ml"] < 1.0
