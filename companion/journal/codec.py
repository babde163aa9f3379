"""Values of the core as JSON text and back, exact to the last bit.

Floats are written by `repr` (shortest text that reads back the same), NaN and infinities as
Python's JSON writes them. A tuple is an array; a dataclass is `{"Name": [values]}` in the order of
its fields, an enumeration `{"Name": value}`, a set `{"frozenset": [values]}`. The names of the
fields are kept once a file, so that a version with more fields still reads the older ones.
Nothing but the core's own types can come out: a journal is read, never executed.

All that is constant in a flight is such text, too. Its ground (zones and field) is not in it: the
journal keeps that as layers, see `geopackage.py`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from types import ModuleType
from typing import Any, cast, get_args, get_type_hints

import numpy as np

from companion.core import boom, frame, nozzle, safety, schedule, setup, types
from companion.core.options import atomisers, pump
from companion.core.prescription import Overlap, Prescription, Zone
from companion.core.setup import Setup
from companion.journal.geopackage import Ground

_MODULES = (types, boom, nozzle, schedule, safety, frame, pump, atomisers, setup)
_SCALARS = frozenset({float, int, str, bool, type(None)})
_SET = "frozenset"

FieldNames = Mapping[str, Sequence[str]]

# What older journals call types, and fields of them: they stay readable.
_RENAMED_TYPES = {"Way": "MissionLeg"}
_RENAMED_FIELDS = {
    ("VehicleState", "way"): "mission_leg",
    ("VehicleState", "way_before"): "mission_leg_before",
    ("Pump", "way"): "outlet",
    ("Detection", "restless_share"): "unsteady_share",
}


def _core_types(modules: Sequence[ModuleType]) -> dict[str, type]:
    """Return every dataclass and enumeration that the modules of the core can name."""
    found: dict[str, type] = {}
    for module in modules:
        for name, item in vars(module).items():
            if not (isinstance(item, type) and item.__module__.startswith("companion.core.")):
                continue
            if is_dataclass(item) or issubclass(item, Enum):
                found[name] = item
    return found


_TYPES = _core_types(_MODULES)
_FIELDS: dict[type, tuple[str, ...]] = {
    item: tuple(field.name for field in fields(item) if field.init)
    for item in _TYPES.values()
    if is_dataclass(item)
}


def _kept(kinds: Iterable[object]) -> set[type]:
    """Return the dataclasses that values of these kinds consist of.

    What a set-up works out of itself is none of them: it is worked out again where it is read.
    """
    found: set[type] = set()
    left = list(kinds)
    while left:
        kind = left.pop()
        left += get_args(kind)
        if isinstance(kind, type) and kind in _FIELDS and kind not in found:
            found.add(kind)
            hints = get_type_hints(kind)
            left += [hints[name] for name in _FIELDS[kind]]
    return found


_KEPT = _kept((setup.Setup, types.Decision, types.Input))
# Of what stands in a journal; all else would only lengthen it.
FIELD_NAMES: FieldNames = {item.__name__: names for item, names in _FIELDS.items() if item in _KEPT}


def to_plain(value: object) -> object:
    """Return `value` as what JSON knows; ValueError for what is no value of the core."""
    kind = type(value)
    if kind in _SCALARS:
        return value
    if isinstance(value, tuple):
        return [to_plain(item) for item in value]
    names = _FIELDS.get(kind)
    if names is not None:
        return {kind.__name__: [to_plain(getattr(value, name)) for name in names]}
    if isinstance(value, frozenset):
        return {_SET: [to_plain(item) for item in sorted(value)]}
    if isinstance(value, Enum):
        return {kind.__name__: value.value}
    if isinstance(value, np.generic):
        return to_plain(value.item())
    raise ValueError(f"no value of the core: {value!r}")


def from_plain(plain: object, field_names: FieldNames) -> object:
    """Return the value that `to_plain` made `plain` of; ValueError for anything else."""
    if isinstance(plain, list):
        return tuple(from_plain(item, field_names) for item in plain)
    if not isinstance(plain, dict):
        return plain
    if len(plain) != 1:
        raise ValueError(f"one type expected, got {sorted(plain)}")
    ((name, content),) = plain.items()
    if name == _SET:
        return frozenset(from_plain(item, field_names) for item in content)
    kind = _TYPES.get(_RENAMED_TYPES.get(name) or name)
    if kind is None:
        raise ValueError(f"unknown type {name}")
    if issubclass(kind, Enum):
        return kind(content)
    try:
        values = [from_plain(item, field_names) for item in content]
        names = [_RENAMED_FIELDS.get((name, field), field) for field in field_names[name]]
        return kind(**dict(zip(names, values, strict=True)))
    except (TypeError, KeyError, ValueError) as error:
        raise ValueError(f"no {name} of this version: {error}") from error


def encode(value: object) -> str:
    """Return `value` as one line of JSON.

    >>> encode(types.SpeedReport(received_s=0.1, ground_speed_m_s=float("nan")))
    '{"SpeedReport":[0.1,NaN]}'
    """
    return json.dumps(to_plain(value), separators=(",", ":"))


def decode(text: str, field_names: FieldNames = FIELD_NAMES) -> object:
    """Return the value that `encode` wrote; ValueError for anything else.

    >>> decode('{"SpeedReport":[0.1,5.0]}')
    SpeedReport(received_s=0.1, ground_speed_m_s=5.0)
    """
    return from_plain(json.loads(text), field_names)


SETUP_VERSION = 1
# In tables of their own: the ground as layers, what earlier flights treated as tiles.
_APART = frozenset({"prescription", "treated"})
# Of older journals: an option that moved doses, where it was on, by the flow of single valves.
_GONE = "valve_tracking"


def setup_to_json(setup: Setup) -> str:
    """Return `setup` without its ground as one line of JSON."""
    prescription = setup.prescription
    return json.dumps(
        {
            "version": SETUP_VERSION,
            "fields": FIELD_NAMES,
            "prescription": {
                "overlap": prescription.overlap,
                "default_rate_l_ha": prescription.default_rate_l_ha,
                "sha256": prescription.sha256,
            },
            "setup": {
                field.name: to_plain(getattr(setup, field.name))
                for field in fields(setup)
                if field.init and field.name not in _APART
            },
        }
    )


def calibration_sha256(setup: Setup) -> str:
    """Return what changes with anything that was measured of the sprayer, and with nothing else."""
    own_lags_s = tuple(valve.lags_s for valve in setup.boom.valves)
    measured: tuple[object, ...] = (setup.nozzle_sets, setup.lag, setup.pwm)
    if any(any(each) for each in own_lags_s):
        measured = (*measured, own_lags_s)
    text = json.dumps(to_plain(measured), separators=(",", ":"))
    return hashlib.sha256(text.encode("ascii")).hexdigest()


def field_names_of(text: str) -> FieldNames:
    """Return the names of the fields of every type, as they were when `text` was written."""
    return cast(FieldNames, json.loads(text)["fields"])


def setup_from_json(text: str, ground: Ground) -> Setup:
    """Return the setup that `setup_to_json` wrote; ValueError for anything else."""
    try:
        document: dict[str, Any] = json.loads(text)
        if document["version"] != SETUP_VERSION:
            raise ValueError(f"set-up of version {document['version']}")
        names: FieldNames = document["fields"]
        values: dict[str, Any] = {
            key: from_plain(value, names)
            for key, value in document["setup"].items()
            if key != _GONE
        }
        about = document["prescription"]
        overlap: Overlap = about["overlap"]
        prescription = Prescription(
            [
                Zone(name=name, polygon=polygon, rate_l_ha=rate_l_ha)
                for name, rate_l_ha, polygon in ground.zones
            ],
            boundary=ground.field,
            cells=ground.cells,
            overlap=overlap,
            default_rate_l_ha=about["default_rate_l_ha"],
            sha256=about["sha256"],
        )
        return Setup(prescription=prescription, **values)
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"set-up of another version: {error!r}") from error
