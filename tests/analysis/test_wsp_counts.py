"""Drops counted by the law of overlap and by notches: on average right, and closer than the law."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from analysis.wsp.corrected import Counted, at_edge, crossings, drops_on, notches, seen_share
from analysis.wsp.stains import Outlines, drops_px, outlines_of, segment

SIDE, BEYOND = 700, 30
PAPER, STAIN, LEVEL = 180.0, 80.0, 130
ALL = np.ones((SIDE, SIDE), dtype=np.bool_)


def seen(
    discs: np.ndarray, *, side: int = SIDE, blur_px: float = 0.8, noise: float = 1.0
) -> np.ndarray:
    """Return grey as a scanner sees discs (x, y, radius): smooth edges, blur, noise."""
    stain = np.zeros((side, side))
    for x, y, r in discs:
        left, right = (int(np.clip(x + reach, 0, side)) for reach in (-r - 2, r + 3))
        top, bottom = (int(np.clip(y + reach, 0, side)) for reach in (-r - 2, r + 3))
        away = np.hypot(
            np.arange(left, right) + 0.5 - x, (np.arange(top, bottom) + 0.5 - y)[:, None]
        )
        part = stain[top:bottom, left:right]
        np.maximum(part, np.clip(r - away + 0.5, 0.0, 1.0), out=part)
    grey = PAPER + (STAIN - PAPER) * ndimage.gaussian_filter(stain, blur_px)
    grey += np.random.default_rng(len(discs)).normal(0.0, noise, grey.shape)
    return np.asarray(np.clip(np.round(grey), 0, 255).astype(np.uint8))


def outlined(discs: np.ndarray, **options: float) -> Outlines:
    grey = seen(discs, **options)  # type: ignore[arg-type]
    roi = np.ones_like(grey, dtype=np.bool_)
    return outlines_of(grey <= LEVEL, grey, roi, threshold=LEVEL)


def counted(grey: np.ndarray) -> Counted:
    stains = segment(grey, ALL, threshold=LEVEL)
    is_drop = np.ones(len(stains.area_px), dtype=np.bool_)
    return Counted(grey=grey, roi=ALL, stains=stains, is_drop=is_drop, dpi=600.0)


@cache
def models(count: int, least: float, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much both counts are off, in percent, on Boolean models of known number."""
    off = []
    for seed in range(16):
        rng = np.random.default_rng([seed, count])
        number = rng.poisson(count * (1.0 + 2.0 * BEYOND / SIDE) ** 2)
        middles = rng.uniform(-BEYOND, SIDE + BEYOND, (number, 2))
        discs = np.column_stack([middles, rng.uniform(least, most, number)])
        true = int(((middles >= 0.0) & (middles <= SIDE)).all(axis=1).sum())
        card = counted(seen(discs))
        both, law = drops_on(card), drops_px(card.stains.labels > 0, ALL)
        assert both is not None and law is not None
        off.append((100.0 * (both / true - 1.0), 100.0 * (law * ALL.size / true - 1.0)))
    both_off, law_off = np.array(off).T
    return both_off, law_off


MODELS = [(70, 8.0, 18.0), (150, 5.0, 12.0), (500, 3.0, 6.0)]


@pytest.mark.parametrize(("count", "least", "most"), MODELS)
def test_the_count_is_right_on_average(count: int, least: float, most: float) -> None:
    off, _ = models(count, least, most)
    # Blur joins small stains that do not touch, which costs about one in a hundred.
    assert abs(off.mean()) < 1.2


@pytest.mark.parametrize(("count", "least", "most"), MODELS)
def test_the_count_is_closer_than_that_by_the_law_of_overlap(
    count: int, least: float, most: float
) -> None:
    both, law = models(count, least, most)
    assert both.std() < 0.75 * law.std()


def test_the_outline_of_a_disc_is_a_circle() -> None:
    outline = outlined(np.array([[30.3, 29.8, 12.0]]), side=60)
    radius = np.hypot(outline.x - 30.3, outline.y - 29.8)
    assert radius == pytest.approx(12.0, abs=0.2)
    assert outline.length_px == pytest.approx(2.0 * np.pi * 12.0, rel=0.01)
    assert outline.patches == 1
    np.testing.assert_array_equal(outline.before[outline.after], np.arange(len(outline.x)))


