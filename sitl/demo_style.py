"""How the demo's pictures look: colours, letters, titles."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from analysis.report import figure_style
from analysis.report.figure_style import FAINT, INK, QUIET

if TYPE_CHECKING:
    from sitl.demo import DemoResult, Flown

__all__ = [
    "COLOURS",
    "DPI",
    "FAINT",
    "INK",
    "QUIET",
    "STYLE",
    "TITLES",
    "new_figure",
    "shown",
]

# Okabe and Ito's colours, told apart by all kinds of eyes.
COLOURS = {
    "none": "#D55E00",
    "look-ahead": "#E69F00",
    "look-ahead-stated": "#CC79A7",
    "scheduled": "#0072B2",
}
TITLES = {
    "none": "none",
    "look-ahead": "look-ahead 0.71 s",
    "look-ahead-stated": "look-ahead 0.97 s, as stated",
    "scheduled": "scheduled",
}
STYLE: dict[Any, Any] = {**figure_style.STYLE, "font.size": 9.0, "axes.titlesize": 10.0}
DPI = 150


def new_figure(size_in: tuple[float, float], title: str, subtitle: str) -> Figure:
    """Return a figure with its titles; no window and no state that outlives it."""
    figure = Figure(figsize=size_in)
    FigureCanvasAgg(figure)
    height_in = size_in[1]
    figure.text(0.02, 1.0 - 0.16 / height_in, title, size=14, weight="bold", va="top")
    figure.text(0.02, 1.0 - 0.47 / height_in, subtitle, size=9, color=QUIET, va="top")
    return figure


def shown(result: DemoResult) -> dict[str, Flown]:
    """Return the flights that pictures are made of, by method."""
    return {flown.job.method: flown for flown in result.flights if flown.traces is not None}
