"""Where the border holds a valve closed its flow says nothing of the rate, and hides nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from shapely import Point, box

from analysis.evaluation import Evaluation, FlightMeta, FlightRecord, evaluate
from analysis.holds import BESIDE_S, Hold, holds_of
from analysis.lag import Step, Verdict
from analysis.strips import strips_of
from companion.core.boom import Boom, Valve
from companion.core.prescription import Prescription, Zone
from companion.core.types import TimedChange

SPEED_M_S = 4.0
PERIOD_S = 1.0 / 15.0
LAG_S = 0.07
PLOT_M = 16.0
RATES = (140.0, 160.0, 140.0, 120.0)
RUN_UP_M = 12.0
# The change in question: from the second plot to the third, 8 s after the first border.
CHANGE_M = 2.0 * PLOT_M


def field_of(ponds: Sequence[tuple[float, float, float]]) -> Prescription:
    """Return four plots in a row, 20 m across, less round ponds (east, north, radius)."""
    ground = box(-1.0, -20.0, 4.0 * PLOT_M + 1.0, 20.0)
    for east_m, north_m, radius_m in ponds:
        ground = ground.difference(Point(east_m, north_m).buffer(radius_m))
    return Prescription(
        [
            Zone(
                name=str(i),
                polygon=box(i * PLOT_M, -10.0, (i + 1) * PLOT_M, 10.0).intersection(ground),
                rate_l_ha=rate,
            )
            for i, rate in enumerate(RATES)
        ]
    )


def flown(
    ponds: Sequence[tuple[float, float, float]],
    shut_m: Sequence[tuple[float, float]] = (),
    *,
    late_m: float = 0.0,
    ordered: bool = True,
    ignore: bool = False,
) -> FlightRecord:
    """Return one valve's flight along the row; `shut_m` is where it is closed.

    All changes of rate are `late_m` late; `ignore` leaves out that in question. What is not
    `ordered` happens to the flow alone: the valve has failed.
    """
    length_m = 4.0 * PLOT_M + 2.0 * RUN_UP_M
    time_s = np.arange(0.0, length_m / SPEED_M_S, 0.005)
    along_m = SPEED_M_S * time_s - RUN_UP_M
    rate = np.zeros(len(along_m))
    for i, value in enumerate(RATES):
        start_m = i * PLOT_M + (late_m if i else 0.2)
        if not (ignore and i == 2):
            rate[(along_m >= start_m) & (along_m < 4.0 * PLOT_M - 0.2)] = value
    asked = rate.copy()
    for start_m, end_m in shut_m:
        rate[(along_m >= start_m) & (along_m < end_m)] = 0.0
    told = rate if ordered else asked
    jumps = np.flatnonzero(np.diff(told, prepend=0.0))
    drops = rate * 0.1 * SPEED_M_S * 0.005
    return FlightRecord(
        time_s=time_s,
        east_m=along_m,
        north_m=np.zeros(len(time_s)),
        heading_deg=np.full(len(time_s), 90.0),
        volume_ml=np.concatenate(([0.0], np.cumsum(drops)[:-1]))[:, np.newaxis],
        boom=Boom(width_m=1.0, valves=(Valve(name="1", right_m=0.0, forward_m=0.0, width_m=1.0),)),
        prescription=field_of(ponds),
        pwm_period_s=PERIOD_S,
        orders=tuple(
            TimedChange(at_s=float(time_s[i]) - LAG_S, valve=0, duty=float(told[i]) / 200.0)
            for i in jumps
        ),
        meta=FlightMeta(
            speed_m_s=SPEED_M_S, method="scheduled", fidelity="averaged", output="gpio", seed=0
        ),
    )


def step_at(evaluation: Evaluation, place_m: float) -> Step:
    """Return the change at a place inside the field."""
    inside = [step for step in evaluation.steps if not step.change.border]
    return min(inside, key=lambda step: abs(step.change.distance_m - RUN_UP_M - place_m))


# A pond across the way over the second half of the third plot, and one whose edge the strip's end
# passes at 6 cm, in the third plot.
ACROSS = ((CHANGE_M + 12.0, 0.0, 3.5),)
ACROSS_SHUT = ((CHANGE_M + 8.1, CHANGE_M + 15.9),)
BESIDE = ((CHANGE_M + 10.0, -4.56, 4.0),)
BESIDE_SHUT = ((CHANGE_M + 9.0, CHANGE_M + 11.0),)


@pytest.mark.parametrize("late_m", [-0.3, 0.0, 0.2])
@pytest.mark.parametrize(
    ("ponds", "shut_m"), [(ACROSS, ACROSS_SHUT), (BESIDE, BESIDE_SHUT)], ids=["across", "beside"]
)
def test_a_change_is_placed_by_what_a_pond_leaves_of_its_stretch(
    ponds: Sequence[tuple[float, float, float]],
    shut_m: Sequence[tuple[float, float]],
    late_m: float,
) -> None:
    evaluation = evaluate(flown(ponds, shut_m, late_m=late_m))
    step = step_at(evaluation, CHANGE_M)
    assert step.verdict is Verdict.MEASURED
    assert step.lag_distance_m == pytest.approx(late_m, abs=0.005)
    assert evaluation.missed == 0


@pytest.mark.parametrize(
    ("ponds", "shut_m"), [(ACROSS, ACROSS_SHUT), (BESIDE, BESIDE_SHUT)], ids=["across", "beside"]
)
def test_a_change_that_never_came_is_missed_with_a_pond_behind_it_too(
    ponds: Sequence[tuple[float, float, float]], shut_m: Sequence[tuple[float, float]]
) -> None:
    step = step_at(evaluate(flown(ponds, shut_m, ignore=True)), CHANGE_M)
    assert step.verdict is Verdict.MISSED


def holds_inside(record: FlightRecord) -> list[Hold]:
    """Return the holds, without the switch at the far end of the row."""
    strip = strips_of(record)[0]
    found = holds_of(strip.track, record.prescription, strip.stretches, strip.orders, strip.spared)
    last_s = (4.0 * PLOT_M + RUN_UP_M) / SPEED_M_S - 1.0
    return [hold for hold in found if hold.start_s < last_s]


def test_a_valve_that_closes_without_an_order_is_not_held() -> None:
    assert len(holds_inside(flown(BESIDE, BESIDE_SHUT))) == 1
    assert holds_inside(flown(BESIDE, BESIDE_SHUT, ordered=False)) == []


def test_a_valve_that_is_ordered_shut_far_from_any_border_has_missed() -> None:
    record = flown((), ((CHANGE_M + 5.0, CHANGE_M + 15.0),))
    assert holds_inside(record) == []
    assert evaluate(record).missed >= 1


def test_a_pond_excuses_no_more_than_half_a_second_beside_it() -> None:
    # Shut from long before the pond to long after it: only what lies near it is the border's.
    (hold,) = holds_inside(flown(BESIDE, ((CHANGE_M + 1.0, CHANGE_M + 15.0),)))
    middle_s = (CHANGE_M + 10.0 + RUN_UP_M) / SPEED_M_S
    # The strip's end comes within 0.2 m of the pond over 1.07 m to either side of its middle.
    near_s = np.sqrt(4.2**2 - 4.06**2) / SPEED_M_S
    assert middle_s - hold.start_s == pytest.approx(near_s + BESIDE_S, abs=0.03)
    assert hold.end_s - middle_s == pytest.approx(near_s + BESIDE_S, abs=0.03)


def test_a_change_that_comes_while_the_border_holds_the_valve_counts_apart() -> None:
    # The pond lies over the boundary itself.
    evaluation = evaluate(flown(((CHANGE_M, -4.56, 4.0),), ((CHANGE_M - 1.0, CHANGE_M + 1.0),)))
    step = step_at(evaluation, CHANGE_M)
    assert (step.verdict, step.lag_distance_m) == (Verdict.BORDER, None)
    assert (evaluation.missed, evaluation.apart) == (0, 1)


def test_ground_left_beside_a_pond_is_a_gap_and_no_overlap() -> None:
    # From 1.5 m before the pond on closed: the switch belongs to where the flow ended.
    evaluation = evaluate(flown(ACROSS, ((CHANGE_M + 7.0, CHANGE_M + 15.9),)))
    closing = next(
        switch
        for switch in evaluation.switches
        if switch.kind == "off" and switch.border and switch.time_s < 15.0
    )
    assert closing.overlap_m2 == 0.0
    assert closing.gap_m2 == pytest.approx(1.5, abs=0.05)
