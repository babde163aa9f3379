"""Drops counted where their stains have run together."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from analysis.wsp.corrected import without_holes
from analysis.wsp.stains import drops_px

SIDE = 900
EVERYWHERE = np.ones((SIDE, SIDE), dtype=np.bool_)


def discs(count: int, radius: tuple[float, float], seed: int, margin: float = 0.0) -> np.ndarray:
    """Return discs at random places; what goes over an edge comes back in on the other side."""
    rng = np.random.default_rng(seed)
    stained = np.zeros((SIDE, SIDE), dtype=np.bool_)
    for x, y, r in zip(
        *rng.uniform(margin, SIDE - margin, (2, count)), rng.uniform(*radius, count), strict=True
    ):
        reach = int(r) + 2
        dx = np.arange(int(x) - reach, int(x) + reach + 1)
        dy = np.arange(int(y) - reach, int(y) + reach + 1)
        disc = (dx + 0.5 - x) ** 2 + (dy[:, None] + 0.5 - y) ** 2 <= r**2
        stained[np.ix_(dy % SIDE, dx % SIDE)] |= disc
    return stained


@pytest.mark.parametrize(("count", "least", "most"), [(1500, 4.0, 6.0), (1000, 3.0, 15.0)])
def test_drops_are_counted_through_their_overlaps(count: int, least: float, most: float) -> None:
    found, plain = [], []
    for seed in range(8):
        stained = discs(count, (least, most), seed)
        assert 0.10 < stained.mean() < 0.35
        drops = drops_px(stained, EVERYWHERE)
        assert drops is not None
        found.append(drops * stained.size / count)
        plain.append(ndimage.label(stained, structure=np.ones((3, 3)))[1] / count)
    assert np.mean(found) == pytest.approx(1.0, abs=0.03)
    assert np.mean(plain) < 0.8  # what a plain count would say of the same picture


@pytest.mark.parametrize("seed", range(5))
def test_drops_far_apart_are_what_a_plain_count_says(seed: int) -> None:
    stained = discs(12, (3.0, 5.0), seed, margin=20.0)
    _, plain = ndimage.label(stained, structure=np.ones((3, 3)))
    drops = drops_px(stained, EVERYWHERE)
    assert drops is not None
    assert drops * stained.size == pytest.approx(plain, rel=0.05)


def test_a_clean_card_has_no_drops_and_a_wet_one_no_count() -> None:
    assert drops_px(~EVERYWHERE, EVERYWHERE) == 0.0
    assert drops_px(EVERYWHERE, EVERYWHERE) is None
    nothing = np.zeros((4, 4), dtype=np.bool_)
    assert drops_px(nothing, nothing) is None


def test_a_light_spot_in_a_stain_is_no_drop_less() -> None:
    stained = np.zeros((600, 600), dtype=np.bool_)
    stained[10:40, 10:40] = True
    stained[20:23, 20:23] = False
    filled = without_holes(stained, 600 / 25.4)
    assert filled[21, 21] and not filled[5, 5]
    whole = np.ones_like(stained)
    drops = drops_px(filled, whole)
    assert drops is not None and drops * whole.size == pytest.approx(1.0, abs=0.15)
