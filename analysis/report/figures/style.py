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
RATES_MAP, DEVIATION_MAP = "viridis", "RdBu"
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.titlelocation": "left",
    "axes.titlesize": 10.0,
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
# Nothing of the program, the day or the network in an SVG.
# A third of the time for a tenth more of bytes.
PNG: dict[str, Any] = {"compress_level": 3}
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


@contextmanager
def styled() -> Iterator[None]:
    """Draw in this style, and leave no setting behind."""
    with mpl.rc_context(STYLE):
        yield


def new_figure(height_in: float, width_in: float = WIDTH_IN) -> Figure:
    """Return an empty figure; no window and no state that outlives it."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def laid_out(drawn: Drawn) -> Drawn:
    """Return a figure whose parts have found their places; they would be sought at every save."""
    engine = drawn.figure.get_layout_engine()
    if engine is not None:
        engine.execute(drawn.figure)
        drawn.figure.set_layout_engine("none")
    return drawn


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
