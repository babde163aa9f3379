"""Whether a battery lasts for a sortie while its pieces are still being moved about."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from missions.energy import J_WH, KG_L, Battery
from missions.network import Network, rows_of
from missions.strips import Floats
from missions.turns import Motion
from missions.verticals import Vertical

# From one pass to the next, and from a ferry into a pass, the nose turns by this much or less.
NOSE_DEG = 180.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """Time and watt-hours without liquid, from end to end and along each piece.

    The rows and columns are those of `Network.between_s`, but without the search's extra time for
    a refill. `limit_wh` is what a sortie may take.
    """

    between_s: list[Sequence[float]]
    between_wh: list[Sequence[float]]
    piece_s: list[float]
    piece_wh: list[float]
    litres: list[float]
    depot: int
    start_wh: float
    start_s: float
    reserve_l: float
    per_l_wh_s: float
    limit_wh: float

    def wh(self, sortie: list[int]) -> float:
        """Return what a sortie takes."""
        left_l = self.reserve_l + sum(self.litres[enter >> 1] for enter in sortie)
        used = self.start_wh + self.per_l_wh_s * self.start_s * left_l
        here = self.depot
        for enter in sortie:
            piece = enter >> 1
            half_l = self.litres[piece] / 2.0
            seconds = self.between_s[here][enter] * left_l
            seconds += self.piece_s[piece] * (left_l - half_l)
            used += self.between_wh[here][enter] + self.piece_wh[piece]
            used += self.per_l_wh_s * seconds
            left_l -= 2.0 * half_l
            here = enter ^ 1
        home = self.between_wh[here][self.depot]
        return used + home + self.per_l_wh_s * self.between_s[here][self.depot] * left_l

    def lasts(self, sortie: list[int]) -> bool:
        """Return whether the battery lasts."""
        return not sortie or self.wh(sortie) <= self.limit_wh


def build_budget(
    network: Network,
    battery: Battery,
    motion: Motion,
    *,
    length_m: Floats,
    pace_s_m: Floats | float,
    vertical: Vertical,
    height_m: float,
    ferry_height_m: float | None,
    reserve_l: float,
    nose_rate_deg_s: float | None,
    refill_s: float,
    limit_wh: float,
) -> Budget:
    """Return the budget of a network; `pace_s_m` is the time of a metre of each piece."""
    cruise_s = length_m * pace_s_m
    stops_s = motion.legs_s(length_m) - length_m / motion.speed_m_s
    stop_s = motion.at(motion.speed_m_s).reaching_s
    between_s = network.between_s.copy()
    between_s[network.depot] -= refill_s / 2.0
    between_s[:, network.depot] -= refill_s / 2.0
    moving_s = np.where(between_s > 2.0 * stop_s, between_s - stop_s, 0.0)
    nose_s = np.zeros_like(between_s)
    if nose_rate_deg_s is not None and motion.turn == "stop":
        # Pieces that follow each other without a stop have times below zero, or just above.
        nose_s[between_s > 0.0] = NOSE_DEG / nose_rate_deg_s
    other_s = between_s - moving_s + nose_s
    between_wh = (moving_s * battery.cruise_w + other_s * battery.hover_w) / J_WH
    upper_m = height_m if ferry_height_m is None else ferry_height_m
    upright_s = vertical.climb_s(upper_m) + vertical.return_s(upper_m)
    upright_s += vertical.change_s(upper_m, height_m) + vertical.change_s(height_m, upper_m)
    piece_wh = (cruise_s * battery.cruise_w + stops_s * battery.hover_w) / J_WH
    return Budget(
        between_s=rows_of(between_s + nose_s),
        between_wh=rows_of(between_wh),
        piece_s=(cruise_s + stops_s).tolist(),
        piece_wh=piece_wh.tolist(),
        litres=network.litres.tolist(),
        depot=network.depot,
        start_wh=upright_s * battery.hover_w / J_WH,
        start_s=upright_s,
        reserve_l=reserve_l,
        per_l_wh_s=battery.per_kg_w * KG_L / J_WH,
        limit_wh=limit_wh,
    )
