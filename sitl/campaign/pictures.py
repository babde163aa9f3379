"""Pictures of a campaign: responses, parallel coordinates, sensitivity."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from companion.errors import ConfigError
from companion.wording import install_command
from sitl.campaign.sensitivity import Index
from sitl.campaign.show import CONFIDENCE, Floats, Group, Rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RESPONSES, PARALLEL, SENSITIVITY = "responses.png", "parallel.png", "sensitivity.png"
POINTS_MAX, LINES_MAX = 3000, 800
BLUE, RED = "#0072B2", "#D55E00"


def draw_pictures(
    rows: Rows, groups: Sequence[Group], found: Sequence[Index], folder: Path
) -> list[Path]:
    """Draw what there is to be drawn, and return the files.

    Raises:
        ConfigError: without matplotlib, or where the folder cannot be written.
    """
    try:
        from matplotlib import rc_context

        from sitl.demo_style import DPI, STYLE
    except ImportError as error:
        raise ConfigError(
            f"no pictures without matplotlib; {install_command('campaign')}"
        ) from error
    with rc_context(STYLE):
        drawn = {
            RESPONSES: _responses(rows, groups),
            PARALLEL: _parallel(rows),
            SENSITIVITY: _sensitivity(rows, found),
        }
        files = []
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for name, figure in drawn.items():
                if figure is not None:
                    files.append(folder / name)
                    figure.savefig(files[-1], dpi=DPI, facecolor="white")
        except OSError as error:
            raise ConfigError(
                f"--plots {folder}: cannot be written ({error.strerror}); give a folder that can"
            ) from error
    return files


def _numeric(rows: Rows) -> dict[str, Floats]:
    """Return the settings that are numbers in every flight."""
    found = {}
    for name, column in rows.settings.items():
        if all(isinstance(value, int | float) for value in column):
            found[name] = np.array(column, dtype=np.float64)
    return found


def _title(rows: Rows, text: str) -> tuple[str, str]:
    flown = len(rows.flight) - rows.failed
    return text, f"{rows.manifest['name']}: {flown} of {rows.manifest['flights']} flights"


def _responses(rows: Rows, groups: Sequence[Group]) -> Figure | None:
    """Draw each figure over each setting: flights as dots, means with their intervals."""
    from sitl.demo_style import new_figure

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
            if row < len(rows.figures) - 1:
                axis.tick_params(labelbottom=False)
            else:
                axis.set_xlabel(setting, size=8)
    return figure


def _response(
    axis: Axes, values: Floats, places: Floats | None, groups: Sequence[Group], name: str
) -> None:
    at: Any = range(len(groups))
    if places is not None:
        some = slice(None, None, -(-len(values) // POINTS_MAX))
        axis.plot(places[some], values[some], ".", ms=2, color="0.75", mec="none", zorder=1)
        at = [group.middle for group in groups]
    else:
        axis.set_xticks(
            list(at), [group.value for group in groups], rotation=30, ha="right", size=7
        )
        axis.set_xlim(-0.5, len(groups) - 0.5)
    for x, group in zip(at, groups, strict=True):
        found = group.figures[name]
        if found is None:
            continue
        low, high = found.low, found.high
        half = [[0.0], [0.0]]
        if low is not None and high is not None:
            half = [[found.mean - low], [high - found.mean]]
        axis.errorbar(
            [x], [found.mean], yerr=half, fmt="o", ms=3.5, color=BLUE, capsize=2, zorder=2
        )


def _short(name: str) -> str:
    """Break a long name in two lines."""
    parts = name.split("_")
    half = (len(parts) + 1) // 2
    return "_".join(parts[:half]) + "\n" + "_".join(parts[half:])


def _parallel(rows: Rows) -> Figure | None:
    """Draw a line for each setting through all it was given and all it gave."""
    from matplotlib import colormaps

    from sitl.demo_style import new_figure

    everything = np.ones(len(rows.point), dtype=bool)
    columns = {name: rows.by_point(v, everything) for name, v in _numeric(rows).items()}
    figures = {name: rows.by_point(v, everything) for name, v in rows.figures.items()}
    figures = {name: v for name, v in figures.items() if not np.isnan(v).all()}
    if not columns or not figures:
        return None
    columns |= figures
    width = 1.6 * len(columns) + 1.0
    figure = new_figure(
        (max(width, 7.0), 4.4),
        *_title(rows, f"A line a setting, its colour by {next(iter(figures))}"),
    )
    axis = figure.add_axes((0.06, 0.2, 0.88, 0.6))
    data = np.column_stack(list(columns.values()))
    data = data[~np.isnan(data).any(axis=1)]
    data = data[:: max(-(-len(data) // LINES_MAX), 1)]
    if not len(data):
        return None
    low, span = data.min(axis=0), np.ptp(data, axis=0)
    scaled = np.where(span > 0.0, (data - low) / np.where(span > 0.0, span, 1.0), 0.5)
    first = scaled[:, len(columns) - len(figures)]
    order = np.argsort(first)
    for line in order.tolist():
        axis.plot(scaled[line], color=colormaps["viridis_r"](first[line]), lw=0.8, alpha=0.7)
    names = [_short(name) if name in figures else name.replace(".", "\n") for name in columns]
    axis.set_xticks(range(len(columns)), names, size=7)
    axis.set_xlim(0, len(columns) - 1)
    axis.set_yticks([])
    for place, (least, width_of) in enumerate(zip(low, span, strict=True)):
        axis.axvline(place, color="0.5", lw=0.8)
        axis.text(place, 1.03, f"{least + width_of:.3g}", ha="center", va="bottom", size=7)
        axis.text(place, -0.03, f"{least:.3g}", ha="center", va="top", size=7)
    axis.set_ylim(0.0, 1.0)
    axis.tick_params(axis="x", length=0, pad=16)
    for spine in axis.spines.values():
        spine.set_visible(False)
    return figure


def _sensitivity(rows: Rows, found: Sequence[Index]) -> Figure | None:
    """Draw every index with its interval: a panel a figure, for the first case."""
    from sitl.demo_style import new_figure

    if not found:
        return None
    shown = [each for each in found if each.case == found[0].case]
    figures = list(dict.fromkeys(each.figure for each in shown))
    settings = list(dict.fromkeys(each.setting for each in shown))
    kinds = list(dict.fromkeys(each.name for each in shown))
    width, height = 2.4 * len(figures) + 2.2, 0.5 * len(settings) + 1.6
    figure = new_figure(
        (width, height),
        *_title(rows, f"What matters: {', '.join(kinds)} with {CONFIDENCE:.0%} intervals"),
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
            half = [[e.value - e.low for e in each], [e.high - e.value for e in each]]
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
