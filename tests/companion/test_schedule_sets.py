"""Nozzle sets: down below 3.7, up above 4.1 L/min for P1's, and on the boundary of a zone only."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import pytest
import shapely

from companion.core.controller import Memory, step
from companion.core.nozzle import choose_set
from companion.core.prescription import Prescription
from companion.core.setup import Setup
from companion.core.types import TimedChange
from sitl.knowledge import measured_sets
from sitl.profile import load_profile
from tests.builders import LAG, flying, plots, setup

SMALL, LARGE = SETS = measured_sets(load_profile("wang-2024"))
SPEED = 5.0
STEP_S = 0.05


@pytest.mark.parametrize(
    ("flow_l_min", "current", "expected"),
    [(4.09, 0, 0), (4.11, 0, 1), (3.71, 1, 1), (3.69, 1, 0), (2.0, 1, 0), (6.0, 0, 1)],
)
def test_the_published_sets_change_at_3_7_and_4_1_l_min(
    flow_l_min: float, current: int, expected: int
) -> None:
    assert choose_set(SETS, flow_l_min, current=current) == expected


def two_sets(rates: Sequence[float]) -> Setup:
    length_m = 12.0 * len(rates)
    ground = shapely.box(0.0, -1.0, length_m, 7.0)
    field = Prescription(plots([rates]), boundary=ground)
    return setup(prescription=field, nozzle_sets=SETS)


def fly(given: Setup, start_m: float, end_m: float, speeds: Sequence[float] = (SPEED,)) -> list[
    tuple[float, TimedChange]
]:  # fmt: skip
    """Return the changes carried out on the way east, and where the boom then was."""
    memory, done, pending = Memory(), [], list[TimedChange]()
    east_m, now_s, number = start_m, 10.0, 0
    while east_m < end_m:
        speed = speeds[number % len(speeds)]
        done += [(east_m, change) for change in pending if change.at_s <= now_s]
        state = replace(flying(now_s, east_m), velocity_east_m_s=speed, checked_speed_m_s=speed)
        decision, memory = step(given, state, memory, now_s)
        pending = list(decision.plan.changes)
        east_m, now_s, number = east_m + speed * STEP_S, now_s + STEP_S, number + 1
    return done


def moves_of(done: list[tuple[float, TimedChange]], valve: int) -> list[TimedChange]:
    """Return what moved one valve by more than a trim; an order to stay as it is does not."""
    mine = [change for _, change in done if change.valve == valve]
    before = [0.0, *(change.duty for change in mine)]
    return [change for change, duty in zip(mine, before, strict=False)
            if change.restart and change.duty != duty]  # fmt: skip


# Valves that P1's smaller set lacks: "valves 5 and 6 closed".
OUTER = sorted(set(LARGE.valves) - set(SMALL.valves))
# L/ha at 5 m/s and 6 m: 2.7 L/min, the smaller set; 5.04 L/min, the larger one.
LOW, HIGH = 15.0, 28.0


def test_the_sets_change_on_the_boundary_and_not_where_it_comes_into_view() -> None:
    done = fly(two_sets([LOW, HIGH, LOW]), 3.0, 33.0)
    for valve in OUTER:
        opens, shuts = moves_of(done, valve)
        assert opens.duty > 0.0 == shuts.duty
        # On: opened by its own lag ahead; off: closed by its own.
        at_m = (opens.at_s + LAG.on_s + LAG.output_s - 10.0) * SPEED + 3.0
        assert at_m == pytest.approx(12.0, abs=1e-6)
        at_m = (shuts.at_s + LAG.off_s + LAG.output_s - 10.0) * SPEED + 3.0
        assert at_m == pytest.approx(24.0, abs=1e-6)
    for valve in SMALL.valves:
        _, up, down = moves_of(done, valve)
        # Fewer valves at a higher duty: each gives less after the change only as the set says.
        assert up.duty == pytest.approx(LARGE.curve.duty_for(5.04), abs=1e-6)
        assert down.duty == pytest.approx(SMALL.curve.duty_for(2.7), abs=1e-6)


def test_inside_a_zone_no_speed_changes_the_set() -> None:
    # 21 L/ha and 6 m: 3.78 L/min at 5 m/s, the flow swings from 3.5 to 4.2 L/min.
    # It is entered at 5 m/s: within the hysteresis, so with the set that sprayed before.
    speeds = [5.0] * 60 + [5.0 + 0.45 * math.sin(0.4 * i) for i in range(200)]
    low_first = fly(two_sets([LOW, 21.0, 21.0, 21.0]), 3.0, 46.0, speeds)
    assert [moves_of(low_first, valve) for valve in OUTER] == [[]] * len(OUTER)
    high_first = fly(two_sets([HIGH, 21.0, 21.0, 21.0]), 3.0, 46.0, speeds)
    for valve in OUTER:
        assert [change.duty > 0.0 for _, change in high_first if change.valve == valve]
        assert all(change.duty > 0.0 for _, change in high_first if change.valve == valve)


def test_what_is_ordered_ahead_is_not_taken_back_by_the_noise_of_the_speed() -> None:
    # 23 L/ha is 4.14 L/min at 5 m/s and 4.06 at 4.9: about the upper threshold.
    done = fly(two_sets([LOW, 23.0]), 3.0, 20.0, (5.0, 4.9))
    for valve in OUTER:
        assert len(moves_of(done, valve)) in (0, 1)
    assert len({len(moves_of(done, valve)) for valve in OUTER}) == 1


def test_a_set_that_can_no_longer_deliver_is_given_up() -> None:
    given = two_sets([20.0])
    slow = flying(10.0, 4.0)
    _, memory = step(given, slow, Memory(), 10.0)  # 3.6 L/min
    assert memory.ordering.set_index == 0
    fast = flying(10.05, 4.3, velocity_east_m_s=7.0, checked_speed_m_s=7.0)  # 5.04 L/min
    _, memory = step(given, fast, memory, 10.05)
    assert memory.ordering.set_index == 1
