"""ADAPT Standard: a folder or a zip with an `adapt.json` and the maps that it names."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from missions.maps.adapt.catalogue import NAME, Operation, chosen, operations_in
from missions.maps.adapt.geoparquet import layer_of_parquet
from missions.maps.bundle import Bundle, open_bundle
from missions.maps.geotiff.reader import grid_of_tiff
from missions.maps.layer import Grid, Layer
from missions.maps.model import map_error


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
    return _read(bundle, operation, description)


def _read(bundle: Bundle, operation: Operation, description: str) -> Layer | Grid:
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
