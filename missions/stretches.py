"""Which parts of a line are worth flying: where nothing is prescribed, nothing has to be flown.

What is cut out may still be flown over: the order of the parts decides, by time.
"""

from __future__ import annotations

import numpy as np

from missions.strips import Floats

# A shorter stretch without a rate is flown over with shut valves: going around it saves nothing.
GAP_MIN_M = 10.0


def stretches(at_m: Floats, litres: Floats, *, margin_m: float) -> list[tuple[float, float]]:
    """Return from where to where along a line something is prescribed, and `margin_m` around it.

    `litres` is what the line needs up to each of `at_m`. The margin is for speeding up before
    the first rate and braking after the last one, as far as the line is long.

    >>> at = np.array([0.0, 40.0, 60.0, 100.0])
    >>> stretches(at, np.array([0.0, 0.0, 2.0, 2.0]), margin_m=5.0)
    [(35.0, 65.0)]
    """
    needed = np.flatnonzero(np.diff(litres) > 0.0)
    if not len(needed):
        return []
    first, last = float(at_m[0]), float(at_m[-1])
    starts = np.maximum(at_m[needed] - margin_m, first)
    ends = np.minimum(at_m[needed + 1] + margin_m, last)
    apart = np.flatnonzero(starts[1:] - ends[:-1] >= GAP_MIN_M)
    begin = np.concatenate([[0], apart + 1])
    end = np.concatenate([apart, [len(needed) - 1]])
    found = list(zip(starts[begin].tolist(), ends[end].tolist(), strict=True))
    # A rest at an end that is too short to be worth a stop of its own.
    start = first if found[0][0] - first < GAP_MIN_M else found[0][0]
    stop = last if last - found[-1][1] < GAP_MIN_M else found[-1][1]
    found[0] = (start, found[0][1])
    found[-1] = (found[-1][0], stop)
    return found
