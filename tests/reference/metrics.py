"""The figures of a flight: keys of the JSON, name, unit and meaning."""

from __future__ import annotations

import inspect
import re

from analysis.evaluation import Distances, Evaluation
from analysis.report.contents import CAUSES, DEFINITIONS

INTRODUCTION = """# Metrics

The figures of a flight as `vrspray report`, `vrspray demo --json` and `vrspray sitl fly --json` give them.
Positive distances are too late. A figure without anything to measure is `null`.
[How a flight is judged](../explanation/metrics.md) explains them.
"""
MORE: dict[str, tuple[str, str]] = {
    "limit_ratio": ("", "misapplied volume, divided by that of a flight with perfect knowledge"),
    "section_volume_error_percent": ("%", "the volume error, valve by valve"),
    "zone_volume_error_percent": ("%", "the volume error, zone by zone"),
    "applied_ml": ("mL", "volume that was applied"),
}


def page() -> str:
    """Return the page; KeyError for a key of the JSON that is not described."""
    keys = re.findall(
        r'^            "(\w+)": ', inspect.getsource(Evaluation.as_json), re.MULTILINE
    )
    parts = [INTRODUCTION, "## Keys\n\n| Key | Name | Unit | Meaning |\n|---|---|---|---|"]
    for key in keys:
        if key in DEFINITIONS:
            name, unit, meaning = DEFINITIONS[key]
        else:
            (unit, meaning), name = MORE[key], ""
        # A bar would end the cell.
        meaning = meaning.replace("|", "&#124;")
        parts.append(f"| `{key}` | {name} | {unit} | {meaning} |")
    fields = ", ".join(f"`{name}`" for name in Distances.__dataclass_fields__)
    parts.append(
        f"\nThe distances (`lag_distance_m`, `settled_lag_distance_m`, `border_margin_m`) are objects with "
        f"{fields}. The settled one has `apart` and `missed` of its own, the margin the `bound` of physics.\n"
    )
    parts.append("## Causes\n\nWhy ground got another dose, as the report names it.\n")
    parts.append("| Key | In the report |\n|---|---|")
    parts += [f"| `{key}` | {text} |" for key, text in CAUSES.items()]
    return "\n".join(parts)
