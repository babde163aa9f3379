"""Reading a map of any known format; a new format is one file and one line here."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import shapely
from pyproj import CRS
from shapely import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from companion.core.frame import LocalFrame
from companion.flight_map import is_flight_map, read_flight_map
from companion.wording import typed
from missions.maps.adapt import (
    NAME,
    Operation,
    chosen,
    layer_of_parquet,
    operations_in,
    read_geoparquet,
)
from missions.maps.assemble import crs_of, ground_of, map_of, zone_names
from missions.maps.bundle import Bundle, open_bundle
from missions.maps.cells import cells_of
from missions.maps.crs import Floats, over_180, to_longitude_latitude
from missions.maps.csvfile import read_csv
from missions.maps.fields import Given
from missions.maps.geojson import is_geojson, read_geojson
from missions.maps.geopackage import read_geopackage
from missions.maps.geotiff import (
    RX_FOLDER,
    SHAPE_FOLDER,
    grid_of_tiff,
    read_dji,
    read_geotiff,
)
from missions.maps.isoxml.reader import read_isoxml
from missions.maps.kml import read_kml
from missions.maps.local import Area, polygons_of
from missions.maps.model import Grid, Layer, MapFile, MapZone, Value, map_error
from missions.maps.outlines import BOUNDARY_NAME, united
from missions.maps.shapefile import read_shapefile
from missions.maps.text_map import read_text_map

# ADAPT Standard: a folder or a zip with an `adapt.json` and the maps that it names.


def read_adapt(path: Path, layer: str | None = None) -> Layer | Grid:
    """Return the map of one operation; `layer` is the operation's name, or that of its file.

    `path` is the folder, the zip, or the `adapt.json` itself.
    """
    alone = path.name.casefold() == NAME and not path.is_dir()
    bundle = open_bundle(path.parent if alone else path)
    descriptions = [path.name] if alone else bundle.called(NAME)
    places: list[tuple[Operation, str]] = []
    for name in descriptions:
        operations = operations_in(bundle.read(name), bundle.path / name)
        places += [(operation, name) for operation in operations]
    if not places:
        raise map_error(
            path,
            f"no work order in its {NAME} names the file of a map"
            if descriptions
            else f"it holds no {NAME}",
            fix="export the prescription again, with its map",
            code="no-file",
        )
    operation = chosen([one for one, _ in places], layer, path)
    description = next(name for one, name in places if one is operation)
    return _read_adapt(bundle, operation, description)


def _read_adapt(bundle: Bundle, operation: Operation, description: str) -> Layer | Grid:
    """Return the map that an operation names, which lies beside its description."""
    wanted = str(PurePosixPath(description).parent / operation.file).casefold()
    name = next((one for one in bundle.names if one.casefold() == wanted), None)
    if name is None:
        raise map_error(
            bundle.path / description,
            f"the file {operation.file[:60]!r} of {operation.name} is not beside it",
            fix="copy all files of the map",
            code="no-file",
        )
    also = {description: bundle.read(description)}
    suffix = PurePosixPath(name).suffix.casefold()
    if suffix in (".tif", ".tiff"):
        return grid_of_tiff(bundle, name, format="adapt", operation=operation, also=also)
    if suffix == ".parquet":
        return layer_of_parquet(bundle, name, operation=operation, also=also)
    raise map_error(
        bundle.path / name,
        f"a map in an {NAME} is a .tiff or a .parquet, not {suffix or 'without a suffix'}",
        fix="export the map again",
        code="unknown-format",
    )


Reader = Callable[[Path, str | None], Layer | Grid]

# The suffix, in lower case, and who reads it.
READERS: dict[str, Reader] = {
    ".shp": read_shapefile,
    ".geojson": read_geojson,
    ".json": read_geojson,
    ".gpkg": read_geopackage,
    ".kml": read_kml,
    ".kmz": read_kml,
    ".xml": read_isoxml,
    ".tif": read_geotiff,
    ".tiff": read_geotiff,
    ".parquet": read_geoparquet,
    ".geoparquet": read_geoparquet,
    ".csv": read_csv,
    ".txt": read_text_map,
}
# Folders and archives, by the files in them: what each format is called, and the patterns of its
# files' names. A package has to hold maps of one format alone, else the operator names the file.
PACKAGES: tuple[tuple[str, tuple[str, ...], Reader], ...] = (
    ("ISOXML", ("taskdata.xml",), read_isoxml),
    ("ADAPT", ("adapt.json",), read_adapt),
    ("GeoPackage", ("*.gpkg",), read_geopackage),
    ("KML", ("*.kml",), read_kml),
    ("GeoTIFF", ("*.tif", "*.tiff"), read_dji),
    ("GeoParquet", ("*.parquet", "*.geoparquet"), read_geoparquet),
    ("GeoJSON", ("*.geojson", "*.json"), read_geojson),
    ("shapefile", ("*.shp",), read_shapefile),
)
# Readers whose layers are tasks or operations: a name of theirs is never one of a file.
_OF_TASKS = (read_isoxml, read_adapt)
# Files of ISOXML's own, `GRD00001`: terminals keep pictures of their grids beside them.
_TASK_FILE = re.compile(r"[a-z]{3}\d{5}")
_SHOWN_MAX = 8
# A repair of a boundary or an exclusion may move the limit of spraying by this much unasked.
REPAIR_MAX_M2 = 1.0
# Of an outline whose repairs are told, by this share of its ground: a recorded walk that crosses
# its own start, but no outline whose corners are in the wrong order.
REPAIR_MAX_SHARE = 0.001


def read_map(
    path: Path,
    *,
    rate_field: str | None = None,
    unit: str | None = None,
    crs: str | None = None,
    layer: str | None = None,
    density_kg_l: float | None = None,
    flow_width_m: float | None = None,
    flow_speed_m_s: float | None = None,
    mix_rate: float | None = None,
    scale: float | None = None,
    merge: str | None = None,
    origin: tuple[float, float, float] | None = None,
) -> MapFile:
    """Return the prescription in a file, or raise a `MapError` that names file, reason and fix.

    The arguments answer what the file leaves open: which column, band or product is the rate, in
    which unit, in which coordinate reference system, in which layer or task; the density for
    rates by weight, width and speed for rates by time, factors for rates of product or of another
    sprayer; how P2's text map makes its cells.
    """
    path = Path(path)
    if is_flight_map(path):
        return read_compiled(path, {"mix_rate": mix_rate, "scale": scale})
    given = Given(
        unit=unit,
        density_kg_l=density_kg_l,
        flow_width_m=flow_width_m,
        flow_speed_m_s=flow_speed_m_s,
        mix_rate=mix_rate,
        scale=scale,
    )
    found = _read(path, layer, merge=merge, origin=origin)
    return map_of(found, path, rate_field=rate_field, crs=crs, given=given)


def read_area(
    path: Path,
    *,
    crs: str | None = None,
    layer: str | None = None,
    repairs: list[str] | None = None,
    nested: bool = False,
) -> MultiPolygon:
    """Return the ground that a boundary or exclusion file covers, in longitude and latitude.

    Of a file that has an outline of the field beside its zones (ISOXML, a DJI package), that
    outline. Stricter than a prescription: a record that has to be left out, or a ring whose
    repair moves more than a square metre, could be the ground that must not be sprayed. Whoever
    gives `repairs` takes such rings repaired where that moves no more than a thousandth of their
    ground, and finds there what each repair changed. `nested`: its polygons may lie in each other,
    as they may where nothing is sprayed on them.
    """
    path = Path(path)
    found = _read(path, layer)
    if found.boundary is not None:
        return found.boundary
    found = _no_grid(found, path)
    used_crs, _ = crs_of(found, path, crs)
    names = zone_names(found)
    ground = _strict_ground(found, used_crs, names, path, repairs)
    if found.skipped:
        index, reason = next(iter(found.skipped.items()))
        raise map_error(
            path,
            f"record {names[index]} is not an area: {reason}",
            fix="draw it as a polygon",
            code="no-polygon",
        )
    return united(ground, [f"record {name}" for name in names], path, nested=nested)


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """One record of a file, an area, points or lines in longitude and latitude."""

    name: str
    geometry: BaseGeometry
    values: Mapping[str, Value]


def read_records(path: Path, *, crs: str | None = None, layer: str | None = None) -> list[Record]:
    """Return areas, points and lines of a file with their attributes, as obstacles are given.

    As strict as `read_area`: what is none of these could be what stands in the way.
    """
    path = Path(path)
    given = _read(path, layer)
    if given.boundary is not None:
        return [Record(name=BOUNDARY_NAME, geometry=given.boundary, values={})]
    read = _no_grid(given, path)
    used_crs, _ = crs_of(read, path, crs)
    names = zone_names(read)
    marks = dict(read.marks)
    for index, reason in read.skipped.items():
        if index not in marks:
            raise map_error(
                path,
                f"record {names[index]} is not an area, point or line: {reason}",
                fix="draw it again, or delete the record",
                code="no-polygon",
            )
    found: dict[int, BaseGeometry] = {}
    if len(marks) < len(read.geometries):
        ground = _strict_ground(read, used_crs, names, path, None)
        found = {index: area for index, area in enumerate(ground) if area is not None}
    if marks:
        native = np.array(list(marks.values()), dtype=object)
        places = to_longitude_latitude(native, used_crs, path=path)
        found |= dict(zip(marks, places.tolist(), strict=True))
    return [
        Record(
            name=names[index],
            geometry=found[index],
            values={column.name.casefold(): column.values[index] for column in read.columns},
        )
        for index in sorted(found)
    ]


def read_layer(path: Path, *, layer: str | None = None) -> Layer | Grid:
    """Return what stands in a file, before anybody makes sense of it as rates."""
    return _read(Path(path), layer)


def _no_grid(layer: Layer | Grid, path: Path) -> Layer:
    if isinstance(layer, Grid):
        raise map_error(
            path,
            "rows and columns of cells are not an outline",
            fix="give the boundary or the exclusion as polygons",
            code="no-polygon",
        )
    return layer


def _strict_ground(
    layer: Layer, crs: CRS, names: Sequence[str], path: Path, repairs: list[str] | None
) -> list[Area | None]:
    """Return every record's ground; refuse repairs that move more than a little of it."""
    ground, repaired = ground_of(layer, crs, names, path)
    large = [repair for repair in repaired if not repair.change_m2 <= REPAIR_MAX_M2]
    refused = large
    if repairs is not None:
        repairs += [f"{path}: record {repair.zone}: {repair.text}" for repair in large]
        refused = [each for each in large if each.change_m2 > REPAIR_MAX_SHARE * each.after_m2]
    if refused:
        raise map_error(
            path,
            f"record {refused[0].zone}: {refused[0].text}",
            fix="repair it where it is made: corners in order, holes inside",
            code="invalid-ring",
        )
    return ground


