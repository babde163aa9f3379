"""Valves that differ: each is dosed by its own flow and timed by its own lags."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.cli.doctor import configuration_checks
from companion.config import load
from companion.core.boom import Boom
from companion.core.controller import Memory, step
from companion.core.nozzle import NozzleSet
from companion.core.setup import Setup
from companion.doctor.check import Status
from companion.errors import ConfigError
from companion.journal.codec import calibration_sha256, setup_from_json, setup_to_json
from companion.journal.geopackage import Ground
from tests import builders

FACTORS = (0.97, 1.01, 1.03, 0.99, 1.02, 0.98)
LAGS_S = (0.004, -0.006, 0.0, 0.005, -0.003, 0.002)
NOW_S = 10.0
SPEED_M_S = 5.0
ANYANG = Path(__file__).parents[2] / "examples" / "anyang"


def different(factors: tuple[float, ...] = FACTORS, **lags: tuple[float, ...]) -> Setup:
    """Return the set-up of the builders with valves that differ."""
    same = builders.boom()
    valves = tuple(
        replace(
            valve, flow_factor=factors[number], **{key: each[number] for key, each in lags.items()}
        )
        for number, valve in enumerate(same.valves)
    )
    nozzles = NozzleSet.with_factors(tuple(range(6)), builders.CURVE, factors)
    return builders.setup(boom=Boom(width_m=same.width_m, valves=valves), nozzle_sets=(nozzles,))


def ordered(setup: Setup, east_m: float) -> tuple[tuple[float, ...], dict[int, float]]:
    """Return the duties within a plot, and the time of each valve's next change."""
    state = builders.flying(NOW_S, east_m)
    decision, _ = step(setup, state, Memory(), NOW_S)
    in_force = {
        change.valve: change.duty for change in decision.plan.changes if change.at_s <= NOW_S
    }
    duties = tuple(in_force.get(v, duty) for v, duty in enumerate(decision.plan.duty))
    later = {change.valve: change.at_s for change in decision.plan.changes if change.at_s > NOW_S}
    return duties, later


def flow_l_min(duty: float) -> float:
    """Return the set's flow by the measured points, by another library's interpolation."""
    return float(np.interp(duty, builders.CURVE.duty, builders.CURVE.flow_l_min))


def test_each_valve_delivers_the_same_though_they_differ() -> None:
    duties, _ = ordered(different(), 6.0)
    delivered = [
        flow_l_min(duty) / 6 * factor for duty, factor in zip(duties, FACTORS, strict=True)
    ]
    # 20 L/ha at 5 m/s on 1 m: 0.6 L/min.
    assert delivered == pytest.approx([0.6] * 6, rel=1e-6)
    assert len(set(duties)) == 6


@given(st.lists(st.floats(0.8, 1.2), min_size=6, max_size=6))
def test_ratios_alone_count(factors: list[float]) -> None:
    once = NozzleSet.with_factors(tuple(range(6)), builders.CURVE, factors)
    twice = NozzleSet.with_factors(tuple(range(6)), builders.CURVE, [1.7 * f for f in factors])
    shares = [once.share(valve) for valve in range(6)]
    assert shares == pytest.approx([twice.share(valve) for valve in range(6)], rel=1e-12)
    assert sum(shares) == pytest.approx(6.0)


def test_a_smaller_set_has_its_own_mean() -> None:
    small = NozzleSet.with_factors((0, 1), builders.CURVE, (0.9, 1.2, 7.0))
    assert (small.share(0) + small.share(1)) / 2 == pytest.approx(1.0)
    assert small.share(1) / small.share(0) == pytest.approx(1.2 / 0.9)


def test_each_valve_is_ordered_by_its_own_lag() -> None:
    # Before the plot of 25 L/ha at 12 m: all go up.
    same = ordered(builders.setup(), 11.0)[1]
    own = ordered(different((1.0,) * 6, lag_up_s=LAGS_S), 11.0)[1]
    assert [own[v] - same[v] for v in range(6)] == pytest.approx([-lag for lag in LAGS_S], abs=1e-9)


def test_only_the_lag_of_its_kind_counts() -> None:
    own = ordered(different((1.0,) * 6, lag_down_s=LAGS_S, lag_off_s=LAGS_S), 11.0)[1]
    assert own == pytest.approx(ordered(builders.setup(), 11.0)[1], abs=1e-9)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("lag_on_s = -0.09\n", "is before the order"),
        ("lag_up_s = 0.3\n", r"lag_up_s"),
        ('measured_on = "May"\n', "measured_on"),
        ('measured_with = "milk"\n', "measured_with"),
    ],
)
def test_figures_that_cannot_be_are_refused(tmp_path: Path, line: str, words: str) -> None:
    path = configuration(tmp_path, (1.0,) * 6, line)
    text = path.read_text(encoding="utf-8")
    path.write_text(re.sub(r"(?m)^on_s = .*$", "on_s = 0.05", text), encoding="utf-8")
    with pytest.raises(ConfigError, match=words):
        load(path)


