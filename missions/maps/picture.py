"""A map as a picture: rates in colours, with legend, north and a scale.

With `ground` all that needs matplotlib here (extra `plot`), imported when it is asked for. Drawn is
what would be sprayed: the default rate as ground of its own, nothing beyond the map's boundary.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.errors import ShapelyError

from companion.core.frame import LocalFrame
from companion.map_pictures import draw_below
from companion.wording import lack_of
from missions.maps.build import frame_for
from missions.maps.cells import bounds_deg
from missions.maps.local import project_all
from missions.maps.model import MapFile, map_error, unusable_polygons, write_whole
from missions.maps.totals import Totals, as_sprayed, totals

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.figure import Figure

    from missions.maps.picture_ground import Colours

SUFFIXES = (".png", ".svg", ".pdf")
# 1600 by 1200 pixels at most; the map's own part of them, and what legend and title take.
DPI = 100
_MAP_MAX_IN, _MAP_MIN_IN = (11.6, 10.0), (5.0, 4.0)
_LEFT_IN, _RIGHT_IN, _BELOW_IN, _ABOVE_IN = 0.4, 4.0, 0.9, 1.1
_FONT = "DejaVu Sans"  # comes with matplotlib
STYLE: dict[Any, Any] = {"font.family": _FONT, "svg.hashsalt": "vrspray"}
# No date and no version in the file: the same map makes the same bytes.
_METADATA: dict[str, dict[str, str | None]] = {
    ".png": {"Software": None},
    ".svg": {"Date": None},
    ".pdf": {"CreationDate": None},
}


class Sheet(NamedTuple):
    """The paper: its size, the map's place on it in inches, and the ground in that place [m]."""

    size_in: tuple[float, float]
    map_in: tuple[float, float]
    ground_m: tuple[float, float, float, float]

    @property
    def metres_per_inch(self) -> float:
        """Return the scale."""
        return (self.ground_m[2] - self.ground_m[0]) / self.map_in[0]


def draw(
    map_file: MapFile, out: Path, *, title: str, names: Mapping[str, str] | None = None
) -> Totals:
    """Draw a map into a PNG, SVG or PDF file and return the ground of each rate.

    `names` are written on zones, by what these are called in the map.
    """
    suffix = out.suffix.casefold()
    if suffix not in SUFFIXES:
        raise map_error(
            out,
            f"pictures are not written as {suffix or 'a folder'}",
            fix=f"take one of {', '.join(SUFFIXES)}",
            code="unknown-format",
        )
    if importlib.util.find_spec("matplotlib") is None:
        text, fix = lack_of("matplotlib")
        raise map_error(out, text, fix=fix, code="missing-library")
    if not map_file.zones and map_file.cells is None:
        raise map_error(
            map_file.path, "there is nothing to draw", fix="name another file", code="no-polygon"
        )
    try:
        content, found = _drawn(map_file, title, suffix, names or {})
    except ShapelyError as error:
        raise unusable_polygons(map_file.path, error) from None
    write_whole(out, content)
    return found


def _drawn(
    map_file: MapFile, title: str, suffix: str, names: Mapping[str, str]
) -> tuple[bytes, Totals]:
    """Return the picture's bytes, and the ground of each rate."""
    from matplotlib import rc_context

    sprayed = as_sprayed(map_file)
    frame = frame_for(sprayed)
    found = totals(map_file, frame=frame)
    with rc_context(STYLE | {"hatch.linewidth": 0.6}):
        figure = _figure(sprayed, frame, found, title)
        _write_names(figure, sprayed, frame, names)
        return content_of(figure, suffix, dpi=DPI), found


def content_of(figure: Figure, suffix: str, *, dpi: float) -> bytes:
    """Return a figure as PNG, SVG or PDF: the same figure makes the same bytes."""
    content = BytesIO()
    figure.savefig(content, format=suffix[1:], dpi=dpi, metadata=_METADATA[suffix])
    return content.getvalue()


