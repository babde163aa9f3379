"""Random places on a map, the same at every run."""

from __future__ import annotations

import numpy as np

# A tenth beyond the map on every side: outside has to be told as well as inside.
MARGIN = 0.1


def places_in(
    bounds: tuple[float, float, float, float], count: int, *, seed: int
) -> list[tuple[float, float]]:
    """Return (latitude, longitude) of `count` places in and around west, south, east, north."""
    west, south, east, north = bounds
    rng = np.random.default_rng(seed)
    x = rng.uniform(west - MARGIN * (east - west), east + MARGIN * (east - west), count)
    y = rng.uniform(south - MARGIN * (north - south), north + MARGIN * (north - south), count)
    return list(zip(y.tolist(), x.tolist(), strict=True))
