"""What every picture of ground has in common: colours of rates, a scale bar and where north is.

Maps, plans, reports and the demo are drawn in several packages; what these look like is said here
once. Nothing here imports matplotlib: the caller's axes draw.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.transforms import Transform

_DARK, _PALE = "black", "0.72"
_BAR_PT = 4.0
# Rates on all pictures of a map: the darker, the more.
RATES_MAP = "viridis_r"
# Of a map's width at most.
SHARE_MAX = 0.25


def rate_ends(rates_l_ha: Iterable[float]) -> tuple[float, float]:
    """Return the rates at both ends of a map's scale of colours, on every picture of that map.

    They lie a quarter of the map's span beyond its own rates: ground that got too little is paler
    than the least of them, and ground that was sprayed twice is darker than the largest.

    >>> rate_ends([15.0, 25.0, 0.0]), rate_ends([20.0]), rate_ends([0.0])
    ((12.5, 27.5), (10.0, 30.0), (0.5, 1.5))
    """
    sprayed = [rate for rate in rates_l_ha if rate > 0.0] or [1.0]
    least, most = min(sprayed), max(sprayed)
    beyond = (most - least) / 4.0 or most / 2.0
    return max(least - beyond, 0.0), most + beyond


def scale_length_m(width_m: float, *, share: float = SHARE_MAX) -> float:
    """Return a round length of at most a share of the picture's width.

    >>> scale_length_m(950.0), scale_length_m(72.0), scale_length_m(126.0, share=0.2)
    (200.0, 10.0, 20.0)
    """
    most = share * width_m
    power = 10.0 ** math.floor(math.log10(most))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= most)


def length_text(length_m: float) -> str:
    """Return a length as a scale bar says it.

    >>> length_text(0.5), length_text(200.0), length_text(2000.0)
    ('0.5 m', '200 m', '2 km')
    """
    return f"{length_m / 1000:g} km" if length_m >= 1000.0 else f"{length_m:g} m"


def draw_bar(
    panel: Axes, west_m: float, at: float, length_m: float, *, transform: Transform | None = None
) -> None:
    """Draw a bar of two halves eastwards from `west_m`; `at` is its height in the transform."""
    half_m = length_m / 2.0
    for start_m, colour in ((west_m, _DARK), (west_m + half_m, _PALE)):
        panel.plot(
            [start_m, start_m + half_m], [at, at], color=colour, linewidth=_BAR_PT,
            transform=transform or panel.transData, clip_on=False, solid_capstyle="butt",
        )  # fmt: skip


def draw_below(panel: Axes, high_in: float) -> None:
    """Draw a scale bar at the left below a map of this height on paper, and north at its right."""
    west_m, east_m = panel.get_xlim()
    length_m = scale_length_m(east_m - west_m)
    across = panel.get_xaxis_transform()  # x in metres, y as a share of the map's height
    draw_bar(panel, west_m, -0.3 / high_in, length_m, transform=across)
    panel.text(
        west_m + length_m / 2.0, -0.42 / high_in, length_text(length_m), transform=across,
        ha="center", va="top", fontsize=11,
    )  # fmt: skip
    panel.annotate(
        "N", xy=(0.97, -0.1 / high_in), xytext=(0.97, -0.72 / high_in), xycoords="axes fraction",
        ha="center", fontsize=13, fontweight="bold", annotation_clip=False,
        arrowprops={"facecolor": _DARK, "width": 3.0, "headwidth": 10.0, "headlength": 10.0},
    )  # fmt: skip


def draw_above(panel: Axes, above: Transform) -> None:
    """Draw a scale bar above the right corner of a map whose top is north, and say so."""
    west_m, east_m = panel.get_xlim()
    length_m = scale_length_m(east_m - west_m, share=0.2)
    draw_bar(panel, east_m - length_m, 1.0, length_m, transform=above)
    panel.text(
        east_m - length_m - 0.02 * (east_m - west_m), 1.0, f"N \u2191  {length_text(length_m)}",
        transform=above, ha="right", va="center", size=9.5,
    )  # fmt: skip
