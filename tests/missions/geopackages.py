"""GeoPackages to be read in tests, written by GDAL."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely

from companion.errors import MapError
from missions.maps.assemble import crs_of, map_of
from missions.maps.fields import Given
from missions.maps.geopackage import read_geopackage
from missions.maps.model import Layer, MapFile
from tests.missions.two_grounds import RING, TWO


def by_gdal(
    path: Path,
    *,
    grounds: Sequence[shapely.Geometry | None] = (RING, TWO),
    rates: Sequence[float] = (12.5, np.nan),
    field: str = "rate",
    layer: str = "rx",
    crs: str | None = "EPSG:4326",
    geometry_type: str = "Unknown",
    append: bool = False,
    blobs: Sequence[bytes] | None = None,
    **options: str,
) -> Path:
    pyogrio.raw.write(
        str(path),
        np.array(
            blobs
            or [None if one is None else shapely.to_wkb(one, flavor="iso") for one in grounds],
            dtype=object,
        ),
        [np.array(rates, dtype=np.float64), np.array(["l/ha"] * len(rates), dtype=object)],
        [field, "unit"],
        geometry_type=geometry_type,
        crs=crs,
        driver="GPKG",
        layer=layer,
        append=append,
        layer_options=options,
    )
    return path


def understood(layer: Layer, path: Path) -> MapFile:
    return map_of(layer, path, rate_field=None, crs=None, given=Given())


def refused(path: Path, layer: str | None = None) -> MapError:
    with pytest.raises(MapError) as caught:
        crs_of(read_geopackage(path, layer), path, None)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(path))
    assert caught.value.fix
    return caught.value
