"""What was applied as GeoParquet 1.1, and with `adapt.json` as the ADAPT standard has it.

Columns that the standard knows have its names and units (adapt-data-type-definitions.json 2.0);
what it does not know has a name and unit of ours. A reader of tables finds places as numbers too.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import shapely
from numpy.typing import NDArray

from analysis.exports.columns import utc_text
from companion.map_formats import zipped

if TYPE_CHECKING:
    from analysis.exports.output import Content
    from analysis.exports.samples import Samples, Swaths
    from analysis.exports.source import Source

Floats = NDArray[np.float64]

_ADAPT_JSON = "adapt.json"
_SCHEMA_VERSION = "2.0.0"
_PRODUCT, _FIELD = "product-1", "field-1"
_SECONDS_A_MINUTE = 60.0
_OF_PRODUCT = (
    "AppliedVolumePerAreaTarget", "AppliedVolumePerAreaActual", "AppliedVolumePerTime",
    "AppliedTotalVolume",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class _Field:
    """One column; `code` is the standard's definition code, None for what it does not know."""

    name: str
    unit: str
    values: Floats | Sequence[str]
    code: str | None = None


def make(source: Source, out: Path) -> Content:
    """Return one GeoParquet file."""
    return {out.name: [_parquet(source, _fields(source))]}


def make_adapt(source: Source, out: Path) -> Content:
    """Return the two files of the standard, side by side in a folder or in one zip."""
    fields = _fields(source)
    table = f"{source.about.flight}.parquet"
    files = {
        table: _parquet(source, fields),
        _ADAPT_JSON: _adapt_json(source, fields, table),
    }
    if out.suffix.casefold() != ".zip":
        return {name: [content] for name, content in files.items()}
    return {out.name: [zipped(files)]}


def _fields(source: Source) -> list[_Field]:
    found = _swath_fields(source) if source.shape == "swaths" else _point_fields(source)
    return [*found, _Field(name="sortie", unit="", values=source.sorties)] if source.also else found


def _work_fields(rows: Swaths | Samples) -> list[_Field]:
    return [
        _standard("AppliedTotalVolume", "l", rows.volume_ml / 1000.0),
        _standard("AppliedArea", "ha", rows.area_m2 / 10_000.0),
        _standard("DistanceTraveled", "m", rows.distance_m),
        _standard("Width", "m", rows.width_m),
        _standard("DutyCycle", "prcnt", 100.0 * rows.duty),
        _standard("Speed", "m1sec-1", rows.speed_m_s),
        _standard("Heading", "arcdeg", rows.heading_deg),
    ]


def _swath_fields(source: Source) -> list[_Field]:
    swaths = source.swaths
    names = source.valve_names
    return [
        _Field(
            name="timestamp", unit="", code="Timestamp",
            values=utc_text(swaths.start_s + swaths.utc_offset_s),
        ),
        _Field(name="end", unit="", values=utc_text(swaths.end_s + swaths.utc_offset_s)),
        _Field(name="valve", unit="", values=[names[at] for at in swaths.valve.tolist()]),
        _standard("AppliedVolumePerAreaTarget", "l1ha-1", swaths.rate_l_ha),
        _standard("AppliedVolumePerAreaActual", "l1ha-1", swaths.applied_l_ha),
        *_work_fields(swaths),
        _Field(name="height_m", unit="m", values=swaths.height_m),
        _Field(name="longitude_deg", unit="arcdeg", values=swaths.longitude_deg),
        _Field(name="latitude_deg", unit="arcdeg", values=swaths.latitude_deg),
    ]  # fmt: skip


def _point_fields(source: Source) -> list[_Field]:
    samples = source.samples
    fields = [
        _Field(name="timestamp", unit="", code="Timestamp", values=utc_text(samples.utc_s)),
        _standard("AppliedVolumePerAreaTarget", "l1ha-1", samples.rate_l_ha),
        _standard("AppliedVolumePerAreaActual", "l1ha-1", samples.applied_l_ha),
        _standard("AppliedVolumePerTime", "l1sec-1", samples.flow_l_min / _SECONDS_A_MINUTE),
        *_work_fields(samples),
    ]
    if samples.pressure_kpa is not None:
        fields.append(_standard("SprayPressureActual", "Pa", 1000.0 * samples.pressure_kpa))
    return [
        *fields,
        _Field(name="course_deg", unit="arcdeg", values=samples.course_deg),
        _Field(name="height_m", unit="m", values=samples.height_m),
        _Field(name="inhibits", unit="", values=samples.inhibits),
        _Field(name="longitude_deg", unit="arcdeg", values=samples.longitude_deg),
        _Field(name="latitude_deg", unit="arcdeg", values=samples.latitude_deg),
    ]


