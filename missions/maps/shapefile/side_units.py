"""Units of columns from the file that John Deere's programs write beside a shapefile.

`<name>-Deere-Metadata.json` lists the columns as `DataAttributes`, with a unit for each, such as
`gal1ac-1`. What cannot be read in it is nothing: the unit is then asked for, as without the file.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

from missions.maps.layer import Column

_BYTES_MAX = 1024 * 1024
_DBF_NAME = 10
_UNIT_MEMBERS = ("unit", "units", "unitid", "uom")


def with_units(columns: Sequence[Column], metadata: bytes | None) -> tuple[Column, ...]:
    """Return the columns with the units that the metadata states for them.

    Where it states two for one column, it states none.
    """
    if metadata is None or len(metadata) > _BYTES_MAX:
        return tuple(columns)
    stated: dict[str, set[str]] = {}
    for name, unit in _attributes(metadata):
        # The table cuts names at ten characters, the metadata does not.
        stated.setdefault(name[:_DBF_NAME].casefold(), set()).add(unit)
    units = {name: next(iter(said)) for name, said in stated.items() if len(said) == 1}
    return tuple(
        replace(column, unit=units.get(column.name[:_DBF_NAME].casefold())) for column in columns
    )


def _attributes(metadata: bytes) -> list[tuple[str, str]]:
    """Return names and units of all columns for which there is a unit."""
    try:
        document = json.loads(metadata.decode("utf-8-sig"))
    except (ValueError, RecursionError):
        return []
    attributes = document.get("DataAttributes") if isinstance(document, dict) else None
    found = []
    for attribute in attributes if isinstance(attributes, list) else ():
        if not isinstance(attribute, dict):
            continue
        members = {str(key).casefold(): value for key, value in attribute.items()}
        name = members.get("name")
        unit = next((members[key] for key in _UNIT_MEMBERS if members.get(key)), None)
        if isinstance(name, str) and isinstance(unit, str) and unit.strip():
            found.append((name.strip(), unit.strip()[:40]))
    return found
