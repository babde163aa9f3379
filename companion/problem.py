"""One thing that is wrong or remarkable about a map, a configuration or a sprayer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """One thing that is wrong or remarkable, where it is, and what the operator can do."""

    severity: Severity
    code: str
    text: str
    where: str = ""
    fix: str = ""

    def __post_init__(self) -> None:
        if self.severity not in ("error", "warning"):
            raise ValueError(f"no severity: {self.severity}")
