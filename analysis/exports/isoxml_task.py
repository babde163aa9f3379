"""A flight as ISOXML 4 (ISO 11783-10): a completed task with its field, device and time log.

Of a job each sortie is a task on the same field: the totals of a task's times are of all of it.

Identifiers are negative, as those that a task controller gives; so they can never be taken for
those of the farm's own data. Text has at most 32 characters there, so that what does not fit is in
the comments of the task, a line each.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import MultiPolygon, Polygon

from analysis.exports.columns import utc_ms
from analysis.exports.output import ExportError, geographic
from companion.map_formats import zipped

if TYPE_CHECKING:
    from analysis.exports.columns import About
    from analysis.exports.output import Content
    from analysis.exports.samples import Samples
    from analysis.exports.source import Source
    from companion.core.boom import Boom


# The time logs of ISO 11783-10: TLG00001.xml names what TLG00001.bin holds, record by record.
#
# A record is little-endian: milliseconds of the day (uint32) and days since 1980-01-01 (uint16),
# then what the template's position leaves empty, here north and east (int32, 1e-7 degrees), status
# (uint8), GPS time of day (uint32, ms) and date (uint16, days since 1980); the number of values
# (uint8), and for each its place in the template (uint8) and the value (int32). Data dictionary
# identifiers and their resolutions are those of ISO 11783-11.

Ints = NDArray[np.int64]

BOOM = "DET-2"
# Of the data dictionary: [0.01 mm3/m2], [mm3/s], [mm], none, [mm/s], [0.1 Pa] of a resolution.
SETPOINT_RATE, ACTUAL_RATE, ACTUAL_FLOW = 1, 2, 37
ACTUAL_WIDTH, WORK_STATE, FIRST_CONDENSED = 67, 141, 161
ACTUAL_SPEED, ACTUAL_PRESSURE = 397, 194
SECTIONS_A_CONDENSED = 16
RAW_PER_L_HA = 10_000.0
RAW_PER_L_MIN = 1e6 / 60.0
RAW_PER_KPA = 10_000.0
# Of the position all that is known is that the autopilot had one.
GNSS_FIX = 1
_MS_A_DAY = 86_400_000
_DAYS_1970_TO_1980 = 3652
_INT32 = (-(2**31), 2**31 - 1)
# The values of a record are counted in one byte; with more valves their own rates are left out.
_VALUES_MAX = 255


@dataclass(frozen=True, slots=True, kw_only=True)
class Logged:
    """One value of every record: its identifier, the element that it is of, the raw numbers."""

    ddi: int
    element: str
    raw: Ints


def section(valve: int) -> str:
    """Return the identifier of the device element of a valve."""
    return f"DET-{3 + valve}"


def logged(samples: Samples) -> list[Logged]:
    """Return all values of the log, in the order of the template."""
    is_open = samples.valve_flow_l_min > 0.0
    columns: list[tuple[int, Floats]] = [
        (SETPOINT_RATE, samples.rate_l_ha * RAW_PER_L_HA),
        (ACTUAL_RATE, samples.applied_l_ha * RAW_PER_L_HA),
        (ACTUAL_FLOW, samples.flow_l_min * RAW_PER_L_MIN),
        (ACTUAL_WIDTH, samples.width_m * 1000.0),
        (WORK_STATE, np.where(is_open.any(axis=1), 1.0, 0.0)),
        (ACTUAL_SPEED, samples.speed_m_s * 1000.0),
    ]
    if samples.pressure_kpa is not None:
        columns.append((ACTUAL_PRESSURE, samples.pressure_kpa * RAW_PER_KPA))
    found = [Logged(ddi=ddi, element=BOOM, raw=_whole(values)) for ddi, values in columns]
    found += [
        Logged(ddi=FIRST_CONDENSED + number, element=BOOM, raw=_condensed(states))
        for number, states in enumerate(
            np.split(
                is_open, range(SECTIONS_A_CONDENSED, is_open.shape[1], SECTIONS_A_CONDENSED), axis=1
            )
        )
    ]
    of_valves = [
        Logged(ddi=ddi, element=section(valve), raw=_whole(values[:, valve] * RAW_PER_L_HA))
        for valve in range(is_open.shape[1])
        for ddi, values in (
            (SETPOINT_RATE, samples.valve_rate_l_ha),
            (ACTUAL_RATE, samples.valve_applied_l_ha),
        )
    ]
    return found + of_valves if len(found) + len(of_valves) <= _VALUES_MAX else found


def template(values: list[Logged]) -> bytes:
    """Return a log's template: attributes without a value stand for what each record holds."""
    time = Element("TIM", A="", D="4")
    SubElement(time, "PTN", A="", B="", D="", H="", I="")
    for each in values:
        SubElement(time, "DLV", A=f"{each.ddi:04X}", B="", C=each.element)
    indent(time)
    content: bytes = tostring(time, encoding="UTF-8", xml_declaration=True)
    return content + b"\n"


