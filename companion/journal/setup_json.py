"""All that is constant in a flight as JSON text and back, exact to the last bit.

The ground (zones and field) is not in the text: the journal keeps it as layers, see `layers.py`.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import fields
from typing import Any, cast

from companion.core.prescription import Overlap, Prescription, Zone
from companion.core.setup import Setup
from companion.journal.codec import FIELD_NAMES, FieldNames, from_plain, to_plain
from companion.journal.layers import Ground

SETUP_VERSION = 1
# In tables of their own: the ground as layers, what earlier flights treated as tiles.
_APART = frozenset({"prescription", "treated"})


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
            key: from_plain(value, names) for key, value in document["setup"].items()
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
