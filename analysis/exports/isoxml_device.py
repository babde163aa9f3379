"""The sprayer as ISO 11783-10 describes a device: its elements, where they sit, what they tell."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import TYPE_CHECKING
from xml.etree.ElementTree import Element, SubElement

from analysis.exports.isoxml_log import (
    ACTUAL_RATE,
    ACTUAL_WIDTH,
    BOOM,
    SETPOINT_RATE,
    Logged,
    section,
)
from companion.maps.isoxml.elements import printable

if TYPE_CHECKING:
    from analysis.exports.about import About
    from companion.core.boom import Boom

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
        root, "DVC", A=DEVICE, B="vrspray", C=printable(about.recorded_by),
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
            self._device, "DET", A=id_, B=str(self._last), C=kind, D=printable(name),
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