def records(samples: Samples, values: list[Logged]) -> bytes:
    """Return a log."""
    value = [("place", "u1"), ("raw", "<i4")]
    kind = np.dtype(
        [
            ("ms", "<u4"), ("day", "<u2"), ("north", "<i4"), ("east", "<i4"), ("status", "u1"),
            ("gps_ms", "<u4"), ("gps_day", "<u2"), ("count", "u1"), ("values", value, len(values)),
        ]
    )  # fmt: skip
    rows = np.zeros(len(samples), dtype=kind)
    days, ms = np.divmod(utc_ms(samples.utc_s), _MS_A_DAY)
    rows["ms"] = rows["gps_ms"] = ms
    rows["day"] = rows["gps_day"] = np.clip(days - _DAYS_1970_TO_1980, 0, 0xFFFF)
    rows["north"] = _whole(samples.latitude_deg * 1e7)
    rows["east"] = _whole(samples.longitude_deg * 1e7)
    rows["status"] = GNSS_FIX
    rows["count"] = len(values)
    for place, each in enumerate(values):
        rows["values"]["place"][:, place] = place
        rows["values"]["raw"][:, place] = each.raw
    return rows.tobytes()


def _whole(values: Floats) -> Ints:
    """Return raw values; nothing is 0, which is what a log has where nothing is prescribed."""
    limited = np.clip(np.rint(np.nan_to_num(values, nan=0.0)), *_INT32)
    found: Ints = limited.astype(np.int64)
    return found


def _condensed(states: NDArray[np.bool_]) -> Ints:
    """Return the states of up to 16 sections, two bits each from the lowest: 01 on, 00 off."""
    bits = np.left_shift(1, 2 * np.arange(states.shape[1], dtype=np.int64))
    sections: Ints = states.astype(np.int64) @ bits
    return np.where(sections > _INT32[1], sections - 2**32, sections)


Floats = NDArray[np.float64]

TASK_DATA = "TASKDATA.XML"
# Of a polygon: the outline of a field. Of a task: completed. Of a time: effective work.
_FIELD, _COMPLETED, _EFFECTIVE = "1", "4", "4"
# Totals of ISO 11783-11: volume [L], area [m2], distance [mm], time [s], volume [mL].
_VOLUME_L, _AREA, _DISTANCE, _TIME, _VOLUME_ML = 80, 116, 117, 119, 351
_COMMENT_MAX = 32
_HASH_DIGITS = 20


# As long as a designator may be (ISO 11783-10).
_NAME_MAX = 32


def _printable(name: str) -> str:
    """Return a name without what XML cannot hold, as long as a designator may be."""
    return " ".join("".join(one for one in name if one.isprintable()).split())[:_NAME_MAX]


def make(source: Source, out: Path) -> Content:
    """Return the files of the folder, or one zip with the folder in it."""
    every = {f"TLG{number:05d}": part for number, part in enumerate(source.parts, start=1)}
    if any(each.flight.setup.boom != source.flight.setup.boom for each in every.values()):
        raise ExportError(
            "isoxml describes one boom; export the sorties of each boom by themselves"
        )
    values = {name: logged(part.samples) for name, part in every.items()}
    logs = {name: records(part.samples, values[name]) for name, part in every.items()}
    files = {f"{name}.bin": log for name, log in logs.items()}
    files |= {f"{name}.xml": template(its) for name, its in values.items()}
    root = _opening(source, max(values.values(), key=len))
    for number, (name, part) in enumerate(every.items(), start=1):
        _add_task(root, part, number, name, len(logs[name]))
    # Elements of one kind stand together, those that others refer to first.
    root[:] = sorted(root, key=lambda each: _ORDER.index(each.tag))
    indent(root)
    files[TASK_DATA] = tostring(root, encoding="UTF-8", xml_declaration=True) + b"\n"
    if out.suffix.casefold() != ".zip":
        return {name: [content] for name, content in files.items()}
    return {out.name: [zipped({f"TASKDATA/{name}": one for name, one in files.items()})]}


_ORDER = ("DVC", "PFD", "PDT", "WKR", "TSK")


