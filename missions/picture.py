"""A plan as a picture: swaths and route of each sortie in its colour, depots, what is missed.

All that needs matplotlib here (extra `plot`), imported when it is asked for.
"""

from __future__ import annotations

import colorsys
import importlib.util
import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from companion.map_pictures import draw_below
from companion.wording import counted, missing
from missions.boom import boom_of
from missions.errors import PlanError
from missions.field import Kind
from missions.maps.local import polygons_of
from missions.maps.model import write_whole
from missions.maps.picture import STYLE, SUFFIXES, Sheet, content_of, printable, sheet_for
from missions.plan import Leg, Plan, Sortie
from missions.strips import sprayed_twice, whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Of a large field more dots an inch, so that a swath is some dots wide.
DPI_MIN, DPI_MAX, SWATH_DOTS = 110.0, 250.0, 7.0
# What is nowhere this wide is the rounding of strips that touch, and the margin of the border.
SEEN_M = 0.05


def check_picture(out: Path) -> None:
    """Refuse a picture that cannot be made, before any work."""
    if out.suffix.casefold() not in SUFFIXES:
        raise PlanError(f"--png {out}: pictures are written as {', '.join(SUFFIXES)}")
    if importlib.util.find_spec("matplotlib") is None:
        raise PlanError(missing("matplotlib"))


def draw_plan(plan: Plan, out: Path, *, title: str) -> None:
    """Draw a plan into a PNG, SVG or PDF file."""
    check_picture(out)
    from matplotlib import rc_context

    suffix = out.suffix.casefold()
    sheet = sheet_for(_bounds_m(plan))
    swath_in = plan.settings.swath_width_m / sheet.metres_per_inch
    dpi = min(max(SWATH_DOTS / swath_in, DPI_MIN), DPI_MAX)
    with rc_context(STYLE):
        content = content_of(_figure(plan, sheet, title), suffix, dpi=dpi)
    write_whole(out, content)


def _figure(plan: Plan, sheet: Sheet, title: str) -> Figure:
    from matplotlib.figure import Figure

    swath_pt = 72.0 * plan.settings.swath_width_m / sheet.metres_per_inch
    wide = sheet.map_in[0] + LEFT_IN + RIGHT_IN
    high = sheet.map_in[1] + BELOW_IN + ABOVE_IN
    figure = Figure(figsize=(wide, high), facecolor="white")
    axes = figure.add_axes(
        (LEFT_IN / wide, BELOW_IN / high, sheet.map_in[0] / wide, sheet.map_in[1] / high)
    )
    west, south, east, north = sheet.ground_m
    axes.set_xlim(west, east)
    axes.set_ylim(south, north)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color("0.75")
    seen = {"closed": _draw_field(axes, plan)} | _draw_strips(axes, plan, swath_pt=swath_pt)
    for sortie in plan.sorties:
        _draw_route(axes, sortie, swath_pt=swath_pt, points_per_m=72.0 / sheet.metres_per_inch)
    _draw_ends(axes, plan)
    _draw_depots(axes, plan)
    draw_below(axes, sheet.map_in[1])
    if plan.wind is not None:
        draw_wind(axes, sheet, plan.wind)
    write_title(figure, plan, title)
    write_legend(figure, plan, seen, left=(LEFT_IN + sheet.map_in[0] + 0.3) / wide)
    return figure


def _bounds_m(plan: Plan) -> tuple[float, float, float, float]:
    ways = [shapely.LineString(leg.points) for each in plan.sorties for leg in each.legs
            if leg.length_m > 0.0]  # fmt: skip
    west, south, east, north = shapely.total_bounds(
        np.array([plan.field.outline, *ways, shapely.MultiPoint(list(plan.depots))], dtype=object)
    ).tolist()
    return west, south, east, north


def _fill(axes: Axes, areas: Iterable[BaseGeometry], **style: Any) -> None:
    from matplotlib.collections import PathCollection

    from missions.maps.picture_ground import outline_of

    paths = [outline_of(part) for area in areas for part in polygons_of(area)]
    if paths:
        axes.add_collection(PathCollection(paths, **style), autolim=False)


def _draw_field(axes: Axes, plan: Plan) -> bool:
    """Draw the ground; return whether some of it is not to be sprayed."""
    field = plan.field
    _fill(axes, [field.outline], facecolors=FIELD, edgecolors="black", linewidths=1.3, zorder=1.0)
    closed = shapely.union_all([field.blocked, field.outline.difference(field.limit)])
    _fill(axes, [closed], facecolors="0.9", edgecolors=CLOSED, linewidths=0.8, zorder=1.5)
    others = closed.difference(shapely.union_all([ground for _, ground in field.closed]))
    for kind, ground in (*field.closed, (None, others.buffer(-SEEN_M))):
        colour, hatch, _ = KINDS[kind]
        _fill(axes, [ground], facecolors="none", edgecolors=colour, hatch=hatch, linewidths=0.8,
              zorder=1.6)  # fmt: skip
        if kind == "point":
            middles = shapely.get_coordinates(shapely.centroid(shapely.get_parts(ground)))
            axes.plot(*middles.T, linestyle="", marker="^", markersize=7, color=colour,
                      markeredgecolor="white", zorder=6.5)  # fmt: skip
    return not closed.is_empty