def _read(
    path: Path,
    layer: str | None,
    *,
    merge: str | None = None,
    origin: tuple[float, float, float] | None = None,
) -> Layer | Grid:
    try:
        folder = path.is_dir()
        there = path.exists()
        usable = folder or path.is_file()
    except (OSError, ValueError) as error:
        raise map_error(
            path, f"is not a path ({error})", fix="check the path", code="no-file"
        ) from None
    if not there:
        raise map_error(path, "there is no such file", fix="check the path", code="no-file")
    if not usable:
        raise map_error(
            path, "this is not a regular file", fix="name the map's file", code="no-file"
        )
    suffix = path.suffix.casefold()
    reader = READERS.get(suffix)
    if folder or suffix == ".zip":
        reader, layer = _of_package(path, layer)
    elif path.name.casefold() == "adapt.json":
        reader = read_adapt
    if reader is None:
        known = ", ".join(READERS)
        raise map_error(
            path,
            f"the format {suffix or 'without a suffix'} is not known",
            fix="name the .shp of the shapefile"
            if suffix in (".dbf", ".prj", ".shx", ".cpg")
            else f"take one of {known}, or a folder or .zip with such files",
            code="unknown-format",
        )
    if reader is read_text_map:
        return read_text_map(path, layer, merge=merge or "max", origin=origin)
    if merge is not None or origin is not None:
        raise map_error(
            path,
            "it is no text map, which alone has points to merge and an origin",
            fix="leave out --merge and --origin (prescription.merge, prescription.origin)",
            code="not-a-text-map",
        )
    return reader(path, layer)


