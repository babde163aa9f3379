"""What is doubtful about a card is said by name."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from analysis.wsp.card import Card, Method, Reading, read_sheet
from analysis.wsp.image import Sheet
from analysis.wsp.results import density_class
from tests.synthetic_cards import Scanner, Spray, draw_card

WHOLE = Reading(method=Method(inset_mm=0.0), whole=True)
SPRAY = Spray(drops_per_cm2=20.0, nmd_um=180.0, sigma=1.3)
SCANNER = Scanner(dpi=500.0)


def seen(pixels: np.ndarray, dpi: float = 500.0) -> Card:
    sheet = Sheet(path=Path("card.png"), page=1, pixels=pixels, dpi=dpi)
    (card,) = read_sheet(sheet, WHOLE).cards
    return card


@cache
def _drawn(scanner: Scanner, spray: Spray) -> np.ndarray:
    return draw_card(spray, seed=2, scanner=scanner).pixels


def drawn(scanner: Scanner = SCANNER, spray: Spray = SPRAY) -> np.ndarray:
    return _drawn(scanner, spray).copy()


def test_a_good_card_has_no_flag() -> None:
    assert seen(drawn()).flags == {}


def test_a_clean_card_has_no_flag_and_no_deposits() -> None:
    card = seen(drawn(spray=replace(SPRAY, drops_per_cm2=0.0)))
    assert card.flags == {}
    assert (card.main.deposits, card.better.drops_per_cm2, card.better.covered_percent) == (0, 0, 0)


@pytest.mark.parametrize(
    ("part", "names"),
    [(0.15, set()), (0.25, {"counts-unreliable"}), (0.4, {"counts-unreliable", "overspray"})],
)
def test_wet_cards_are_flagged_by_their_coverage(part: float, names: set[str]) -> None:
    pixels = drawn(spray=replace(SPRAY, drops_per_cm2=0.0))
    # Stripes: no single stain of a tenth of the card.
    for k in range(20):
        start = k * pixels.shape[1] // 20
        pixels[:, start : start + int(part * pixels.shape[1] / 20)] = (40, 58, 142)
    assert set(seen(pixels).flags) == names


def test_uneven_light_is_flagged() -> None:
    pixels = drawn()
    shade = np.linspace(1.0, 0.8, pixels.shape[1])[None, :, None]
    assert set(seen((pixels * shade).astype(np.uint8)).flags) == {"uneven-light"}


def test_clipped_paper_is_flagged() -> None:
    pixels = drawn()
    pixels[:200] = np.where(pixels[:200] > 80, 255, pixels[:200])
    assert "clipping" in seen(pixels).flags


def test_stains_of_pure_black_are_flagged() -> None:
    scanner = replace(SCANNER, stain=(-20.0, -20.0, -20.0), noise=0.0)
    assert "clipping" in seen(drawn(scanner, replace(SPRAY, nmd_um=300.0))).flags


def test_a_threshold_beside_the_middle_is_flagged_and_the_corrected_figures_hold() -> None:
    sheet = draw_card(SPRAY, seed=2, scanner=replace(SCANNER, stain=(80.0, 98.0, 182.0)))
    card = seen(sheet.pixels)
    assert set(card.flags) == {"threshold-off-middle"}
    truth = sheet.coverage_percent(sheet.cards[0].outline)
    assert card.main.coverage_percent < truth - 0.1
    assert card.better.covered_percent == pytest.approx(truth, abs=0.06)


def test_a_low_resolution_is_flagged() -> None:
    scanner = replace(SCANNER, dpi=300.0)
    assert set(seen(drawn(scanner), dpi=300.0).flags) == {"low-dpi"}


def test_a_size_that_no_card_has_is_flagged() -> None:
    pixels = drawn()
    assert set(seen(pixels[:, :900]).flags) == {"card-size"}
    assert set(seen(pixels, dpi=700.0).flags) == {"card-size"}


def test_a_picture_without_paper_is_flagged() -> None:
    assert "no-paper" in seen(np.zeros((512, 1496, 3), dtype=np.uint8)).flags


@pytest.mark.parametrize(
    ("per_cm2", "name"),
    [(29.9, "below 30"), (30.0, "30 to 70"), (70.0, "30 to 70"), (70.1, "above 70")],
)
def test_densities_stand_between_the_limits_of_the_paper(per_cm2: float, name: str) -> None:
    assert density_class(per_cm2) == name
