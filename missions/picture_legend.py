"""What stands around a plan's picture: title, legend, scale and north (extra `plot`)."""

from __future__ import annotations

import colorsys
import math
from typing import TYPE_CHECKING, Any

from companion.wording import counted
from missions.maps.picture.draw import Sheet, printable, scale_length_m
from missions.plan import Plan

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LEFT_IN, RIGHT_IN, BELOW_IN, ABOVE_IN = 0.4, 4.0, 0.9, 1.3
LISTED_MAX, ROW_IN = 26, 0.26
# Of the arrow of the wind.
WIND_IN, WIND = 0.6, "#1f5fa8"
SKIPPED, TWICE, CLOSED, FIELD = "#d0021b", "#1a1a1a", "#8a8a8a", "#f4f1ea"
Colour = tuple[float, float, float]


def colour_of(number: int) -> Colour:
    """Return a colour for a sortie: neighbours in the list are far apart on the wheel.

    >>> colour_of(1) != colour_of(2)
    True
    """
    hue = (0.58 + 0.381966 * (number - 1)) % 1.0
    return colorsys.hls_to_rgb(hue, (0.42, 0.55)[(number // 8) % 2], 0.62)


def draw_scale(axes: Axes, sheet: Sheet) -> None:
    """Draw a round length and the arrow to the north, below the map."""
    west, _, east, _ = sheet.ground_m
    length_m = scale_length_m(east - west)
    across = axes.get_xaxis_transform()
    down = 0.3 / sheet.map_in[1]
    axes.plot(
        [west, west + length_m], [-down, -down], color="black", linewidth=4.0, transform=across,
        clip_on=False,
        solid_capstyle="butt",
    )  # fmt: skip
    text = f"{length_m / 1000:g} km" if length_m >= 1000.0 else f"{length_m:g} m"
    axes.text(
        west + length_m / 2.0, -1.4 * down, text, transform=across, ha="center", va="top",
        fontsize=11,
    )  # fmt: skip
    axes.annotate(
        "N", xy=(0.97, -0.1 / sheet.map_in[1]), xytext=(0.97, -0.72 / sheet.map_in[1]),
        xycoords="axes fraction",
        ha="center",
        fontsize=13,
        fontweight="bold",
        arrowprops={"facecolor": "black", "width": 3.0, "headwidth": 10.0, "headlength": 10.0},
        annotation_clip=False,
    )  # fmt: skip


def draw_wind(axes: Axes, sheet: Sheet, wind: tuple[float, float]) -> None:
    """Draw where the wind blows to, beside the north, with its speed and where it comes from."""
    speed_m_s, from_deg = wind
    wide_in, high_in = sheet.map_in
    towards = math.radians(from_deg + 180.0)
    half_in = WIND_IN / 2.0
    along = (half_in * math.sin(towards) / wide_in, half_in * math.cos(towards) / high_in)
    middle = (0.97 - 0.55 / wide_in, -0.41 / high_in)
    axes.annotate(
        "", xy=(middle[0] + along[0], middle[1] + along[1]),
        xytext=(middle[0] - along[0], middle[1] - along[1]), xycoords="axes fraction",
        arrowprops={"facecolor": WIND, "edgecolor": WIND, "width": 2.0, "headwidth": 8.0,
                    "headlength": 8.0, "shrink": 0.0},
        annotation_clip=False,
    )  # fmt: skip
    axes.text(
        middle[0] - 0.42 / wide_in, middle[1], f"wind {speed_m_s:g} m/s\nfrom {from_deg:g}°",
        transform=axes.transAxes, ha="right", va="center", fontsize=10, color=WIND,
    )  # fmt: skip


def write_title(figure: Figure, plan: Plan, title: str) -> None:
    """Write the name of the field and the figures of the plan."""
    wide_in, high_in = figure.get_figwidth(), figure.get_figheight()
    count = len(plan.sorties)
    figures = (
        f"{plan.field.area_m2 / 1e4:.2f} ha    {plan.volume_l:,.1f} L    "
        f"{_duration(plan.total_s)} with refills    "
        f"{counted(count, 'sortie')}    covered {plan.coverage.percent:.2f} %    "
        f"twice {plan.coverage.overlap_percent:.2f} %    "
        f"ferry {plan.length_m('ferry') / 1e3:.1f} km"
    )
    settings = plan.settings
    low, high = _speeds(plan)
    ferries = settings.ferry_height_m
    flown = (
        f"passes at {high:g} m/s, {settings.height_m:g} m high    "
        if low == high
        else f"passes at {low:g} to {high:g} m/s, {settings.height_m:g} m high    "
    )
    flown += "" if ferries is None else f"ferries {ferries:g} m high    "
    flown += f"swath {settings.swath_width_m:g} m    course {plan.angle_deg:.0f}°"
    shown = printable(title)[: int(wide_in * 7.0)]
    for text, size, weight, below_in in (
        (shown, 17, "bold", 0.28),
        (figures, 11, "normal", 0.66),
        (flown, 11, "normal", 0.92),
    ):
        figure.text(
            LEFT_IN / wide_in, 1.0 - below_in / high_in, text, fontsize=size, fontweight=weight,
            va="top",
            parse_math=False,
        )  # fmt: skip


def _ferry(plan: Plan) -> str:
    height_m = plan.settings.ferry_height_m
    return "ferry" if height_m is None else f"ferry or transit {height_m:g} m high"


def _duration(seconds: float) -> str:
    """Return a time with refills in words.

    >>> _duration(5430.0), _duration(240.0)
    ('1 h 30 min', '4 min')
    """
    hours, minutes = divmod(round(seconds / 60.0), 60)
    return f"{hours} h {minutes:02} min" if hours else f"{minutes} min"


def _speeds(plan: Plan) -> tuple[float, float]:
    speeds = [sortie.speeds_m_s for sortie in plan.sorties]
    return min(low for low, _ in speeds), max(high for _, high in speeds)


def write_legend(figure: Figure, plan: Plan, seen: dict[str, bool], *, left: float) -> None:
    """Say what is drawn, and list the sorties for which there is room."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    high_in = figure.get_figheight()
    handles: list[Any] = [
        Line2D([], [], color="0.15", linewidth=0.8, label="transit"),
        Line2D([], [], color="0.3", linestyle="--", label=_ferry(plan)),
        Line2D([], [], color="black", marker="s", markersize=9, linestyle="", label="depot"),
        Line2D(
            [], [], color="0.35", marker="o", markersize=9, linestyle="", markeredgecolor="black",
            label="first pass begins (number of the sortie)",
        ),
        Line2D(
            [], [], color="white", marker="X", markersize=8, linestyle="", markeredgecolor="black",
            label="last pass ends",
        ),
    ]  # fmt: skip
    if seen["twice"]:
        handles.append(Patch(facecolor=TWICE, alpha=0.45, label="sprayed twice"))
    if seen["skipped"]:
        handles.append(Patch(facecolor=SKIPPED, label="left unsprayed"))
    if seen["bare"]:
        handles.append(Patch(facecolor=FIELD, edgecolor="0.6", label="nothing prescribed"))
    if seen["closed"]:
        handles.append(
            Patch(facecolor="0.9", edgecolor=CLOSED, hatch="////", label="not to be sprayed")
        )
    room = max(4, math.floor((high_in - ABOVE_IN) / ROW_IN) - len(handles) - 2)
    listed = plan.sorties[: min(LISTED_MAX, room)]
    for sortie in listed:
        fill_l = sortie.volume_l + plan.settings.reserve_l
        words = (
            f"sortie {sortie.number}", f"fill {fill_l:.1f} L",
            f"{plan.airborne_s(sortie) / 60:.1f} min",
        )  # fmt: skip
        colour = colour_of(sortie.number)
        handles.append(Patch(facecolor=(*colour, 0.45), edgecolor=colour, label="    ".join(words)))
    if len(listed) < len(plan.sorties):
        more = len(plan.sorties) - len(listed)
        handles.append(Line2D([], [], linestyle="", label=f"and {more} more"))
    figure.legend(
        handles=handles, loc="upper left", bbox_to_anchor=(left, 1.0 - ABOVE_IN / high_in),
        frameon=False, fontsize=10, borderaxespad=0.0, labelspacing=0.55, handlelength=2.2,
    )  # fmt: skip