def _figure(map_file: MapFile, frame: LocalFrame, found: Totals, title: str) -> Figure:
    from matplotlib.figure import Figure

    from missions.maps.picture_ground import Colours, draw_ground

    sheet = sheet_for(_bounds_m(map_file, frame))
    wide, high = sheet.size_in
    figure = Figure(figsize=sheet.size_in, facecolor="white")
    axes = figure.add_axes(
        (
            _LEFT_IN / wide, _BELOW_IN / high, sheet.map_in[0] / wide, sheet.map_in[1] / high,
        )
    )  # fmt: skip
    west, south, east, north = sheet.ground_m
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color("0.75")
    colours = Colours.of(found.rates_l_ha)
    bare = draw_ground(
        axes, map_file, frame, colours,
        metres_per_inch=sheet.metres_per_inch, rated_ha=found.area_ha,
    )  # fmt: skip
    axes.set_xlim(west, east)
    axes.set_ylim(south, north)
    draw_below(axes, sheet.map_in[1])
    _title(figure, sheet, frame, found, title)
    draw_legend(
        figure,
        colours,
        found,
        left=(_LEFT_IN + sheet.map_in[0] + 0.3) / wide,
        top=1.0 - _ABOVE_IN / high,
        bare=bare,
        boundary=map_file.boundary is not None,
    )
    return figure


def _write_names(
    figure: Figure, map_file: MapFile, frame: LocalFrame, names: Mapping[str, str]
) -> None:
    """Write a name along each zone that has one, as large as it has room."""
    axes = figure.axes[0]
    point_m = np.ptp(axes.get_xlim()) / (axes.get_position().width * figure.get_figwidth() * 72.0)
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.3}
    for zone in map_file.zones:
        if (text := names.get(zone.name)) is None:
            continue
        (area,) = project_all(np.array([zone.geometry], dtype=object), frame)
        sides = np.diff(shapely.get_coordinates(shapely.oriented_envelope(area))[:3], axis=0)
        across, along = sorted(sides, key=lambda side: float(np.hypot(*side)))
        room_m = min(0.75 * np.hypot(*across), np.hypot(*along) / (0.65 * len(text)))
        angle_deg = (np.degrees(np.arctan2(along[1], along[0])) + 90.0) % 180.0 - 90.0
        at = shapely.centroid(area)
        axes.text(
            at.x, at.y, text, size=min(room_m / point_m, 12.0), rotation=angle_deg, bbox=box,
            rotation_mode="anchor", ha="center", va="center",
        )  # fmt: skip


def sheet_for(bounds_m: tuple[float, float, float, float]) -> Sheet:
    """Return a sheet for ground of this size; a narrow field gets more of its surroundings.

    >>> sheet = sheet_for((0.0, 0.0, 1000.0, 500.0))
    >>> sheet.map_in[0], round(sheet.map_in[1], 2)
    (11.6, 5.8)
    """
    west, south, east, north = bounds_m
    wide_m, high_m = max(east - west, 1.0) * 1.08, max(north - south, 1.0) * 1.08
    scale = max(wide_m / _MAP_MAX_IN[0], high_m / _MAP_MAX_IN[1])
    wide_in = max(wide_m / scale, _MAP_MIN_IN[0])
    high_in = max(high_m / scale, _MAP_MIN_IN[1])
    middle = (west + east) / 2, (south + north) / 2
    half = wide_in * scale / 2, high_in * scale / 2
    return Sheet(
        size_in=(wide_in + _LEFT_IN + _RIGHT_IN, high_in + _BELOW_IN + _ABOVE_IN),
        map_in=(wide_in, high_in),
        ground_m=(
            middle[0] - half[0], middle[1] - half[1], middle[0] + half[0], middle[1] + half[1],
        ),
    )  # fmt: skip


def _bounds_m(map_file: MapFile, frame: LocalFrame) -> tuple[float, float, float, float]:
    areas = [zone.geometry for zone in map_file.zones]
    if map_file.cells is not None:
        areas.append(shapely.box(*bounds_deg(map_file.cells)))
    if map_file.boundary is not None:
        areas.append(map_file.boundary)
    local = project_all(np.array(areas, dtype=object), frame)
    west, south, east, north = shapely.total_bounds(local).tolist()
    return west, south, east, north


