"""Stains next to the smallest that count: found in spite of blur, sized in spite of texture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analysis.wsp.corrected import by_peak, corrected, full_grey, with_faint
from analysis.wsp.stains import DEPOSITSCAN, grey_of, segment
from tests.synthetic_cards import Scanner, Spray, TrueSheet, draw_card

MIST = Spray(drops_per_cm2=40.0, nmd_um=75.0, sigma=1.6)


def drawn(blur_px: float, texture: float) -> TrueSheet:
    return draw_card(MIST, seed=4, scanner=replace(Scanner(), blur_px=blur_px, texture=texture))


@pytest.mark.parametrize(("blur_px", "texture"), [(0.5, 5.0), (0.8, 2.0)])
def test_drops_next_to_the_smallest_that_count_are_counted(blur_px: float, texture: float) -> None:
    sheet = drawn(blur_px, texture)
    grey = grey_of(sheet.pixels)
    roi = np.ones_like(grey, dtype=np.bool_)
    found = corrected(grey, roi, segment(grey, roi), dpi=600.0, spread=DEPOSITSCAN)
    true = sheet.cards[0].count(sheet.cards[0].outline)
    assert found.drops_per_cm2 is not None
    assert found.drops_per_cm2 * 7.6 * 2.6 == pytest.approx(true, rel=0.04)


def test_blur_hides_stains_from_the_threshold_and_not_from_the_lighter_one() -> None:
    sheet = drawn(0.8, 2.0)
    grey = grey_of(sheet.pixels)
    roi = np.ones_like(grey, dtype=np.bool_)
    stains = segment(grey, roi, threshold="auto")
    both = with_faint(grey, roi, stains, full=full_grey(grey, stains))
    faint = both.area_px[len(stains.area_px) :]
    assert len(faint) > 20
    assert not faint.any()
    np.testing.assert_array_equal(both.labels[stains.labels > 0], stains.labels[stains.labels > 0])
    assert both.labels.max() == len(both.area_px)


def test_no_paper_has_faint_stains() -> None:
    """Noise and texture alone: nothing is taken for a stain."""
    sheet = draw_card(
        Spray(drops_per_cm2=2.0, nmd_um=400.0, sigma=1.1),
        seed=1,
        scanner=replace(Scanner(), noise=4.0, texture=6.0),
    )
    grey = grey_of(sheet.pixels)
    roi = np.ones_like(grey, dtype=np.bool_)
    stains = segment(grey, roi, threshold="auto")
    both = with_faint(grey, roi, stains, full=full_grey(grey, stains))
    assert len(both.area_px) == len(stains.area_px)


def spots(area_px: np.ndarray, noise: float) -> np.ndarray:
    """Return 7 x 7 pixels of darkness about bells of these areas, each moved within its pixel."""
    rng = np.random.default_rng(1)
    away = np.arange(-3, 4) - rng.uniform(-0.5, 0.5, (2, len(area_px), 1))
    rows, columns = np.exp(-0.5 * (away / 0.9) ** 2) / (0.9 * np.sqrt(2.0 * np.pi))
    bells = area_px[:, None, None] * rows[:, :, None] * columns[:, None, :]
    return np.asarray(bells + rng.normal(0.0, noise, bells.shape))


def test_peaks_tell_areas_closer_than_the_darkness_about_them() -> None:
    area_px = np.linspace(1.5, 6.0, 200)
    taken = spots(area_px, noise=0.05)
    found = by_peak(taken, np.ones(200, dtype=np.bool_), np.round(area_px))
    held = taken[:, 1:-1, 1:-1].sum(axis=(1, 2))
    assert (found - area_px).mean() == pytest.approx(0.0, abs=0.12)
    assert (found - area_px).std() < 0.8 * (held - area_px).std()


def test_too_few_single_stains_tell_nothing() -> None:
    area_px = np.linspace(2.0, 5.0, 30)
    is_single = np.arange(30) < 20
    assert np.isnan(by_peak(spots(area_px, 0.0), is_single, area_px)).all()
