"""Maps of the ground, cell by cell: prescribed and applied, deviation, duty; north is up.

As P2's Figs. 10, 15 and 16. Cells are rastered, so that a large field makes no large file.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from matplotlib import colormaps

from analysis.report.figures.sheet import NOTHING_COLOUR, Sheet, dress
from analysis.report.figures.style import DEVIATION_MAP, RATES_MAP, Drawn

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.colors import Colormap

    from analysis.assess.cell_maps import CellMaps
    from analysis.track import Floats

# A deviation map reaches at least this far, so that a good flight looks good.
# Cells on the border, which get nothing by rule, must not make all others white.
DEVIATION_MIN_PERCENT, DEVIATION_MAX_PERCENT, DEVIATION_PERCENTILE = 20.0, 50.0, 98.0
NOTHING_L_HA = 1e-6


def prescribed_and_applied(sheet: Sheet) -> Drawn:
    """Draw both maps with one scale of colours."""
    asked, given = sheet.cells.commanded_l_ha, sheet.cells.measured_l_ha
    least, most = _rates_shown(asked)
    figure, panels, bar = sheet.panels(2)
    colours = colormaps[RATES_MAP].with_extremes(under=NOTHING_COLOUR)
    nothing = (asked <= NOTHING_L_HA) & (given <= NOTHING_L_HA)
    for panel, values, title in zip(panels, (asked, given), ("prescribed", "applied"), strict=True):
        shown = np.where(nothing, -1.0, np.maximum(values, least))
        mesh = _mesh(panel, sheet, shown, colours, least, most)
        dress(panel, sheet, title, with_path=title == "applied")
    # One scale for both: the north names one axis of two maps side by side.
    panels[1].set_ylabel("" if not sheet.is_wide else "north [m]")
    panels[0].set_xlabel("" if sheet.is_wide else "east [m]")
    figure.colorbar(mesh, cax=bar, label="rate [L/ha]")
    return Drawn(
        name="map",
        title="Prescribed and applied",
        caption=f"{_cells_text(sheet.cells)} Dark is little, bright is much; grey is rate 0, "
        "white was not flown over. The thin line is the path of the vehicle, the black one "
        "the border.",
        alt="Two maps of the field with one scale of colours: the prescribed rate of each cell, "
        "and the rate that was applied.",
        kind="map",
        figure=figure,
    )


def _rates_shown(asked: Floats) -> tuple[float, float]:
    """Return the rates at both ends of the scale; from 0 where the least is not far from it."""
    known = asked[np.isfinite(asked) & (asked > 0.0)]
    if not len(known):
        return 0.0, 1.0
    least, most = (float(each) for each in np.percentile(known, [1.0, 99.9]))
    return (least if 0.5 * most < least < most else 0.0), most


def deviation(sheet: Sheet) -> Drawn:
    """Draw by how much each cell is off its rate."""
    error = sheet.cells.relative_error_percent
    known = np.abs(error[np.isfinite(error)])
    reach = float(np.percentile(known, DEVIATION_PERCENTILE)) if len(known) else 0.0
    reach = math.ceil(reach / 5.0) * 5.0
    reach = min(max(reach, DEVIATION_MIN_PERCENT), DEVIATION_MAX_PERCENT)
    figure, (panel,), scale = sheet.panels(1)
    mesh = _mesh(panel, sheet, error, DEVIATION_MAP, -reach, reach)
    dress(panel, sheet, "deviation")
    bar = figure.colorbar(mesh, cax=scale, extend="both")
    bar.set_label("deviation [%], + too much")
    return Drawn(
        name="deviation",
        title="Deviation",
        caption=f"{_cells_text(sheet.cells)} White: as prescribed; cells at the ends of a pass "
        "get less where nothing may fall outside the border. Grey: not flown over, or prescribed "
        "less than a tenth of the highest rate.",
        alt="Map of the relative deviation of each cell from its prescribed rate, red where too "
        "little was applied and blue where too much.",
        kind="map",
        figure=figure,
    )


def duty(sheet: Sheet) -> Drawn:
    """Draw the duty that the valves had over each cell."""
    figure, (panel,), scale = sheet.panels(1)
    mesh = _mesh(panel, sheet, 100.0 * sheet.cells.duty, RATES_MAP, 0.0, 100.0)
    dress(panel, sheet, "duty")
    figure.colorbar(mesh, cax=scale, label="duty [%]")
    return Drawn(
        name="duty",
        title="Duty of the valves",
        caption=f"{_cells_text(sheet.cells)} Mean of the orders in force.",
        alt="Map of the mean duty of the valves over each cell.",
        kind="map",
        figure=figure,
    )


def _cells_text(cells: CellMaps) -> str:
    whose = "the map's own cells" if cells.source == "map" else "square cells"
    return f"Mean of {whose} of {cells.cell_m:.2g} m."


def _mesh(
    panel: Axes, sheet: Sheet, values: Floats, colours: str | Colormap, low: float, high: float
) -> QuadMesh:
    return panel.pcolormesh(
        sheet.cells.corner_east_m,
        sheet.cells.corner_north_m,
        np.ma.masked_invalid(values),
        cmap=colours,
        vmin=low,
        vmax=high,
        rasterized=True,
    )
