"""Readers of exports that are not ours: GDAL's tables and shapes, as plain Python."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio.raw
import shapely
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Layer:
    """A layer as GDAL reads it."""

    columns: dict[str, NDArray[Any]]
    shapes: NDArray[np.object_]
    crs: str | None

    def numbers(self, name: str) -> NDArray[np.float64]:
        """Return a column of numbers, NaN for nothing, whatever GDAL takes it for."""
        values = self.columns[name]
        if values.dtype != object:
            return values.astype(np.float64)
        return np.array([float(each) if each else float("nan") for each in values])

    def milliseconds(self, name: str) -> NDArray[np.int64]:
        """Return a column of times as milliseconds since 1970."""
        values = self.columns[name]
        if values.dtype == object:
            assert all(each.endswith("Z") for each in values)
            values = np.array([each[:-1] for each in values], dtype="datetime64[ms]")
        return values.astype("datetime64[ms]").astype(np.int64)


def read_layer(path: Path, layer: str | None = None) -> Layer:
    """Return a layer, the only one by default."""
    # Times as text: for one that is missing pyogrio makes a NaT without a unit, which NumPy 2.5
    # warns of.
    about, _, wkb, values = pyogrio.raw.read(path, layer=layer, datetime_as_string=True)
    shapes = np.array([]) if wkb is None else shapely.from_wkb(wkb)
    return Layer(
        columns=dict(zip(about["fields"].tolist(), values, strict=True)),
        shapes=shapes,
        crs=about["crs"],
    )
