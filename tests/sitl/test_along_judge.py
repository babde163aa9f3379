"""Two judges of flights along logs: the program's, and one that shares nothing with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sitl.along import AlongOptions, figures_of, fly_method, prepare
from tests import flown_logs
from tests.along_judge import Flown, judge


@pytest.mark.parametrize("method", ["vrspray", "perfect", "none"])
def test_both_judges_find_the_same(method: str, tmp_path: Path) -> None:
    log = flown_logs.telemetry(tmp_path / "a.tlog")
    bed = prepare(AlongOptions(log=log, position_rate_hz=10.0))
    result = fly_method(bed, method, 1)
    ours, record = figures_of(bed, result), result.record
    curve, count = bed.setup.nozzle_sets[-1].curve, len(bed.setup.boom.valves)
    other = judge(
        Flown(
            time_s=record.time_s,
            east_m=record.east_m,
            north_m=record.north_m,
            heading_deg=record.heading_deg,
            volume_ml=record.volume_ml,
            strips=tuple((v.right_m, v.forward_m, v.width_m) for v in bed.setup.boom.valves),
            zones=tuple((z.polygon, z.rate_l_ha) for z in bed.setup.prescription.zones),
            period_s=bed.setup.pwm.period_s,
            least_l_min=curve.flow_l_min[0] / count,
            full_l_min=curve.flow_l_min[-1] / count,
            slow_m_s=bed.setup.limits.speed_min_m_s,
        )
    )
    assert other.misapplied_percent == pytest.approx(ours["misapplied_percent"], abs=0.15)
    assert other.turn_percent == pytest.approx(ours["turn_misapplied_percent"], abs=0.7)
    assert other.cannot_percent == pytest.approx(ours["cannot_percent"], abs=0.3)
    lags_m = ours["steps"][np.isfinite(ours["steps"][:, 0]), 0]
    assert len(other.lags_m) == pytest.approx(len(lags_m), abs=2)
    assert len(lags_m) > 20
    for measure in (np.median, np.mean):
        assert measure(np.abs(other.lags_m)) == pytest.approx(measure(np.abs(lags_m)), abs=0.02)
