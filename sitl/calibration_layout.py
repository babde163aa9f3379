"""The flight that `vrspray calibrate lag` needs: strips across the passes, a step at every edge.

Each cycle goes closed, low, high, low, closed or closed, high, low, high, closed by turns: one
change of each kind. Every strip is long enough for the flow to settle and then to be metered over
whole PWM periods. Strips of rate 0 lie between the cycles and around them, so all steps are inside
the field and every valve changes at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from analysis.calibration.steps import settle_s
from companion.core.nozzle import SET_UP_FRACTION, set_change_l_min
from companion.errors import ConfigError

if TYPE_CHECKING:
    from companion.config import Config

CYCLES = 12
STEADY_S = 1.6  # of metered flow on both sides of a step
PASS_MAX_M = 200.0
RUN_OUT_M = 20.0
MARGIN_M = 4.0  # strips are wider than the boom by this
TURN_S = 8.0  # about, for the stated duration
DEFAULT_SPEED_M_S = 5.0
DEFAULT_HEIGHT_M = 3.5
# Within the valves' window, away from its ends: the speed is not quite that of the mission.
LOW_SHARE, HIGH_SHARE = 0.15, 0.90
# A low flow that must not have the controller change to a smaller nozzle set.
ABOVE_SET = 1.05
STEP_MIN = 0.15


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """The whole flight: every pass has the same strips, one after the other along it.

    `flows_l_min` are those of the strips of one pass, closed ones included.
    """

    speed_m_s: float
    height_m: float
    strip_m: float
    width_m: float
    boom_m: float
    passes: tuple[tuple[float, ...], ...]

    @property
    def volume_l(self) -> float:
        """Return what is sprayed in all."""
        return math.fsum(map(math.fsum, self.passes)) * self.strip_m / self.speed_m_s / 60.0

    @property
    def duration_s(self) -> float:
        """Return how long the passes and the turns between them take, about."""
        length_m = math.fsum(len(flows) * self.strip_m + 2.0 * RUN_OUT_M for flows in self.passes)
        return length_m / self.speed_m_s + TURN_S * len(self.passes)


def make_layout(config: Config) -> Layout:
    """Return strips for twelve changes of each kind, for the sprayer of a configuration."""
    speed_m_s = DEFAULT_SPEED_M_S if config.mission is None else config.mission.speed_m_s
    height_m = DEFAULT_HEIGHT_M if config.mission is None else config.mission.height_m
    low, high = _flows(config)
    strip_m = speed_m_s * (settle_s(config.lag_model()) + STEADY_S)
    per_pass = max(1, min(CYCLES, int((PASS_MAX_M / strip_m - 1.0) / 4.0)))
    cycles = [(low, high, low) if i % 2 == 0 else (high, low, high) for i in range(CYCLES)]
    passes = []
    for first in range(0, CYCLES, per_pass):
        flows = [0.0]
        for cycle in cycles[first : first + per_pass]:
            flows += [*cycle, 0.0]
        passes.append(tuple(flows))
    boom_m = config.boom().width_m
    return Layout(
        speed_m_s=speed_m_s,
        height_m=height_m,
        strip_m=strip_m,
        width_m=boom_m + MARGIN_M,
        boom_m=boom_m,
        passes=tuple(passes),
    )


def _flows(config: Config) -> tuple[float, float]:
    """Return a low and a high flow that all valves of the largest set can make."""
    sets, pwm = config.nozzle_sets(), config.pwm_limits()
    curve = sets[-1].curve
    window = pwm.duty_max - pwm.duty_min
    low = curve.flow_for(max(pwm.duty_min + LOW_SHARE * window, curve.duty[0]))
    high = curve.flow_for(min(pwm.duty_min + HIGH_SHARE * window, curve.duty[-1]))
    if len(sets) > 1:
        low = max(low, set_change_l_min(sets[-2], sets[-1]) * SET_UP_FRACTION * ABOVE_SET)
    if not low <= (1.0 - STEP_MIN) * high:
        raise ConfigError(
            f"{config.path}: the largest nozzle set makes {low:.2f} to {high:.2f} L/min and no "
            f"step of {STEP_MIN:.0%} within; measure pwm.duty_min, pwm.duty_max and its curve"
        )
    return low, high
