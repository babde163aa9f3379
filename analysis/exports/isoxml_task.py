"""A flight as ISOXML 4 (ISO 11783-10): a completed task with its field, device and time log.

Identifiers are negative, as those that a task controller gives; so they can never be taken for
those of the farm's own data. Text has at most 32 characters there, so that what does not fit is in
the comments of the task, a line each.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import MultiPolygon

from analysis.exports.ground import geographic
from analysis.exports.isoxml_device import DEVICE, add_device, client_name
from analysis.exports.isoxml_log import BOOM, LOG_NAME, Logged, logged, records, template
from analysis.exports.output import zipped
from companion.maps.isoxml.elements import add_polygons, printable

if TYPE_CHECKING:
    from analysis.exports.output import Content
    from analysis.exports.samples import Samples
    from analysis.exports.source import Source

Floats = NDArray[np.float64]

TASK_DATA = "TASKDATA.XML"
# Of a polygon: the outline of a field. Of a task: completed. Of a time: effective work.
_FIELD, _COMPLETED, _EFFECTIVE = "1", "4", "4"
# Totals of ISO 11783-11: volume [L], area [m2], distance [mm], time [s], volume [mL].
_VOLUME_L, _AREA, _DISTANCE, _TIME, _VOLUME_ML = 80, 116, 117, 119, 351
_COMMENT_MAX = 32
_HASH_DIGITS = 20


def make(source: Source, out: Path) -> Content:
    """Return the files of the folder, or one zip with the folder in it."""
    values = logged(source.samples)
    log = records(source.samples, values)
    files = {
        f"{LOG_NAME}.bin": log,
        f"{LOG_NAME}.xml": template(values),
        TASK_DATA: _task_data(source, len(log), values),
    }
    if out.suffix.casefold() != ".zip":
        return {name: [content] for name, content in files.items()}
    return {out.name: [zipped({f"TASKDATA/{name}": one for name, one in files.items()})]}


def _task_data(source: Source, log_bytes: int, values: list[Logged]) -> bytes:
    about, boom = source.about, source.flight.setup.boom
    maker = printable(about.exported_by)
    root = Element(
        "ISO11783_TaskData",
        VersionMajor="4",
        VersionMinor="3",
        ManagementSoftwareManufacturer="vrspray",
        ManagementSoftwareVersion=maker,
        TaskControllerManufacturer="vrspray",
        TaskControllerVersion=printable(about.recorded_by),
        DataTransferOrigin="2",
    )
    totals = _totals(source.samples)
    add_device(root, boom, about, values=values, totals=list(totals))
    _add_field(root, source)
    SubElement(root, "PDT", A="PDT-1", B=printable(_product(source)))
    task = SubElement(root, "TSK", A="TSK-1", B=printable(about.title), E="PFD-1", G=_COMPLETED)
    if about.operator is not None:
        worker = Element("WKR", A="WKR-1", B=printable(about.operator))
        root.insert(list(root).index(task), worker)
    time = SubElement(
        task, "TIM", A=about.started_utc, B=about.ended_utc,
        C=str(round(source.flight.duration_s)), D=_EFFECTIVE,
    )  # fmt: skip
    for ddi, total in totals.items():
        SubElement(time, "DLV", A=f"{ddi:04X}", B=str(total), C=BOOM)
    if about.operator is not None:
        SubElement(task, "WAN", A="WKR-1")
    SubElement(task, "DAN", A=client_name(about), C=DEVICE)
    SubElement(task, "PAN", A="PDT-1", E=BOOM)
    for comment in _comments(source):
        SubElement(task, "CAN", C=comment)
    SubElement(task, "TLG", A=LOG_NAME, B=str(log_bytes), C="1")
    indent(root)
    content: bytes = tostring(root, encoding="UTF-8", xml_declaration=True)
    return content + b"\n"


def _totals(samples: Samples) -> dict[int, int]:
    """Return what the task came to, by identifier."""
    working = samples.flow_l_min > 0.0
    volume_ml = float(samples.volume_ml.sum())
    lasted_s = np.gradient(samples.time_s) if len(samples) > 1 else np.zeros(1)
    return {
        _VOLUME_L: round(volume_ml / 1000.0),
        _VOLUME_ML: round(volume_ml),
        _AREA: round(float(samples.area_m2.sum())),
        _DISTANCE: round(1000.0 * float(samples.distance_m[working].sum())),
        _TIME: round(float(lasted_s[working].sum())),
    }


def _product(source: Source) -> str:
    about = source.about
    if about.is_training:
        return f"training: {about.training}"
    return about.product or "not stated"


def _comments(source: Source) -> list[str]:
    """Return what a terminal has no place for, in lines short enough for a comment."""
    about = source.about
    lines = [
        f"flight: {about.flight}",
        f"training: {about.training}",
        f"clock: {about.utc_source}, times are UTC",
        f"map: {about.map_sha256[:_HASH_DIGITS]}",
    ]
    if not about.is_closed:
        lines.append("record cut: end may be missing")
    if about.lost_rows:
        lines.append(f"record: {about.lost_rows} rows lost")
    return [line[:_COMMENT_MAX] for line in lines]


def _add_field(root: Element, source: Source) -> None:
    """Add the ground where spraying was allowed, with its holes."""
    setup = source.flight.setup
    ground = setup.prescription.field
    name = source.about.field_name or "Field"
    field = SubElement(root, "PFD", A="PFD-1", C=printable(name), D=str(round(ground.area)))
    if not ground.is_empty:
        (outline,) = geographic([MultiPolygon(shapely.get_parts(ground).tolist())], setup.frame)
        add_polygons(field, shapely.get_parts(outline).tolist(), kind=_FIELD)
