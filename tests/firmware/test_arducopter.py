"""Beside a real ArduCopter: where the changes fall, judged from its simulator's own truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from tests.firmware.fields import LOW_RATES_L_HA, RATES_L_HA, pass_items, write_pass
from tests.firmware.firmware import companion
from tests.firmware.flights import (
    COPTER,
    OFF_LINES_MAX_ML,
    check_simulated,
    fly_field,
    ready,
    start,
    until_heard,
    until_landed,
)
from tests.firmware.judge import Verdict, geojson_area, geojson_zones, judge

pytestmark = [pytest.mark.firmware, pytest.mark.timeout(300)]

MEAN_MAX_M, WORST_MAX_M, OFF_TARGET_MAX_ML = 0.05, 0.25, 0.1


def fly_pass(
    firmwares: Path, folder: Path, speed_m_s: float, rates_l_ha: Sequence[float]
) -> Verdict:
    """Fly one pass over eight zones and judge it."""
    config = write_pass(folder / "field", rates_l_ha)
    with ready(COPTER, folder / "copter", firmwares) as vehicle:
        with companion(folder, "--config", str(config)) as started:
            until_heard(vehicle.station, started, folder / "companion.txt")
            vehicle.station.log.clear_flight()
            start(vehicle, pass_items(speed_m_s))
            until_landed(vehicle, 150.0)
        log = vehicle.station.log
    check_simulated(config.parent)
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
    flown = fly_field(COPTER, firmwares, tmp_path)
    log = flown.log
    verdict = judge(log.places, log.pulses, flown.zones, inside=flown.inside, lines=flown.lines)
    tell(verdict)
    assert len(verdict.changes) + len(verdict.apart) == 4 * 9 * 6
    holds(verdict)
    assert verdict.off_lines_ml <= OFF_LINES_MAX_ML
    assert verdict.sprayed_l == pytest.approx(flown.planned_l, rel=0.05)
