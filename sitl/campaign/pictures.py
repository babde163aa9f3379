"""Pictures of a campaign: responses, parallel coordinates, sensitivity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from companion.wording import writing
from sitl.campaign.show import CONFIDENCE, Floats, Group, Index, Rows, shown_value

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RESPONSES, PARALLEL, SENSITIVITY = "responses.png", "parallel.png", "sensitivity.png"
POINTS_MAX, LINES_MAX = 3000, 800
# Values of a text that are written at its axis.
WORDS_MAX = 16
BLUE, RED = "#0072B2", "#D55E00"


def draw_pictures(
    rows: Rows, groups: Sequence[Group], found: Sequence[Index], folder: Path
) -> list[Path]:
    """Draw what there is to be drawn, and return the files.

    Raises:
        ConfigError: where the folder cannot be written.
    """
    from matplotlib import rc_context

    from sitl.demo_pictures import DPI, STYLE

    with rc_context(STYLE):
        drawn = {
            RESPONSES: _responses(rows, groups),
            PARALLEL: _parallel(rows),
            SENSITIVITY: _sensitivity(rows, found),
        }
        files = []
        with writing(f"--plots {folder}"):
            folder.mkdir(parents=True, exist_ok=True)
            for name, figure in drawn.items():
                if figure is not None:
                    files.append(folder / name)
                    figure.savefig(files[-1], dpi=DPI, facecolor="white")
    return files


def _numeric(rows: Rows) -> dict[str, Floats]:
    """Return the settings that are numbers in every flight."""
    found = {}
    for name, column in rows.settings.items():
        if all(isinstance(v, int | float) and not isinstance(v, bool) for v in column):
            found[name] = np.array(column, dtype=np.float64)
    return found


def _title(rows: Rows, text: str) -> tuple[str, str]:
    flown = len(rows.flight) - rows.failed
    return text, f"{rows.manifest['name']}: {flown} of {rows.manifest['flights']} flights"


def _responses(rows: Rows, groups: Sequence[Group]) -> Figure | None:
    """Draw each figure over each setting: flights as dots, means with their intervals."""
    from sitl.demo_pictures import new_figure

    settings = list(dict.fromkeys(group.setting for group in groups))
    if not rows.settings:
        return None
    width, height = 2.6 * len(settings) + 0.8, 1.7 * len(rows.figures) + 1.1
    figure = new_figure(
        (max(width, 6.0), height),
        *_title(rows, f"Each figure by setting, mean with its {CONFIDENCE:.0%} interval"),
    )
    axes = figure.subplots(len(rows.figures), len(settings), squeeze=False, sharey="row")
    figure.subplots_adjust(
        left=0.9 / width, right=1.0 - 0.15 / width, top=1.0 - 0.75 / height,
        bottom=0.75 / height, wspace=0.08, hspace=0.16,
    )  # fmt: skip
    numeric = _numeric(rows)
    for column, setting in enumerate(settings):
        of_setting = [group for group in groups if group.setting == setting]
        for row, name in enumerate(rows.figures):
            axis = axes[row][column]
            _response(axis, rows.figures[name], numeric.get(setting), of_setting, name)
            if column == 0:
                axis.set_ylabel(_short(name), size=7)
            if row == 0 and of_setting[0].within:
                axis.legend(fontsize=6)
            if row < len(rows.figures) - 1:
                axis.tick_params(labelbottom=False)
            else:
                axis.set_xlabel(setting, size=8)
    return figure


def _response(
    axis: Axes, values: Floats, places: Floats | None, groups: Sequence[Group], name: str
) -> None:
    words = list(dict.fromkeys(group.value for group in groups))
    if places is not None:
        some = slice(None, None, -(-len(values) // POINTS_MAX))
        axis.plot(places[some], values[some], ".", ms=2, color="0.75", mec="none", zorder=1)
    else:
        axis.set_xticks(range(len(words)), words, rotation=30, ha="right", size=7)
        axis.set_xlim(-0.5, len(words) - 0.5)
    # Cases have a colour each, and one name in the legend.
    series = list(dict.fromkeys(", ".join(group.within.values()) for group in groups))
    named: set[str] = set()
    for group in groups:
        found, of = group.figures[name], ", ".join(group.within.values())
        if found is None:
            continue
        half = _halves([(found.low, found.mean, found.high)])
        at: Any = words.index(group.value) if group.middle is None else group.middle
        axis.errorbar(
            [at], [found.mean], yerr=half, fmt="o", ms=3.5, capsize=2, zorder=2,
            color=BLUE if len(series) == 1 else f"C{series.index(of)}",
            label=None if of in named else of or None,
        )  # fmt: skip
        named.add(of)


def _halves(ends: Sequence[tuple[float | None, float, float | None]]) -> Any:
    """Return how far intervals reach to both sides; None where one has none."""
    sides = [
        (at - low, high - at) for low, at, high in ends if low is not None and high is not None
    ]
    return list(zip(*sides, strict=True)) if len(sides) == len(ends) else None


def _short(name: str) -> str:
    """Break a long name in two lines."""
    parts = name.split("_")
    half = (len(parts) + 1) // 2
    return "_".join(parts[:half]) + "\n" + "_".join(parts[half:])


@dataclass(frozen=True, slots=True)
class _Column:
    """An axis of parallel coordinates: where each setting's line crosses it, 0 to 1, and its marks.

    A number has its least and greatest value as marks, a text each of its values.
    """

    places: Floats
    marks: tuple[tuple[float, str], ...]


def _of_numbers(values: Floats) -> _Column:
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if not high > low:
        return _Column(np.where(np.isnan(values), np.nan, 0.5), ((0.5, f"{low:.3g}"),))
    marks = ((0.0, f"{low:.3g}"), (1.0, f"{high:.3g}"))
    return _Column((values - low) / (high - low), marks)


def _of_words(values: Sequence[Any]) -> _Column:
    words = list(dict.fromkeys(shown_value(value) for value in values))
    at = {word: (n + 0.5) / len(words) for n, word in enumerate(words)}
    marks = list(at.items())[:: -(-len(words) // WORDS_MAX)]
    places = np.array([at[shown_value(value)] for value in values])
    return _Column(places, tuple((place, word) for word, place in marks))


def _columns(rows: Rows) -> tuple[dict[str, _Column], dict[str, _Column]]:
    """Return an axis for each varied setting, and for each figure that there is."""
    everything = np.ones(len(rows.point), dtype=bool)
    _, first = np.unique(rows.point, return_index=True)
    numeric = _numeric(rows)
    settings = {
        name: _of_numbers(numeric[name][first])
        if name in numeric
        else _of_words([column[row] for row in first.tolist()])
        for name, column in rows.settings.items()
    }
    means = {name: rows.by_point(values, everything) for name, values in rows.figures.items()}
    known = {name: values for name, values in means.items() if not np.isnan(values).all()}
    return settings, {name: _of_numbers(values) for name, values in known.items()}


def _parallel(rows: Rows) -> Figure | None:
    """Draw a line for each setting through all it was given and all it gave."""
    from matplotlib import colormaps

    from sitl.demo_pictures import new_figure

    settings, figures = _columns(rows)
    if not settings or not figures:
        return None
    columns = settings | figures
    data = np.column_stack([column.places for column in columns.values()])
    data = data[~np.isnan(data).any(axis=1)]
    data = data[:: max(-(-len(data) // LINES_MAX), 1)]
    if not len(data):
        return None
    figure = new_figure(
        (max(1.6 * len(columns) + 1.0, 7.0), 4.4),
        *_title(rows, f"A line a setting, its colour by {next(iter(figures))}"),
    )
    axis = figure.add_axes((0.06, 0.2, 0.88, 0.6))
    first = data[:, len(settings)]
    for line in np.argsort(first).tolist():
        axis.plot(data[line], color=colormaps["viridis_r"](first[line]), lw=0.8, alpha=0.7)
    names = [_short(name) if name in figures else name.replace(".", "\n") for name in columns]
    axis.set_xticks(range(len(columns)), names, size=7)
    axis.set_xlim(0, len(columns) - 1)
    axis.set_yticks([])
    for place, column in enumerate(columns.values()):
        axis.axvline(place, color="0.5", lw=0.8)
        for height, text in column.marks:
            _mark(axis, place, height, text)
    axis.set_ylim(0.0, 1.0)
    axis.tick_params(axis="x", length=0, pad=16)
    for spine in axis.spines.values():
        spine.set_visible(False)
    return figure


def _mark(axis: Axes, place: float, height: float, text: str) -> None:
    """Write a value at its axis: the ends of numbers above and below it, others beside it."""
    if height in (0.0, 1.0):
        up = height == 1.0
        at, side = (1.03, "bottom") if up else (-0.03, "top")
        axis.text(place, at, text, ha="center", va=side, size=7)
        return
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0}
    axis.text(place, height, text, ha="center", va="center", size=7, bbox=box)


def _sensitivity(rows: Rows, found: Sequence[Index]) -> Figure | None:
    """Draw every index with its interval: a panel a figure, for the first case."""
    from sitl.demo_pictures import new_figure

    if not found:
        return None
    shown = [each for each in found if each.case == found[0].case]
    figures = list(dict.fromkeys(each.figure for each in shown))
    settings = list(dict.fromkeys(each.setting for each in shown))
    kinds = list(dict.fromkeys(each.name for each in shown))
    width, height = 2.4 * len(figures) + 2.2, 0.5 * len(settings) + 1.6
    figure = new_figure(
        (width, height),
        *_title(rows, f"What matters: {', '.join(kinds)}{_said(shown)}"),
    )
    axes = figure.subplots(1, len(figures), squeeze=False, sharey=True)[0]
    figure.subplots_adjust(
        left=2.1 / width, right=1.0 - 0.2 / width, top=1.0 - 0.95 / height,
        bottom=0.4 / height, wspace=0.12,
    )  # fmt: skip
    for axis, name in zip(axes, figures, strict=True):
        for number, kind in enumerate(kinds):
            each = [e for e in shown if (e.figure, e.name) == (name, kind)]
            at = [
                settings.index(e.setting) + 0.25 * (number - 0.5 * (len(kinds) - 1)) for e in each
            ]
            half = _halves([(e.low, e.value, e.high) for e in each])
            colour = (BLUE, RED)[number % 2]
            axis.errorbar(
                [e.value for e in each], at, xerr=half, fmt="o", ms=4, color=colour, capsize=2,
                label=kind,
            )  # fmt: skip
        axis.axvline(0.0, color="0.6", lw=0.8)
        axis.set_title(_short(name), size=7)
    axes[0].set_yticks(range(len(settings)), settings)
    axes[0].invert_yaxis()
    if len(kinds) > 1:
        axes[-1].legend(fontsize=7)
    return figure


def _said(shown: Sequence[Index]) -> str:
    if any(each.low is None for each in shown):
        return ", of too few samples for intervals"
    return f" with {CONFIDENCE:.0%} intervals"
