"""Where to take off and refill: places on the edge of a field that are chosen together.

The best two places are not the best one and another. For each number of depots all of them are
chosen at once, such that no other two would do better in the stead of two of them (a p-median, by
exchanges after Teitz and Bart, 1968). They are compared by the time flown beside the lines: a
battery that is used up on the way sprays less of a tank, and more sorties fly that way.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np

from missions.energy import J_WH, KG_L
from missions.field import Field
from missions.free_space import FreeSpace, Ints
from missions.plan import Settings
from missions.strips import Floats, directions, lengths_m
from missions.ways import Ways, build_ways, edge_places, ways_m

# Places are so far apart, and so many: fewer on a field that does not see all of itself.
STEP_M, PLACES_MAX, PLACES_BENT = 25.0, 120, 60
# So many points stand for the lines, each for as many litres.
POINTS, GOLDEN = 150, 0.6180339887498949
DEPOTS_MAX = 6
# Flights to places farther than this part of what the battery reaches spray little.
REACH = 0.8
# One depot more is suggested where it saves so much of the time, and so long: to carry a tank there
# takes half an hour. Of ten large fields those for which the estimate said 5 % or more saved 6 to
# 19 % as planned, the others 4 % at most.
WORTH, WORTH_S = 0.05, 3600.0
# A sortie beyond its reach sprays so much of a tank, where places are compared.
LEAST_SHARE = 0.05
# How much a sortie sprays and where it begins depend on each other: looked at so often.
ROUNDS = 3
# Sums that are equal but for rounding.
SAME = 1e-9


@dataclass(frozen=True, kw_only=True)
class DepotChoice:
    """The places at which an aircraft that flies these lines may stand."""

    field: Field
    lines: Floats
    litres: Floats
    inside: FreeSpace
    settings: Settings

    def ways(self, at_least: int = 1) -> Ways:
        """Return the ways from the depots that are suggested, so many or more.

        They are the fewest from which the battery reaches all lines well, and more where each
        saves enough time.
        """
        count = at_least
        while count < DEPOTS_MAX and not self._is_near(self.from_best(count)):
            count += 1
        while count < DEPOTS_MAX and self._is_worth(count + 1):
            count += 1
        return self.from_best(count)

    def _is_worth(self, count: int) -> bool:
        """Return whether so many depots save enough of the time of one less."""
        before_s = self.seconds(count - 1)
        return before_s - self.seconds(count) > max(WORTH * before_s, WORTH_S)

    def from_best(self, count: int) -> Ways:
        """Return the ways from the best of so many depots."""
        return build_ways(self.field, self._places[self._chosen(count)], self.inside)

    def _is_near(self, ways: Ways) -> bool:
        """Return whether the battery reaches every line well."""
        home_m = ways.home_ways_m(self.lines.reshape(-1, 2)).min(axis=0)
        return float(home_m.max()) <= REACH * self.settings.reach_m

    def _chosen(self, count: int) -> list[int]:
        """Return the best places for so many depots."""
        if count not in self._known:
            before = self._chosen(count - 1) if count > 1 else []
            self._known[count] = exchanged(self._beside_s, before)
        return self._known[count]

    @cached_property
    def _known(self) -> dict[int, list[int]]:
        return {}

    def seconds(self, count: int) -> float:
        """Return about how long all sorties from the best of so many depots take, with refills."""
        return self._work_s + float(self._beside_s[self._chosen(count)].min(axis=0).sum())

    @cached_property
    def _places(self) -> Floats:
        most = PLACES_MAX if self.inside.is_convex else PLACES_BENT
        return edge_places(self.field, step_m=STEP_M, count_max=most)

    @cached_property
    def _work_s(self) -> float:
        """Return how long all lines and the turns between them take."""
        settings, sprayed = self.settings, self.litres > 0.0
        turns_s = int(sprayed.sum()) * settings.motion.between_passes_s(settings.swath_width_m)
        return float(settings.motion.legs_s(lengths_m(self.lines[sprayed])).sum()) + turns_s

    @cached_property
    def _beside_s(self) -> Floats:
        """Return the time beside the lines that each point costs from each place, (places, n)."""
        settings, litres = self.settings, self.litres
        points, line, reached_m = points_of(self.lines, litres)
        length_m = lengths_m(self.lines)
        need_l_m = litres[line] / length_m[line]
        tank_m = settings.usable_l / need_l_m
        # A sortie sprays on its way out and back, as far as its lines lead. It begins half of what
        # it flies so before its farthest place, a quarter before that in the middle.
        back_m, on_m = np.minimum([reached_m, length_m[line] - reached_m], tank_m / 4.0)
        along = directions(self.lines)[line]
        some = [points, points - back_m[:, None] * along, points + on_m[:, None] * along]
        table_m = ways_m(self._places, np.concatenate(some), self.inside)
        far_m, *ends_m = table_m.reshape(len(table_m), 3, -1).swapaxes(0, 1)
        spared_m = np.maximum(far_m - np.minimum(*ends_m), 0.0) / tank_m
        pace_s_m = self._work_s / float(length_m[litres > 0.0].sum())
        begins_m = far_m
        for _ in range(ROUNDS):
            sprayed_m = _sprayed_m(begins_m, need_l_m, settings, pace_s_m=pace_s_m)
            begins_m = far_m - spared_m * sprayed_m
        sorties = float(litres.sum()) / len(points) / need_l_m / sprayed_m
        return sorties * (
            2.0 * begins_m / settings.speed_m_s + settings.upright_s + settings.refill_s
        )


def exchanged(cost: Floats, before: list[int]) -> list[int]:
    """Return one place more than before, exchanged until no other two cost less.

    `cost` has a row for each place and a column for each point, which the best place serves.

    >>> exchanged(np.array([[2.0, 2.0, 2.0], [0.0, 1.0, 9.0], [9.0, 9.0, 0.0]]), [0])
    [1, 2]
    """
    served = cost[before].min(axis=0, initial=np.inf)
    chosen = [*before, int(np.argmin(np.minimum(cost, served).sum(axis=1)))]
    pairs = list(combinations(range(len(chosen)), 2))
    waiting = list(pairs)
    while waiting:
        pair = waiting.pop()
        others = [place for at, place in enumerate(chosen) if at not in pair]
        served = cost[others].min(axis=0, initial=np.inf)
        left = np.minimum(cost, served)
        all_of_two = np.array([np.minimum(row, left).sum(axis=1) for row in left])
        best = divmod(int(np.argmin(all_of_two)), len(cost))
        if all_of_two[best] < float(cost[chosen].min(axis=0).sum()) * (1.0 - SAME):
            for at, place in zip(pair, best, strict=True):
                chosen[at] = place
            waiting = [each for each in pairs if each != pair]
    return chosen


def points_of(lines: Floats, litres: Floats) -> tuple[Floats, Ints, Floats]:
    """Return points spread over lines by their litres, the line of each, how far along it is."""
    length_m, upto_l = lengths_m(lines), np.cumsum(litres)
    numbers = np.arange(POINTS)
    # Each somewhere else in its part of the litres: all parts may be as long as some lines.
    at_l = (numbers + numbers * GOLDEN % 1.0) / POINTS * upto_l[-1]
    line = np.minimum(np.searchsorted(upto_l, at_l, side="right"), len(lines) - 1)
    reached_m = (1.0 - (upto_l[line] - at_l) / litres[line]) * length_m[line]
    return lines[line, :2] + directions(lines)[line] * reached_m[:, None], line, reached_m


def _sprayed_m(far_m: Floats, need_l_m: Floats, settings: Settings, *, pace_s_m: float) -> Floats:
    """Return how many metres of line a sortie sprays that far from its depot.

    Its tank is empty then, or its battery has what the way back takes. Who can spray only so much
    takes no more litres along.
    """
    tank_m: Floats = np.broadcast_to(settings.usable_l / need_l_m, far_m.shape)
    battery = settings.battery
    if battery is None or battery.capacity_wh is None:
        return tank_m
    per_l_w = battery.per_kg_w * KG_L
    bare_w = battery.cruise_w + per_l_w * settings.reserve_l
    upright_ws = settings.upright_s * (battery.hover_w + per_l_w * settings.reserve_l)
    # What is left for lines is used up by their metres, and by the litres for them: on board on
    # the way out, and half of them along the lines.
    way_s = far_m / settings.speed_m_s
    left_ws = battery.usable_wh * J_WH - upright_ws - 2.0 * way_s * bare_w
    per_m_ws = pace_s_m * bare_w + way_s * per_l_w * need_l_m
    per_m2_ws = pace_s_m * per_l_w * need_l_m / 2.0
    root = np.sqrt(per_m_ws**2 + 4.0 * per_m2_ws * np.maximum(left_ws, 0.0))
    sprayed_m = 2.0 * left_ws / (per_m_ws + root)
    return np.clip(sprayed_m, LEAST_SHARE * tank_m, tank_m)