def _draw_strips(axes: Axes, plan: Plan, *, swath_pt: float) -> dict[str, bool]:
    """Draw what each sortie sprays, what is sprayed twice and what is left; say what there is."""
    boom = boom_of(plan.settings, plan.field)
    everything = []
    for sortie in plan.sorties:
        lines = np.array([[*leg.points[0], *leg.points[-1]] for leg in _sprayed(sortie)])
        if not len(lines):
            continue
        strips = boom.strips(lines)
        everything.append(strips)
        colour = colour_of(sortie.number)
        _fill(
            axes, strips, facecolors=[(*colour, 0.34)], edgecolors=[(*colour, 0.6)],
            linewidths=min(0.5, 0.03 * swath_pt), zorder=2.0,
        )  # fmt: skip
    strips = np.concatenate(everything)
    found = plan.treated
    twice = _seen(sprayed_twice(strips) if found is None else found.twice)
    # Ground of a line on which nothing is prescribed is not missed.
    planned = boom.united(plan.lines)
    skipped = shapely.difference(plan.field.limit, planned) if found is None else found.bare
    skipped = _seen(skipped)
    bare = _seen(shapely.difference(planned, whole(strips)))
    _fill(axes, [twice], facecolors=TWICE, alpha=0.38, linewidths=0.0, zorder=3.0)
    _fill(axes, [skipped], facecolors=SKIPPED, edgecolors=SKIPPED, linewidths=1.0, zorder=6.0)
    seen = {"twice": twice, "skipped": skipped, "bare": bare}
    return {name: not area.is_empty for name, area in seen.items()}


def _seen(area: BaseGeometry) -> BaseGeometry:
    half_m = SEEN_M / 2.0
    return area.buffer(-half_m, join_style="mitre").buffer(half_m, join_style="mitre")


def _sprayed(sortie: Sortie) -> list[Leg]:
    return [leg for leg in sortie.legs if leg.kind == "spray"]


def _draw_route(axes: Axes, sortie: Sortie, *, swath_pt: float, points_per_m: float) -> None:
    from matplotlib.collections import LineCollection

    dark = tuple(0.65 * part for part in colour_of(sortie.number))
    thin = min(1.1, max(0.12 * swath_pt, 0.25))
    styles = (("spray", "-", thin), ("transit", "-", 0.8 * thin), ("ferry", "--", thin))
    for kind, style, width in styles:
        ways = [leg.points for leg in sortie.legs if _drawn_as(leg) == kind and leg.length_m > 0.0]
        if ways:
            shade = "0.15" if kind == "transit" else dark
            axes.add_collection(
                LineCollection(ways, colors=[shade], linestyles=style, linewidths=width, zorder=4),
                autolim=False,
            )
    head_pt = min(9.0, max(0.9 * swath_pt, 3.0))
    for leg in _sprayed(sortie):
        _draw_arrows(axes, leg, dark, head_pt=head_pt, length_pt=leg.length_m * points_per_m)


def _drawn_as(leg: Leg) -> str:
    """Return the kind of a leg; what is flown at the height of ferries is drawn as one."""
    return leg.kind if leg.height_m is None else "ferry"


def _draw_arrows(
    axes: Axes, leg: Leg, colour: tuple[float, ...], *, head_pt: float, length_pt: float
) -> None:
    """Draw which way a line is flown, where it has room for that."""
    if length_pt < 3.0 * head_pt:
        return
    (x0, y0), (x1, y1) = leg.points[0], leg.points[-1]
    step = 0.5 * head_pt / length_pt
    for share in (0.5,) if length_pt < 40.0 * head_pt else (0.25, 0.75):
        x, y = x0 + share * (x1 - x0), y0 + share * (y1 - y0)
        axes.annotate(
            "", xy=(x + step * (x1 - x0), y + step * (y1 - y0)), xytext=(x, y),
            arrowprops={"arrowstyle": "-|>", "color": colour, "linewidth": 0.1 * head_pt,
                        "mutation_scale": head_pt, "shrinkA": 0.0, "shrinkB": 0.0},
            annotation_clip=False,
            zorder=5,
        )  # fmt: skip


