"""What a fault of the liquid is seen by: bins of ordered and metered volume, and their name."""

from __future__ import annotations

import pytest

from companion.core.options.flow_meter import Detection, Order, Watching, bin_length_s
from companion.core.options.liquid_evidence import (
    Bin,
    Collecting,
    Evidence,
    collected,
    expected_ml,
    name_of,
    valve_of,
)
from companion.core.types import FaultKind, FlowReport, SprayPlan, TimedChange
from tests.builders import CURVE, LAG, setup
from tests.companion.liquid_rig import LAW, NAN, OPEN_ML_S


@pytest.mark.parametrize("changed_s", [0.31, 0.37, 0.45])
def test_a_rate_that_changes_between_two_counts_is_no_difference(changed_s: float) -> None:
    """Counts 0.2 s apart, as of an autopilot's meter; a bin ends between two of them."""
    orders = (Order(-1.0, (40.0,), None), Order(changed_s, (80.0,), None))

    def counted(at_s: float) -> FlowReport:
        volume_ml = 40.0 * min(at_s, changed_s) + 80.0 * max(at_s - changed_s, 0.0)
        return FlowReport(received_s=at_s, volume_ml=volume_ml)

    state, bins = Collecting(orders=orders), []
    for at_s in (0.0, 0.1, 0.3, 0.5, 0.7, 0.9):
        state, filled = collected(state, counted(at_s), bin_s=0.4, delay_s=0.0, now_s=at_s)
        bins += [] if filled is None else [filled]
    assert [round(each.end_s, 6) for each in bins] == [0.4, 0.8]
    for each in bins:
        assert each.metered_ml == pytest.approx(each.all_ml, rel=1e-9)


def test_no_bin_ends_while_nothing_was_heard() -> None:
    orders, silence = (Order(-1.0, (40.0,), None),), (0.35, 0.55)
    state, bins = Collecting(orders=orders, silences=(silence,)), []
    for at_s in (0.0, 0.1, 0.3, 0.5, 0.7, 0.9):
        report = FlowReport(received_s=at_s, volume_ml=40.0 * at_s)
        state, filled = collected(state, report, bin_s=0.4, delay_s=0.0, now_s=at_s)
        bins += [] if filled is None else [filled]
    assert [round(each.end_s, 6) for each in bins] == [0.8]


@pytest.mark.parametrize("is_open", [False, True])
@pytest.mark.parametrize("valve", range(6))
def test_clicks_tell_the_valve(valve: int, is_open: bool) -> None:
    bins = []
    for clicked in range(6):
        ordered = tuple(OPEN_ML_S if each == clicked else 0.0 for each in range(6))
        metered = sum(ordered)
        if is_open:
            metered += OPEN_ML_S - ordered[valve]
        else:
            metered -= ordered[valve]
        bins.append(Bin(float(clicked), clicked + 1.0, ordered, metered, None))
    assert valve_of(bins, gain=1.0, open_ml_s=OPEN_ML_S, is_open=is_open) == valve


# -------------------------------------------------------------------------------- its parts


def test_bins_are_whole_periods() -> None:
    assert bin_length_s(0.1) == pytest.approx(0.2)
    assert bin_length_s(1.0) == 1.0


def test_changes_of_a_plan_count_from_their_own_times_until_its_lease_ends() -> None:
    plan = SprayPlan(
        sequence=1,
        issued_s=10.0,
        duty=(0.0, 0.5),
        changes=(
            TimedChange(at_s=9.99, valve=0, duty=0.3),
            TimedChange(at_s=10.2, valve=1, duty=0.0),
        ),
        lease_until_s=10.3,
    )
    assert list(plan.duties_until(10.1)) == [(10.0, (0.0, 0.5)), (10.0, (0.3, 0.5))]
    assert list(plan.duties_until(11.0))[2:] == [(10.2, (0.3, 0.0)), (10.3, (0.0, 0.0))]


