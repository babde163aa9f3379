"""Every key of the configuration file, from the models that check it."""

from __future__ import annotations

import json
import re
from typing import Any

from companion.config.legal_entries import ASKED
from companion.config.limits import LimitsFile
from companion.config.model import Config
from companion.config.wording import allowed_text

INTRODUCTION = """# Configuration keys

Every table and key of the configuration file, as the program checks them. How to write a file:
[configure a sprayer](../howto/configure.md). `vrspray config schema` prints the same as a JSON
Schema for editors.

*Write* says what is accepted; anything else is refused, with the key, the value and what to write
instead. A key without a default, marked **required**, has to be given if its table is; `-` means
that it is not set.
"""
RULES = """## What the tables must say together

| Rule | Reason |
|---|---|
| names and channels of valves are used once | an order is for one valve |
| every valve is in a nozzle set, and every name in a set is a valve | a valve in no set would never open |
| `flow_l_min` and `duty` increase strictly | otherwise two duty cycles would give one flow |
| `lag.on_start_s` ≤ `lag.on_s`, `lag.off_end_s` ≥ `lag.off_s` | the first drop comes before the step, the last drop after it |
| `lag.up_time_s` ≤ `lag.up_s`, `lag.down_time_s` ≤ `lag.down_s` | a time constant is part of its lag |
| a pump that makes the flow has one nozzle set, without `duty` and `flow_l_min` | the pump's curve sets the flow; the valves only open and close |
| `pump.us`, `pump.flow_l_min`, `atomiser.us` and `atomiser.rpm` increase strictly | one pulse for one flow or speed |
| `pwm.valve = "normally-open"` needs `safety.pump_cutoff = true` | such valves spray when the power fails |
| `safety.enable_by` leaves a way to enable: `command`, or `rc` with `safety.rc_channel` | otherwise nobody could enable spraying |
| no rate of the map is above `product.rate_max_l_ha` | the label is the law |
| `mission.lines_aside_m` is at most half of `mission.swath_width_m` | otherwise the next line could be the nearer one |
| `mission.swath_width_m` is within 2 % of `boom.width_m`, and so is the sum of the strips, with no gap or overlap above 2 % between them (`config check` and `run`) | otherwise every pass leaves a skip or an overlap |
| every entry of `safety.modes` is a flight mode of ArduPilot or PX4 (`config check` and `run`) | otherwise nothing is ever sprayed |
"""
# What the end of a key's name says about its unit, longest first.
UNITS = {
    "l_min_m_s": "L/min per m/s", "kg_l": "kg/L", "l_min": "L/min", "l_ha": "L/ha",
    "m_s2": "m/s²", "m_s3": "m/s³", "m_s": "m/s", "deg_s": "°/s", "per_l": "per L",
    "ml_min": "mL/min", "percent": "%", "mah": "mAh", "kpa": "kPa", "bar": "bar", "rpm": "rpm",
    "deg": "°", "hz": "Hz", "ms": "ms", "us": "µs", "um": "µm", "ohm": "Ω", "ma": "mA",
    "min": "min", "ha": "ha", "mb": "MB", "mm": "mm", "ml": "mL", "kg": "kg", "wh": "Wh",
    "l": "L", "m": "m", "s": "s", "c": "°C", "w": "W", "v": "V", "days": "days",
}  # fmt: skip


def page() -> str:
    """Return the page: one heading a table of the file."""
    schema = Config.model_json_schema(by_alias=True)
    parts = [INTRODUCTION]
    for table, node in schema["properties"].items():
        reference, is_list = _reference(node)
        if reference is None:
            continue
        definition = schema["$defs"][reference.rpartition("/")[2]]
        parts.append(f"## {table}\n")
        parts.append(_about(table, definition, is_list=is_list) + "\n")
        parts.append("| Key | Unit | Write | Default | Meaning |\n|---|---|---|---|---|")
        parts += [*_rows(table, definition, schema), ""]
    return "\n".join([*parts, _limits(), _asked(), RULES])


LIMITS = """## The limits file

What `limits.file` names: a TOML file of its own with the limits of one label and permit. What is absent
is not limited. [How to use it](../howto/keep-label-and-permit.md).

| Key | Unit | Write | Default | Meaning |
|---|---|---|---|---|"""


ASKED_HEAD = """## What the record asks for

By `application.profile`; the flight adds area, places, times and quantities.

| Profile | Keys |
|---|---|"""


def _asked() -> str:
    rows = [
        f"| `{name}` | {', '.join(f'`{key}`' for key in keys)} |" for name, keys in ASKED.items()
    ]
    return "\n".join([ASKED_HEAD, *rows, ""])


def _limits() -> str:
    schema = LimitsFile.model_json_schema()
    rows = [row.replace("| `limits.", "| `", 1) for row in _rows("limits", schema, schema)]
    rows += _rows("buffer", schema["$defs"]["BufferTable"], schema)
    return "\n".join([LIMITS, *rows, ""])


def _reference(node: dict[str, Any]) -> tuple[str | None, bool]:
    branch = next((b for b in node.get("anyOf", [node]) if b.get("type") != "null"), node)
    item = branch.get("items", {})
    return branch.get("$ref") or item.get("$ref"), "$ref" in item


def _about(table: str, definition: dict[str, Any], *, is_list: bool) -> str:
    about = " ".join(str(definition.get("description", "")).split())
    about = re.sub(r"[;:,]? see [\w.-]+\.md", "", about)
    head = f"`[[{table}]]`, one table each. " if is_list else f"`[{table}]`. "
    return head + about


def _rows(table: str, definition: dict[str, Any], schema: dict[str, Any]) -> list[str]:
    rows = []
    for key, leaf in definition["properties"].items():
        if key in definition.get("required", []):
            default = "**required**"
        else:
            default = "-" if leaf["default"] is None else f"`{json.dumps(leaf['default'])}`"
        allowed = allowed_text(leaf, schema, key)
        rows.append(
            f"| `{table}.{key}` | {unit(key)} | {allowed} | {default} | {leaf['description']} |"
        )
    return rows


def unit(key: str) -> str:
    """Return the unit that a key's name ends with; empty where it has none.

    >>> unit("speed_m_s"), unit("width_m"), unit("modes")
    ('m/s', 'm', '')
    """
    return next((unit for end, unit in UNITS.items() if key == end or key.endswith(f"_{end}")), "")
