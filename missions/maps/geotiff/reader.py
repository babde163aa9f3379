"""GeoTIFF: rows and columns of rates, with a world file beside it or without.

The file's own position holds; a world file says where the map lies when the file does not. What
its bands are, an `adapt.json` beside it may say, or their own names.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from missions.maps.adapt.catalogue import Operation, described_beside
from missions.maps.bundle import Bundle, files_beside
from missions.maps.geotiff.bands import (
    ReadBand,
    class_problem,
    difference,
    parse_world_file,
    usable,
    world_file_of,
)
from missions.maps.geotiff.file import Raster, read_raster
from missions.maps.layer import Band, Grid, digest
from missions.maps.model import Affine, Problem, map_error

# What programs fill with lies below and above all indices, reflectances and yields.
FILL_LEAST, FILL_MOST = 5_000.0, 65_000.0


def read_geotiff(path: Path, layer: str | None = None) -> Grid:
    """Return what a GeoTIFF holds; `layer` is the number of one of several pictures in it."""
    found = described_beside(path, layer)
    bundle = files_beside(path)
    if found is None:
        return grid_of_tiff(bundle, path.name, layer=layer)
    operation, content = found
    return grid_of_tiff(
        bundle, path.name, format="adapt", operation=operation, also={"adapt.json": content}
    )


def read_bands(path: Path, layer: str | None = None) -> Grid:
    """Return the bands of a GeoTIFF as measurements, which are no rates and may be negative."""
    bundle = files_beside(path)
    content = bundle.read(path.name)
    raster = read_raster(content, path, layer=layer, described=False, colours=True)
    if not raster.bands:
        raise map_error(
            path, "it has no band of values", fix="export the raster again", code="no-rate-column"
        )
    for one in raster.bands:
        values = one.band.values
        if one.fault is None or one.fault.code != "nodata-undeclared":
            continue
        # A fill is far from all measurements; a single negative index is one.
        if not float(np.nanmin(values)) >= -FILL_LEAST or float(np.nanmax(values)) > FILL_MOST:
            raise one.fault
    rows, columns = raster.bands[0].band.values.shape
    name = world_file_of(bundle, path.name)
    world = None
    if name is not None:
        alone = raster.transform is None
        world = parse_world_file(bundle.read(name), bundle.path / name, alone=alone)
    transform, moved = _placed(raster, world, (rows, columns), path)
    return Grid(
        format="geotiff",
        crs=raster.crs,
        transform=transform,
        bands=_told_apart([one.band for one in raster.bands]),
        sha256=digest([content]),
        problems=(*moved, *(problem for one in raster.bands for problem in one.problems)),
    )


def grid_of_tiff(
    bundle: Bundle,
    name: str,
    *,
    layer: str | None = None,
    format: str = "geotiff",
    operation: Operation | None = None,
    also: dict[str, bytes] | None = None,
) -> Grid:
    """Return the GeoTIFF `name` of a bundle; `also` are files of the map that others have read."""
    path = bundle.path / name
    content = bundle.read(name)
    files = {**(also or {}), name: content}
    raster = read_raster(content, path, layer=layer, described=operation is not None)
    if not raster.bands:
        raise map_error(
            path, "it has no band of values", fix="export the map again", code="no-rate-column"
        )
    shape = raster.bands[0].band.values.shape
    world_name = world_file_of(bundle, name)
    world = None
    if world_name is not None:
        files[world_name] = bundle.read(world_name)
        world = parse_world_file(
            files[world_name], bundle.path / world_name, alone=raster.transform is None
        )
    transform, moved = _placed(raster, world, (shape[0], shape[1]), path)
    bands, said = _bands(raster, operation, path)
    return Grid(
        format=format,
        crs=raster.crs,
        transform=transform,
        bands=bands,
        sha256=digest(files[one] for one in sorted(files)),
        unit=raster.unit,
        problems=(*moved, *said),
    )


def _placed(
    raster: Raster, world: Affine | None, shape: tuple[int, int], path: Path
) -> tuple[Affine, list[Problem]]:
    """Return where the cells lie: by the file itself, else by its world file."""
    if raster.transform is None and world is None:
        raise map_error(
            path,
            "it does not say where it lies",
            fix="export it as GeoTIFF, or copy its .tfw beside it",
            code="not-georeferenced",
        )
    if raster.transform is None or world is None:
        return raster.transform or world or (1.0, 0.0, 0.0, 0.0, 1.0, 0.0), []
    problem = difference(raster.transform, world, shape, raster.crs, path)
    return raster.transform, [problem] if problem is not None else []


def _bands(
    raster: Raster, operation: Operation | None, path: Path
) -> tuple[tuple[Band, ...], list[Problem]]:
    """Return the bands by names that tell them apart, and what there is to say about them."""
    if operation is not None:
        return _described(raster.bands, operation, path)
    bands = _told_apart(usable(raster.bands))
    problems = [problem for one in raster.bands for problem in one.problems]
    for band in bands:
        looks = class_problem(band) if (band.unit or raster.unit) is None else None
        problems += [looks] if looks is not None else []
    return bands, problems


def _described(
    found: Sequence[ReadBand], operation: Operation, path: Path
) -> tuple[tuple[Band, ...], list[Problem]]:
    """Return the bands that the description names, as it names them, and no others."""
    chosen: list[ReadBand] = []
    for variable in operation.variables:
        if variable.index is None or not 1 <= variable.index <= len(found):
            raise map_error(
                path,
                f"its adapt.json puts {variable.name} in band {variable.index} of {len(found)}",
                fix="copy the files again, or export the map again",
                code="wrong-description",
            )
        one = found[variable.index - 1]
        band = replace(
            one.band,
            name=variable.name,
            unit=variable.unit,
            is_rate=variable.is_rate,
            default=variable.default,
        )
        problems = tuple(replace(problem, where=band.name) for problem in one.problems)
        chosen.append(replace(one, band=band, problems=problems))
        if problems and variable.default:
            raise map_error(
                path,
                f"0 is no data in {band.name}, and its adapt.json prescribes "
                f"{variable.default:g} where there are none",
                fix="export the map with -9999 for no data",
                code="nodata-zero",
            )
    usable([one for one in chosen if one.band.is_rate])
    return tuple(one.band for one in chosen), [
        problem for one in chosen for problem in one.problems
    ]


def _told_apart(bands: Sequence[Band]) -> tuple[Band, ...]:
    """Return the bands with their numbers behind names that several of them have."""
    count = Counter(band.name for band in bands)
    return tuple(
        band if count[band.name] == 1 else replace(band, name=f"{band.name} (band {number})")
        for number, band in enumerate(bands, start=1)
    )
