"""From rates along the path to timed changes of duty: each ahead of its crossing by its lag."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class LagModel:
    """Identified lags, seconds from the order at the output (accuracy: volume-equivalent).

    `on_s`, `off_s`, `up_s`, `down_s` are volume-equivalent; `on_start_s` is order to first flow
    and `off_end_s` order to less than 2 % of it (the two ends that the border rule needs);
    `output_s` is the delay of the output path; `position_s` how old the position is when the
    autopilot sends it.
    """

    on_s: float
    off_s: float
    up_s: float
    down_s: float
    on_start_s: float
    off_end_s: float
    output_s: float
    position_s: float = 0.0

    def __post_init__(self) -> None:
        for name in ("on_s", "off_s", "up_s", "down_s", "on_start_s", "off_end_s", "output_s"):
            value = getattr(self, name)
            if not 0.0 <= value <= 30.0:
                raise ValueError(f"{name} must lie in [0, 30] s, got {value}")
        if not -0.5 <= self.position_s <= 0.5:
            raise ValueError(f"position_s must lie in [-0.5, 0.5] s, got {self.position_s}")
        if not self.on_start_s <= self.on_s:
            raise ValueError("on_start_s (first flow) cannot be later than on_s")
        if not self.off_end_s >= self.off_s:
            raise ValueError("off_end_s (last flow) cannot be earlier than off_s")