def _standard(code: str, unit: str, values: Floats) -> _Field:
    return _Field(name=code, unit=unit, values=values, code=code)


def _parquet(source: Source, fields: Sequence[_Field]) -> bytes:
    shapes: NDArray[np.object_]
    if source.shape == "swaths":
        shapes = np.array(source.swaths.polygons, dtype=object)
    else:
        samples = source.samples
        places = np.stack((samples.longitude_deg, samples.latitude_deg), axis=1)
        shapes = np.asarray(shapely.points(places), dtype=object)
    arrays = [
        pa.array(field.values, from_pandas=True)
        if isinstance(field.values, np.ndarray)
        else pa.array([value or None for value in field.values], type=pa.string())
        for field in fields
    ]
    schema = pa.schema(
        [
            pa.field(field.name, array.type, metadata={"unit": field.unit} if field.unit else None)
            for field, array in zip(fields, arrays, strict=True)
        ]
        + [pa.field("geometry", pa.binary())],
        metadata={
            "geo": json.dumps(_geo(shapes)),
            "vrspray": json.dumps(_facts(source, fields), allow_nan=False),
        },
    )
    geometry = pa.array(shapely.to_wkb(shapes).tolist(), type=pa.binary())
    table = pa.table([*arrays, geometry], schema=schema)
    packed = BytesIO()
    pq.write_table(table, packed, compression="zstd")
    return packed.getvalue()


def _geo(shapes: NDArray[np.object_]) -> dict[str, Any]:
    """Return the description of the geometry; without a CRS it is longitude and latitude."""
    column: dict[str, Any] = {
        "encoding": "WKB",
        "geometry_types": sorted({each.geom_type for each in shapes}),
    }
    if len(shapes):
        column["bbox"] = shapely.total_bounds(shapes).tolist()
    return {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}}


def _facts(source: Source, fields: Sequence[_Field]) -> dict[str, object]:
    return source.facts() | {"units": {field.name: field.unit for field in fields if field.unit}}


def _adapt_json(source: Source, fields: Sequence[_Field], table: str) -> bytes:
    """Return the catalogue and the record of the work, with the flight's facts as notes."""
    about = source.about
    variables = [
        {
            "id": {"referenceId": f"variable-{number}"},
            "name": field.name,
            "definitionCode": field.code,
            **({"productId": _PRODUCT} if field.code in _OF_PRODUCT else {}),
            "geoParquetColumnName": field.name,
        }
        for number, field in enumerate(fields, start=1)
        if field.code is not None
    ]
    total = {
        "id": {"referenceId": "total"},
        "name": "Total",
        "definitionCode": "AppliedTotalVolume",
    }
    scope = {"dateContextCode": "ACTUAL", "start": about.started_utc, "end": about.ended_utc}
    operation = {
        "id": {"referenceId": "operation-1"},
        "name": about.title,
        "operationTypeCode": "APPLICATION_CROP_PROTECTION",
        "productIds": [_PRODUCT],
        "spatialRecordsFile": table,
        "variables": [*variables, total],
        "summaryValues": [{"variableId": "total", "valueText": f"{source.volume_l:.6f}"}],
        "timeScopes": [scope],
    }
    document = {
        "catalog": {
            "fields": [{"id": {"referenceId": _FIELD}, "name": about.field_name or "Field"}],
            "products": [_product(source)],
        },
        "documents": {
            "workRecords": [
                {
                    "id": {"referenceId": "work-1"},
                    "name": about.title,
                    "fieldId": _FIELD,
                    "notes": [f"{name}: {value}" for name, value in about.as_text().items()],
                    "timeScopes": [scope],
                    "operations": [operation],
                }
            ]
        },
        "rootSchemaVersion": _SCHEMA_VERSION,
    }
    return json.dumps(document, indent=2, allow_nan=False).encode() + b"\n"


def _product_name(source: Source) -> str:
    about = source.about
    if about.simulated == "yes":
        return "SIMULATED: nothing was applied"
    return "Water" if about.training == "water" else about.product or "Not stated"


def _product(source: Source) -> dict[str, object]:
    about = source.about
    is_water = about.training == "water"
    return {
        "id": {"referenceId": _PRODUCT},
        "name": _product_name(source),
        "productTypeCode": "WATER" if is_water else "NOT_SPECIFIED",
        "productFormCode": "LIQUID",
        "productStatusCode": "ACTIVE",
    }
