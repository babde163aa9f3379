"""What the paper that this project started from has published, for the tables beside ours.

P1: Wang et al., a variable-rate spray system with lag compensation on a six-rotor UAV, Journal of
Agricultural Engineering 2024, LV:1547.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

P1_SOURCE = "Journal of Agricultural Engineering 2024, LV:1547"


@dataclass(frozen=True, slots=True, kw_only=True)
class P1LagDistance:
    """P1's lag distance [m] at one speed; None where only the mean is given."""

    speed_m_s: float
    mean: float
    min: float | None
    max: float | None
    where: str


# P1 gives the mean at 6 m/s as "4.2 m s-1"; metres must be meant.
P1_LAG_DISTANCE_M: dict[str, tuple[P1LagDistance, ...]] = {
    "none": (
        P1LagDistance(speed_m_s=5.0, mean=3.87, min=3.5, max=4.3, where="Figure 8a and text"),
        P1LagDistance(speed_m_s=6.0, mean=4.2, min=None, max=None, where="text on Figure 8b"),
    ),
    "look-ahead": (
        P1LagDistance(speed_m_s=5.0, mean=0.32, min=-0.27, max=0.78, where="Figure 8a and text"),
    ),
}

# Table 5: spraying accuracy [%] by flight speed [m/s] and rate [L/ha], with lag compensation.
P1_RATES_L_HA = (14.5, 15.4, 16.6, 17.7, 19.4, 20.5, 22.7, 23.8, 25.5, 27.8)
P1_SPRAYING_ACCURACY_PERCENT: dict[float, tuple[float, ...]] = {
    4.0: (91.56, 92.63, 93.26, 93.55, 94.62, 94.34, 95.28, 95.33, 95.88, 96.48),
    5.0: (93.73, 93.28, 93.43, 94.58, 95.46, 94.69, 94.74, 95.67, 96.27, 96.09),
    6.0: (93.66, 93.84, 94.23, 94.66, 95.85, 95.16, 95.81, 95.61, 96.31, 97.32),
}
P1_MEAN_ACCURACY_PERCENT = 94.77

# Everything of the above in a form that JSON takes.
P1_RESULTS: dict[str, object] = {
    "source": P1_SOURCE,
    "lag_distance_m": {
        method: [asdict(row) for row in rows] for method, rows in P1_LAG_DISTANCE_M.items()
    },
    "spraying_accuracy_percent": {
        "where": "Table 5; mean and range in the text",
        "mean": P1_MEAN_ACCURACY_PERCENT,
        "min": 91.56,
        "max": 97.32,
        "rates_l_ha": list(P1_RATES_L_HA),
        "by_speed_m_s": {
            f"{speed:g}": list(row) for speed, row in P1_SPRAYING_ACCURACY_PERCENT.items()
        },
    },
}


def p1_accuracy_percent(speed_m_s: float) -> float | None:
    """Return the mean of Table 5 at one speed; None where P1 did not fly.

    >>> p1_accuracy_percent(5.0)
    94.794
    """
    row = P1_SPRAYING_ACCURACY_PERCENT.get(speed_m_s)
    return None if row is None else round(sum(row) / len(row), 3)


def p1_lag_distance_m(method: str, speed_m_s: float) -> P1LagDistance | None:
    """Return P1's lag distance; None where P1 has none.

    >>> p1_lag_distance_m("look-ahead", 5.0).mean
    0.32
    """
    rows = P1_LAG_DISTANCE_M.get(method, ())
    return next((row for row in rows if row.speed_m_s == speed_m_s), None)
