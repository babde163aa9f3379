"""How the figures look, and how they become files: letters, colours, PNG, SVG for a page."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

INK, QUIET, FAINT, GRID = "#222222", "#555555", "#8A8A8A", "#E4E4E4"
# Okabe and Ito's colours, told apart by all kinds of eyes.
BLUE, ORANGE, GREEN, RED, PURPLE, YELLOW, SKY = (
    "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#F0E442", "#56B4E9",
)  # fmt: skip
# As in all maps of the program: more is darker. Of a deviation, red is too little, blue too much,
# and darker is further off.
RATES_MAP, DEVIATION_MAP = "viridis_r", "RdBu"
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 10.0,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.titlelocation": "left",
    "axes.titlesize": 11.0,
    # Where it is in any case: else every label is measured once more for each file.
    "axes.titley": 1.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    # Letters stay letters: small files, and text that can be searched and read out.
    "svg.fonttype": "none",
    # The same flight gives the same file.
    "svg.hashsalt": "vrspray",
}
DPI = 120
WIDTH_IN = 9.0
MARGINS_IN = (0.85, 0.25, 0.6, 0.4)
# A third of the time for a tenth more of bytes.
PNG: dict[str, Any] = {"compress_level": 3}
# Nothing of the program, the day or the network in an SVG.
_NO_METADATA = {"Creator": None, "Date": None, "Format": None, "Type": None}

Kind = Literal["chart", "map"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Drawn:
    """A figure with what is said of it; a chart stands in the page as SVG, a map as PNG."""

    name: str
    title: str
    caption: str
    alt: str
    kind: Kind
    figure: Figure

    @property
    def width(self) -> float:
        """Return its share of the page's width."""
        return min(float(self.figure.get_figwidth()) / WIDTH_IN, 1.0)


def stamp(figure: Figure, mark: str) -> None:
    """Write a mark into the upper right corner: a figure travels without its page."""
    if mark:
        figure.text(0.995, 0.995, mark, ha="right", va="top", size=9, weight="bold", color=RED)


@contextmanager
def styled() -> Iterator[None]:
    """Draw in this style, and leave no setting behind."""
    with mpl.rc_context(STYLE):
        yield


def new_figure(
    height_in: float,
    width_in: float = WIDTH_IN,
    *,
    margins_in: tuple[float, float, float, float] = MARGINS_IN,
) -> Figure:
    """Return an empty figure; no window and no state that outlives it.

    Margins are left, right, bottom and top, in inches: to have matplotlib seek them costs as much
    as to draw the figure.
    """
    figure = Figure(figsize=(width_in, height_in))
    FigureCanvasAgg(figure)
    left, right, bottom, top = margins_in
    figure.subplots_adjust(
        left=left / width_in,
        right=1.0 - right / width_in,
        bottom=bottom / height_in,
        top=1.0 - top / height_in,
    )
    return figure


def png_of(drawn: Drawn) -> bytes:
    """Return a figure as PNG."""
    file = io.BytesIO()
    drawn.figure.savefig(file, format="png", dpi=DPI, metadata={"Software": None}, pil_kwargs=PNG)
    return file.getvalue()


def svg_of(drawn: Drawn) -> str:
    """Return a figure as an SVG document."""
    file = io.StringIO()
    drawn.figure.savefig(file, format="svg", dpi=DPI, metadata=_NO_METADATA)
    return file.getvalue()


def inline_svg(drawn: Drawn, document: str) -> str:
    """Return an SVG document as a part of a page: no prologue, names of its own, an alt text.

    Every document of matplotlib calls its parts the same; in one page they would be mixed up.
    """
    body = document[document.index("<svg") :]
    body = re.sub(r'\bid="', f'id="{drawn.name}-', body)
    body = re.sub(r"url\(#", f"url(#{drawn.name}-", body)
    body = re.sub(r'(?:xlink:)?href="#', f'href="#{drawn.name}-', body)
    body = body.replace("xlink:href=", "href=")
    # Their style is meant for their own parts, and would be the page's.
    body = re.sub(r"<style[^>]*>\*\{", f"<style>#{drawn.name}-figure_1 *{{", body)
    body = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", body)
    head, tail = body.split(">", 1)
    head = re.sub(r'\s(width|height)="[^"]*"', "", head)
    return f'{head} role="img" aria-label="{_attribute(drawn.alt)}">{tail}'


def _attribute(text: str) -> str:
    return text.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
