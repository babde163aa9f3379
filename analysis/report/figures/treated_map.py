"""Where was sprayed: the treated area that the record of the application has as geodata."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import shapely
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from analysis.report.figures.sheet import dress
from analysis.report.figures.style import SKY, Drawn

if TYPE_CHECKING:
    from analysis.report.figures.sheet import Sheet
    from analysis.report.treated import Treated


def treated_area(sheet: Sheet, treated: Treated) -> Drawn:
    """Draw the treated area over the zones."""
    figure, (panel,), _ = sheet.panels(1, has_bar=False)
    panel.add_patch(PathPatch(_path(treated), facecolor=SKY, edgecolor="none", rasterized=True))
    dress(panel, sheet, f"{treated.area_ha:.4f} ha")
    return Drawn(
        name="treated",
        title="Treated area",
        caption="Blue: where the spray of open valves fell, as the record of the application has "
        "it as geodata; ground sprayed twice counts once. Black: the border.",
        alt=f"Map of the treated area, {treated.area_ha:.4f} hectares, within the field's border.",
        kind="map",
        figure=figure,
    )


def _path(treated: Treated) -> Path:
    """Return the area as one path; rings that turn the other way are holes."""
    parts = shapely.orient_polygons(shapely.get_parts(treated.area))
    places, codes = [], []
    for ring in shapely.get_rings(parts):
        corners = shapely.get_coordinates(ring)
        kinds = np.full(len(corners), Path.LINETO, dtype=np.uint8)
        kinds[0], kinds[-1] = Path.MOVETO, Path.CLOSEPOLY
        places.append(corners)
        codes.append(kinds)
    return Path(np.concatenate(places), np.concatenate(codes))
