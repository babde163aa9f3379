"""Student's t for whole degrees of freedom: intervals from few measurements.

The finite series of Abramowitz and Stegun, 26.7.3 and 26.7.4, are exact; no library is needed.
"""

from __future__ import annotations

import math

# Halvings of [0, 1]: the angle of the series is known to 1e-15 after these.
HALVINGS = 60


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
