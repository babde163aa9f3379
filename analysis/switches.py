"""Gaps and overlaps at every switch on and off, as section control is judged."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from analysis.lag import Step, Verdict

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.strips import Strip


@dataclass(frozen=True, slots=True, kw_only=True)
class Switch:
    """One switch of one valve: ground left out, ground sprayed that should not be.

    Both follow from the volume-equivalent switch against the boundary, times the strip's width;
    a switch that never came leaves out its whole stretch, or sprays it.
    """

    valve: int
    kind: Literal["on", "off"]
    time_s: float
    border: bool
    gap_m2: float
    overlap_m2: float


def switches_of(strip: Strip, steps: Sequence[Step]) -> list[Switch]:
    """Return every switch of one strip whose place is known."""
    lengths_m = {run.start_s: run.end_m - run.start_m for run in strip.stretches}
    found: list[Switch] = []
    for step in steps:
        change = step.change
        if change.before_l_ha > 0.0 and change.after_l_ha > 0.0:
            continue
        late_m = step.lag_distance_m
        if step.verdict is Verdict.MISSED:
            late_m = lengths_m[change.time_s]
        if late_m is None:
            continue
        kind: Literal["on", "off"] = "on" if change.after_l_ha > 0.0 else "off"
        area_m2 = late_m * strip.track.value(strip.track.across_m, change.time_s)
        gap_m2 = area_m2 if kind == "on" else -area_m2
        found.append(
            Switch(
                valve=change.valve,
                kind=kind,
                time_s=change.time_s,
                border=change.border,
                gap_m2=max(gap_m2, 0.0),
                overlap_m2=max(-gap_m2, 0.0),
            )
        )
    return found
