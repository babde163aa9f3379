"""The companion sprays the plan's lines over the wire, and a ferry over them not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import pytest

from sitl.serve import ServeOptions
from tests.bench.wire import RTK, example
from tests.bench.wire_clock import fly
from tests.companion.realtime.test_wire_flight import HOME, write_field, write_mission
from tests.virtual_time import WireLink

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


def write_ferry(path: Path) -> None:
    """Write a mission that flies over the line, nearly along it, and then sprays it."""
    places = [(-1.5, 24.0), (1.5, 84.0), (0.0, 87.0), (0.0, 24.0), (0.0, 20.0)]
    degrees = ["{:.7f} {:.7f}".format(*HOME.to_geographic(*place)) for place in places]
    path.write_text(
        "QGC WPL 110\n"
        "0 1 0 16 0 0 0 0 36.0 114.5 60 1\n"
        "1 0 3 22 0 0 0 0 36.0 114.5 3.5 1\n"
        "2 0 2 178 1 5 0 0 0 0 0 1\n"
        + "".join(f"{3 + n} 0 3 16 0 0 0 0 {place} 3.5 1\n" for n, place in enumerate(degrees))
    )


def flown(folder: Path, autopilot: Literal["ardupilot", "px4"], mission: str) -> dict[str, Any]:
    """Fly a mission over the line from 28 to 80 m north; return the metrics of what fell."""
    config = example(folder / "field", autopilot=autopilot, port=14550)
    folder = config.parent
    write_field(folder)
    write_mission(folder / "short.waypoints")
    write_ferry(folder / "ferry.waypoints")
    write_line(folder / "lines.geojson", 28.0, 80.0)
    text = config.read_text().replace('rate_field = "rate"', 'rate_field = "rate"\nunit = "L/ha"')
    config.write_text(text.replace("[mission]", '[mission]\nlines = "lines.geojson"'))
    scenario = folder / "rtk.toml"
    scenario.write_text(RTK)
    result, fault = fly(
        config,
        ServeOptions(
            autopilot=autopilot,
            field_config=config,
            mission=folder / mission,
            scenario=scenario,
            seed=5,
            out=folder / "truth",
        ),
    )
    assert fault is None
    metrics: dict[str, Any] = result["metrics"]
    return metrics


# 52 m of plots of 15, 25, 16, 27 and 15 L/ha, less what the flow takes at both ends.
ASKED_ML = 0.6 * (4.0 * 15.0 + 12.0 * 25.0 + 12.0 * 16.0 + 12.0 * 27.0 + 12.0 * 15.0)


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_only_the_line_is_sprayed_over_the_wire(
    tmp_path: Path, autopilot: Literal["ardupilot", "px4"]
) -> None:
    metrics = flown(tmp_path, autopilot, "short.waypoints")
    assert metrics["missed"] == 0
    assert metrics["lag_distance_m"]["count"] == 4 * 6  # the boundaries at 32, 44, 56 and 68 m
    assert metrics["applied_ml"] == pytest.approx(ASKED_ML, rel=0.06)
    assert metrics["off_target_ml"] < 1.0


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_a_ferry_nearly_along_the_line_is_not_sprayed_over_the_wire(
    tmp_path: Path, autopilot: Literal["ardupilot", "px4"], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Armed soon after the companion is heard: PX4 has said nothing of its mission by then, if its
    # ten seconds will have it so.
    arrive = WireLink.arrive

    def heard(link: WireLink, data: bytes) -> None:
        is_told = data[0] == 0xFD and data[7:10] == b"\x2a\0\0"  # MISSION_CURRENT
        if link.component._command_state.is_armed or not is_told:
            arrive(link, data)

    monkeypatch.setattr(WireLink, "arrive", heard)
    metrics = flown(tmp_path, autopilot, "ferry.waypoints")
    assert metrics["missed"] == 0
    assert metrics["applied_ml"] == pytest.approx(ASKED_ML, rel=0.06)
    assert metrics["off_target_ml"] < 1.0
