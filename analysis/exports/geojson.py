"""As-applied points or ground as GeoJSON (RFC 7946), in one document or a feature a line.

A document says what it is in a member `vrspray` beside the features, which other programs pass
over (RFC 7946, section 6.1); of a feature a line, every one has the facts of the flight.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely

from companion.map_formats import DEGREE_DECIMALS, GEOJSON_TAIL, geojson_head

if TYPE_CHECKING:
    from analysis.exports.output import Content
    from analysis.exports.source import Source

_BLOCK = 5_000


def make(source: Source, out: Path) -> Content:
    """Return one document."""
    return {out.name: _document(source)}


def make_lines(source: Source, out: Path) -> Content:
    """Return a feature a line."""
    return {out.name: _blocks(_features(source), between="\n", end="\n")}


def _document(source: Source) -> Iterator[bytes]:
    yield geojson_head(vrspray=source.facts()).encode()
    yield from _blocks(_features(source), between=",\n", end=GEOJSON_TAIL)


def _blocks(features: Iterable[str], *, between: str, end: str) -> Iterator[bytes]:
    """Yield many features at a time."""
    held: list[str] = []
    begun = False
    for feature in features:
        held.append(feature)
        if len(held) == _BLOCK:
            yield ((between if begun else "") + between.join(held)).encode()
            held, begun = [], True
    if held:
        yield ((between if begun else "") + between.join(held)).encode()
    yield end.encode()


def _features(source: Source) -> Iterator[str]:
    columns = source.columns
    names = [each.name for each in columns]
    rows = zip(*(each.python() for each in columns), strict=True)
    for place, row in zip(_geometries(source), rows, strict=True):
        properties = json.dumps(dict(zip(names, row, strict=True)), allow_nan=False)
        yield f'{{"type": "Feature", "geometry": {place}, "properties": {properties}}}'


def _geometries(source: Source) -> Iterator[str]:
    if source.shape == "points":
        samples = source.samples
        form = f'{{"type": "Point", "coordinates": [%.{DEGREE_DECIMALS}f, %.{DEGREE_DECIMALS}f]}}'
        places = zip(samples.longitude_deg.tolist(), samples.latitude_deg.tolist(), strict=True)
        return (form % place for place in places)
    rounded = shapely.transform(
        np.array(source.swaths.polygons, dtype=object), lambda at: np.round(at, DEGREE_DECIMALS)
    )
    return iter(shapely.to_geojson(rounded).tolist())