def _title(figure: Figure, sheet: Sheet, frame: LocalFrame, found: Totals, title: str) -> None:

    wide, high = sheet.size_in
    fits = int(wide * 72.0 / (0.66 * 17.0))
    shown = printable(title)
    shown = shown if len(shown) <= fits else f"{shown[: fits - 3]}..."
    lines = (
        (shown, 17, "bold", 0.28),
        (
            f"application rate [L/ha]    {amount(found.area_ha)} ha    "
            f"{amount(found.all_litres)} L    "
            f"centre {frame.latitude_deg:.5f}, {frame.longitude_deg:.5f}",
            11, "normal", 0.66,
        ),
    )  # fmt: skip
    for text, size, weight, below_in in lines:
        figure.text(
            _LEFT_IN / wide, 1.0 - below_in / high, text,
            fontsize=size, fontweight=weight, va="top", parse_math=False,
        )  # fmt: skip


def printable(text: str) -> str:
    r"""Return text that the font has; what it lacks, such as Chinese, by its numbers.

    >>> printable("map \u5904")
    'map \\u5904'
    """
    from matplotlib.font_manager import FontProperties, findfont, get_font

    known = get_font(findfont(FontProperties(family=_FONT))).get_charmap()
    return "".join(
        one if ord(one) in known and one.isprintable() else one.encode("unicode_escape").decode()
        for one in text
    )


# The legend of a picture: what the colours mean, and the ground and the litres of each rate.


def draw_legend(
    figure: Figure,
    colours: Colours,
    found: Totals,
    *,
    left: float,
    top: float,
    bare: bool,
    boundary: bool,
) -> None:
    """Write what the colours mean, and the ground and the litres of each rate."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    from missions.maps.picture_ground import BARE, HATCH, LINE

    shown = found.rates_l_ha >= 0.0 if colours.are_listed else found.rates_l_ha == 0.0
    shades = colours(found.rates_l_ha[shown]).tolist()
    handles: list[Artist] = []
    for label, shade in zip(_lines_of(found, shown), shades, strict=True):
        handles.insert(0, Patch(facecolor=tuple(shade), edgecolor=LINE, label=label))
    if bare:
        handles.append(Patch(facecolor=BARE, edgecolor=HATCH, hatch="///", label="no rate"))
    if boundary:
        handles.append(Line2D([], [], color="black", linestyle="--", label="boundary"))
    high_in = figure.get_figheight()
    if not colours.are_listed:
        bar_in = min(5.0, 0.6 * high_in)
        axes = figure.add_axes((left, top - bar_in / high_in, 0.03, bar_in / high_in))
        figure.colorbar(colours.scale, cax=axes, label="L/ha")
        top -= (bar_in + 0.3) / high_in
    if handles:
        figure.legend(
            handles=handles, loc="upper left", bbox_to_anchor=(left, top), frameon=False,
            fontsize=11, borderaxespad=0.0, labelspacing=0.7, handlelength=2.2,
        )  # fmt: skip


def amount(value: float) -> str:
    """Return a number as a person writes it: with decimals where it is small.

    >>> amount(12345.6), amount(76.8062), amount(0.02881), amount(0.0)
    ('12,346', '76.8', '0.0288', '0')
    """
    if value >= 100.0:
        return f"{value:,.0f}"
    if value >= 1.0:
        return f"{value:.1f}" if value >= 10.0 else f"{value:.2f}"
    return f"{value:.3g}"


def _lines_of(found: Totals, shown: NDArray[np.bool_]) -> list[str]:
    """Return rate, ground and litres as columns; a figure space is as wide as a digit."""
    most = float(found.litres.max(initial=0.0))
    decimals = 0 if most >= 100.0 else 1 if most >= 10.0 else 2
    columns = [
        [f"{rate:.6g}" for rate in found.rates_l_ha[shown].tolist()],
        [
            f"{area:.2f}" if area >= 1.0 else f"{area:.4f}"
            for area in found.areas_ha[shown].tolist()
        ],
        [f"{litres:,.{decimals}f}" for litres in found.litres[shown].tolist()],
    ]
    widths = [max(map(len, column), default=0) for column in columns]
    rows = zip(*columns, strict=True)
    return [
        "    ".join(
            text.rjust(width, "\N{FIGURE SPACE}") + unit
            for text, width, unit in zip(row, widths, (" L/ha", " ha", " L"), strict=True)
        )
        for row in rows
    ]
