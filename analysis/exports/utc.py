"""Times as files write them: UTC, ISO 8601, to the millisecond."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def utc_ms(utc_s: Floats) -> NDArray[np.int64]:
    """Return seconds since 1970 as whole milliseconds, to the nearest."""
    found: NDArray[np.int64] = np.rint(np.asarray(utc_s) * 1000.0).astype(np.int64)
    return found


def utc_text(utc_s: Floats) -> list[str]:
    """Return seconds since 1970 as text.

    >>> utc_text(np.array([0.0005, 1774953296.1234]))
    ['1970-01-01T00:00:00.000Z', '2026-03-31T10:34:56.123Z']
    """
    moments = utc_ms(utc_s).astype("datetime64[ms]")
    return [f"{each}Z" for each in np.datetime_as_string(moments, unit="ms").tolist()]
