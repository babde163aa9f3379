"""Settings that are compiled into a flight map, and a configuration that says something else.

Where a flight goes on with other settings than those that the map was checked with, the map that
was checked is not the map that is flown: such a flight is refused, and the key is named.
"""

from __future__ import annotations

from pathlib import PurePosixPath

from companion.config import Config
from companion.config.tables import PrescriptionTable
from companion.flight_map.model import FlightMap

# What the ground and its rates depend on.
_FROZEN = ("overlap", "default_rate_l_ha", "unit", "density_kg_l", "boundary", "exclusions")
# How the source was read: a configuration that says nothing of it does not object.
_READING = ("rate_field", "crs", "layer", "flow_width_m", "flow_speed_m_s", "merge", "origin")
_LINES = "mission.lines"


def frozen_settings(table: PrescriptionTable, lines: str | None) -> dict[str, object]:
    """Return the settings that are frozen in a flight map, as JSON has them."""
    found = table.model_dump(mode="json", include={*_FROZEN, *_READING})
    named = {f"prescription.{name}": found[name] for name in (*_FROZEN, *_READING)}
    return {**named, _LINES: lines}


def difference(flight_map: FlightMap, config: Config) -> tuple[str, object, object] | None:
    """Return the first frozen key in which flight map and configuration differ, and both values.

    The configuration's value comes first. Files are compared by their names here: those of the
    office lie in other folders.
    """
    if config.prescription is None:
        return None
    lines = None if config.mission is None else config.mission.lines
    for key, wanted in frozen_settings(config.prescription, lines).items():
        compiled = flight_map.frozen.get(key)
        is_hint = key.removeprefix("prescription.") in _READING
        if is_hint and wanted is None:
            continue
        if _comparable(key, wanted) != _comparable(key, compiled):
            return key, wanted, compiled
    return None


def _comparable(key: str, value: object) -> object:
    if key in ("prescription.boundary", _LINES) and isinstance(value, str):
        return PurePosixPath(value).name
    if key == "prescription.exclusions" and isinstance(value, list):
        return [PurePosixPath(str(name)).name for name in value]
    return value