@given(st.lists(st.booleans(), min_size=64, max_size=64))
def test_outlines_count_patches_less_holes(dots: list[bool]) -> None:
    stained = np.zeros((10, 10), dtype=np.bool_)
    stained[1:9, 1:9] = np.array(dots).reshape(8, 8)
    grey = np.where(stained, 0, 255).astype(np.uint8)
    everywhere = np.ones_like(stained)
    _, patches = ndimage.label(stained, structure=np.ones((3, 3)))
    _, grounds = ndimage.label(~stained)
    outlines = outlines_of(stained, grey, everywhere, threshold=127)
    assert outlines.patches == patches - (grounds - 1)
    # The chain closes: each point is followed by one, and follows one.
    assert sorted(outlines.after) == list(range(len(outlines.x)))


@pytest.mark.parametrize(
    ("second", "count"),
    [
        ((58.0, 40.0, 9.0), 2),
        ((50.0, 48.0, 6.0), 2),
        ((43.0, 40.0, 4.0), 0),
        ((70.0, 40.0, 9.0), 0),
    ],
)
def test_two_drops_that_hit_each_other_make_two_notches(
    second: tuple[float, float, float], count: int
) -> None:
    """Side by side, a small one on the rim, one within the other, apart."""
    assert notches(outlined(np.array([(40.0, 40.0, 12.0), second]), side=90)) == count


@pytest.mark.parametrize("radius", [2.5, 3.5, 5.0, 8.0, 14.0])
def test_as_many_crossings_are_seen_as_is_said(radius: float) -> None:
    rng = np.random.default_rng(3)
    cell, columns = int(6 * radius), 18
    discs = []
    for k in range(columns**2):
        x, y = (cell * (each + 0.5) for each in divmod(k, columns))
        away, turn = 2.0 * radius * np.sqrt(rng.uniform()), rng.uniform(0.0, 2.0 * np.pi)
        discs += [(x, y, radius), (x + away * np.cos(turn), y + away * np.sin(turn), radius)]
    found = notches(outlined(np.array(discs), side=cell * columns, blur_px=0.6))
    said = seen_share(np.array([np.pi * radius**2]))
    assert found / (2.0 * columns**2) == pytest.approx(said, abs=0.07)


def test_crossings_follow_from_the_length_of_outlines() -> None:
    """Two circles of radius r on an area A hit each other with 4 pi r^2 / A, and cross twice."""
    n, r, area = 100.0, 5.0, 1_000_000
    mean = n**2 / 2.0 * 2.0 * 4.0 * np.pi * r**2 / area
    assert crossings(n * 2.0 * np.pi * r, 0.0, area) == pytest.approx(mean)


@pytest.mark.parametrize(("x", "inside"), [(3.0, 1), (-3.0, 0), (SIDE - 3.0, 1), (SIDE + 3.0, 0)])
def test_a_drop_at_the_edge_counts_by_its_middle(x: float, inside: int) -> None:
    card = counted(seen(np.array([(x, 300.0, 10.0), (200.0, 200.0, 10.0)])))
    labels, threshold = card.stains.labels, card.stains.threshold
    outlines = outlines_of(labels > 0, card.grey, ALL, threshold=threshold)
    assert at_edge(outlines, labels, card.stains.area_px) == (1, inside)
    drops = drops_on(card)
    assert drops == pytest.approx(1.0 + inside, abs=0.1)


def test_ragged_outlines_leave_the_count_to_the_law() -> None:
    """Stars have notches of their own: four and more a stain, and none of them is a second drop."""
    rng = np.random.default_rng(0)
    stars = []
    for x, y in rng.uniform(40.0, SIDE - 40.0, (60, 2)):
        turns = np.linspace(0.0, 2.0 * np.pi, 6)[:-1]
        rays = [(x + 10.0 * np.cos(turn), y + 10.0 * np.sin(turn), 3.0) for turn in turns]
        stars += [(x, y, 8.0), *rays]
    card = counted(seen(np.array(stars)))
    law, both = drops_px(card.stains.labels > 0, ALL), drops_on(card)
    assert law is not None
    assert both == pytest.approx(law * ALL.size, rel=0.02)
