"""The prescribed rate of ground itself, whatever strip comes over it: points, and whole cells."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import shapely

from analysis.assess.zone_lookup import lookup_of
from analysis.track import in_field

if TYPE_CHECKING:
    from analysis.track import Bools, Floats
    from companion.core.prescription import Prescription


def ground_rates(prescription: Prescription, east_m: Floats, north_m: Floats) -> Floats:
    """Return the rate at each point [L/ha]; NaN outside the field or without a rate."""
    found = np.full(len(east_m), np.nan)
    index = np.flatnonzero(in_field(prescription, east_m, north_m))
    lookup = lookup_of(prescription)
    keys, place = np.unique(lookup.keys(east_m[index], north_m[index]), return_inverse=True)
    rates = [prescription.rate_of(lookup.zones(key)) for key in keys.tolist()]
    found[index] = np.array([np.nan if rate is None else rate for rate in rates])[place]
    return found


def rates_of_squares(
    prescription: Prescription, west_m: Floats, south_m: Floats, size_m: float
) -> tuple[Bools, Floats]:
    """Return which squares no edge of zones or field comes near, and the rate of each of those.

    0 where nothing is prescribed. A map of cells has no edges to ask: no square is sure.
    """
    sure = np.full(len(west_m), prescription.cells is None)
    if prescription.cells is None and len(west_m):
        squares = shapely.box(west_m, south_m, west_m + size_m, south_m + size_m)
        met, _ = prescription.edges.tree.query(squares, predicate="intersects")
        sure[met] = False
    rates = np.full(len(west_m), np.nan)
    half_m = 0.5 * size_m
    middle = ground_rates(prescription, west_m[sure] + half_m, south_m[sure] + half_m)
    rates[sure] = np.nan_to_num(middle)
    return sure, rates