def _draw_ends(axes: Axes, plan: Plan) -> None:
    """Draw where each sortie begins to spray, with its number, and where it ends."""
    crowd = min(1.0, 20.0 / len(plan.sorties))
    size_pt = 7.0 + 5.0 * crowd
    for sortie in plan.sorties:
        passes = _sprayed(sortie)
        if not passes:
            continue
        colour = tuple(0.75 * part for part in colour_of(sortie.number))
        (east_m, north_m), end = passes[0].points[0], passes[-1].points[-1]
        axes.plot(
            [end[0]], [end[1]], marker="X", markersize=0.7 * size_pt, color="white",
            markeredgecolor=colour, markeredgewidth=1.2,
            zorder=6.5,
        )  # fmt: skip
        axes.plot(
            [east_m], [north_m], marker="o", markersize=size_pt, color=colour,
            markeredgecolor="black", markeredgewidth=0.6,
            zorder=6.6,
        )  # fmt: skip
        axes.text(
            east_m, north_m, f"{sortie.number}", ha="center", va="center_baseline", color="white",
            fontsize=0.58 * size_pt, fontweight="bold",
            zorder=6.7,
        )  # fmt: skip


def _draw_depots(axes: Axes, plan: Plan) -> None:
    for number, (east_m, north_m) in enumerate(plan.depots, start=1):
        axes.plot(
            [east_m], [north_m], marker="s", markersize=13, color="black",
            markeredgecolor="white",
            zorder=7,
        )  # fmt: skip
        label = "D" if len(plan.depots) == 1 else str(number)
        axes.text(
            east_m, north_m, label, ha="center", va="center_baseline", color="white", fontsize=9,
            fontweight="bold",
            zorder=8,
        )  # fmt: skip


# What stands around a plan's picture: title, legend, scale and north (extra `plot`).

LEFT_IN, RIGHT_IN, BELOW_IN, ABOVE_IN = 0.4, 4.0, 0.9, 1.3
LISTED_MAX, ROW_IN = 26, 0.26
# Of the arrow of the wind.
WIND_IN, WIND = 0.6, "#1f5fa8"
SKIPPED, TWICE, CLOSED, FIELD = "#d0021b", "#1a1a1a", "#8a8a8a", "#f4f1ea"
# What is not sprayed, by its kind: colour, hatching, words.
KINDS: dict[Kind | None, tuple[str, str, str]] = {
    "point": ("#1b5e20", "", "tree or pole, with buffer"),
    "line": ("#8a4b00", "||||", "power line or wire, with corridor"),
    "area": ("#4a148c", "xxxx", "building or other obstacle"),
    "hole": (CLOSED, "////", "not to be sprayed: hole of the field"),
    "no spray": ("#b71c1c", "....", "not to be sprayed, may be crossed"),
    None: (CLOSED, "////", "not to be sprayed"),
}
Colour = tuple[float, float, float]


def colour_of(number: int) -> Colour:
    """Return a colour for a sortie: neighbours in the list are far apart on the wheel.

    >>> colour_of(1) != colour_of(2)
    True
    """
    hue = (0.58 + 0.381966 * (number - 1)) % 1.0
    return colorsys.hls_to_rgb(hue, (0.42, 0.55)[(number // 8) % 2], 0.62)


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
    doubled = "under two passes" if plan.closes else "twice"
    found = plan.treated
    treated = (
        f"covered {plan.coverage.percent:.2f} %"
        if found is None
        else f"treated {found.percent:.1f} %"
    )
    figures = (
        f"{plan.field.area_m2 / 1e4:.2f} ha    {plan.volume_l:,.1f} L    "
        f"{plan.times}    "
        f"{counted(count, 'sortie')}    {treated}    "
        f"{doubled} {plan.coverage.overlap_percent:.2f} %    "
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


def _speeds(plan: Plan) -> tuple[float, float]:
    speeds = [sortie.speeds_m_s for sortie in plan.sorties]
    return min(low for low, _ in speeds), max(high for _, high in speeds)


def _closed_handles(plan: Plan) -> list[Any]:
    """Return the legend of what is not sprayed, a row for each kind."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    found: list[Any] = []
    kinds: list[Kind | None] = [kind for kind, _ in plan.field.closed]
    for kind in kinds or [None]:
        colour, hatch, words = KINDS[kind]
        patch = Patch(facecolor="0.9", edgecolor=colour, hatch=hatch, label=words)
        mark = Line2D([], [], color=colour, marker="^", markersize=8, linestyle="", label=words)
        found.append(mark if kind == "point" else patch)
    return found


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
        closes = plan.closes and plan.treated is None
        label = "under two passes (valves close)" if closes else "sprayed twice"
        handles.append(Patch(facecolor=TWICE, alpha=0.45, label=label))
    if seen["skipped"]:
        handles.append(Patch(facecolor=SKIPPED, label="left unsprayed"))
    if seen["bare"]:
        handles.append(Patch(facecolor=FIELD, edgecolor="0.6", label="nothing prescribed"))
    if seen["closed"]:
        handles += _closed_handles(plan)
    room = max(4, math.floor((high_in - ABOVE_IN) / ROW_IN) - len(handles) - 2)
    listed = plan.sorties[: min(LISTED_MAX, room)]
    for sortie in listed:
        fill_l = min(plan.needs_l(sortie) + plan.settings.reserve_l, plan.settings.tank_l)
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