@pytest.mark.parametrize(
    ("factors", "more", "status", "words"),
    [
        ((1.0,) * 6, "", Status.NOT_APPLICABLE, "no valve has figures"),
        (FACTORS, "", Status.WARN, "age is unknown"),
        (FACTORS, 'measured_on = "2026-05-02"\nmeasured_with = "water"\n', Status.OK,
         "30 days ago with water"),
        (FACTORS, 'measured_on = "2025-05-02"\n', Status.WARN, "with a liquid that is not said"),
        ((0.85, 1.03, 1.03, 1.03, 1.03, 1.03), "", Status.WARN, "valve 1 has flow_factor 0.85"),
    ],
)  # fmt: skip
def test_doctor_names_the_age_and_the_liquid(
    tmp_path: Path, factors: tuple[float, ...], more: str, status: Status, words: str
) -> None:
    config = load(configuration(tmp_path, factors, more))
    found = {each.name: each for each in configuration_checks(config, today=date(2026, 6, 1))}
    check = found["valve-calibration"]
    assert (check.status, words in check.text) == (status, True)


def test_at_the_border_a_late_valve_closes_sooner_and_an_early_one_no_later() -> None:
    # The field ends at 48 m, all at right angles to the course.
    same = ordered(builders.setup(), 46.3)[1]
    own = ordered(different((1.0,) * 6, lag_off_s=LAGS_S), 46.3)[1]
    assert [own[v] - same[v] for v in range(6)] == pytest.approx(
        [-max(lag, 0.0) for lag in LAGS_S], abs=1e-9
    )


def test_the_path_reaches_as_far_as_the_latest_valve_needs() -> None:
    late = different((1.0,) * 6, lag_off_s=(0.0, 0.0, 0.0, 0.0, 0.0, 0.08))
    assert late.ahead_s >= builders.setup().ahead_s + 0.08


def test_the_flow_that_is_told_counts_each_valve_as_it_is() -> None:
    setup = different()
    decision, memory = step(setup, builders.flying(NOW_S, 6.0), Memory(), NOW_S)
    decision, _ = step(setup, builders.flying(NOW_S + 0.05, 6.25), memory, NOW_S + 0.05)
    assert decision.flow_l_min == pytest.approx(3.6, rel=1e-6)


def configuration(folder: Path, factors: tuple[float, ...], more: str = "") -> Path:
    """Return the example's configuration with factors of its valves."""
    text = (ANYANG / "config.toml").read_text(encoding="utf-8")
    parts = text.split("[[valve]]\n")
    assert len(parts) == 7
    written = parts[0] + "".join(
        f"[[valve]]\nflow_factor = {factor}\n{more}{part}"
        for factor, part in zip(factors, parts[1:], strict=True)
    )
    path = folder / "config.toml"
    path.write_text(written, encoding="utf-8")
    return path


def test_the_configuration_hands_them_to_the_core(tmp_path: Path) -> None:
    config = load(configuration(tmp_path, FACTORS, "lag_off_s = 0.003\n"))
    assert [config.nozzle_sets()[-1].share(valve) for valve in range(6)] == pytest.approx(FACTORS)
    assert [valve.lag_off_s for valve in config.boom().valves] == [0.003] * 6


def test_factors_that_are_no_ratios_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"flow_factor.*mean 1\.1 and not 1; divide each by it"):
        load(configuration(tmp_path, (1.1,) * 6))


def test_at_the_border_a_late_valve_opens_as_late_as_the_others_and_an_early_one_later() -> None:
    # Into the field at 0 m.
    same = ordered(builders.setup(), -1.2)[1]
    own = ordered(different((1.0,) * 6, lag_on_s=LAGS_S), -1.2)[1]
    assert [own[v] - same[v] for v in range(6)] == pytest.approx(
        [-min(lag, 0.0) for lag in LAGS_S], abs=1e-9
    )


def test_a_journal_keeps_them_to_the_bit() -> None:
    written = different(lag_up_s=LAGS_S, lag_off_s=LAGS_S)
    ground = Ground(
        zones=tuple(
            (zone.name, zone.rate_l_ha, zone.polygon) for zone in written.prescription.zones
        ),
        field=written.prescription.field,
        cells=None,
    )
    text = setup_to_json(written)
    older = json.loads(text)
    older["setup"]["valve_tracking"] = {"ValveTracking": [0.1, 3600.0, 0.001, 0.5]}
    assert setup_from_json(json.dumps(older), ground).nozzle_sets == written.nozzle_sets
    read = setup_from_json(text, ground)
    assert read.boom.valves == written.boom.valves
    assert read.nozzle_sets == written.nozzle_sets
    assert read.timings == written.timings


def test_figures_of_a_valve_are_another_calibration() -> None:
    same = calibration_sha256(builders.setup())
    assert calibration_sha256(different()) != same
    assert calibration_sha256(different((1.0,) * 6, lag_on_s=LAGS_S)) != same
    assert calibration_sha256(different((1.0,) * 6)) == same