def _opening(source: Source, values: list[Logged]) -> Element:
    """Return the file with what its tasks refer to: device and field."""
    about = source.about
    root = Element(
        "ISO11783_TaskData",
        VersionMajor="4",
        VersionMinor="3",
        ManagementSoftwareManufacturer="vrspray",
        ManagementSoftwareVersion=_printable(about.exported_by),
        TaskControllerManufacturer="vrspray",
        TaskControllerVersion=_printable(about.recorded_by),
        DataTransferOrigin="2",
    )
    boom = source.flight.setup.boom
    add_device(root, boom, about, values=values, totals=list(_totals(source.samples)))
    _add_field(root, source)
    return root


def _named(root: Element, tag: str, name: str) -> str:
    """Return the identifier of a product or worker, which is added with the first of the name."""
    there = root.findall(tag)
    for each in there:
        if each.attrib["B"] == name:
            return each.attrib["A"]
    return SubElement(root, tag, A=f"{tag}-{len(there) + 1}", B=name).attrib["A"]


def _add_task(root: Element, part: Source, number: int, log_name: str, log_bytes: int) -> None:
    about = part.about
    product = _named(root, "PDT", _printable(_product(part)))
    title = _printable(about.title)
    task = SubElement(root, "TSK", A=f"TSK-{number}", B=title, E="PFD-1", G=_COMPLETED)
    time = SubElement(
        task, "TIM", A=about.started_utc, B=about.ended_utc,
        C=str(round(part.flight.duration_s)), D=_EFFECTIVE,
    )  # fmt: skip
    for ddi, total in _totals(part.samples).items():
        SubElement(time, "DLV", A=f"{ddi:04X}", B=str(total), C=BOOM)
    if about.operator is not None:
        SubElement(task, "WAN", A=_named(root, "WKR", _printable(about.operator)))
    SubElement(task, "DAN", A=client_name(about), C=DEVICE)
    SubElement(task, "PAN", A=product, E=BOOM)
    for comment in _comments(part):
        SubElement(task, "CAN", C=comment)
    SubElement(task, "TLG", A=log_name, B=str(log_bytes), C="1")


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
    if about.simulated == "yes":
        return "SIMULATED: nothing was applied"
    if about.is_training:
        return f"training: {about.training}"
    return about.product or "not stated"


def _comments(source: Source) -> list[str]:
    """Return what a terminal has no place for, in lines short enough for a comment."""
    about = source.about
    lines = [
        f"flight: {about.flight}",
        f"training: {about.training}",
        f"simulated: {about.simulated}",
        f"clock: {about.utc_source}, times are UTC",
        f"map: {about.map_sha256[:_HASH_DIGITS]}",
        "volumes: model of the executed changes",
    ]
    if source.metered_l is not None:
        lines.append(f"flow meter: {source.metered_l:.3f} L")
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
    field = SubElement(root, "PFD", A="PFD-1", C=_printable(name), D=str(round(ground.area)))
    if not ground.is_empty:
        (outline,) = geographic([MultiPolygon(shapely.get_parts(ground).tolist())], setup.frame)
        _add_outline(field, shapely.get_parts(outline).tolist())


# The sprayer as ISO 11783-10 describes a device: its elements, where they sit, what they tell.

DEVICE = "DVC-1"
# Offsets of an element from the device's reference point [mm]: forward, right, down; its width.
_OFFSETS = (134, 135, 136)
_MAXIMUM_WIDTH = 70
# Kinds of elements, and when a value is logged: at even times, or in all.
_DEVICE, _FUNCTION, _SECTION, _NAVIGATION = "1", "2", "4", "7"
_BY_TIME, _TOTAL = "1", "16"
_IN_DEFAULT_SET = "1"
# ISO 11783-1: industry group 2 is agriculture, its device class 6 sprayers; no function is known
# for aircraft, and there is no number of a manufacturer.
_GROUP, _CLASS, _FUNCTION_UNKNOWN, _NO_MANUFACTURER = 2, 6, 255, 0
# English, decimal point, 24 hours, metric; the byte of units of all kinds twice (ISO 11783-7).
_LOCALIZATION = "FF000000406E65"
# How numbers are shown: millimetres as metres, raw rates as L/ha.
_SHOWN_RATE, _SHOWN_LENGTH = 1, 2
_RATES = (SETPOINT_RATE, ACTUAL_RATE)


def client_name(about: About) -> str:
    """Return the 64 bits that name a device on a bus (ISO 11783-5), made from the flight's name.

    The bit of arbitrary addresses is set, so that it can never be a real device's by accident.
    """
    identity = zlib.crc32(about.map_sha256.encode()) & 0x1F_FFFF
    name = (
        identity
        | _NO_MANUFACTURER << 21
        | _FUNCTION_UNKNOWN << 40
        | _CLASS << 49
        | _GROUP << 60
        | 1 << 63
    )
    return f"{name:016X}"


