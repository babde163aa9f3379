"""How often cells deviate by how much."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    from analysis.track import Floats, Ints

HISTOGRAM_BINS = 41


@dataclass(frozen=True, slots=True, kw_only=True)
class Histogram:
    """Deviations of cells in one unit: + is too much; `edges` has one value more than `counts`."""

    unit: Literal["L/ha", "L/min"]
    edges: Floats
    counts: Ints
    mean: float
    sd: float
    mean_abs: float
    sd_abs: float
    cells: int

    @staticmethod
    def of(values: Floats, unit: Literal["L/ha", "L/min"]) -> Histogram | None:
        """Return the histogram of the values that are numbers; None without any."""
        known = values[np.isfinite(values)]
        if not len(known):
            return None
        # Nearly all: a few cells at the edge would make all others one bar.
        most = max(float(np.quantile(np.abs(known), 0.99)), 1e-6)
        counts, edges = np.histogram(
            np.clip(known, -most, most), bins=HISTOGRAM_BINS, range=(-most, most)
        )
        distances = np.abs(known)
        return Histogram(
            unit=unit,
            edges=edges,
            counts=counts,
            mean=float(known.mean()),
            sd=float(known.std()),
            mean_abs=float(distances.mean()),
            sd_abs=float(distances.std()),
            cells=len(known),
        )

    def as_json(self) -> dict[str, Any]:
        """Return it without its bars."""
        return {
            "unit": self.unit, "mean": self.mean, "sd": self.sd,
            "mean_abs": self.mean_abs, "sd_abs": self.sd_abs, "cells": self.cells,
        }  # fmt: skip
