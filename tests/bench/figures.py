"""A measured figure, its target, the alternative beside it; statistics, JSON, a table."""

from __future__ import annotations

import gc
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """One figure with what it is judged by; `n` says how many samples stand behind it.

    `alternative` is another way to do the same, measured in the same run. `section` is where the
    page has it; figures of one `row` are one line of the page's summary.
    """

    key: str
    what: str
    value: float | None
    unit: str
    n: int
    target: float | None = None
    is_at_least: bool = False
    alternative: dict[str, float | None] = field(default_factory=dict)
    details: dict[str, Any] = field(default_factory=dict)
    section: str = ""
    row: str = ""

    @property
    def met(self) -> bool | None:
        """Return whether the target is met; None without a target, False without a value."""
        if self.target is None:
            return None
        if self.value is None:
            return False
        return self.value >= self.target if self.is_at_least else self.value <= self.target

    def as_json(self) -> dict[str, Any]:
        """Return the figure as it stands in the results."""
        return {
            "what": self.what,
            "value": rounded(self.value),
            "unit": self.unit,
            "n": self.n,
            "target": self.target,
            "bound": None if self.target is None else (">=" if self.is_at_least else "<="),
            "met": self.met,
            "alternative": rounded(self.alternative),
            "section": self.section,
            "row": self.row,
            **rounded(self.details),
        }

    @classmethod
    def from_json(cls, key: str, found: dict[str, Any]) -> Figure:
        """Return the figure that `as_json` wrote."""
        rest = dict(found)
        known = {name: rest.pop(name) for name in ("what", "value", "unit", "n", "target")}
        bound, _ = rest.pop("bound"), rest.pop("met")
        return cls(
            key=key,
            **known,
            is_at_least=bound == ">=",
            alternative=rest.pop("alternative", {}),
            section=rest.pop("section", ""),
            row=rest.pop("row", ""),
            details=rest,
        )


def rounded(value: Any) -> Any:
    """Return `value` with its floats cut to five digits; not a number is None."""
    if isinstance(value, float):
        return float(f"{value:.5g}") if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(item) for item in value]
    return value


def spread(samples: Sequence[float]) -> dict[str, float]:
    """Return mean, median, 99th percentile and greatest value."""
    values = np.asarray(samples, dtype=np.float64)
    return {
        "mean": float(values.mean()),
        "p50": float(np.percentile(values, 50)),
        "p99": float(np.percentile(values, 99)),
        "max": float(values.max()),
    }


@contextmanager
def collector_as_in_flight() -> Iterator[None]:
    """Have the garbage collector as `runtime.execute` has it: on, what exists by now frozen."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def table(figures: Sequence[Figure]) -> str:
    """Return the figures as lines for people."""
    head = ("figure", "value", "target", "", "n", "alternative")
    rows = [head, *(_row(figure) for figure in figures)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(head) - 1)]
    lines = []
    for row in rows:
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=False))
        lines.append("  ".join((*cells, row[-1])).rstrip())
    return "\n".join(lines)


def _row(figure: Figure) -> tuple[str, ...]:
    bound = ">=" if figure.is_at_least else "<="
    verdict = {None: "", True: "ok", False: "MISSED"}[figure.met]
    others = ", ".join(f"{name} {short(value)}" for name, value in figure.alternative.items())
    return (
        figure.what,
        f"{short(figure.value)} {figure.unit}",
        "" if figure.target is None else f"{bound} {figure.target:g}",
        verdict,
        str(figure.n),
        others,
    )


def short(value: float | None) -> str:
    """Return a number in few digits.

    >>> short(1234.5), short(0.012345), short(None)
    ('1234', '0.0123', '-')
    """
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"