@dataclass(frozen=True, slots=True)
class _Candidate:
    """One file of a package that could be the map, or of several files the one that names it."""

    name: str
    format: str
    reader: Reader


def _of_package(path: Path, layer: str | None) -> tuple[Reader, str | None]:
    """Return who reads a folder or an archive, and the layer to ask for.

    A file that the operator names becomes the layer, by its place in the package; a task's own
    name stays what it is.
    """
    found = _candidates(open_bundle(path))
    if not found:
        signs = ", ".join(sign for _, signs, _ in PACKAGES for sign in signs)
        raise map_error(
            path,
            f"it holds none of {signs}",
            fix="name the file of the map itself",
            code="unknown-format",
        )
    maps = [one for one in found if PurePosixPath(one.name).stem.casefold() != BOUNDARY_NAME]
    readers = list(dict.fromkeys(one.reader for one in maps or found))
    if len(readers) == 1:
        return readers[0], layer
    meant = [] if layer is None else _named(found, layer)
    if len(meant) == 1:
        reader = meant[0].reader
        return reader, None if reader in _OF_TASKS else meant[0].name
    of_tasks = [reader for reader in readers if reader in _OF_TASKS]
    if layer is not None and not meant and len(of_tasks) == 1:
        return of_tasks[0], layer
    shown = [f"{one.name} ({one.format})" for one in found[:_SHOWN_MAX]]
    shown += [f"{len(found) - _SHOWN_MAX} more"] if len(found) > _SHOWN_MAX else []
    none = f", and no {layer[:40]!r}" if layer is not None and not meant else ""
    raise map_error(
        path,
        f"it holds maps of several formats: {', '.join(shown)}{none}",
        fix="name one with --layer (prescription.layer), for example "
        f"--layer {typed([maps[0].name])}, or give the file itself",
        code="several-layers",
    )


