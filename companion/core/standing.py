"""The last rule at the border, which foretells nothing: by the present state alone.

A path may be foretold wrongly. So a strip that is outside now is ordered closed, or one that would
be by its last flow if all goes on as it does; and nothing is ordered open whose first flow would
fall outside if the vehicle went on from here with any acceleration that it is capable of. The rule
only ever closes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from companion.core.boom import Boom, place_velocity
from companion.core.frame import Floats, Offset, PlainEdge
from companion.core.prescription import Prescription
from companion.core.types import VehicleState

# Of a vehicle whose acceleration nobody wrote down.
MOST_M_S2 = 2.5


# A strip so long from now, going on as it does; with its acceleration, or with what any one up to
# so much may make of it on all sides.
_Look = tuple[int, float, float | None]


class Flowing(NamedTuple):
    """What lets liquid out over the strips of some valves, and what it is about to be ordered.

    `changes` are (time, value), 0 is shut. From an order until its first flow it takes `first_s`,
    until its last one `last_s`.
    """

    valves: Sequence[int]
    is_open: bool
    changes: Sequence[tuple[float, float]]
    first_s: float
    last_s: float

    def opening(self) -> tuple[int, float] | None:
        """Return which of the changes opens it, and when; None where none does."""
        stands = self.is_open
        for number, (at_s, value) in enumerate(self.changes):
            if value > 0.0 and not stands:
                return number, at_s
            stands = value > 0.0
        return None

    def looks(self, now_s: float, most_m_s2: float) -> Iterator[_Look]:
        """Yield what is to be asked: of each strip that may be wet, and then of each that opens."""
        if self.is_open:
            for valve in self.valves:
                yield valve, 0.0, 0.0
                yield valve, self.first_s, most_m_s2
                yield valve, self.last_s, None
        opening = self.opening()
        if opening is not None:
            wait_s = max(opening[1] - now_s, 0.0)
            due_s = wait_s + self.first_s
            for valve in self.valves:
                yield valve, due_s, most_m_s2
                yield valve, max(due_s, wait_s + self.last_s), None

    def verdict(self, inside: Iterator[bool]) -> int | None:
        """Return what may be ordered, by the answers to `looks`."""
        found = None
        if self.is_open:
            for _ in self.valves:
                here, first, last = next(inside), next(inside), next(inside)
                # Over a strip that is about to come inside nothing flows yet, and nothing ends.
                if not (last if here else first):
                    found = -1
        opening = self.opening()
        if opening is None:
            return found
        every = [next(inside) for _ in self.valves for _ in range(2)]
        return opening[0] if found is None and not all(every) else found


class Standing(NamedTuple):
    """Where a boom is now, with the edges of the ground that a strip may come to soon.

    It falls from under its nozzle until `drift_m` beside it. `most_m_s2` is the vehicle's
    acceleration.
    """

    ground: Prescription
    edges: list[PlainEdge]
    state: VehicleState
    boom: Boom
    most_m_s2: float
    drift_m: Offset | None

    def kept(self, flowing: Sequence[Flowing]) -> list[int | None]:
        """Return how many of its changes each may be ordered: None for all, -1 to close it now."""
        looks: list[_Look] = []
        if not (self.edges or any(each.opening() for each in flowing)):
            return [None] * len(flowing)  # it has not left the ground since it opened
        for each in flowing:
            looks += each.looks(self.state.time_s, self.most_m_s2)
        if not looks:
            return [None] * len(flowing)
        inside = self._inside(looks, (0.0, 0.0))
        if self.drift_m is not None:
            beside = self._inside(looks, self.drift_m)
            inside = [here and there for here, there in zip(inside, beside, strict=True)]
        answers = iter(inside)
        return [each.verdict(answers) for each in flowing]

    def _inside(self, looks: list[_Look], beside_m: Offset) -> list[bool]:
        """Return whether all of each strip is inside, moved by `beside_m`."""
        east_m, north_m, sin, cos, half, margin = self._places(looks, beside_m).T[:, :, None]
        half = half + margin
        ends = np.array([edge[:4] for edge in self.edges]).reshape(-1, 4)
        x, y = ends[:, 0::2].T.ravel() - east_m, ends[:, 1::2].T.ravel() - north_m
        # Of the edges' ends: along the strip, and square to it.
        along, aside = x * cos - y * sin, x * sin + y * cos
        count = len(ends)
        u0, u1, w0, w1 = along[:, :count], along[:, count:], aside[:, :count], aside[:, count:]
        beyond = (np.minimum(u0, u1) > half) | (np.maximum(u0, u1) < -half)
        slope = (w1 - w0) / np.where(u1 == u0, np.inf, u1 - u0)
        w0 = w0 + slope * (np.clip(u0, -half, half) - u0)
        w1 = w1 + slope * (np.clip(u1, -half, half) - u1)
        beyond |= (np.minimum(w0, w1) > margin) | (np.maximum(w0, w1) < -margin)
        within = self.ground.inside(east_m[:, 0], north_m[:, 0])
        found: list[bool] = (within & beyond.all(axis=1)).tolist()
        return found

    def _places(self, looks: list[_Look], beside_m: Offset) -> Floats:
        """Return of each look the strip's middle, sine and cosine of the nose, half its width.

        And what may come to it on all sides.
        """
        state = self.state
        goes_east, goes_north = place_velocity(state)
        places: list[tuple[float, ...]] = []
        for valve, dt_s, most_m_s2 in looks:
            right, forward, half = self.boom.strips_m[valve]
            square = 0.5 * dt_s * dt_s
            gains = square if most_m_s2 is None else 0.0
            nose = math.radians((state.heading_deg or 0.0) + state.yaw_rate_deg_s * dt_s)
            sin, cos = math.sin(nose), math.cos(nose)
            east = state.east_m + goes_east * dt_s + state.acceleration_east_m_s2 * gains
            north = state.north_m + goes_north * dt_s + state.acceleration_north_m_s2 * gains
            east += right * cos + forward * sin + beside_m[0]
            north += forward * cos - right * sin + beside_m[1]
            places.append((east, north, sin, cos, half, square * (most_m_s2 or 0.0)))
        return np.array(places)


def standing(
    ground: Prescription,
    state: VehicleState,
    boom: Boom,
    *,
    most_m_s2: float,
    drift_m: Offset | None,
    within_s: float,
) -> Standing:
    """Return where the boom is; `within_s` is how soon an edge matters."""
    now_m_s2 = math.hypot(state.acceleration_east_m_s2, state.acceleration_north_m_s2)
    most_m_s2 = max(most_m_s2, now_m_s2)
    reach_m = boom.reach_m + math.hypot(*place_velocity(state)) * within_s
    reach_m += 0.5 * most_m_s2 * within_s**2
    if drift_m is not None:
        reach_m += math.hypot(*drift_m)
    east_m, north_m = state.east_m, state.north_m
    box = (east_m - reach_m, north_m - reach_m, east_m + reach_m, north_m + reach_m)
    edges = ground.near(box).edges_in(box, of_border=True)
    return Standing(ground, edges, state, boom, most_m_s2, drift_m)
