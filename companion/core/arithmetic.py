"""Functions of the mathematics library, the same to the last bit on every processor.

A flight is replayed elsewhere, and its decisions are compared to the last bit. Additions,
multiplications, divisions and square roots are rounded alike everywhere (IEEE 754); `exp` and its
like are not: the C library takes other code where the processor has fused multiply-add, and BLAS
where it has wider registers, and the last bit differs. These here are made of the four operations
alone, in one order, and are as exact as the library's, to 1 in the last place.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from operator import mul

# ln 2 in two parts: the first has so few bits that a whole multiple of it is exact (as in fdlibm).
_LN_2_HIGH, _LN_2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
_LOG2_E = 1.4426950408889634
_EXP_MAX = 700.0
# Below half of ln 2 nothing is halved: most that is asked for.
_NO_HALVING = 0.34
_SQRT_HALF = 0.7071067811865476


def exp(x: float) -> float:
    """Return e to the power of `x`; 0 below -700, infinite above 700.

    >>> exp(0.0), exp(-800.0), abs(exp(1.0) - 2.718281828459045) < 1e-15
    (1.0, 0.0, True)
    """
    halvings = 0
    if not abs(x) < _NO_HALVING:
        if not abs(x) <= _EXP_MAX:
            return 0.0 if x < 0.0 else x * math.inf
        halvings = round(x * _LOG2_E)
    r = (x - halvings * _LN_2_HIGH) - halvings * _LN_2_LOW if halvings else x
    # The series to r^13 / 13!; what is left out is below 1e-17 for |r| <= ln 2 / 2.
    tail = 1.0 / 40_320.0 + r * (
        1.0 / 362_880.0
        + r
        * (
            1.0 / 3_628_800.0
            + r * (1.0 / 39_916_800.0 + r * (1.0 / 479_001_600.0 + r / 6_227_020_800.0))
        )
    )
    head = 1.0 / 24.0 + r * (1.0 / 120.0 + r * (1.0 / 720.0 + r * (1.0 / 5040.0 + r * tail)))
    found = 1.0 + r * (1.0 + r * (0.5 + r * (1.0 / 6.0 + r * head)))
    return math.ldexp(found, halvings) if halvings else found


def log(x: float) -> float:
    """Return the natural logarithm of a positive number.

    >>> log(1.0), abs(log(10.0) - 2.302585092994046) < 1e-15
    (0.0, True)
    """
    mantissa, halvings = math.frexp(x)
    if mantissa < _SQRT_HALF:
        mantissa, halvings = 2.0 * mantissa, halvings - 1
    # 2 artanh(f), to f^21; what is left out is below 1e-18 for |f| <= 0.172.
    f = (mantissa - 1.0) / (mantissa + 1.0)
    f2 = f * f
    # Written out: a loop takes twice as long, and each position asks three times.
    total = (((1.0 / 21.0 * f2 + 1.0 / 19.0) * f2 + 1.0 / 17.0) * f2 + 1.0 / 15.0) * f2 + 1.0 / 13.0
    total = (((total * f2 + 1.0 / 11.0) * f2 + 1.0 / 9.0) * f2 + 1.0 / 7.0) * f2 + 1.0 / 5.0
    total = (total * f2 + 1.0 / 3.0) * f2
    return halvings * _LN_2_HIGH + (halvings * _LN_2_LOW + 2.0 * f * total + 2.0 * f)


def total(values: Iterable[float]) -> float:
    """Return the sum, from the first value on; `sum` does it otherwise since Python 3.12.

    >>> total([0.1] * 10)
    0.9999999999999999
    """
    found = 0.0
    for value in values:
        found += value
    return found


# ---------------------------------------------------------------------------------- small matrices

Row = tuple[float, ...]
Matrix = tuple[Row, ...]


def identity(size: int) -> Matrix:
    """Return ones on the diagonal."""
    return tuple(tuple(1.0 if i == j else 0.0 for j in range(size)) for i in range(size))


def transposed(matrix: Matrix) -> Matrix:
    """Return rows for columns."""
    return tuple(zip(*matrix, strict=True))


def added(one: Matrix, other: Matrix) -> Matrix:
    """Return the sum."""
    return tuple(
        tuple(a + b for a, b in zip(*rows, strict=True)) for rows in zip(one, other, strict=True)
    )


def product(one: Matrix, other: Matrix) -> Matrix:
    """Return the matrix product; each sum is taken from the first term on.

    >>> product(((1.0, 2.0),), ((3.0,), (4.0,)))
    ((11.0,),)
    """
    columns = tuple(zip(*other, strict=True))
    if len(other) == 4:
        return tuple(
            tuple([a * e + b * f + c * g + d * h for e, f, g, h in columns]) for a, b, c, d in one
        )
    if len(other) == 3:
        return tuple(tuple([a * d + b * e + c * f for d, e, f in columns]) for a, b, c in one)
    return tuple(tuple([total(map(mul, row, column)) for column in columns]) for row in one)


def inverse(matrix: Matrix) -> Matrix:
    """Return the inverse, by Gauss and Jordan with the largest pivot of each column.

    >>> inverse(((0.0, 2.0), (4.0, 0.0)))
    ((0.0, 0.25), (0.5, 0.0))
    """
    size = len(matrix)
    rows = [[*own, *unit] for own, unit in zip(matrix, identity(size), strict=True)]
    for at in range(size):
        best = max(range(at, size), key=lambda i: abs(rows[i][at]))
        rows[at], rows[best] = rows[best], rows[at]
        pivot = rows[at][at]
        # What lies to the left of the pivot is done with.
        head = [value / pivot for value in rows[at][at:]]
        rows[at][at:] = head
        for i in range(size):
            row = rows[i]
            share = row[at]
            if i != at and share != 0.0:
                row[at:] = [a - share * b for a, b in zip(row[at:], head, strict=True)]
    return tuple(tuple(row[size:]) for row in rows)
