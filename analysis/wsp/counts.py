"""How many drops fell on a card: by the law of overlap, and by the notches of the outlines.

Euler's law (`overlap`) needs the shares of free paper alone, and holds whatever small stains look
like. But how many drops of a few hundred hit each other is chance, which it cannot see. An outline
can: two drops that hit each other make one patch with two notches, so that patches plus half of
the notches are the drops but for those that hide in others and for notches that are not seen. How
many crossings there are in the mean follows from the length of the outlines (`notches`); of n
patches, V notches seen of a share q of crossings and B crossings in the mean that is

    drops = (n + V / 2 + B (1 / 4 - q / 2)) / (1 - covered),

since n + B / 4 is what overlap leaves of the drops in the mean and V has the mean q B. The two
counts are joined by their variances. A drop at the edge of the region counts where its middle lies
inside, which it does if more than half of it is to be seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from analysis.wsp.notches import crossings, notches, seen_share
from analysis.wsp.outlines import Outlines, outlines_of
from analysis.wsp.overlap import drops_px
from analysis.wsp.stains import Stains

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]

# What either count may be off beyond chance, of the pairs that it counts by law: blur joins about
# a tenth of stains that do not touch; the share of notches seen is known to about a third.
_JOINED, _SHARE_KNOWN = 0.1, 0.3
# Many more notches than crossings: the outlines are ragged, and notches tell nothing.
_RAGGED, _RAGGED_DEVIATIONS = 1.3, 8.0
# A light spot within a stain is no sign of several drops: holes up to a disc of 0.25 mm.
_HOLE_MM2 = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Counted:
    """A card as it is counted; `is_drop` tells which of the stains are those of drops."""

    grey: Bytes
    roi: Mask
    stains: Stains
    is_drop: Mask
    dpi: float


def drops_on(card: Counted) -> float | None:
    """Return the number of drops on the region; None where too little paper is free to tell."""
    roi_px = int(np.count_nonzero(card.roi))
    number = np.where(card.is_drop, np.arange(1, len(card.is_drop) + 1, dtype=np.int32), 0)
    labels = np.concatenate([np.zeros(1, dtype=np.int32), number])[card.stains.labels]
    stained, outlines = _outlined(card, labels > 0)
    by_law_px = drops_px(stained, card.roi)
    if not by_law_px:
        return by_law_px
    covered = int(np.count_nonzero(stained)) / roi_px
    touching, inside = at_edge(outlines, labels, card.stains.area_px)
    # Euler's law takes half of each drop at the edge.
    by_law = by_law_px * roi_px + (inside - touching / 2.0) / (1.0 - covered)
    seen = notches(outlines)
    expected = crossings(outlines.length_px, covered, roi_px)
    if seen > _RAGGED * expected + _RAGGED_DEVIATIONS * math.sqrt(expected + 1.0):
        return by_law
    share = seen_share(card.stains.area_px[card.is_drop])
    patches = outlines.patches - touching + inside
    by_notches = (patches + seen / 2.0 + expected * (0.25 - share / 2.0)) / (1.0 - covered)
    pairs = expected / 4.0
    law_variance = pairs + (_JOINED * pairs) ** 2
    hidden = (1.0 - share) * pairs
    notch_variance = hidden + (_SHARE_KNOWN * hidden) ** 2
    weight = law_variance / (law_variance + notch_variance) if pairs else 1.0
    return weight * by_notches + (1.0 - weight) * by_law


def _outlined(card: Counted, stained: Mask) -> tuple[Mask, Outlines]:
    """Return the stains with their light spots filled, and their outlines."""
    threshold = card.stains.threshold
    outlines = outlines_of(stained, card.grey, card.roi, threshold=threshold)
    if outlines.patches < np.count_nonzero(card.is_drop):  # else there is no hole
        stained = without_holes(stained, card.dpi / 25.4)
        outlines = outlines_of(stained, card.grey, card.roi, threshold=threshold)
    return stained, outlines


def without_holes(stained: Mask, px_per_mm: float) -> Mask:
    """Return the stains with their light spots filled; ground between stains stays free."""
    labels, count = ndimage.label(~stained)  # by sides: ground that touches by a corner is parted
    if count < 2:
        return stained
    areas = np.bincount(labels.ravel())
    is_spot = areas <= _HOLE_MM2 * px_per_mm**2
    is_spot[0] = False
    return np.asarray(stained | is_spot[labels])


def at_edge(
    outlines: Outlines, labels: NDArray[np.int32], area_px: NDArray[np.float64]
) -> tuple[int, int]:
    """Return how many stains the edge of the region cuts, and of how many the middle is inside.

    Half a disc, and half an ellipse, has pi / 8 of the square over its cut.
    """
    points = np.flatnonzero(outlines.at_edge)
    label = labels.ravel()[outlines.pixel[points]]
    points, label = points[label > 0], label[label > 0]
    order = np.argsort(label, kind="stable")
    points, label = points[order], label[order]
    first = np.flatnonzero(np.diff(label, prepend=0))
    if not len(first):
        return 0, 0
    across, down = (
        np.maximum.reduceat(axis[points], first) - np.minimum.reduceat(axis[points], first)
        for axis in (outlines.x, outlines.y)
    )
    cut_px = np.hypot(across, down) + 1.0
    is_inside = np.maximum(area_px[label[first] - 1], 1.0) > math.pi / 8.0 * cut_px**2
    return len(first), int(np.count_nonzero(is_inside))
