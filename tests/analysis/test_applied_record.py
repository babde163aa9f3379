"""From executed changes to volumes: the model of the flow, the meter, the record of a journal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from analysis.evaluation import evaluate
from analysis.flown.applied_record import EvaluationError, record_of
from analysis.flown.modelled_flow import (
    ML_S_PER_L_MIN,
    counted,
    flow_of,
    levels_ml_s,
    ramped,
    valve_flows,
)
from companion.core.nozzle import FlowCurve, NozzleSet
from companion.core.schedule import LagModel, Timing
from companion.core.types import Method, PwmLimits
from tests.analysis.applied_flights import SPEED_M_S, changes_of, eastwards, with_meter
from tests.builders import CURVE, LAG

SET = NozzleSet(valves=tuple(range(6)), curve=CURVE)


# ------------------------------------------------------------------------------------ the flow


def test_a_lone_valve_opens_by_its_lag_and_closes_by_the_other() -> None:
    flow = valve_flows(changes_of([(10.0, 0, 0.7), (12.0, 0, 0.0)]), [SET], [LAG])[0]
    full_ml_s = CURVE.flow_for(0.7) * ML_S_PER_L_MIN / 6
    sprayed_s = 2.0 + LAG.off_s - LAG.on_s
    assert flow.volume_ml(np.array([20.0]))[0] == pytest.approx(full_ml_s * sprayed_s, rel=1e-9)
    first_s = 10.0 + LAG.output_s + LAG.on_start_s
    last_s = 12.0 + LAG.output_s + LAG.off_end_s
    before, after, late = flow.volume_ml(np.array([first_s, first_s + 0.002, last_s]))
    assert before < 1e-12
    assert after > 0.0
    assert late == pytest.approx(flow.volume_ml(np.array([99.0]))[0])


def test_a_valve_that_rests_before_its_first_pulse_begins_later_and_delivers_the_same() -> None:
    pwm = PwmLimits(frequency_hz=11.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01)
    lag = replace(LAG, on_start_s=LAG.on_s - 0.03)
    timing = Timing.of(Method.SCHEDULED, lag, look_ahead_s=0.0, period_s=pwm.period_s, centred=pwm)
    rest_s = timing.rest_s(0.7)
    assert rest_s == pytest.approx(0.98 * 0.5 * 0.3 / 11.0)
    changes = changes_of([(10.0, 0, 0.7), (12.0, 0, 0.0)])
    plain, rested = (valve_flows(changes, [SET], [lag], timings)[0] for timings in ((), (timing,)))
    first_s = 10.0 + lag.output_s + lag.on_start_s
    assert plain.volume_ml(np.array([first_s + rest_s]))[0] > 0.0
    before, after = rested.volume_ml(np.array([first_s + rest_s, first_s + rest_s + 0.002]))
    assert (before, after > 0.0) == (pytest.approx(0.0, abs=1e-12), True)
    whole_ml = plain.volume_ml(np.array([20.0]))[0]
    assert rested.volume_ml(np.array([20.0]))[0] == pytest.approx(whole_ml, rel=1e-9)
    # The closing is as it was.
    assert rested.knot_s[-2:] == pytest.approx(plain.knot_s[-2:])


@given(
    rows=st.lists(
        st.tuples(st.floats(0.0, 3.0), st.sampled_from([0.0, 0.2, 0.35, 0.7, 1.0])), max_size=12
    ),
    lags=st.tuples(*[st.floats(0.0, 0.5)] * 4),
    ends=st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 0.5)),
)
def test_volume_never_falls_however_orders_overtake_each_other(
    rows: list[tuple[float, float]],
    lags: tuple[float, float, float, float],
    ends: tuple[float, float],
) -> None:
    on_s, off_s, up_s, down_s = lags
    lag = LagModel(
        on_s=on_s, off_s=off_s, up_s=up_s, down_s=down_s,
        on_start_s=ends[0] * on_s, off_end_s=off_s + ends[1], output_s=0.0,
    )  # fmt: skip
    rows.sort()
    times = np.array([row[0] for row in rows])
    levels = np.array([row[1] for row in rows])
    flow = ramped(times, levels, lag)
    volumes = flow.volume_ml(np.linspace(-1.0, 6.0, 701))
    assert (np.diff(volumes) >= -1e-9).all()
    assert (flow.flow_ml_s <= 1.0 + 1e-6).all()
    # Where everything is over, the flow is that of the last order.
    last = levels[-1] if len(levels) else 0.0
    assert (flow.flow_ml_s[-1] if len(levels) else 0.0) == pytest.approx(last, abs=1e-6)


@given(
    gaps=st.lists(st.floats(0.5, 2.0), min_size=1, max_size=8),
    duties=st.lists(st.sampled_from([0.0, 0.2, 0.4, 0.7, 1.0]), min_size=8, max_size=8),
)
def test_changes_far_apart_deliver_what_sharp_steps_at_their_lags_would(
    gaps: list[float], duties: list[float]
) -> None:
    times = np.cumsum(gaps)
    levels = np.array(duties[: len(times)])
    end_s = float(times[-1]) + 5.0
    before, expected = 0.0, 0.0
    for at_s, level in zip(times.tolist(), levels.tolist(), strict=True):
        kind_s = LAG.up_s if level > before else LAG.down_s
        if before == 0.0:
            kind_s = LAG.on_s
        elif level == 0.0:
            kind_s = LAG.off_s
        expected += (level - before) * (end_s - at_s - LAG.output_s - kind_s)
        before = level
    found = ramped(times, levels, LAG).volume_ml(np.array([end_s]))[0]
    assert found == pytest.approx(expected, abs=1e-9)


def test_many_duties_are_read_from_the_curve_as_one_is() -> None:
    duties = np.linspace(0.0, 1.0, 5003)
    exact = [CURVE.flow_for(duty) * ML_S_PER_L_MIN for duty in duties.tolist()]
    assert flow_of(SET, duties) == pytest.approx(np.array(exact), rel=1e-12)


def test_the_smallest_set_with_all_open_valves_says_the_flow() -> None:
    inner = NozzleSet(valves=(1, 2, 3, 4), curve=FlowCurve(duty=(0.2, 1.0), flow_l_min=(1.0, 4.0)))
    four = changes_of([(1.0, valve, 1.0) for valve in (1, 2, 3, 4)])
    assert levels_ml_s(four, [SET, inner]) == pytest.approx(1.0 * ML_S_PER_L_MIN)
    six = changes_of([(1.0, valve, 1.0) for valve in range(6)])
    assert levels_ml_s(six, [SET, inner]) == pytest.approx(6.096 / 6 * ML_S_PER_L_MIN)


# ---------------------------------------------------------------------------------- the record


@pytest.mark.parametrize("late_s", [0.0, 0.03, -0.02])
def test_lag_distances_of_a_journal_are_those_that_its_orders_make(late_s: float) -> None:
    found = evaluate(record_of(eastwards(late_s=late_s)))
    assert found.lag_distance_m.count == 18
    assert found.lag_distance_m.mean == pytest.approx(late_s * SPEED_M_S, abs=0.005)
    assert found.missed == found.apart == 0


def test_the_real_time_of_an_order_counts_where_it_is_known() -> None:
    flight = eastwards()
    changes = replace(flight.changes, actual_s=flight.changes.planned_s + 0.04)
    found = evaluate(record_of(replace(flight, changes=changes)))
    assert found.lag_distance_m.mean == pytest.approx(0.04 * SPEED_M_S, abs=0.005)


def test_a_flow_that_is_too_high_is_too_much_volume() -> None:
    found = evaluate(record_of(eastwards(scale=1.05)))
    assert found.volume_error_percent == pytest.approx(5.0, abs=0.1)
    assert found.spraying_accuracy_percent == pytest.approx(95.0, abs=1.0)


def test_a_flight_without_a_position_says_so_in_one_line() -> None:
    flight = eastwards()
    empty = np.zeros(0)
    nothing = replace(flight, time_s=empty, east_m=empty, north_m=empty)
    with pytest.raises(EvaluationError, match="there is nothing to evaluate"):
        record_of(nothing)


def test_without_a_heading_the_course_stands_for_it() -> None:
    flight = eastwards()
    blind = replace(flight, heading_deg=np.full(len(flight.time_s), np.nan))
    assert record_of(blind).heading_deg == pytest.approx(90.0)


# ----------------------------------------------------------------------------------- the meter


def test_a_count_that_begins_anew_goes_on_and_faults_are_left_out() -> None:
    values = np.array([5.0, 25.0, np.nan, 2.0, 12.0])
    flight = with_meter(eastwards(), np.arange(5.0), values)
    assert flight.meter_ml is not None
    times, counts = counted(flight.meter_ml)
    assert times.tolist() == [0.0, 1.0, 3.0, 4.0]
    assert counts.tolist() == [0.0, 20.0, 22.0, 32.0]
