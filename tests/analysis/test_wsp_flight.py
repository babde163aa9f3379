"""Cards tied to a flight: which pass went over them, what was ordered there, how far the change."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.flown.applied_flight import AppliedFlight, ValveChanges
from analysis.wsp.card import Method, Reading, read_sheet
from analysis.wsp.flight_ties import (
    CardAtChange,
    NearestChange,
    Position,
    duty_at,
    nearest_change,
    passing,
    read_positions,
    tables,
    tie,
    tie_lines,
)
from analysis.wsp.image import sheets_of
from analysis.wsp.results import numbered
from tests import builders
from tests.pump_flight import pump, pump_setup

NAN = float("nan")
STEP_S, SPEED_M_S = 0.05, 5.0


def flown(*, north_m: float = 3.0, back: bool = False, forward_m: float = 0.0) -> AppliedFlight:
    """Return a flight over the row of plots, eastwards at 5 m/s, or back again at 90 s."""
    east_m = np.arange(-10.0, 58.0, SPEED_M_S * STEP_S)
    if back:
        east_m = np.concatenate([east_m, east_m[::-1]])
    count = len(east_m)
    heading = np.full(count, 90.0)
    heading[len(heading) // 2 :] = 270.0 if back else 90.0
    setup = builders.setup(boom=builders.boom(forward_m=forward_m))
    rates = setup.prescription.rates_at(east_m, np.full(count, 3.0))
    return AppliedFlight(
        path=Path("flight-0001.gpkg"),
        meta={},
        setup=setup,
        is_closed=True,
        lost=0,
        events=(),
        utc_offset_s=1_000_000.0,
        utc_source="computer",
        time_s=np.arange(count, dtype=np.float64) * STEP_S,
        latitude_deg=np.zeros(count),
        longitude_deg=np.zeros(count),
        east_m=east_m,
        north_m=np.full(count, north_m),
        height_m=np.full(count, 3.5),
        speed_m_s=np.full(count, SPEED_M_S),
        course_deg=heading,
        heading_deg=heading,
        rate_l_ha=np.repeat(rates[:, None], 6, axis=1),
        target_flow_l_min=np.zeros(count),
        flow_l_min=np.zeros(count),
        inhibits=("",) * count,
        changes=ValveChanges(
            planned_s=np.array([1.9, 4.3, 11.5]),
            actual_s=np.array([NAN, 4.31, NAN]),
            valve=np.full(3, 2),
            duty=np.array([0.5, 0.7, 0.0]),
        ),
    )


def test_the_boom_passes_a_card_at_its_time_and_by_its_valve() -> None:
    over = passing(flown(), 10.1, 2.4)
    assert over is not None
    assert over.time_s == pytest.approx(20.1 / SPEED_M_S)
    assert over.right_m == pytest.approx(0.6)  # eastwards, so that south is right
    assert over.valve == 3
    assert (over.beside_m, over.passes, over.planned_l_ha) == (0.0, 1, 20.0)


def test_a_boom_before_the_receiver_passes_earlier() -> None:
    over = passing(flown(forward_m=1.0), 10.1, 3.5)
    assert over is not None
    assert over.time_s == pytest.approx(19.1 / SPEED_M_S)


def test_both_ways_count_as_passes_and_the_middle_of_the_boom_is_nearest() -> None:
    over = passing(flown(back=True), 10.0, 2.9)
    assert over is not None
    assert over.passes == 2


def test_a_card_beside_the_boom_is_not_under_a_valve() -> None:
    over = passing(flown(), 10.0, 7.5)
    assert over is not None
    assert (over.valve, over.planned_l_ha, over.applied_l_ha) == (None, None, None)
    assert over.beside_m == pytest.approx(1.5)
    assert passing(flown(), 10.0, 20.0) is None
    assert passing(flown(), 80.0, 3.0) is None


def test_a_gap_in_the_record_is_no_pass() -> None:
    flight = flown()
    keep = (flight.time_s < 3.0) | (flight.time_s > 5.0)
    names = ("time_s", "east_m", "north_m", "height_m", "speed_m_s", "course_deg", "heading_deg")
    cut = replace(flight, **{name: getattr(flight, name)[keep] for name in names})
    assert passing(cut, 10.0, 3.0) is None


def test_the_course_stands_for_a_heading_that_is_not_known() -> None:
    flight = flown()
    blind = replace(flight, heading_deg=flight.heading_deg * NAN)
    assert passing(blind, 10.0, 2.4) == passing(flight, 10.0, 2.4)
    assert passing(replace(blind, course_deg=blind.course_deg * NAN), 10.0, 3.0) is None


def test_a_pass_that_sprayed_counts_before_a_nearer_one_that_did_not() -> None:
    """Eastwards valve 2 sprays; on the way back, 0.2 m nearer, nothing does."""
    flight = flown(back=True)
    half = len(flight.time_s) // 2
    north_m = np.where(np.arange(len(flight.time_s)) < half, 3.0, 3.3)
    over = passing(replace(flight, north_m=north_m), 10.0, 3.5)
    assert over is not None
    assert (over.passes, over.course_deg) == (2, 90.0)
    assert over.applied_l_ha is not None and over.applied_l_ha > 0.0
    assert over.applied_all_passes_l_ha == over.applied_l_ha


@pytest.mark.parametrize(
    ("time_s", "duty"),
    [(1.9, 0.0), (2.009, 0.0), (2.011, 0.5), (4.42, 0.5), (4.43, 0.7), (11.61, 0.7), (11.63, 0.0)],
)
def test_a_duty_holds_from_its_order_and_the_lag_of_its_kind(time_s: float, duty: float) -> None:
    """on 0.10 s, up 0.104 s, off 0.11 s, each after 0.01 s of the output."""
    assert duty_at(flown(), 2, time_s) == duty


def test_the_applied_rate_is_the_flow_over_speed_and_width() -> None:
    over = passing(flown(), 10.0, 3.5)
    assert over is not None and over.valve == 2
    flow_l_min = builders.CURVE.flow_for(0.5) / 6
    assert over.applied_l_ha == pytest.approx(flow_l_min / (0.006 * SPEED_M_S * 1.0))
    closed = passing(flown(), 10.0, 2.5)
    assert closed is not None and closed.applied_l_ha == 0.0


@pytest.mark.parametrize(
    ("east_m", "course_deg", "distance_m", "rates"),
    [
        (13.0, 90.0, 1.0, (20.0, 25.0)),
        (11.25, 90.0, -0.75, (20.0, 25.0)),
        (13.0, 270.0, -1.0, (25.0, 20.0)),
        (0.5, 90.0, 0.5, (None, 20.0)),
        (47.0, 90.0, -1.0, (20.0, None)),
    ],
)
def test_the_nearest_change_lies_behind_or_ahead(
    east_m: float, course_deg: float, distance_m: float, rates: tuple[float | None, float | None]
) -> None:
    prescription = builders.setup().prescription
    found = nearest_change(prescription, east_m, 3.0, course_deg=course_deg)
    assert found is not None
    assert found.distance_m == pytest.approx(distance_m, abs=0.002)
    assert (found.before_l_ha, found.after_l_ha) == rates


def test_there_is_no_change_far_from_the_field() -> None:
    prescription = builders.setup().prescription
    assert nearest_change(prescription, 500.0, 3.0, course_deg=90.0) is None


def test_deposit_is_set_against_distance_for_two_cards_or_more_at_a_change() -> None:
    def at(card: int, distance_m: float, time_s: float) -> CardAtChange:
        change = NearestChange(distance_m=distance_m, before_l_ha=20.0, after_l_ha=25.0)
        return CardAtChange(
            card=card, change=change, time_s=time_s, speed_m_s=5.0, found={"deposit_l_ha": 9.0}
        )

    # Both cross the change at 10 s; the third is of another pass.
    (table,) = tables([at(1, 1.0, 10.2), at(2, -2.0, 9.6), at(3, 1.0, 50.2)])
    assert (table["before_l_ha"], table["after_l_ha"]) == (20.0, 25.0)
    assert [row["card"] for row in table["cards"]] == [2, 1]
    assert [row["distance_m"] for row in table["cards"]] == [-2.0, 1.0]


def test_a_pump_sprays_through_the_open_sections_only() -> None:
    """Two of six sections are open: each gets half of the flow, a closed one nothing."""
    flight = flown()
    made = replace(
        flight.setup,
        pump=pump("valves"),
        nozzle_sets=(pump_setup([20.0], "valves", valves=6).nozzle_sets),
    )
    count = len(flight.time_s)
    changes = ValveChanges(
        planned_s=np.zeros(2), actual_s=np.full(2, NAN), valve=np.array([2, 3]), duty=np.ones(2)
    )
    pumped = replace(flight, setup=made, flow_l_min=np.full(count, 0.6), changes=changes)
    opened, closed = passing(pumped, 40.0, 3.5), passing(pumped, 40.0, 1.5)
    assert opened is not None and closed is not None
    assert opened.applied_l_ha == pytest.approx(0.3 / (0.006 * SPEED_M_S), rel=0.01)
    assert closed.applied_l_ha == 0.0


def test_deposit_against_distance_is_by_the_corrected_figures() -> None:
    """On the example's cards, as they lay around a change of the flight."""
    example = Path(__file__).resolve().parents[2] / "examples" / "paper"
    (sheet,) = sheets_of(example / "scan.jpg")
    cards = numbered([read_sheet(sheet, Reading(method=Method()))])
    setup = flown().setup
    places = {
        each.number: Position(card=str(each.number), latitude_deg=at[0], longitude_deg=at[1])
        for each, along in zip(cards, (38.5, 39.5, 40.5, 41.5), strict=True)
        if (at := setup.frame.to_geographic(along, 3.0))
    }
    ties = tie(flown(), cards, places)
    (table,) = ties.boundaries
    lines = tie_lines(ties)
    for each, row, line in zip(cards, table["cards"], lines[-4:], strict=True):
        assert row["drops_per_cm2"] == each.card.better.drops_per_cm2
        assert row["covered_percent"] == each.card.better.covered_percent
        shown = line.split()[-2:]
        assert shown == [f"{row['covered_percent']:.2f}", f"{row['drops_per_cm2']:.1f}"]
        # It matters: the plain count misses drops in the stains of others.
        assert row["drops_per_cm2"] > 1.05 * row["deposits_per_cm2"]


def test_the_examples_scan_has_the_rates_that_it_was_drawn_with() -> None:
    example = Path(__file__).resolve().parents[2] / "examples" / "paper"
    (sheet,) = sheets_of(example / "scan.jpg")
    cards = read_sheet(sheet, Reading(method=Method())).cards
    drawn = (44.8, 47.2, 72.7, 75.1)
    found = [card.better.drops_per_cm2 for card in cards]
    assert found == pytest.approx(drawn, rel=0.12)
    assert not any(card.flags for card in cards)
    assert [each.card for each in read_positions(example / "cards.csv")] == ["1", "2", "3", "4"]
