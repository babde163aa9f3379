"""Rows of the layer `applied`: where the vehicle was and what was to be applied there.

For map viewers and reports: ten a second, and one more whenever the reasons not to spray or the
state of the sprayer change. Every decision itself is in the blocks.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence

from companion.core.frame import LocalFrame, course_deg
from companion.core.types import Decision, Inhibit, SprayerState, VehicleState
from companion.record.geopackage import point_blob

EVERY_S = 0.1
# Decisions come when something arrives, not on the tick.
_EARLY_S = 0.005
Box = tuple[float, float, float, float]


class AppliedRows:
    """Makes rows of some decisions, and keeps the box around their places."""

    def __init__(self, frame: LocalFrame, time_text: Callable[[float], str | None]) -> None:
        # A projection of its own: pyproj's are not to be shared between threads.
        self._frame = LocalFrame(frame.latitude_deg, frame.longitude_deg)
        self._time_text = time_text
        self._last_s = -math.inf
        self._told: tuple[frozenset[Inhibit], SprayerState] | None = None
        self.box: Box | None = None

    def take(self, sequence: int, decision: Decision) -> tuple[object, ...] | None:
        """Return the row of a decision; None where none is due."""
        told = (decision.inhibits, decision.sprayer)
        since_s = decision.now_s - self._last_s
        if told == self._told and 0.0 <= since_s < EVERY_S - _EARLY_S:
            return None
        self._told, self._last_s = told, decision.now_s
        return self._row(sequence, decision)

    def _row(self, sequence: int, decision: Decision) -> tuple[object, ...]:
        state, duty = decision.state, decision.plan.duty
        rates = [rate for rate in decision.rate_l_ha if rate is not None]
        motion: tuple[float | None, ...] = (None, None, None, None)
        if state is not None:
            east, north = state.velocity_east_m_s, state.velocity_north_m_s
            speed_m_s = math.hypot(east, north)
            motion = (speed_m_s, course_deg(east, north), state.heading_deg, state.height_m)
        return (
            sequence,
            None if state is None else self._point(state),
            self._time_text(decision.now_s),
            decision.now_s,
            sum(rates) / len(rates) if rates else None,
            decision.target_flow_l_min,
            decision.flow_l_min,
            sum(duty) / len(duty) if duty else 0.0,
            *motion,
            " ".join(sorted(decision.inhibits)),
            _short(decision.rate_l_ha),
        )

    def _point(self, state: VehicleState) -> bytes | None:
        latitude, longitude = self._frame.to_geographic(state.east_m, state.north_m)
        if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
            return None
        west, south, east, north = self.box or (longitude, latitude, longitude, latitude)
        self.box = (
            min(west, longitude),
            min(south, latitude),
            max(east, longitude),
            max(north, latitude),
        )
        return point_blob(longitude, latitude)


def _short(values: Sequence[float | None]) -> str:
    """Return one value a valve; one alone where all are the same, as they mostly are."""
    rounded = [None if value is None else round(value, 4) for value in values]
    return json.dumps(rounded[:1] if len(set(rounded)) == 1 else rounded, separators=(",", ":"))