def test_expected_volume_is_that_of_the_orders_in_their_time() -> None:
    watching = Watching.of(LAW, setup().nozzle_sets, LAG, setup().pwm)
    orders = (
        watching.order(0.0, (0.0,) * 6, 0),
        watching.order(1.0, (1.0,) * 5 + (0.0,), 0),
        watching.order(2.0, (0.5,) * 6, 0),
    )
    volumes = expected_ml(orders, 0.5, 2.5)
    half = CURVE.flow_for(0.5) * 1000.0 / 60.0 / 6.0 * 0.5
    assert volumes[0] == pytest.approx(OPEN_ML_S + half)
    assert volumes[5] == pytest.approx(half)
    assert orders[2].pressure_kpa == pytest.approx(227.0)
    assert orders[0].pressure_kpa is None


@pytest.mark.parametrize(
    "change",
    [
        {"spread": 0.0},
        {"spread": NAN},
        {"closed_share": NAN},
        {"meter_minimum_l_min": -1.0},
        {"pressure_duty": (0.5,), "pressure_kpa": (1.0,)},
        {"pressure_duty": (0.5, 0.5), "pressure_kpa": (1.0, 2.0)},
        {"pressure_duty": (0.1, 0.5), "pressure_kpa": (0.0, 2.0)},
        {"pressure_duty": (0.1, 0.5), "pressure_kpa": (NAN, 2.0)},
    ],
)
def test_a_law_that_cannot_be_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"must|need"):
        Detection(**change)  # type: ignore[arg-type]


# -------------------------------------------------------------------------- the size of a fault


def some_bins(flows: list[tuple[float, float]], *, gain: float = 1.0) -> tuple[Bin, ...]:
    """Return bins of a second of six valves: what is ordered of each, and metered besides."""
    return tuple(
        Bin(
            begin_s=float(number),
            end_s=number + 1.0,
            expected_ml=(each_ml,) * 6,
            metered_ml=gain * (6.0 * each_ml + more_ml),
            pressure=None,
        )
        for number, (each_ml, more_ml) in enumerate(flows)
    )


def named(bins: tuple[Bin, ...], count: int, *, learnt: float, likely: float = 1.0) -> FaultKind:
    evidence = Evidence.of(
        bins, count, gain=learnt, likely_gain=likely, pressure_gain=1.0, open_ml_s=OPEN_ML_S
    )
    return name_of(evidence)


@pytest.mark.parametrize("gain", [0.97, 1.0, 1.03])
@pytest.mark.parametrize("learnt", [-0.02, 0.0, 0.02])
def test_a_stuck_valve_is_told_from_a_leak_though_the_gain_was_learnt_wrong(
    gain: float, learnt: float
) -> None:
    healthy = [(12.0, 0.0), (13.0, 0.0), (12.0, 0.0)]
    stuck = [(each, OPEN_ML_S - each) for each in (11.0, 12.0, 10.0, 9.0)]
    bins = some_bins(healthy + stuck, gain=gain)
    assert named(bins, 5, learnt=gain + learnt) is FaultKind.STUCK_OPEN
    leak = some_bins(healthy + [(each, 0.4 * more) for each, more in stuck], gain=gain)
    assert named(leak, 5, learnt=gain + learnt) is FaultKind.LEAK


def test_a_fault_since_the_first_bin_is_measured_by_the_likely_gain() -> None:
    stuck = some_bins([(each, OPEN_ML_S - each) for each in (11.0, 11.0, 11.0)], gain=1.02)
    assert named(stuck, 3, learnt=1.0, likely=1.02) is FaultKind.STUCK_OPEN
    half = some_bins([(each, 0.5 * (OPEN_ML_S - each)) for each in (11.0, 11.0, 11.0)], gain=1.02)
    assert named(half, 3, learnt=1.0, likely=1.02) is FaultKind.LEAK


@pytest.mark.parametrize("gain", [0.97, 1.03])
def test_a_shut_valve_is_told_from_a_smaller_clog_though_the_gain_is_not_known(gain: float) -> None:
    healthy = [(12.0, 0.0), (13.0, 0.0), (12.0, 0.0)]
    shut = some_bins(healthy + [(each, -each) for each in (11.0, 12.0, 10.0, 12.0)], gain=gain)
    assert named(shut, 6, learnt=gain) is FaultKind.STUCK_CLOSED
    clog = some_bins(healthy + [(each, -0.5 * each) for each in (11.0, 12.0, 10.0)], gain=gain)
    assert named(clog, 5, learnt=gain) is FaultKind.CLOG
