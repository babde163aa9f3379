"""Plain arithmetic: as exact as the mathematics library's, and the same everywhere."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest

from companion.core.arithmetic import exp, inverse, log, product, total, transposed

CHANCE = random.Random(5)


def test_exp_is_that_of_the_library_to_the_last_place() -> None:
    for _ in range(20_000):
        x = CHANCE.choice((1e-9, 1.0, 50.0, 699.0)) * CHANCE.uniform(-1.0, 1.0)
        assert abs(exp(x) - math.exp(x)) <= 2.0 * math.ulp(math.exp(x))
    assert exp(-math.inf) == 0.0
    assert exp(math.inf) == math.inf
    assert math.isnan(exp(math.nan))


def test_log_is_that_of_the_library_to_the_last_place() -> None:
    for _ in range(20_000):
        x = math.exp(CHANCE.choice((1e-9, 1.0, 50.0)) * CHANCE.uniform(-1.0, 1.0))
        assert abs(log(x) - math.log(x)) <= 2.0 * math.ulp(math.log(x)) + 1e-25


@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_an_inverse_times_its_matrix_is_one(size: int) -> None:
    matrix = tuple(tuple(CHANCE.uniform(-1.0, 1.0) for _ in range(size)) for _ in range(size))
    assert np.array(product(matrix, inverse(matrix))) == pytest.approx(np.eye(size), abs=1e-12)
    assert np.array(product(matrix, transposed(matrix))) == pytest.approx(
        np.array(matrix) @ np.array(matrix).T
    )


def test_a_total_is_taken_from_the_first_value_on() -> None:
    assert total([1e16, 1.0, -1e16]) == 0.0
