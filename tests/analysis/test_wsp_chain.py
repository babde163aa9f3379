"""DepositScan's chain: grey, threshold, neighbours, spread factors, sizes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from analysis.wsp.stains import (
    DEPOSITSCAN,
    SPREADS,
    SpreadError,
    fraction_um,
    grey_of,
    midway,
    second_of,
    segment,
    sizes,
    spread_of,
    stain_um,
)

PX_UM = 25_400.0 / 600.0
ALL = np.ones((8, 8), dtype=np.bool_)


def grey(*dark: tuple[int, int], level: int = 127) -> np.ndarray:
    picture = np.full((8, 8), 200, dtype=np.uint8)
    for place in dark:
        picture[place] = level
    return picture


@given(st.tuples(*[st.integers(0, 255)] * 3))
def test_grey_is_the_rounded_mean_of_the_colours(colour: tuple[int, int, int]) -> None:
    pixel = np.array([[colour]], dtype=np.uint8)
    assert grey_of(pixel)[0, 0] == math.floor(sum(colour) / 3 + 0.5)


@pytest.mark.parametrize(("level", "count"), [(127, 1), (128, 0)])
def test_a_stain_is_as_dark_as_the_threshold(level: int, count: int) -> None:
    assert len(segment(grey((2, 2), level=level), ALL).area_px) == count


def test_pixels_that_touch_by_a_corner_are_one_stain() -> None:
    stains = segment(grey((1, 1), (2, 2), (5, 5)), ALL)
    assert sorted(stains.area_px) == [1.0, 2.0]


def test_what_lies_outside_the_region_is_not_looked_at() -> None:
    roi = ALL.copy()
    roi[:4] = False
    assert list(segment(grey((1, 1), (5, 5), (5, 6)), roi).area_px) == [2.0]


def test_the_threshold_of_auto_lies_halfway_and_plain_paper_keeps_the_usual_one() -> None:
    counts = np.zeros(256, dtype=np.int64)
    counts[[100, 190]] = 50, 5000
    assert midway(counts) == 145
    counts[100] = 0
    assert midway(counts) == 127
    assert midway(np.zeros(256, dtype=np.int64)) == 127


@pytest.mark.parametrize(
    ("stain", "depositscan", "usda", "table"),
    [(100.0, 63, 53, 59), (300.0, 171, 153, 155), (600.0, 321, 291, 285)],
)
def test_spread_factors_give_the_published_drops(
    stain: float, depositscan: int, usda: int, table: int
) -> None:
    for name, drop in (("depositscan", depositscan), ("usda", usda), ("table", table)):
        assert round(float(SPREADS[name].drop_um(np.array([stain]))[0])) == drop


def test_depositscans_law_is_the_one_of_areas() -> None:
    """The literature has it as 1.06 A^0.455."""
    stain = np.array([80.0, 250.0, 900.0])
    by_area = 1.06 * (math.pi / 4.0 * stain**2) ** 0.455
    np.testing.assert_allclose(DEPOSITSCAN.drop_um(stain), by_area, rtol=0.002)


@pytest.mark.parametrize("name", SPREADS)
@given(stains=st.lists(st.floats(0.0, 20_000.0), min_size=2, max_size=20))
def test_a_larger_stain_never_means_a_smaller_drop(name: str, stains: list[float]) -> None:
    drops = SPREADS[name].drop_um(np.sort(stains))
    assert (np.diff(drops) >= -1e-9).all()


@pytest.mark.parametrize("name", ["", "usda2", "user:1", "user:a,b", "user:0,1", "user:nan,1"])
def test_an_unknown_spread_factor_is_refused_by_name(name: str) -> None:
    with pytest.raises(SpreadError, match="depositscan, usda"):
        spread_of(name)


def test_the_second_column_is_always_another_law() -> None:
    assert all(second_of(spread).name != spread.name for spread in SPREADS.values())


def test_figures_of_a_card_agree_with_a_sum_by_hand() -> None:
    area_px = np.array([1.0, 30.0, 200.0])  # the first drop is 32 um: left out
    found = sizes(area_px, dpi=600.0, roi_px=1_000_000, spread=DEPOSITSCAN)
    drop_um = [0.95 * (math.sqrt(4.0 * a / math.pi) * PX_UM) ** 0.91 for a in (30.0, 200.0)]
    volume_um3 = [math.pi / 6.0 * d**3 for d in drop_um]
    roi_um2 = 1_000_000 * PX_UM**2
    assert found.deposits == 2
    assert found.coverage_percent == pytest.approx(0.023)
    assert found.deposits_per_cm2 == pytest.approx(2.0 / (roi_um2 / 1e8))
    assert found.ul_per_cm2 == pytest.approx(sum(volume_um3) * 1e-9 / (roi_um2 / 1e8))
    assert found.l_ha == pytest.approx(100.0 * found.ul_per_cm2)
    first = volume_um3[0] / sum(volume_um3)
    assert first < 0.1  # the median lies between the two drops, so does the tenth
    median_um = drop_um[0] + (0.5 - first) / (1.0 - first) * (drop_um[1] - drop_um[0])
    assert found.dv05_um == pytest.approx(median_um)
    assert found.nmd_um == pytest.approx(drop_um[0])
    assert found.dv01_um is not None and found.dv09_um is not None
    assert found.relative_span == pytest.approx((found.dv09_um - found.dv01_um) / median_um)


def test_a_card_without_a_stain_has_no_sizes() -> None:
    found = sizes(np.empty(0), dpi=600.0, roi_px=100, spread=DEPOSITSCAN)
    assert (found.deposits, found.l_ha, found.coverage_percent) == (0, 0.0, 0.0)
    assert (found.dv05_um, found.relative_span, found.nmd_um) == (None, None, None)


@given(
    drops=st.lists(st.floats(50.0, 900.0), min_size=1, max_size=30),
    parts=st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)),
)
def test_sizes_rise_with_the_part_and_stay_within_the_drops(
    drops: list[float], parts: tuple[float, float]
) -> None:
    drop_um = np.array(drops)
    low, high = (fraction_um(drop_um, drop_um**3, part) for part in sorted(parts))
    assert low is not None and high is not None
    assert 0.0 <= low <= high <= drop_um.max() * (1.0 + 1e-12)


def test_the_size_of_a_stain_scales_with_the_resolution() -> None:
    area = np.array([10.0, 400.0])
    np.testing.assert_allclose(stain_um(area, 300.0), 2.0 * stain_um(area, 600.0))