def _candidates(bundle: Bundle) -> list[_Candidate]:
    """Return the files that could be the map; what belongs to one of them is none."""
    tasks, described = (
        {PurePosixPath(name).parent for name in bundle.called(sign)}
        for sign in ("taskdata.xml", "adapt.json")
    )
    found = []
    for format_name, signs, reader in PACKAGES:
        for name in bundle.names:
            place = PurePosixPath(name)
            if not any(PurePosixPath(name.casefold()).match(sign) for sign in signs):
                continue
            if place.parent in tasks and _TASK_FILE.match(place.stem.casefold()):
                continue
            if place.parent in described and reader in (read_dji, read_geoparquet):
                continue
            if reader is read_geojson and not is_geojson(bundle, name):
                continue
            found.append(_Candidate(name, format_name, reader))
    return [one for one in found if not _is_field_of_dji(one, found)]


def _is_field_of_dji(one: _Candidate, found: Sequence[_Candidate]) -> bool:
    """Tell whether a shapefile is the outline beside the raster of DJI's package."""
    return (
        one.reader is read_shapefile
        and PurePosixPath(one.name).parent.name.casefold() == SHAPE_FOLDER.casefold()
        and any(
            other.reader is read_dji
            and PurePosixPath(other.name).parent.name.casefold() == RX_FOLDER.casefold()
            for other in found
        )
    )


def _named(found: Sequence[_Candidate], layer: str) -> list[_Candidate]:
    """Return the files that a name means: by place, by file name, else by what stands before it."""
    for called in (
        lambda place: str(place),
        lambda place: place.name,
        lambda place: place.stem,
    ):
        meant = [one for one in found if called(PurePosixPath(one.name)) == layer]
        if meant:
            return meant
    return []


# A flight map read as any other map: to plan over what will be flown, and to look at it.


def read_compiled(path: Path, factors: Mapping[str, float | None]) -> MapFile:
    """Return a flight map in longitude and latitude, cells as cells.

    Its rates are L/ha already, its boundary is without the exclusions. Factors on its rates are in
    it: others are refused.
    """
    found = read_flight_map(path)
    for name, value in factors.items():
        if value is not None and value != found.frozen.get(f"prescription.{name}"):
            raise map_error(
                path,
                f"its rates were compiled without {name} = {value:g}",
                fix=f"compile its source again, or leave out {name}",
                code="scaled-rates",
            )
    prescription = found.prescription
    grid = prescription.cells
    cells = None if grid is None else cells_of(grid, found.frame)
    sources = () if cells is not None else prescription.zones
    # Cells that are their own border have no other.
    border = [prescription.field] if found.is_bounded or cells is None else []
    areas = _degrees([*(zone.polygon for zone in sources), *border], found.frame)
    zones = [
        MapZone(name=zone.name, geometry=area, rate_l_ha=zone.rate_l_ha)
        for zone, area in zip(sources, areas, strict=False)
        if not area.is_empty
    ]
    return MapFile(
        path=path,
        format="flight map",
        crs="EPSG:4326",
        unit="L/ha",
        rate_field="rate_l_ha",
        zones=tuple(zones),
        sha256=prescription.sha256,
        cells=cells,
        boundary=MultiPolygon(polygons_of(areas[-1])) if border else None,
        default_rate_l_ha=prescription.default_rate_l_ha,
        overlap=prescription.overlap,
    )


def _degrees(areas: Sequence[Area], frame: LocalFrame) -> list[Area]:
    def there(places: Floats) -> Floats:
        latitudes, longitudes = frame.to_geographic_all(
            places[:, 0].tolist(), places[:, 1].tolist()
        )
        return over_180(np.column_stack([longitudes, latitudes]))

    found = shapely.transform(np.array(areas, dtype=object), there)
    return [area for area in found if isinstance(area, Polygon | MultiPolygon)]
