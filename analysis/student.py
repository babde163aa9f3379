"""Student's t and Fisher's F: intervals and tests from few measurements; no library is needed.

t, for whole degrees of freedom, by the finite series of Abramowitz and Stegun, 26.7.3 and 26.7.4,
which are exact; F by the continued fraction of the incomplete beta function, 26.6.2 and 26.5.8.
"""

from __future__ import annotations

import math

# Halvings of [0, 1]: the angle of the series is known to 1e-15 after these.
HALVINGS = 60
# Terms of the continued fraction, some ten are needed; and what stands for a divisor of 0.
TERMS = 300
TINY = 1e-300


def t_inside(t: float, dof: int) -> float:
    """Return the probability that |T| is below `t`.

    >>> round(t_inside(2.228, 10), 4)
    0.95
    """
    return _inside(math.atan2(t, math.sqrt(dof)), dof)


def t_factor(dof: int, inside: float = 0.95) -> float:
    """Return how many standard errors on each side hold the truth with probability `inside`.

    >>> [round(t_factor(dof), 3) for dof in (1, 3, 10, 1000)]
    [12.706, 3.182, 2.228, 1.962]
    """
    if not (dof >= 1 and 0.0 < inside < 1.0):
        raise ValueError(f"no t with {dof} degrees of freedom and probability {inside}")
    low, high = 0.0, 0.5 * math.pi
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if _inside(middle, dof) < inside:
            low = middle
        else:
            high = middle
    return math.sqrt(dof) * math.tan(low)


def _inside(angle: float, dof: int) -> float:
    sin, cos = math.sin(angle), math.cos(angle)
    odd = dof % 2
    term = total = cos if odd else 1.0
    if dof == 1:
        return 2.0 * angle / math.pi
    for k in range(2 + odd, dof - 1, 2):
        term *= cos * cos * (k - 1) / k
        total += term
    return 2.0 / math.pi * (angle + sin * total) if odd else sin * total


def f_above(f: float, dof_1: float, dof_2: float) -> float:
    """Return the probability that F with these degrees of freedom, whole or not, exceeds `f`.

    >>> [round(f_above(f, 5, 7), 4) for f in (0.0, 1.7111, 3.9715)]
    [1.0, 0.25, 0.05]
    """
    if not (f >= 0.0 and dof_1 > 0.0 and dof_2 > 0.0):
        raise ValueError(f"no F of {f} with {dof_1} and {dof_2} degrees of freedom")
    return _beta_below(dof_2 / (dof_2 + dof_1 * f), 0.5 * dof_2, 0.5 * dof_1)


def _beta_below(x: float, a: float, b: float) -> float:
    """Return the regularised incomplete beta function."""
    if x <= 0.0 or x >= 1.0:
        return 1.0 if x >= 1.0 else 0.0
    if x > (a + 1.0) / (a + b + 2.0):
        return 1.0 - _beta_below(1.0 - x, b, a)
    scale = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b)
    front = math.exp(scale + a * math.log(x) + b * math.log1p(-x)) / a
    # Lentz's way to work out the fraction from its front.
    c, d, found = 1.0, 0.0, 1.0
    for i in range(TERMS):
        m = i // 2
        if i == 0:
            term = 1.0
        elif i % 2:
            term = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1.0))
        else:
            term = m * (b - m) * x / ((a + 2 * m - 1.0) * (a + 2 * m))
        d = 1.0 / (1.0 + term * d or TINY)
        c = 1.0 + term / c or TINY
        found *= c * d
        if abs(c * d - 1.0) < 1e-14:
            break
    return front * (found - 1.0)