def add_device(
    root: Element, boom: Boom, about: About, *, values: Sequence[Logged], totals: Sequence[int]
) -> None:
    """Add the device with an element for the boom, one for each valve and one for the antenna."""
    device = SubElement(
        root, "DVC", A=DEVICE, B="vrspray", C=_printable(about.recorded_by),
        D=client_name(about), F=_label(boom), G=_LOCALIZATION,
    )  # fmt: skip
    objects = _Objects(device)
    body = objects.element("DET-1", _DEVICE, "Sprayer", number=0, parent=0)
    boom_element = objects.element(BOOM, _FUNCTION, "Boom", number=1, parent=body)
    objects.place(boom_element, forward_m=0.0, right_m=0.0, width=(_MAXIMUM_WIDTH, boom.width_m))
    objects.tells(boom_element, [each.ddi for each in values if each.element == BOOM])
    objects.totals(boom_element, totals)
    for number, valve in enumerate(boom.valves):
        element = objects.element(
            section(number), _SECTION, valve.name, number=2 + number, parent=boom_element
        )
        objects.place(
            element,
            forward_m=valve.forward_m,
            right_m=valve.right_m,
            width=(ACTUAL_WIDTH, valve.width_m),
        )
        objects.tells(element, [each.ddi for each in values if each.element == section(number)])
    antenna = objects.element(
        section(len(boom.valves)), _NAVIGATION, "Position", number=2 + len(boom.valves), parent=body
    )
    objects.place(antenna, forward_m=0.0, right_m=0.0, width=None)
    objects.close()


class _Objects:
    """Numbers the objects of a device, and puts them where they belong: elements come first."""

    def __init__(self, device: Element) -> None:
        self._device = device
        self._elements: dict[int, Element] = {}
        self._others: list[Element] = []
        self._last = 10  # 1 to 10 are for presentations
        for number, scale, decimals, unit in (
            (_SHOWN_RATE, "0.0001", "2", "L/ha"),
            (_SHOWN_LENGTH, "0.001", "3", "m"),
        ):
            self._others.append(Element("DVP", A=str(number), B="0", C=scale, D=decimals, E=unit))

    def element(self, id_: str, kind: str, name: str, *, number: int, parent: int) -> int:
        """Add an element and return the number of its object."""
        self._last += 1
        self._elements[self._last] = SubElement(
            self._device, "DET", A=id_, B=str(self._last), C=kind, D=_printable(name),
            E=str(number), F=str(parent),
        )  # fmt: skip
        return self._last

    def place(
        self, element: int, *, forward_m: float, right_m: float, width: tuple[int, float] | None
    ) -> None:
        """Say where an element sits, and how wide it is: identifier and metres."""
        lengths = [*zip(_OFFSETS, (forward_m, right_m, 0.0), strict=True)]
        for ddi, metres in lengths if width is None else [*lengths, width]:
            value = str(round(1000.0 * metres))
            self._add(element, "DPT", B=f"{ddi:04X}", C=value, E=str(_SHOWN_LENGTH))

    def tells(self, element: int, ddis: Sequence[int]) -> None:
        """Say which values of an element are logged."""
        for ddi in ddis:
            shown = {"F": str(_SHOWN_RATE)} if ddi in _RATES else {}
            self._add(element, "DPD", B=f"{ddi:04X}", C=_IN_DEFAULT_SET, D=_BY_TIME, **shown)

    def totals(self, element: int, ddis: Sequence[int]) -> None:
        """Say which totals of an element stand at the times of the task."""
        for ddi in ddis:
            self._add(element, "DPD", B=f"{ddi:04X}", C="0", D=_TOTAL)

    def close(self) -> None:
        """Put what elements refer to after the elements."""
        self._device.extend(self._others)

    def _add(self, element: int, tag: str, **attributes: str) -> None:
        self._last += 1
        self._others.append(Element(tag, {"A": str(self._last), **attributes}))
        SubElement(self._elements[element], "DOR", A=str(self._last))


def _label(boom: Boom) -> str:
    """Return seven bytes that change with the structure of the device."""
    told = repr([(valve.right_m, valve.forward_m, valve.width_m) for valve in boom.valves])
    return f"{zlib.crc32(told.encode()):014X}"


def _add_outline(field: Element, polygons: Iterable[Polygon]) -> None:
    """Add the outline of a field: polygons with their rings."""
    for polygon in polygons:
        element = SubElement(field, "PLN", A=_FIELD)
        for kind, ring in (("1", polygon.exterior), *(("2", hole) for hole in polygon.interiors)):
            line = SubElement(element, "LSG", A=kind)
            for east, north in ring.coords:
                # Nine decimals of a degree are 0.1 mm.
                SubElement(line, "PNT", A="2", C=f"{north:.9f}", D=f"{east:.9f}")
