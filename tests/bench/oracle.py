"""Whether a valve may be open, judged again from the inputs alone, without the core's own code.

It knows less than the interlock (no map, no filter): what it forbids nothing may open; what it
allows the interlock may still refuse.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from companion.core.types import (
    Decision,
    EstimatorReport,
    Fix,
    GnssReport,
    HeartbeatReport,
    Input,
    LandedReport,
    OperatorCommand,
    OutputReport,
    SpeedReport,
    Telemetry,
    WindReport,
)

_AGES_S: dict[type, float] = {
    Telemetry: 0.85,
    HeartbeatReport: 2.5,
    GnssReport: 5.0,
    EstimatorReport: 5.0,
    LandedReport: 5.0,
    SpeedReport: 1.0,
}


@dataclass(slots=True)
class Oracle:
    """The newest input of each kind, and the consent of the operator."""

    newest: dict[type, Input] = field(default_factory=dict)
    enabled: bool = False

    def hear(self, item: Input) -> None:
        """Take one input."""
        before = self.newest.get(type(item))
        if isinstance(item, WindReport) and item.speed_m_s is None:
            return  # says nothing of the wind: what was known of it before stays
        if (
            isinstance(item, Telemetry)
            and isinstance(before, Telemetry)
            and _is_stray(item, before)
        ):
            return
        self.newest[type(item)] = item
        if isinstance(item, OperatorCommand):
            self.enabled = item.enable
        elif isinstance(item, HeartbeatReport) and isinstance(before, HeartbeatReport):
            disarmed = before.armed and not item.armed
            left = before.mode in ("AUTO", "MISSION") and item.mode not in ("AUTO", "MISSION")
            self.enabled = self.enabled and not (disarmed or left)

    def forbids(self, now_s: float) -> Iterator[str]:
        """Yield why nothing may be open."""
        if not self.enabled:
            yield "the operator has not enabled, or the pilot has taken over"
        for kind, age_s in _AGES_S.items():
            item = self.newest.get(kind)
            if item is None or not now_s - item.received_s <= age_s + 1e-6:
                yield f"{kind.__name__} is missing or old"
            elif not _is_good(item):
                yield f"{item}"
        for kind in (WindReport, OutputReport):
            item = self.newest.get(kind)
            if item is not None and not _is_good(item):
                yield f"{item}"


def _is_stray(item: Telemetry, before: Telemetry) -> bool:
    """Whether a position does not go on from a fresh one: a late copy, or of another clock.

    It is dropped, good or bad; where the stream has stopped, what comes then is judged.
    """
    passed_s = item.received_s - before.received_s
    ahead_s = (item.boot_s - before.boot_s) - passed_s
    return passed_s <= _AGES_S[Telemetry] and not (item.boot_s > before.boot_s and ahead_s <= 1.0)


_GOOD: dict[type, Callable[[Any], bool]] = {
    HeartbeatReport: lambda item: item.armed and item.mode in ("AUTO", "MISSION"),
    GnssReport: lambda item: item.fix >= Fix.RTK_FLOAT,
    EstimatorReport: lambda item: item.healthy,
    OutputReport: lambda item: item.healthy and item.link_up,
    LandedReport: lambda item: item.in_air is True,
    SpeedReport: lambda item: (
        item.ground_speed_m_s is not None and 0.0 <= item.ground_speed_m_s <= 13.0
    ),
    WindReport: lambda item: 0.0 <= item.speed_m_s <= 6.0,
    Telemetry: lambda item: abs(item.latitude_deg) <= 90.0 and item.heading_deg is not None,
}


def _is_good(item: Input) -> bool:
    return _GOOD[type(item)](item)


def open_under(decision: Decision, oracle: Oracle) -> str | None:
    """Return why a plan that opens should not; None for one that is right."""
    if decision.plan.is_off:
        return None
    if decision.inhibits:
        return f"{decision.now_s}: open under {sorted(decision.inhibits)}"
    for reason in oracle.forbids(decision.now_s):
        return f"{decision.now_s}: open though {reason}"
    return None
