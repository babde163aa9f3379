"""Joining polygons by their edges, against the overlay of GEOS."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import Polygon, box

from companion.core.outline import Objects, dissolved, without_overlay
from missions.maps.overlaps import overlaps


def ragged(seed: int, *, side: int = 12, decimals: int = 7, kinds: int = 3) -> Objects:
    """Return polygons of lattice cells of one kind that touch along edges, turned and rounded.

    Corners in the middle of a longer edge of the neighbour are left out of that edge, as programs
    do that trace rasters; rounded, they stand a little beside it.
    """
    rng = np.random.default_rng(seed)
    kind = rng.integers(0, kinds, (side, side))
    kind[rng.random((side, side)) < 0.1] = -1
    turn = rng.uniform(0.0, np.pi)
    turned = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    found = []
    for one in range(kinds):
        row, column = np.nonzero(kind == one)
        joined = shapely.union_all(shapely.box(column, row, column + 1, row + 1))
        for whole in shapely.get_parts(joined):
            plain = shapely.simplify(whole, 0.0)
            part = plain if abs(plain.area - whole.area) < 1e-9 else whole
            found.append(shapely.transform(part, lambda at: np.round(7.0 * at @ turned, decimals)))
    parts = np.array(found, dtype=object)
    assert shapely.is_valid(parts).all()
    return parts


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), decimals=st.sampled_from([3, 4, 7, 12]))
def test_ragged_ground_is_joined_as_an_overlay_joins_it(seed: int, decimals: int) -> None:
    parts = ragged(seed, decimals=decimals)
    ground, overlaid = dissolved(parts), shapely.union_all(parts)
    # A millimetre along all edges is what corners may move.
    assert (
        shapely.symmetric_difference(ground, overlaid).area <= 0.001 * shapely.length(parts).sum()
    )
    assert shapely.is_valid(ground)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), shift_m=st.floats(0.05, 3.0), which=st.integers(0, 1_000))
def test_an_overlap_is_never_taken_for_a_common_border(
    seed: int, shift_m: float, which: int
) -> None:
    parts = ragged(seed)
    index = which % len(parts)
    parts[index] = shapely.transform(parts[index], lambda at: at + shift_m)
    one, two = np.triu_indices(len(parts), 1)
    shared_m2 = shapely.area(shapely.intersection(parts[one], parts[two]))
    found = without_overlay(parts)
    assert found is None or found[1] >= shared_m2.max() - 1e-9
    overlaid = shapely.union_all(parts)
    assert shapely.symmetric_difference(dissolved(parts), overlaid).area <= 0.01 * len(parts)
    areas = [pair.area_m2 for pair in overlaps(list(parts), above_m2=0.01)]
    wanted = np.sort(shared_m2[shared_m2 > 0.01])[::-1]
    assert areas == pytest.approx(wanted.tolist())


@pytest.mark.parametrize(
    "parts",
    [
        [box(0, 0, 10, 10), box(0, 0, 10, 10)],
        [box(0, 0, 10, 10), box(2, 2, 3, 3)],
        [box(0, 0, 10, 10), box(5, 5, 15, 15)],
        [box(0, 0, 10, 10), box(10, 0, 20, 10), box(0, 0, 20, 10)],
        [box(0, 0, 10, 10), box(0, 0, 10, 5)],
    ],
    ids=["twice", "inside", "across", "two under one", "half"],
)
def test_ground_under_two_polygons_is_no_outline(parts: list[Polygon]) -> None:
    given = np.array(parts, dtype=object)
    assert without_overlay(given) is None
    assert dissolved(given).equals(shapely.union_all(given))


@pytest.mark.parametrize(
    "parts",
    [
        [box(0, 0, 10, 10)],
        [box(0, 0, 10, 10), box(20, 0, 30, 10)],
        [box(0, 0, 10, 10), box(10, 10, 20, 20)],
        [box(0, 0, 30, 30).difference(box(10, 10, 20, 20)), box(10, 10, 20, 20)],
        [box(0, 0, 30, 30).difference(box(10, 10, 20, 20)), box(12, 12, 18, 18)],
        [box(0, 0, 10, 10), box(10, 0, 20, 5), box(10, 5, 20, 10)],
        [box(0, 0, 10, 10), box(10, 0, 20, 5), box(10, 5, 20, 10), box(0, 10, 20, 12)],
    ],
    ids=["one", "apart", "corner", "filled hole", "island in a hole", "T", "T all round"],
)
def test_neighbours_are_joined_without_an_overlay(parts: list[Polygon]) -> None:
    given = np.array(parts, dtype=object)
    found = without_overlay(given)
    assert found is not None
    assert found[0].equals(shapely.union_all(given))
    assert found[1] == 0.0


def test_crowded_corners_are_left_to_the_overlay() -> None:
    """Thousands of corners within a millimetre of each other would make millions of pairs."""
    x = np.linspace(0.0, 0.02, 4_001)
    y = np.where(np.arange(4_001) % 2, 1e-4, 0.0)
    comb = Polygon([*zip(x, y, strict=True), (0.02, 1.0), (0.0, 1.0)])
    given = np.array([comb, box(0.0, 1.0, 0.02, 2.0)], dtype=object)
    assert without_overlay(given) is None
    assert dissolved(given).area == pytest.approx(0.04, abs=1e-5)


def test_nothing_is_joined_to_nothing() -> None:
    assert shapely.is_empty(dissolved(np.empty(0, dtype=object)))
