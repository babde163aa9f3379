"""The time log of ISO 11783-10: TLG00001.xml names what TLG00001.bin holds, record by record.

A record is little-endian: milliseconds of the day (uint32) and days since 1980-01-01 (uint16),
then what the template's position leaves empty, here north and east (int32, 1e-7 degrees), status
(uint8), GPS time of day (uint32, ms) and date (uint16, days since 1980); the number of values
(uint8), and for each its place in the template (uint8) and the value (int32). Data dictionary
identifiers and their resolutions are those of ISO 11783-11.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
from numpy.typing import NDArray

from analysis.exports.utc import utc_ms

if TYPE_CHECKING:
    from analysis.exports.samples import Samples

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LOG_NAME = "TLG00001"
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
    """Return TLG00001.xml: attributes without a value stand for what each record holds."""
    time = Element("TIM", A="", D="4")
    SubElement(time, "PTN", A="", B="", D="", H="", I="")
    for each in values:
        SubElement(time, "DLV", A=f"{each.ddi:04X}", B="", C=each.element)
    indent(time)
    content: bytes = tostring(time, encoding="UTF-8", xml_declaration=True)
    return content + b"\n"


def records(samples: Samples, values: list[Logged]) -> bytes:
    """Return TLG00001.bin."""
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
