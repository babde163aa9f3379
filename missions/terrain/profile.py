"""Which points of a profile are needed, such that straight lines between them stay near it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from missions.strips import Floats


def kept_points(at_m: Floats, height_m: Floats, tolerance_m: float) -> NDArray[np.int64]:
    """Return which points are kept, first and last among them.

    Between two that are kept the profile leaves the straight line by no more than the tolerance,
    in height: Douglas and Peucker (1973), with the error that an aircraft flies. Where it leaves
    it by more, the worst point is kept, and both sides are looked at again.

    >>> at = np.array([0.0, 10.0, 20.0, 30.0, 40.0])
    >>> kept_points(at, np.array([0.0, 0.1, 3.0, 0.0, 0.0]), 0.5).tolist()
    [0, 1, 2, 3, 4]
    >>> kept_points(at, np.array([0.0, 1.0, 2.1, 3.0, 4.0]), 0.5).tolist()
    [0, 4]
    """
    last = len(at_m) - 1
    kept = {0, last}
    todo = [(0, last)]
    while todo:
        start, end = todo.pop()
        if end - start < 2:
            continue
        inside = slice(start + 1, end)
        straight = np.interp(at_m[inside], at_m[[start, end]], height_m[[start, end]])
        error = np.abs(height_m[inside] - straight)
        worst = int(np.argmax(error))
        if not error[worst] <= tolerance_m:
            middle = start + 1 + worst
            kept.add(middle)
            todo += [(start, middle), (middle, end)]
    return np.array(sorted(kept), dtype=np.int64)
