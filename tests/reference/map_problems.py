"""Every code that a problem of a map can have, with its meaning, an example and the fix."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

PROBLEMS = Path(__file__).with_name("map_problems.toml")
INTRODUCTION = """# Map problems

What `vrspray map check`, `map compile`, `map convert` and `run` can find wrong with a map. A *refusal*
ends with exit code 2, an *error* with 1; a map with *warnings* can be used. With `--json` each problem
is an object with `severity`, `code`, `text`, `where` and `fix`, also for a map that is refused.
"""


def problems() -> list[dict[str, Any]]:
    """Return the catalogue, in its order."""
    found: list[dict[str, Any]] = tomllib.loads(PROBLEMS.read_text(encoding="utf-8"))["problem"]
    return found


def shown(example: str) -> str:
    """Return an example as a person reads it, without the braces around its values."""
    return example.replace("{", "").replace("}", "")


def page() -> str:
    """Return the page: a table a section."""
    parts, section = [INTRODUCTION], None
    for one in problems():
        if one["section"] != section:
            section = one["section"]
            parts.append(
                f"\n## {section}\n\n| Code | | Meaning | Example | Fix |\n|---|---|---|---|---|"
            )
        codes = ", ".join(f"`{code}`" for code in one["codes"])
        cells = (codes, one["severity"], one["meaning"], shown(one["example"]), one["fix"])
        parts.append(f"| {' | '.join(cells)} |")
    return "\n".join(parts)
