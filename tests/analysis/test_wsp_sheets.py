"""Cards on scans: found, put in order, measured against drawn truth."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from analysis.wsp.card import INSET_MM, Method, Reading, SheetResult, read_sheet
from analysis.wsp.image import Rectangle, Sheet, around, find_cards
from tests.synthetic_cards import Scanner, Spray, TrueSheet, draw_card, draw_sheet

DPI = 300.0
PX = DPI / 25.4
LIGHT = Spray(drops_per_cm2=25.0, nmd_um=160.0, sigma=1.4)
READING = Reading(method=Method())


def card(x_mm: float, y_mm: float, angle_deg: float, width_mm: float = 26.0) -> Rectangle:
    return Rectangle(
        x=x_mm * PX, y=y_mm * PX, long=76.0 * PX, short=width_mm * PX, angle_deg=angle_deg
    )


def drawn(*places: Rectangle, spray: Spray = LIGHT, scanner: Scanner | None = None) -> TrueSheet:
    return draw_sheet(
        [spray] * len(places),
        places,
        size=(round(130 * PX), round(125 * PX)),
        seed=3,
        scanner=scanner or Scanner(dpi=DPI),
    )


@cache
def one_card() -> TrueSheet:
    return drawn(card(60.0, 50.0, 0.0))


def sheet_of(pixels: np.ndarray, *, dpi: float | None = DPI) -> Sheet:
    return Sheet(path=Path("scan.png"), page=1, pixels=pixels, dpi=dpi)


def read(truth: TrueSheet, *, dpi: float | None = DPI, reading: Reading = READING) -> SheetResult:
    return read_sheet(sheet_of(truth.pixels, dpi=dpi), reading)


def test_cards_are_found_turned_and_in_reading_order() -> None:
    places = [card(25.0, 45.0, 86.0), card(60.0, 48.0, 92.5), card(70.0, 106.0, -2.0)]
    found, others = find_cards(sheet_of(drawn(*[places[k] for k in (2, 1, 0)]).pixels))
    assert (len(found), others) == (3, 0)
    for each, place in zip(found, places, strict=True):
        assert (each.outline.x, each.outline.y) == pytest.approx((place.x, place.y), abs=0.3 * PX)
        turned = (each.outline.angle_deg - place.angle_deg + 90.0) % 180.0 - 90.0
        assert abs(turned) < 0.7
        assert each.outline.short == pytest.approx(place.short, abs=0.6 * PX)
        assert each.outline.long == pytest.approx(place.long, abs=0.6 * PX)


def test_coverage_and_drops_agree_with_the_truth_of_the_region() -> None:
    place = card(45.0, 20.0, 3.0)
    truth = draw_sheet(
        [Spray(drops_per_cm2=40.0, nmd_um=150.0)],
        [place.scaled(2.0)],
        size=(round(180 * PX), round(80 * PX)),
        seed=5,
    )
    (found,) = read(truth, dpi=600.0).cards
    region = found.outline.inset(INSET_MM * 2.0 * PX)
    count = truth.cards[0].count(region) / found.roi_cm2
    coverage = truth.coverage_percent(region)
    assert coverage > 2.0
    assert found.main.coverage_percent == pytest.approx(coverage, abs=0.3)
    assert found.better.covered_percent == pytest.approx(coverage, abs=0.15)
    assert found.better.drops_per_cm2 == pytest.approx(count, rel=0.03)
    assert found.main.deposits_per_cm2 < 0.97 * count
    assert found.flags == {}


@pytest.mark.parametrize(
    ("stated", "asked", "dpi", "source"),
    [
        (300.0, None, 300.0, "file"),
        (300.0, 600.0, 600.0, "option"),
        (None, None, 300.0, "card-width"),
    ],
)
def test_the_resolution_says_where_it_comes_from(
    stated: float | None, asked: float | None, dpi: float, source: str
) -> None:
    found = read(one_card(), dpi=stated, reading=replace(READING, dpi=asked))
    assert found.dpi_source == source
    assert found.dpi == pytest.approx(dpi, rel=0.015)


def test_a_wide_card_beside_a_usual_one_does_not_tell_the_resolution() -> None:
    wide = card(85.0, 50.0, 90.0, width_mm=52.0)
    found = read(drawn(card(25.0, 50.0, 90.0), wide), dpi=None)
    assert len(found.cards) == 2
    assert found.dpi == pytest.approx(300.0, rel=0.015)


def test_a_sheet_without_cards_says_so() -> None:
    found = read(drawn())
    assert found.cards == ()
    assert found.dpi is None
    assert "no cards" in found.notes[0]


def test_a_yellow_round_thing_is_no_card() -> None:
    truth = drawn()
    y, x = np.mgrid[: truth.pixels.shape[0], : truth.pixels.shape[1]]
    truth.pixels[(x - 700) ** 2 + (y - 600) ** 2 < 300**2] = (226, 210, 92)
    assert find_cards(sheet_of(truth.pixels)) == ([], 1)


def test_cards_that_touch_are_told_and_not_measured_as_one() -> None:
    found = read(drawn(card(45.0, 45.0, 90.0), card(70.0, 90.0, 0.0)))
    assert found.cards == ()
    assert "touch" in found.notes[0]


def test_a_bent_card_is_measured_in_its_own_form() -> None:
    truth = one_card()
    columns = np.arange(truth.pixels.shape[1])
    shift = (8.0 * PX * ((columns / PX - 60.0) / 38.0) ** 2 / 2.0).astype(int)
    bent = np.stack(
        [np.roll(truth.pixels[:, k], shift[k], axis=0) for k in range(len(columns))], axis=1
    )
    bent[(bent > 243).all(axis=2)] = (20, 60, 20)  # on a leaf: darker than the threshold
    sheet = Sheet(path=Path("photo.png"), page=1, pixels=np.ascontiguousarray(bent), dpi=DPI)
    (found,) = read_sheet(sheet, READING).cards
    assert "not-flat" in found.flags
    assert found.main.coverage_percent == pytest.approx(
        truth.coverage_percent(card(60.0, 50.0, 0.0)), abs=0.6
    )


def test_a_whole_image_is_one_card_to_its_edges() -> None:
    truth = draw_card(LIGHT, seed=1, scanner=Scanner(dpi=DPI))
    reading = Reading(method=Method(inset_mm=0.0), whole=True)
    (found,) = read(truth, reading=reading).cards
    assert found.roi_cm2 == pytest.approx(7.6 * 2.6, rel=0.001)
    assert (found.width_mm, found.length_mm) == pytest.approx((26.0, 76.0), rel=0.001)


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 45.0, 89.0, -60.0])
def test_the_rectangle_around_corners_is_that_rectangle(angle_deg: float) -> None:
    place = Rectangle(x=50.0, y=20.0, long=30.0, short=10.0, angle_deg=angle_deg)
    found = around(*place.corners.T)
    assert found is not None
    np.testing.assert_allclose(sorted(found.corners[:, 0]), sorted(place.corners[:, 0]))
    assert found.long == pytest.approx(30.0)
    assert place.inset(1.0).mask((0, 0, 100, 60)).sum() == pytest.approx(28.0 * 8.0, abs=12)


def test_points_in_a_line_have_no_rectangle() -> None:
    line = np.arange(5.0)
    assert around(line, line) is None


def test_two_drawings_of_one_seed_agree_and_the_truth_counts_every_drop() -> None:
    first, again = (draw_card(LIGHT, seed=7, scanner=Scanner(dpi=DPI)) for _ in range(2))
    np.testing.assert_array_equal(first.pixels, again.pixels)
    (truth,) = first.cards
    assert truth.count(truth.outline, above_um=0.0) == len(truth.drop_um) > 300
