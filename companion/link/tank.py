"""What is left in the tank, once the operator has said that it was filled."""

from __future__ import annotations

# A step that comes later than this was not spraying: the lease had ended.
_STEP_MAX_S = 0.5


class Tank:
    """Counts down from a filling by the flow that was ordered; None until the first filling.

    A display for the operator, not a measurement: nothing opens or closes by it.
    """

    def __init__(self, capacity_l: float | None = None) -> None:
        self.capacity_l = capacity_l
        self.level_l: float | None = None
        self._last: tuple[float, float] | None = None

    def filled(self, litres: float | None) -> bool:
        """Take a filling, 0 for a full tank; return whether it can be one."""
        level_l = self.capacity_l if litres == 0.0 else litres
        most_l = 10_000.0 if self.capacity_l is None else self.capacity_l
        if level_l is None or not 0.0 < level_l <= most_l:
            return False
        self.level_l = level_l
        return True

    def flows(self, flow_l_min: float, now_s: float) -> None:
        """Take the flow from now on."""
        last, self._last = self._last, (flow_l_min, now_s)
        if last is None or self.level_l is None:
            return
        step_s = min(now_s - last[1], _STEP_MAX_S)
        self.level_l = max(self.level_l - last[0] * step_s / 60.0, 0.0)
