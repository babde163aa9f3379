"""Every key of the configuration file, from the models that check it."""

from __future__ import annotations

import json
import re
from typing import Any

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
    return "\n".join(parts)


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
