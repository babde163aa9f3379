"""Beside a real ArduCopter: where the changes fall, judged from its simulator's own truth."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.firmware.fields import (
    HOME,
    LOW_RATES_L_HA,
    RATES_L_HA,
    copy_example,
    pass_items,
    write_pass,
)
from tests.firmware.firmware import companion, vrspray
from tests.firmware.flights import ready_copter, start, until_heard, until_landed
from tests.firmware.judge import (
    Verdict,
    geojson_area,
    geojson_lines,
    geojson_zones,
    judge,
    shapefile_zones,
)

pytestmark = [pytest.mark.firmware, pytest.mark.timeout(300)]

MEAN_MAX_M, WORST_MAX_M, OFF_TARGET_MAX_ML = 0.05, 0.25, 0.1
# At the ends of four lines, on sprayable ground, all six valves at 50 mL/s: the order is early by
# the lag, so that what is left is the half of the fall (0.070 s) behind its middle, the wait for a
# servo frame, and 0.05 m of place at 5 m/s.
OFF_LINES_MAX_ML = 4 * 50.0 * (0.070 / 8.0 + 0.020 + 0.010)
COMPANION_LINK = "udpin:127.0.0.1:14550"


def done(*command: str) -> dict[str, Any]:
    """Run a command of the program to its end and return its one object."""
    found = vrspray(*command, "--json")
    assert found.returncode == 0, found.stderr
    values: dict[str, Any] = json.loads(found.stdout)
    return values


def fly_pass(
    firmwares: Path, folder: Path, speed_m_s: float, rates_l_ha: Sequence[float]
) -> Verdict:
    """Fly one pass over eight zones and judge it."""
    config = write_pass(folder / "field", rates_l_ha)
    with ready_copter(folder / "copter", firmwares, HOME) as vehicle:
        with companion(folder, "--config", str(config)) as started:
            until_heard(vehicle.station, started, folder / "companion.txt")
            vehicle.station.log.clear_flight()
            start(vehicle, pass_items(speed_m_s))
            until_landed(vehicle, 150.0)
        log = vehicle.station.log
    return judge(
        log.places,
        log.pulses,
        geojson_zones(config.parent / "zones.geojson"),
        inside=geojson_area(config.parent / "boundary.geojson"),
    )


def holds(verdict: Verdict) -> None:
    """Hold a flight to what is asked of ArduCopter."""
    assert not verdict.missed
    assert verdict.mean_abs_m <= MEAN_MAX_M
    assert verdict.worst_m <= WORST_MAX_M
    assert verdict.off_target_ml <= OFF_TARGET_MAX_ML
    assert verdict.sprayed_l == pytest.approx(verdict.prescribed_l, rel=0.05)


@pytest.mark.short
def test_each_change_of_a_pass_at_5_m_s_falls_on_its_boundary(
    firmwares: Path, tmp_path: Path, tell: Callable[[object], None]
) -> None:
    verdict = fly_pass(firmwares, tmp_path, 5.0, RATES_L_HA)
    tell(verdict)
    assert len(verdict.changes) == 7 * 6
    holds(verdict)


def test_small_steps_of_low_flows_at_3_m_s_fall_on_their_boundaries(
    firmwares: Path, tmp_path: Path, tell: Callable[[object], None]
) -> None:
    verdict = fly_pass(firmwares, tmp_path, 3.0, LOW_RATES_L_HA)
    tell(verdict)
    assert len(verdict.changes) == 7 * 6
    holds(verdict)


def test_the_planned_and_uploaded_field_is_sprayed_on_its_lines(
    firmwares: Path, tmp_path: Path, tell: Callable[[object], None]
) -> None:
    # README's commands, the vehicle being ArduCopter.
    field = copy_example(tmp_path / "field")
    config, plan, lines = field / "config.toml", field / "field.plan", field / "field.lines.geojson"
    depot = (35.9972, 114.5439)
    planned = done(
        *("plan", f"{field}/prescription.shp", "--prescription", f"{field}/prescription.shp"),
        *("--config", f"{config}", "--depot", "{},{}".format(*depot), "--out", f"{plan}"),
    )
    home = "{},{},60,192".format(*depot)
    with ready_copter(tmp_path / "copter", firmwares, home) as vehicle:
        uploaded = done("upload", f"{plan}", "--link", COMPANION_LINK)
        assert (uploaded["ok"], uploaded["firmware"]) == (True, "ardupilot")
        options = ("--config", f"{config}", "--set", f"mission.lines={lines}")
        with companion(tmp_path, *options) as started:
            until_heard(vehicle.station, started, tmp_path / "companion.txt")
            vehicle.station.log.clear_flight()
            start(vehicle, None)
            until_landed(vehicle, 200.0)
        log = vehicle.station.log
    (tmp_path / "log.pkl").write_bytes(pickle.dumps((log.places, log.pulses, log.told)))
    verdict = judge(
        log.places,
        log.pulses,
        shapefile_zones(field / "prescription.shp"),
        inside=geojson_area(field / "boundary.geojson"),
        lines=geojson_lines(lines),
    )
    tell(verdict)
    assert len(verdict.changes) + len(verdict.apart) == 4 * 9 * 6
    holds(verdict)
    assert verdict.off_lines_ml <= OFF_LINES_MAX_ML
    assert verdict.sprayed_l == pytest.approx(planned["volume_l"], rel=0.05)
