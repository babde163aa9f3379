"""A legal record as files: JSON with the treated area as GeoJSON, CSV of one row."""

from __future__ import annotations

import csv
import io
import json
from typing import TYPE_CHECKING

import shapely

if TYPE_CHECKING:
    from analysis.report.legal import LegalRecord


def record_json(record: LegalRecord) -> bytes:
    """Return the record as JSON."""
    return (json.dumps(record.as_json(), indent=1, allow_nan=False) + "\n").encode()


def record_csv(record: LegalRecord) -> bytes:
    """Return the record as one row under its heading, so that a register grows by appending rows.

    A column is named as the field in the JSON, with the unit where there is one; the area is WKT.
    """
    row: dict[str, object] = {
        "profile": record.profile,
        "complete": "yes" if record.is_complete else "no",
        "missing": "; ".join(record.missing),
    }
    for entry in record.entries:
        row[entry.name] = "" if entry.value is None else entry.value
        if entry.unit and not entry.name.endswith(entry.unit.lower().replace("/", "_")):
            row[f"{entry.name}_unit"] = entry.unit
    row["added_after_flight"] = "; ".join(record.added_after_flight)
    row["remarks"] = "; ".join(record.remarks)
    area = shapely.from_geojson(json.dumps(record.treated_area))
    row["treated_area_wkt"] = shapely.to_wkt(area, rounding_precision=7)
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, fieldnames=list(row))
    writer.writeheader()
    writer.writerow(row)
    return text.getvalue().encode()
